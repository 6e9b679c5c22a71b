"""A hierarchical model by the literal flow of activity: an absorbing chain of enter and exit steps.

``enter(n)``: n has been activated; a leaf emits (the flow is absorbed there), an internal one picks a child.
``exit(n)``: n's turn is over; it picks a sibling, itself, or the end, which makes its parent's turn over.
Nothing here knows of lowest common ancestors or of shortest ways; internal states may follow themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Flow(NamedTuple):
    """Chance of each step of one table of transitions: ``moves[2M, 2M]`` (enter(n) = n, exit(n) = M + n)."""

    moves: np.ndarray
    leaves: int
    nodes: int


def flow(parent: np.ndarray, leaves: int, vertical: np.ndarray, horizontal: np.ndarray | None) -> Flow:
    """Build the steps from ``vertical[I, M]`` and ``horizontal[M, M+1]``; the root never exits."""
    nodes = len(parent)
    moves = np.zeros((2 * nodes, 2 * nodes))
    for node in range(leaves, nodes):
        for child in range(nodes):
            if parent[child] == node:
                moves[node, child] += vertical[node - leaves, child]
    for node in range(nodes):
        if parent[node] < 0 or horizontal is None:
            continue
        for other in range(nodes):
            if parent[other] == parent[node]:
                moves[nodes + node, other] += horizontal[node, other]
        moves[nodes + node, nodes + parent[node]] += horizontal[node, nodes]
    return Flow(moves, leaves, nodes)


def absorbed(it: Flow) -> tuple[np.ndarray, np.ndarray]:
    """Return chances ``[2M, N]`` that the flow from each step is absorbed in each leaf, and mean visits."""
    moves = it.moves.copy()
    moves[: it.leaves] = 0
    visits = np.linalg.inv(np.eye(len(moves)) - moves)
    return visits[:, : it.leaves], visits


def tables(spec) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return probabilities: vertical at starts ``[I, M]``, under actions ``[A, I, M]``, and horizontal."""
    vertical, horizontal = np.exp(spec.log_vertical), np.exp(spec.log_horizontal)
    later = vertical[:-1] if len(vertical) > 1 else np.repeat(vertical, len(horizontal), 0)
    return vertical[-1], later, horizontal


def flat_of(spec) -> tuple[np.ndarray, np.ndarray]:
    """Return ``init[N]`` and ``T*[A, N, N]``."""
    start, later, horizontal = tables(spec)
    n, m = spec.num_states, spec.num_nodes
    init = absorbed(flow(spec.parent, n, start, None))[0][n]
    trans = [
        absorbed(flow(spec.parent, n, pi, t))[0][m : m + n] for pi, t in zip(later, horizontal, strict=True)
    ]
    return init, np.array(trans)


def credited(it: Flow, begin: int, leaf: int) -> np.ndarray:
    """Return how often each step is expected on the way from ``begin``, given that it ends in ``leaf``."""
    chance, visits = absorbed(it)
    moves = it.moves.copy()
    moves[: it.leaves] = 0
    return visits[begin][:, None] * moves * chance[:, leaf][None, :] / chance[begin, leaf]


def counts_of(spec, initial: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Credit every edge of every way: ``vertical[A + 1, I, M]``, starts last; ``horizontal[A, M, M+1]``."""
    start, later, horizontal = tables(spec)
    n, m, root = spec.num_states, spec.num_nodes, spec.root
    down = np.zeros((len(horizontal) + 1, m - n, m))
    across = np.zeros_like(horizontal)
    at_start = flow(spec.parent, n, start, None)
    for leaf in range(n):
        if initial[leaf] > 0:
            down[-1] += initial[leaf] * credited(at_start, root, leaf)[n:m, :m]
    for a, counts in enumerate(xi):
        it = flow(spec.parent, n, later[a], horizontal[a])
        for k, leaf in np.argwhere(counts > 0):
            ways = counts[k, leaf] * credited(it, m + k, leaf)
            down[a] += ways[n:m, :m]
            across[a, :, :m] += ways[m:, :m]
            for node in range(m):
                if node != root:
                    across[a, node, m] += ways[m + node, m + spec.parent[node]]
    return down, across
