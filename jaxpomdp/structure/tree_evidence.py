"""What experience says about each leaf of a tree by the leaf that was active one step before.

Every condition that an operator asks about (a brother, an uncle, the parent entered from outside) is a set of
previous leaves, so tables by previous leaf hold them all; ``conditioned`` adds them up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxpomdp.structure.evidence import bin_of
from jaxpomdp.structure.spec import expect_shape


class TreeEvidence(NamedTuple):
    """Belief-weighted tables by previous leaf k and leaf l; first steps of trials are left out.

    Attributes:
        transitions: ``[A, N, N]``, how often l followed k under each action.
        symbols: ``[N, N, O]``, what was seen in l after k.
        returns: ``[N, N, A, bins]``, the return from l on after k, by the action taken in l.
        sums: ``[N, N, A, 2]``, sums of that return and of its square.
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
        expect_shape("evidence.symbols", self.symbols, (n, n, None))
        expect_shape("evidence.returns", self.returns, (n, n, a, len(self.edges) - 1))
        expect_shape("evidence.sums", self.sums, (n, n, a, 2))


def conditioned(table: np.ndarray, leaf: int, groups: np.ndarray) -> np.ndarray:
    """Return ``[C, ...]``: the entries ``table[:, leaf]`` added up over the previous leaves of each group.

    Args:
        table: ``[N, N, ...]``.
        leaf: the leaf in question.
        groups: weights ``[C, N]``, such as rows of ``TreeSpec.below``.
    """
    return np.tensordot(groups.astype(float), table[:, leaf], 1)


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
        pairs: ``[T, N, N]``, how probable it is that k was active at step t - 1 and l at t; zero at starts.
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
        np.einsum("tkl,ta->akl", pairs, before),
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
