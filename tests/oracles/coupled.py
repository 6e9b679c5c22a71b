"""Coupled chains by brute force: a pair of states is one state of a dense chain, whose paths are all listed.

Tables of moves are made by loops over single entries; nothing here is factored, and nothing recurs over time.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from tests.oracles.hmm import enumerate_tape, log_of


class CoupledAnswer(NamedTuple):
    log_evidence: float
    joint: np.ndarray
    gamma: list[np.ndarray]
    xi: list[np.ndarray]
    initial: list[np.ndarray]
    states: np.ndarray
    best: float


def product_table(pairs: list[np.ndarray], own: int) -> np.ndarray:
    """Multiply ``pairs[k][A][N_k][N]`` entry by entry, divide by the sum; ``own`` alone where that is 0."""
    actions, moved = pairs[0].shape[0], pairs[0].shape[-1]
    sizes = [pair.shape[1] for pair in pairs]
    table = np.zeros((actions, *sizes, moved))
    for a, joint in product(range(actions), product(*map(range, sizes))):
        row = np.ones(moved)
        for k, pair in enumerate(pairs):
            row = row * pair[a, joint[k]]
        row = row if row.sum() > 0 else pairs[own][a, joint[own]]
        table[(a, *joint)] = row / max(row.sum(), 1e-300)
    return table


def mixture_table(pairs: list[np.ndarray], weights: np.ndarray) -> np.ndarray:
    actions, moved = pairs[0].shape[0], pairs[0].shape[-1]
    sizes = [pair.shape[1] for pair in pairs]
    table = np.zeros((actions, *sizes, moved))
    for a, joint in product(range(actions), product(*map(range, sizes))):
        for k, pair in enumerate(pairs):
            table[(a, *joint)] += weights[k] * pair[a, joint[k]]
    return table


def dense_chain(
    log_init: tuple[np.ndarray, ...], log_trans: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, np.ndarray, list[tuple[int, ...]]]:
    """Write the chain of joint states out: ``log_init[J]``, ``log_trans[A, J, J]``, and who is who."""
    log_init, log_trans = [log_of(x) for x in log_init], [log_of(x) for x in log_trans]
    joint = list(product(*(range(len(x)) for x in log_init)))
    first = np.array([sum(log_init[c][x] for c, x in enumerate(states)) for states in joint])
    moves = [
        [
            [sum(t[(a, *old, x)] for t, x in zip(log_trans, new, strict=True)) for new in joint]
            for old in joint
        ]
        for a in range(len(log_trans[0]))
    ]
    return first, np.array(moves), joint


def enumerate_coupled(
    log_init: tuple[np.ndarray, ...],
    log_trans: tuple[np.ndarray, ...],
    log_obs: tuple[np.ndarray, ...],
    actions: np.ndarray,
    start: np.ndarray,
    valid: np.ndarray,
) -> CoupledAnswer:
    """Return everything that inference can say about one tape, for any number of chains."""
    first, moves, joint = dense_chain(log_init, log_trans)
    rows = np.array([[sum(x[t, s] for x, s in zip(log_obs, states, strict=True)) for states in joint]
                     for t in range(len(valid))])  # fmt: skip
    dense = enumerate_tape(first, moves, rows, actions, start, valid)
    sizes = [len(x) for x in log_init]
    gamma = [np.zeros((len(valid), n)) for n in sizes]
    xi = [np.zeros((len(moves), *sizes, n)) for n in sizes]
    initial = [np.zeros(n) for n in sizes]
    for (j, states), c in product(enumerate(joint), range(len(sizes))):
        gamma[c][:, states[c]] += dense.gamma[:, j]
        initial[c][states[c]] += dense.initial[j]
        for i, old in enumerate(joint):
            xi[c][(slice(None), *old, states[c])] += dense.xi[:, i, j]
    places = np.array([(-1,) * len(sizes) if s < 0 else joint[s] for s in dense.states])
    together = dense.gamma.reshape(-1, *sizes)
    return CoupledAnswer(dense.log_evidence, together, gamma, xi, initial, places, dense.best)
