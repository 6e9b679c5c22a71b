"""A chain with a memory by brute force: paths of (active, remembered) are listed, and every choice weighed.

What is listed for each step is the whole event: was the active state noted, who led, where did it go. Nothing
recurs over time, and no table of pairs is shared with the kernels.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from tests.oracles.hmm import trials_of


class MemoryAnswer(NamedTuple):
    log_evidence: float
    gamma: np.ndarray
    held: np.ndarray
    xi: np.ndarray
    initial: np.ndarray
    chain: np.ndarray
    lead: np.ndarray
    heed: np.ndarray
    note: np.ndarray


class Step(NamedTuple):
    """One way to go on: who led (0 the chain), was it noted (0 yes), from, remembered then, to."""

    leader: int
    choice: int
    old: int
    before: int
    held: int
    new: int


def steps_from(n: int, active: int, remembered: int) -> list[Step]:
    return [
        Step(leader, choice, active, remembered, (active, remembered)[choice], new)
        for leader, choice, new in product((0, 1), (0, 1), range(n))
    ]


def chance(model: list[np.ndarray], action: int, step: Step) -> float:
    _, trans, lead, heed, note = model
    row = trans[action][step.old] if step.leader == 0 else lead[action][step.held]
    return note[step.before][step.choice] * heed[step.held][step.leader] * row[step.new]


def paths(model: list[np.ndarray], density: np.ndarray, actions: np.ndarray) -> list[tuple[list, float]]:
    """List every trial's events with their weight, those of no weight left out."""
    n = len(model[0])
    found = [([first], model[0][first] * density[0, first]) for first in range(n)]
    for t in range(1, len(density)):
        longer = []
        for path, weight in found:
            last = path[-1]
            here = (last, last) if len(path) == 1 else (last.new, last.held)
            for step in steps_from(n, *here):
                more = weight * chance(model, actions[t - 1], step) * density[t, step.new]
                if more > 0:
                    longer.append(([*path, step], more))
        found = longer
    return found


def enumerate_memory(log_chain, log_obs, actions, start, valid) -> MemoryAnswer:
    """Return everything that inference can say about one tape."""
    model = [np.exp(np.asarray(x, float)) for x in log_chain]
    shapes = (log_obs.shape, log_obs.shape, model[1].shape, model[0].shape)
    tables = (model[1].shape, model[2].shape, model[3].shape, model[4].shape)
    it = MemoryAnswer(0.0, *(np.zeros(shape) for shape in (*shapes, *tables)))
    evidence = 0.0
    for where in trials_of(start, valid):
        found = paths(model, np.exp(log_obs[where]), actions[where])
        total = sum(weight for _, weight in found)
        evidence += np.log(total)
        for path, weight in found:
            credit(it, path, weight / total, where, actions)
    return it._replace(log_evidence=evidence)


def credit(it: MemoryAnswer, path: list, share: float, where: list[int], actions: np.ndarray) -> None:
    it.initial[path[0]] += share
    it.gamma[where[0], path[0]] += share
    it.held[where[0], path[0]] += share
    for t, step in zip(where[1:], path[1:], strict=True):
        action = actions[t - 1]
        it.gamma[t, step.new] += share
        it.held[t, step.held] += share
        it.xi[action, step.old, step.new] += share
        it.heed[step.held, step.leader] += share
        it.note[step.before, step.choice] += share
        if step.leader == 0:
            it.chain[action, step.old, step.new] += share
        else:
            it.lead[action, step.held, step.new] += share
