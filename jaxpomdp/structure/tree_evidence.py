"""What experience says about each leaf of a tree by the leaf that was active one step before.

Every condition that an operator asks about (a brother, an uncle, the parent entered from outside) is a set of
previous leaves, or the start of a trial, so tables by what was before hold them all; ``conditioned`` adds
them up, and ``effective`` says how many observations a sum is worth.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxpomdp.structure.evidence import bin_of
from jaxpomdp.structure.spec import expect_shape


class TreeEvidence(NamedTuple):
    """Belief-weighted tables by previous leaf k and leaf l; the last k, number N, is the start of a trial.

    Attributes:
        transitions: ``[A, N, N]``, how often l followed k under each action.
        symbols: ``[N+1, N, O]``, what was seen in l after k.
        returns: ``[N+1, N, A, bins]``, the return from l on after k, by the action taken in l.
        sums: ``[N+1, N, A, 2]``, sums of that return and of its square.
        edges: ``[bins + 1]``, of the bins, as in ``ReturnEvidence``.
    """

    transitions: np.ndarray
    symbols: np.ndarray
    returns: np.ndarray
    sums: np.ndarray
    edges: np.ndarray

    def check(self, num_states: int, num_actions: int) -> None:
        """Stop unless the tables are of so many leaves and actions.

        Raises:
            ValueError: naming the table.
        """
        n, a = num_states, num_actions
        expect_shape("evidence.transitions", self.transitions, (a, n, n))
        expect_shape("evidence.symbols", self.symbols, (n + 1, n, None))
        expect_shape("evidence.returns", self.returns, (n + 1, n, a, len(self.edges) - 1))
        expect_shape("evidence.sums", self.sums, (n + 1, n, a, 2))


def conditioned(table: np.ndarray, leaf: int, groups: np.ndarray) -> np.ndarray:
    """Return ``[C, ...]``: the entries ``table[:, leaf]`` added up over what each group holds.

    Args:
        table: ``[N+1, N, ...]``.
        leaf: the leaf in question.
        groups: weights ``[C, N+1]`` between 0 and 1, of previous leaves and of starts.
    """
    return np.tensordot(groups.astype(float), table[:, leaf], 1)


def effective(table: np.ndarray, leaf: int, groups: np.ndarray) -> np.ndarray:
    """Return conditioned histograms ``[C, ..., bins]`` whose weight is the observations that they are worth.

    A weighted sum of independent observations varies as if there were ``(sum w)^2 / sum w^2`` of them (Kish
    1965). An observation with the leaf k before it with probability ``x_k`` has the weight ``w = sum_k g_k
    x_k`` in a group g, and ``w^2 <= sum_k g_k^2 x_k`` (Jensen), with equality where k is known. So the
    histogram is scaled by ``sum_k g_k n_k / sum_k g_k^2 n_k``, n the weights of its rows: by one where a
    group is a set, by more where it is a soft share of each k, never by too much.

    Args:
        table: ``[N+1, N, ..., bins]``.
        leaf: the leaf in question.
        groups: as for ``conditioned``.
    """
    groups = groups.astype(float)
    weight = table[:, leaf].sum(-1)
    first, second = np.tensordot(groups, weight, 1), np.tensordot(groups**2, weight, 1)
    scale = np.where(second > 0, first / np.where(second > 0, second, 1), 1)
    return conditioned(table, leaf, groups) * scale[..., None]


def tree_evidence(
    pairs: np.ndarray,
    actions: np.ndarray,
    symbols: np.ndarray,
    returns: np.ndarray,
    edges: np.ndarray,
    *,
    num_actions: int,
    num_symbols: int,
    has_return: np.ndarray | None = None,
) -> TreeEvidence:
    """Gather the evidence of one tape: the readable definition of what the device does.

    Args:
        pairs: ``[T, N+1, N]``, how probable it is that k was active at step t - 1 and l at t; at the first
            step of a trial only the last row is used.
        actions: int ``[T]``.
        symbols: int ``[T]``, what was seen; -1 where nothing was.
        returns: ``[T]``.
        edges: ``[bins + 1]``.
        num_actions: A.
        num_symbols: O.
        has_return: bool ``[T]``; all if None.
    """
    paid = np.ones(len(returns)) if has_return is None else np.asarray(has_return, float)
    before = np.eye(num_actions)[np.roll(actions, 1)]
    seen = np.eye(num_symbols + 1)[symbols][:, :num_symbols]
    taken = np.eye(num_actions)[actions] * paid[:, None]
    place = np.eye(len(edges) - 1)[bin_of(returns, edges)]
    powers = np.stack([returns, returns**2], -1)
    return TreeEvidence(
        np.einsum("tkl,ta->akl", pairs[:, :-1], before),
        np.einsum("tkl,to->klo", pairs, seen),
        np.einsum("tkl,ta,tb->klab", pairs, taken, place),
        np.einsum("tkl,ta,tp->klap", pairs, taken, powers),
        np.asarray(edges, float),
    )


def mean_and_var(weight: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted mean and variance from ``weight[...]`` and ``sums[..., 2]``; zeros without weight."""
    some = np.where(weight > 0, weight, 1)
    mean = sums[..., 0] / some
    return mean, np.maximum(sums[..., 1] / some - mean**2, 0)
