"""Baum-Welch by brute force: every path of every trial is enumerated, weighted and credited.

A model is a dict: ``init[N]``, ``trans[A][N][N]``, ``symbols[N][O]``, ``mean[N][D]`` with ``cov[N][D][D]``,
and ``return_mean[N][K]`` with ``return_var[N][K]``. A trial is a dict of equally long lists: ``symbols`` and
``vectors`` (None = missing), ``actions`` (the last is unused), ``returns`` (None = not modelled).
"""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.stats import multivariate_normal, norm


def path_weights(model: dict, trial: dict, theta: float) -> dict[tuple[int, ...], float]:
    """Return the joint density of each path and the trial."""
    steps, states = len(trial["symbols"]), len(model["init"])
    weights = {}
    for path in product(range(states), repeat=steps):
        weight = model["init"][path[0]]
        for t in range(steps):
            weight *= step_density(model, trial, t, path[t], theta)
            if t + 1 < steps:
                weight *= model["trans"][trial["actions"][t]][path[t]][path[t + 1]]
        weights[path] = weight
    return weights


def step_density(model: dict, trial: dict, t: int, state: int, theta: float) -> float:
    density = 1.0
    if trial["symbols"][t] is not None:
        density *= model["symbols"][state][trial["symbols"][t]]
        density *= multivariate_normal.pdf(trial["vectors"][t], model["mean"][state], model["cov"][state])
    if trial["returns"][t] is not None:
        slot = return_slot(model, trial, t)
        spread = np.sqrt(model["return_var"][state][slot])
        density *= norm.pdf(trial["returns"][t], model["return_mean"][state][slot], spread) ** theta
    return density


def return_slot(model: dict, trial: dict, t: int) -> int:
    return trial["actions"][t] if len(model["return_mean"][0]) > 1 else 0


def expected(model: dict, trials: list[dict], theta: float) -> tuple[float, dict]:
    """Return the log-evidence of all trials, and weighted lists of what each state was credited with."""
    states, actions = len(model["init"]), len(model["trans"])
    credit = {
        "init": np.zeros(states),
        "trans": np.zeros((actions, states, states)),
        "symbols": np.zeros_like(model["symbols"]),
        "vectors": [[] for _ in range(states)],
        "returns": [[[] for _ in model["return_mean"][0]] for _ in range(states)],
    }
    evidence = 0.0
    for trial in trials:
        weights = path_weights(model, trial, theta)
        total = sum(weights.values())
        evidence += np.log(total)
        for path, weight in weights.items():
            add_credit(credit, model, trial, path, weight / total)
    return evidence, credit


def add_credit(credit: dict, model: dict, trial: dict, path: tuple[int, ...], share: float) -> None:
    credit["init"][path[0]] += share
    for t, state in enumerate(path):
        if t + 1 < len(path):
            credit["trans"][trial["actions"][t]][state][path[t + 1]] += share
        if trial["symbols"][t] is not None:
            credit["symbols"][state][trial["symbols"][t]] += share
            credit["vectors"][state].append((share, trial["vectors"][t]))
        if trial["returns"][t] is not None:
            credit["returns"][state][return_slot(model, trial, t)].append((share, trial["returns"][t]))


def row_mode(old: np.ndarray, counts: np.ndarray, pseudo: float) -> np.ndarray:
    mass = np.where(old > 0, counts + pseudo, 0)
    return mass / mass.sum(axis=-1, keepdims=True)


def moments(credited: list) -> tuple[float, np.ndarray, np.ndarray]:
    """Return weight, mean and covariance (about the mean) of weighted numbers or vectors."""
    weight = np.array([w for w, _ in credited])
    x = np.array([np.atleast_1d(v) for _, v in credited])
    mean = (weight[:, None] * x).sum(0) / weight.sum()
    away = x - mean
    return weight.sum(), mean, np.einsum("k,ki,kj->ij", weight, away, away) / weight.sum()


def em_step(model: dict, trials: list[dict], theta: float, prior) -> tuple[dict, float]:
    """Return the re-estimated model and the old one's log-evidence. Variances are assumed over the floor."""
    evidence, credit = expected(model, trials, theta)
    vectors = [moments(credited) for credited in credit["vectors"]]
    returns = [[moments(credited) for credited in row] for row in credit["returns"]]
    new = {
        "init": row_mode(model["init"], credit["init"], prior.initial),
        "trans": row_mode(model["trans"], credit["trans"], prior.transition),
        "symbols": row_mode(model["symbols"], credit["symbols"], prior.observation),
        "mean": np.array([mean for _, mean, _ in vectors]),
        "cov": np.array([cov for _, _, cov in vectors]),
        "return_mean": np.array([[mean[0] for _, mean, _ in row] for row in returns]),
        "return_var": np.array([[cov[0, 0] for _, _, cov in row] for row in returns]),
    }
    return new, evidence
