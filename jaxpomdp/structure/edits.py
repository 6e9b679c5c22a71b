"""Edits of a model's structure: what every operator proposes and applies, and the cloning they share.

An edit keeps every old state in its place and appends the new ones, so edits found on one spec can be
applied one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.structure.spec import NEG, FlatSpec, expect_shape, safe_log


@dataclass(frozen=True)
class Edit:
    """A change of structure that evidence calls for.

    Attributes:
        kind: name of the operator.
        node: the state (or tree node) that is edited.
        num_states: states before the edit, N.
        copied: the old state of each state that is appended.
        score: rank among the operator's edits; higher goes first.
        statistic: the test's statistic.
        p_value: corrected for the number of tests.
        effect: the test's effect size.
        weight: weight of the evidence.
        details: what the operator needs to apply it; has ``row()`` giving a JSON-friendly dict.
    """

    kind: str
    node: int
    num_states: int
    copied: tuple[int, ...]
    score: float
    statistic: float
    p_value: float
    effect: float
    weight: float
    details: Any

    @property
    def origin(self) -> np.ndarray:
        """``[N + copies]`` ints: the old state that each new state comes from."""
        return np.concatenate([np.arange(self.num_states), np.array(self.copied, int)])

    def moved(self, num_states: int) -> Edit:
        """Return the edit for a spec that has grown to ``num_states`` since it was proposed."""
        return replace(self, num_states=num_states)

    def stop_unless(self, kind: str, num_states: int) -> None:
        """Stop unless this is an edit of ``kind`` for a spec of ``num_states``.

        Raises:
            ValueError: it is for another number of states, or of another kind.
        """
        if self.kind != kind or self.num_states != num_states:
            raise ValueError(
                f"edit must be of kind {kind!r} for {num_states} states, "
                f"got {self.kind!r} for {self.num_states} (see Edit.moved)"
            )

    def row(self) -> dict[str, Any]:
        """Return the edit as a JSON-friendly row for the log."""
        row = {"operator": self.kind, "node": self.node, "copied": list(self.copied), "score": self.score}
        test = {name: getattr(self, name) for name in ("statistic", "p_value", "effect", "weight")}
        sizes = {"states_before": self.num_states, "states_after": self.num_states + len(self.copied)}
        return row | test | sizes | self.details.row()


class Allowance(NamedTuple):
    """What an operator may propose in one phase.

    Attributes:
        room: states that may still be added.
        edits: edits wanted at most.
        resting: bool ``[N]``, states that must be left alone; ``None``: none.
        rng: source of random numbers; ``None``: the operator draws none.
    """

    room: int = 1_000_000
    edits: int = 1_000_000
    resting: np.ndarray | None = None
    rng: np.random.Generator | None = None

    def free(self, num_states: int) -> np.ndarray:
        """Return bool ``[N]``: states that may be edited.

        Raises:
            ValueError: ``resting`` has another length.
        """
        if self.resting is None:
            return np.ones(num_states, bool)
        expect_shape("resting", np.asarray(self.resting), (num_states,))
        return ~np.asarray(self.resting, bool)


UNLIMITED = Allowance()
"""No limits, no random numbers."""


class Operator(NamedTuple):
    """A kind of edit as three functions.

    Attributes:
        kind: its name.
        propose: ``(spec, evidence, config, allowance) -> list[Edit]``, best first.
        shrink: ``(edit, room) -> Edit | None``, the edit with at most ``room >= 1`` new states, if any.
        apply: ``(spec, edit) -> spec``, a pure function.
    """

    kind: str
    propose: Callable[..., list[Edit]]
    shrink: Callable[[Edit, int], Edit | None]
    apply: Callable[[FlatSpec, Edit], FlatSpec]


class Shares(NamedTuple):
    """How what led to one state is shared out among its m copies; every last axis sums to one.

    Attributes:
        initial: ``[m]``, of the probability of starting there.
        incoming: ``[A, N, m]`` (or 1 for A), of the transition from each other old state.
        among: ``[A, m, m]`` (or 1 for A), of the self-transition, from copy (row) to copy (column).
    """

    initial: np.ndarray
    incoming: np.ndarray
    among: np.ndarray


def grown(num_states: int, node: int, copies: int) -> np.ndarray:
    """Return the origin of a state becoming ``copies``: the first keeps its place, the others are appended.

    >>> grown(3, 1, 2).tolist()
    [0, 1, 2, 1]
    """
    return np.concatenate([np.arange(num_states), np.full(copies - 1, node)])


def compose(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the origin of two edits made one after the other: ``first[second]``."""
    return np.asarray(first)[np.asarray(second)]


