"""Worlds made of worlds."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jaxpomdp.envs.build import Outcomes, assemble, merge, tabulate
from jaxpomdp.envs.world import World


def noisy(world: World, *, action: float = 0.1, observation: float = 0.1, reward: float = 0.1) -> World:
    """Return the world with the noise of thesis section 3.5.1, worked into its tables.

    With probability ``action`` an action drawn uniformly of all is done instead; with probability ``observation``
    a random symbol is seen instead, drawn uniformly of those that are not reserved for the end of a trial (the end
    itself is always seen); and uniform(-``reward``, ``reward``) is added to every reward.

    Raises:
        ValueError: a probability is outside [0, 1], ``reward`` is negative, or ``action`` > 0 in a world whose
            observation depends on the action (tables cannot say which action was really done).

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
        raise ValueError(f"action must be 0 in {world.name!r}: its observation depends on the action, got {action}")
    return assemble(
        tabulate(_mixed_actions(world, action)),
        _mixed_observations(world, np.asarray(world.observation_prob, np.float64), observation),
        np.asarray(world.start_prob, np.float64),
        np.asarray(world.terminal),
        first_observation=_mixed_observations(
            world, np.asarray(world.first_observation_prob, np.float64), observation
        ),
        reward_noise=float(world.reward_noise) + reward,
        **_static_of(world, name=f"{world.name}-noise"),
    )


def limited(world: World, step_limit: int) -> World:
    """Return the world with trials of at most ``step_limit`` actions.

    Raises:
        ValueError: ``step_limit`` is below 1.
    """
    if step_limit < 1:
        raise ValueError(f"step_limit must be at least 1, got {step_limit}")
    return replace(world, step_limit=step_limit)


def _static_of(world: World, **changed: Any) -> dict[str, Any]:
    kept = ("name", "discount", "step_limit", "success_above", "action_names", "observation_names", "senses", "layout")
    return {name: getattr(world, name) for name in kept} | changed


def _rows_of(world: World) -> list[list[Outcomes]]:
    """Return ``outcomes[a][s]`` of a world."""
    successors, reward = np.asarray(world.successors), np.asarray(world.reward)
    prob = np.asarray(world.transition_prob, np.float64)
    return [
        [
            merge([(p, {(int(t), float(r)): 1.0}) for t, r, p in zip(*row, strict=True) if p > 0])
            for row in zip(successors[a], reward[a], prob[a], strict=True)
        ]
        for a in range(world.num_actions)
    ]


def _mixed_actions(world: World, share: float) -> list[list[Outcomes]]:
    rows = _rows_of(world)
    num_actions = world.num_actions
    at_random = [
        merge([(1 / num_actions, rows[b][s]) for b in range(num_actions)]) for s in range(world.num_states)
    ]
    return [[merge([(1 - share, own), (share, other)]) for own, other in zip(r, at_random, strict=True)] for r in rows]


def _mixed_observations(world: World, prob: np.ndarray, share: float) -> np.ndarray:
    """Mix ``prob[..., N, O]`` with uniform noise over the symbols of states that are not terminal."""
    terminal = np.asarray(world.terminal)
    shown = np.asarray(world.observation_prob)
    reserved = (shown[:, terminal] > 0).any(axis=(0, 1)) & ~(shown[:, ~terminal] > 0).any(axis=(0, 1))
    uniform = ~reserved / (~reserved).sum()
    return np.where(terminal[:, None], prob, (1 - share) * prob + share * uniform)
