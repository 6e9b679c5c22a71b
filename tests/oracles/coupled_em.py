"""One EM step of two coupled chains by brute force: joint paths are listed, and a mixture's choices.

A model is a dict: ``init[c]``, ``pairs[c][k]`` (``[A, N_k, N_c]`` probabilities), ``weights[C, C]``,
``symbols[N_0, O]``, ``return_mean[N_1]`` and ``return_var[N_1]``. A trial has lists ``symbols`` (None =
missing), ``actions`` and ``returns`` (None = not modelled).
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.stats import norm


def emitted(model: dict, trial: dict, t: int, states: tuple[int, int], theta: float) -> float:
    density = 1.0
    if trial["symbols"][t] is not None:
        density *= model["symbols"][states[0]][trial["symbols"][t]]
    if trial["returns"][t] is not None:
        spread = np.sqrt(model["return_var"][states[1]])
        density *= norm.pdf(trial["returns"][t], model["return_mean"][states[1]], spread) ** theta
    return density


def heeded(model: dict, c: int, action: int, old: tuple[int, int], new: int) -> list[float]:
    """Return the probability that chain ``c`` heeds each chain and goes to ``new``."""
    return [model["weights"][c][k] * model["pairs"][c][k][action][old[k]][new] for k in range(2)]


def path_weight(model: dict, trial: dict, path: tuple[tuple[int, int], ...], theta: float) -> float:
    weight = model["init"][0][path[0][0]] * model["init"][1][path[0][1]]
    for t, states in enumerate(path):
        weight *= emitted(model, trial, t, states, theta)
        if t + 1 < len(path):
            for c in range(2):
                weight *= sum(heeded(model, c, trial["actions"][t], states, path[t + 1][c]))
    return weight


def mixture_step(model: dict, trials: list[dict], theta: float, prior) -> tuple[dict, float]:
    """Return the re-estimated mixture and the old one's log-evidence; no variance is at its floor."""
    joint = list(product(*(range(len(x)) for x in model["init"])))
    init = [np.zeros_like(x) for x in model["init"]]
    pairs = [[np.zeros_like(x) for x in row] for row in model["pairs"]]
    symbols, alone = np.zeros_like(model["symbols"]), np.zeros_like(model["pairs"][0][0])
    credited: list[list[tuple[float, float]]] = [[] for _ in model["return_mean"]]
    evidence = 0.0
    for trial in trials:
        paths = list(product(joint, repeat=len(trial["symbols"])))
        weights = np.array([path_weight(model, trial, path, theta) for path in paths])
        evidence += np.log(weights.sum())
        for path, share in zip(paths, weights / weights.sum(), strict=True):
            for c in range(2):
                init[c][path[0][c]] += share
            for t, states in enumerate(path):
                if trial["symbols"][t] is not None:
                    symbols[states[0]][trial["symbols"][t]] += share
                if trial["returns"][t] is not None:
                    credited[states[1]].append((share, trial["returns"][t]))
                if t + 1 == len(path):
                    continue
                action, new = trial["actions"][t], path[t + 1]
                alone[action][states[0]][new[0]] += share
                for c in range(2):
                    each = np.array(heeded(model, c, action, states, new[c]))
                    for k, part in enumerate(share * each / each.sum()):
                        pairs[c][k][action][states[k]][new[c]] += part
    heeds = np.array([[x.sum() for x in row] for row in pairs])
    moments = [weighted_moments(x) for x in credited]
    return {
        "init": [mode(x, prior.initial) for x in init],
        "pairs": [[mode(x, prior.transition) for x in row] for row in pairs],
        "weights": mode(heeds, prior.transition),
        "symbols": mode(symbols, prior.observation),
        "return_mean": np.array([mean for mean, _ in moments]),
        "return_var": np.array([var for _, var in moments]),
        "alone": mode(alone, prior.transition),
    }, evidence


def mode(counts: np.ndarray, pseudo: float) -> np.ndarray:
    mass = counts + pseudo
    return mass / mass.sum(axis=-1, keepdims=True)


def weighted_moments(credited: list[tuple[float, float]]) -> tuple[float, float]:
    weight, x = (np.array(column) for column in zip(*credited, strict=True))
    mean = (weight * x).sum() / weight.sum()
    return mean, (weight * (x - mean) ** 2).sum() / weight.sum()
