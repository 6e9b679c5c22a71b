"""Which edits are made in a phase: budget, node cap, rest for what was edited lately; and their log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxpomdp.structure.edits import Allowance, Edit, Operator, compose
from jaxpomdp.structure.splits import STATE_SPLIT, SplitConfig


@dataclass(frozen=True)
class PolicyConfig:
    """How much the structure may change.

    Raises:
        ValueError: a setting is out of its range.
    """

    node_cap: int = 70
    """states at most"""
    edits_per_phase: int = 1
    """edits in one phase at most"""
    every: int = 1
    """edit in every so many-th phase"""
    first_phase: int = 0
    """phases before this one edit nothing"""
    cool_down: int = 0
    """phases for which a state that was edited (and its copies) is left alone"""
    order: Literal["given", "rotate"] = "given"
    """which operator has the first say: always the first, or each in turn, phase by phase"""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if self.order not in ("given", "rotate"):
            raise ValueError(f"order must be 'given' or 'rotate', got {self.order!r}")
        least = {"node_cap": 1, "edits_per_phase": 0, "every": 1, "first_phase": 0, "cool_down": 0}
        for name, number in least.items():
            if getattr(self, name) < number:
                raise ValueError(f"{name} must be at least {number}, got {getattr(self, name)}")


STATE_SPLITS = ((STATE_SPLIT, SplitConfig()),)
"""The flat model's operators (thesis 3.3), at their defaults."""


class Revision(NamedTuple):
    """A spec after a phase's edits.

    Attributes:
        spec: the new spec; the very same object when nothing was edited.
        origin: ``[N']`` ints, the state of the old spec that each state comes from.
        rest: ``[N']`` ints, phases for which each state is still left alone.
        rows: a JSON-friendly row per edit.
    """

    spec: Any
    origin: np.ndarray
    rest: np.ndarray
    rows: list[dict[str, Any]]


def revise(
    spec: Any,
    evidence: Any,
    *,
    phase: int,
    rest: np.ndarray | None = None,
    policy: PolicyConfig = PolicyConfig(),
    operators: Sequence[tuple[Operator, Any]] = STATE_SPLITS,
    rng: np.random.Generator | None = None,
) -> Revision:
    """Let the operators, in order, propose edits and apply the best that the policy allows.

    Args:
        spec: the model; needs ``num_states``.
        evidence: what the operators need to propose.
        phase: number of the phase, from 0.
        rest: ``[N]`` from the last revision; ``None``: no state rests.
        policy: the settings.
        operators: pairs of an operator and its config.
        rng: source of random numbers for the operators, made from (seed, phase) by the caller.

    Raises:
        ValueError: the spec is over the node cap, or ``rest`` has another length.
    """
    if spec.num_states > policy.node_cap:
        raise ValueError(f"spec must have at most node_cap={policy.node_cap} states, got {spec.num_states}")
    waiting = np.zeros(spec.num_states, int) if rest is None else np.asarray(rest)
    if waiting.shape != (spec.num_states,):
        raise ValueError(f"rest must have shape ({spec.num_states},), got {waiting.shape}")
    fewer = np.maximum(waiting - 1, 0)
    if phase < policy.first_phase or (phase - policy.first_phase) % policy.every:
        return Revision(spec, np.arange(spec.num_states), fewer, [])
    chosen = _choose(spec, evidence, waiting > 0, policy, _in_turn(operators, policy, phase), rng)
    return _apply_all(spec, chosen, fewer, policy, phase)


def _in_turn(
    operators: Sequence[tuple[Operator, Any]], policy: PolicyConfig, phase: int
) -> list[tuple[Operator, Any]]:
    """Return the operators, the one whose turn it is first."""
    turn = (phase - policy.first_phase) // policy.every if policy.order == "rotate" else 0
    first = turn % max(len(operators), 1)
    return [*operators[first:], *operators[:first]]


def _choose(
    spec: Any,
    evidence: Any,
    resting: np.ndarray,
    policy: PolicyConfig,
    operators: Sequence[tuple[Operator, Any]],
    rng: np.random.Generator | None,
) -> list[tuple[Operator, Edit]]:
    """Collect edits up to the budget, no two of one state or branch, shrunk to the room that is left."""
    room, taken = policy.node_cap - spec.num_states, resting.copy()
    edited = np.zeros(spec.num_states, bool)
    chosen: list[tuple[Operator, Edit]] = []
    for operator, config in operators:
        allowance = Allowance(room, policy.edits_per_phase - len(chosen), taken, rng)
        for edit in operator.propose(spec, evidence, config, allowance):
            fitting = operator.shrink(edit, room) if room > 0 else None
            touched = [] if fitting is None else [fitting.node, *fitting.copied]
            if fitting is not None and not edited[touched].any():
                chosen.append((operator, fitting))
                room -= len(fitting.copied)
                taken[touched], edited[touched] = True, True
    return chosen


def _apply_all(
    spec: Any, chosen: list[tuple[Operator, Edit]], rest: np.ndarray, policy: PolicyConfig, phase: int
) -> Revision:
    origin, rows = np.arange(spec.num_states), []
    for operator, edit in chosen:
        edit = edit.moved(spec.num_states)
        spec = operator.apply(spec, edit)
        origin, rest = compose(origin, edit.origin), rest[edit.origin]
        rest[edit.origin == edit.node] = policy.cool_down
        rows.append({"phase": phase} | edit.row())
    return Revision(spec, origin, rest, rows)