def clone_state(spec: FlatSpec, node: int, shares: Shares) -> FlatSpec:
    """Copy a state m times; copies share what leads there and keep everything else.

    Every copy leaves and emits as its ancestor and enters the whole class of copies as its ancestor entered
    itself, so the evidence of observations is the same for any shares (strong lumpability).

    Args:
        spec: the model.
        node: the state.
        shares: see ``Shares``.

    Raises:
        ValueError: no such state, or shares that do not fit or do not sum to one.
    """
    copies = len(shares.initial)
    _check_shares(spec, node, shares, copies)
    origin = grown(spec.num_states, node, copies)
    columns = np.concatenate([[node], np.arange(spec.num_states, len(origin))])
    log_init = spec.log_init[origin]
    log_init[columns] = _shared(log_init[columns], shares.initial)
    log_trans = spec.log_trans[:, origin][:, :, origin]
    table = np.array(np.broadcast_to(shares.incoming, (spec.num_actions, spec.num_states, copies)))[:, origin]
    table[:, columns] = shares.among
    log_trans[:, :, columns] = _shared(log_trans[:, :, columns], table)
    return FlatSpec(
        log_init,
        log_trans,
        tuple(channel.take(origin) for channel in spec.emissions),
        spec.return_mean[origin],
        spec.return_var[origin],
    )


def even_shares(copies: int) -> np.ndarray:
    """Return ``[m]`` equal shares (thesis 3.3)."""
    return np.full(copies, 1 / copies)


def sticky_among(shares: np.ndarray, stay: float) -> np.ndarray:
    """Return ``[m, m]``: ``stay`` to a copy itself, the rest to the others in proportion to their shares.

    >>> sticky_among(np.array([0.5, 0.25, 0.25]), 0.9).round(3).tolist()
    [[0.9, 0.05, 0.05], [0.067, 0.9, 0.033], [0.067, 0.033, 0.9]]
    """
    copies = len(shares)
    others = np.where(np.eye(copies, dtype=bool), 0.0, shares)
    total = others.sum(1, keepdims=True)
    even = (1 - np.eye(copies)) / max(copies - 1, 1)
    others = np.where(total > 0, others / np.where(total > 0, total, 1), even)
    return np.eye(copies) * stay + others * (1 - stay)


def jittered(shares: np.ndarray, jitter: float, rng: np.random.Generator) -> np.ndarray:
    """Return shares times ``exp(jitter * standard normal)``, normalised along the last axis."""
    noisy = shares * np.exp(jitter * rng.standard_normal(shares.shape))
    return noisy / noisy.sum(-1, keepdims=True)


def _shared(log_prob: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Return ``log(p * share)``, ``NEG`` where either is zero, in the type of ``log_prob``."""
    log_share = safe_log(np.asarray(share, float))
    absent = (log_prob <= NEG / 2) | (log_share <= NEG / 2)
    return np.where(absent, NEG, log_prob + log_share).astype(log_prob.dtype)


def _check_shares(spec: FlatSpec, node: int, shares: Shares, copies: int) -> None:
    if not 0 <= node < spec.num_states:
        raise ValueError(f"node must be a state 0 .. {spec.num_states - 1}, got {node}")
    a, n = spec.num_actions, spec.num_states
    wanted: dict[str, Sequence[int]] = {"incoming": (a, n, copies), "among": (a, copies, copies)}
    for name, shape in wanted.items():
        array = getattr(shares, name)
        expect_shape(f"shares.{name}", array, (a if array.shape[:1] != (1,) else 1, *shape[1:]))
    for name, array in shares._asdict().items():
        if (array < 0).any() or (np.abs(array.sum(-1) - 1) > 1e-9).any():
            raise ValueError(f"shares.{name} must be positive and sum to 1 along the last axis")
