"""From outcomes written down in NumPy to the tables of a world, with checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxpomdp.envs.world import World, running_sum

Outcomes = Mapping[tuple[int, float], float]
"""What one action in one state can bring: ``{(successor, reward): probability}``."""

ROW_TOLERANCE = 1e-6
"""How far the sum of a row of probabilities may be from one."""


class Tables(NamedTuple):
    """Outcomes as padded float64 arrays ``[A, N, K]``: ``successors``, ``prob`` and ``reward``."""

    successors: np.ndarray
    prob: np.ndarray
    reward: np.ndarray


def tabulate(outcomes: Sequence[Sequence[Outcomes]]) -> Tables:
    """Turn ``outcomes[a][s]`` into padded arrays; padding stays in its state with probability zero."""
    num_actions, num_states = len(outcomes), len(outcomes[0])
    kept = [[[(key, p) for key, p in row.items() if p > 0] for row in rows] for rows in outcomes]
    width = max(1, *(len(row) for rows in kept for row in rows))
    shape = (num_actions, num_states, width)
    successors = np.broadcast_to(np.arange(num_states)[None, :, None], shape).copy()
    prob, reward = np.zeros(shape), np.zeros(shape)
    for a, rows in enumerate(kept):
        for s, row in enumerate(rows):
            for k, ((successor, paid), p) in enumerate(row):
                successors[a, s, k], reward[a, s, k], prob[a, s, k] = successor, paid, p
    return Tables(successors, prob, reward)


def merge(parts: Sequence[tuple[float, Outcomes]]) -> Outcomes:
    """Mix outcomes with weights, adding those that agree in successor and reward."""
    merged: dict[tuple[int, float], float] = {}
    for weight, outcomes in parts:
        for key, prob in outcomes.items():
            merged[key] = merged.get(key, 0.0) + weight * prob
    return merged


def stay_for_ever(num_actions: int, state: int) -> list[Outcomes]:
    """Return the outcomes of a terminal state, one entry an action."""
    return [{(state, 0.0): 1.0} for _ in range(num_actions)]


def assemble(
    tables: Tables,
    observation: np.ndarray,
    start: np.ndarray,
    terminal: np.ndarray,
    *,
    first_observation: np.ndarray | None = None,
    reward_noise: float = 0.0,
    **static: Any,
) -> World:
    """Check the tables and make a world of them.

    Args:
        tables: outcomes ``[A, N, K]``.
        observation: ``[1 or A, N, O]``, rows sum to one.
        start: ``[N]``.
        terminal: bool ``[N]``.
        first_observation: ``[N, O]`` seen at a reset; by default the observation after any action.
        reward_noise: half the width of the uniform noise on every reward.
        **static: the static fields of :class:`~jaxpomdp.envs.world.World`.

    Raises:
        ValueError: a shape does not fit, a row does not sum to one, or the first observation is left out though
            the observation depends on the action.
    """
    if first_observation is None and observation.shape[0] > 1:
        raise ValueError("first_observation must be given where the observation depends on the action")
    first = observation[0] if first_observation is None else first_observation
    _check(tables, observation, first, start, terminal, static)
    prob, observed, first, begin = (_rows(x) for x in (tables.prob, observation, first, start))
    return World(
        jnp.asarray(tables.successors, jnp.int32),
        *_pair(prob),
        jnp.asarray(tables.reward, jnp.float32),
        *_pair(observed),
        *_pair(first),
        *_pair(begin),
        jnp.asarray(terminal, bool),
        jnp.asarray(reward_noise, jnp.float32),
        **static,
    )


def _rows(prob: np.ndarray) -> np.ndarray:
    return prob / prob.sum(axis=-1, keepdims=True)


def _pair(prob: np.ndarray) -> tuple[Any, Any]:
    return jnp.asarray(prob, jnp.float32), jnp.asarray(running_sum(prob))


def _check(tables: Tables, observation, first, start, terminal, static: Mapping[str, Any]) -> None:
    num_actions, num_states, _ = tables.prob.shape
    num_observations = observation.shape[-1]
    expected = {
        "observation": (observation, {(1, num_states, num_observations), (num_actions, num_states, num_observations)}),
        "first_observation": (first, {(num_states, num_observations)}),
        "start": (start, {(num_states,)}),
        "terminal": (terminal, {(num_states,)}),
    }
    for name, (array, shapes) in expected.items():
        if array.shape not in shapes:
            raise ValueError(f"{name} must have shape {' or '.join(map(str, sorted(shapes)))}, got {array.shape}")
    rows = {"transitions": tables.prob, "observation": observation, "first_observation": first, "start": start}
    for name, prob in rows.items():
        _check_rows(name, prob)
    for name, size in (("action_names", num_actions), ("observation_names", num_observations)):
        if len(static.get(name, ())) != size:
            raise ValueError(f"{name} must hold {size} names, got {len(static.get(name, ()))}")


def _check_rows(name: str, prob: np.ndarray) -> None:
    wrong = (np.abs(prob.sum(axis=-1) - 1) > ROW_TOLERANCE) | (prob < 0).any(axis=-1)
    if np.any(wrong):
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        row = prob[where]
        raise ValueError(f"{name}{list(where)} must be probabilities that sum to one, got sum {row.sum()}, {row}")
