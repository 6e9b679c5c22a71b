"""Worlds made of worlds."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.envs.build import Outcomes, assemble, merge, tabulate
from jaxpomdp.envs.world import World


def noisy(world: World, *, action: float = 0.1, observation: float = 0.1, reward: float = 0.1) -> World:
    """Return the world with the noise of thesis section 3.5.1, worked into its tables.

    With probability ``action`` an action drawn uniformly of all is done instead; with probability
    ``observation`` a random symbol is seen instead, drawn uniformly of those not reserved for the end of a
    trial (the end itself is always seen); and uniform(-``reward``, ``reward``) is added to every reward.

    Raises:
        ValueError: a probability is outside [0, 1], ``reward`` is negative, or ``action`` > 0 in a world
            whose observation depends on the action (tables cannot say which action was really done).

    Example:
        >>> from jaxpomdp.envs.hallway import hallway_navigation
        >>> noisy(hallway_navigation()).name
        'hallway-noise'
    """
    for name, value in (("action", action), ("observation", observation)):
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be a probability in [0, 1], got {value}")
    if reward < 0:
        raise ValueError(f"reward must not be negative, got {reward}")
    if action > 0 and world.observation_prob.shape[0] > 1:
        raise ValueError(f"action must be 0 in {world.name!r}, which shows what was done, got {action}")
    shown, first = _float64(world.observation_prob), _float64(world.first_observation_prob)
    return assemble(
        tabulate(_mixed_actions(world, action)),
        _mixed_observations(world, shown, observation),
        _float64(world.start_prob),
        np.asarray(world.terminal),
        first_observation=_mixed_observations(world, first, observation),
        reward_noise=float(world.reward_noise) + reward,
        **static_of(world) | {"name": f"{world.name}-noise"},
    )


def limited(world: World, step_limit: int) -> World:
    """Return the world with trials of at most ``step_limit`` actions.

    Raises:
        ValueError: ``step_limit`` is below 1.
    """
    if step_limit < 1:
        raise ValueError(f"step_limit must be at least 1, got {step_limit}")
    return replace(world, step_limit=step_limit)


def static_of(world: World) -> dict[str, Any]:
    """Return the static fields of a world by name."""
    return {f.name: getattr(world, f.name) for f in fields(world) if f.metadata.get("static")}


def _float64(array: Array) -> np.ndarray:
    return np.asarray(array, np.float64)


def _rows_of(world: World) -> list[list[Outcomes]]:
    """Return ``outcomes[a][s]`` of a world."""
    successors, reward = np.asarray(world.successors), np.asarray(world.reward)
    tables = zip(successors, reward, _float64(world.transition_prob), strict=True)
    return [[_outcomes(*row) for row in zip(*table, strict=True)] for table in tables]


def _outcomes(successors: np.ndarray, reward: np.ndarray, prob: np.ndarray) -> Outcomes:
    row = zip(successors, reward, prob, strict=True)
    return merge([(p, {(int(to), float(paid)): 1.0}) for to, paid, p in row if p > 0])


def _mixed_actions(world: World, share: float) -> list[list[Outcomes]]:
    """Mix every action's outcomes with those of an action drawn uniformly."""
    rows = _rows_of(world)
    even = 1 / world.num_actions
    drawn = [merge([(even, row) for row in of_state]) for of_state in zip(*rows, strict=True)]
    return [
        [merge([(1 - share, own), (share, other)]) for own, other in zip(r, drawn, strict=True)] for r in rows
    ]


def _mixed_observations(world: World, prob: np.ndarray, share: float) -> np.ndarray:
    """Mix ``prob[..., N, O]`` with uniform noise over the symbols of states that are not terminal."""
    terminal = np.asarray(world.terminal)
    shown = np.asarray(world.observation_prob).max(axis=0) > 0
    reserved = shown[terminal].any(axis=0) & ~shown[~terminal].any(axis=0)
    uniform = ~reserved / (~reserved).sum()
    return np.where(terminal[:, None], prob, (1 - share) * prob + share * uniform)
