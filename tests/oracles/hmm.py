"""Inference by brute force: every path of every trial on a tape is listed and weighed, in float64 logarithms.

No recursion over time, so nothing in common with the kernels. Zero probability is ``-inf`` here.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

ABSENT = -1e30
"""What the library adds to the log-evidence for an impossible step, and writes for the logarithm of zero."""


class Answer(NamedTuple):
    log_evidence: float
    gamma: np.ndarray
    xi: np.ndarray
    initial: np.ndarray
    states: np.ndarray
    best: float


def log_of(x: np.ndarray) -> np.ndarray:
    """Turn the library's logarithms (finite for zero) into true ones."""
    x = np.asarray(x, np.float64)
    return np.where(x > ABSENT / 2, x, -np.inf)


def trials_of(start: np.ndarray, valid: np.ndarray) -> list[list[int]]:
    """List the steps of each trial: a trial begins at a start, at the tape's first step, or after padding."""
    trials: list[list[int]] = []
    for t in range(len(valid)):
        if not valid[t]:
            continue
        if start[t] or t == 0 or not valid[t - 1]:
            trials.append([])
        trials[-1].append(t)
    return trials


def path_weights(
    log_init: np.ndarray, log_trans: np.ndarray, rows: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """List all paths of one trial, ``[P, L]``, and the log-weight of each."""
    paths = np.array(list(product(range(len(log_init)), repeat=len(rows))))
    weight = log_init[paths[:, 0]].copy()
    for t in range(len(rows)):
        weight = weight + rows[t, paths[:, t]]
        if t + 1 < len(rows):
            weight = weight + log_trans[actions[t], paths[:, t], paths[:, t + 1]]
    return paths, weight


def without_impossible(
    log_init: np.ndarray, log_trans: np.ndarray, rows: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, int]:
    """Blank the rows that no path of positive weight so far can have emitted; count them."""
    rows, ignored = rows.copy(), 0
    for t in range(len(rows)):
        _, weight = path_weights(log_init, log_trans, rows[: t + 1], actions)
        if not np.isfinite(weight).any():
            rows[t], ignored = 0.0, ignored + 1
    return rows, ignored


def enumerate_tape(
    log_init: np.ndarray,
    log_trans: np.ndarray,
    log_obs: np.ndarray,
    actions: np.ndarray,
    start: np.ndarray,
    valid: np.ndarray,
) -> Answer:
    """Return everything that inference can say about one tape."""
    log_init, log_trans, log_obs = log_of(log_init), log_of(log_trans), log_of(log_obs)
    gamma, xi = np.zeros_like(log_obs), np.zeros_like(log_trans)
    initial, states = np.zeros_like(log_init), np.full(len(valid), -1)
    log_evidence = best = 0.0
    for steps in trials_of(start, valid):
        rows, ignored = without_impossible(log_init, log_trans, log_obs[steps], actions[steps])
        paths, weight = path_weights(log_init, log_trans, rows, actions[steps])
        peak = weight.max()
        share = np.exp(weight - peak)
        log_evidence += peak + np.log(share.sum()) + ignored * ABSENT
        share /= share.sum()
        for k, t in enumerate(steps):
            np.add.at(gamma[t], paths[:, k], share)
            if k + 1 < len(steps):
                np.add.at(xi[actions[t]], (paths[:, k], paths[:, k + 1]), share)
        initial += gamma[steps[0]]
        states[steps] = paths[weight.argmax()]
        best += peak + ignored * ABSENT
    return Answer(log_evidence, gamma, xi, initial, states, best)
