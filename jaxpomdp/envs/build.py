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
        ValueError: a shape does not fit, a row does not sum to one, or the first observation is left out
            though the observation depends on the action.
    """
    if first_observation is None and observation.shape[0] > 1:
        raise ValueError("first_observation must be given where the observation depends on the action")
    first = observation[0] if first_observation is None else first_observation
    _check(tables, observation, first, start, terminal, static)
    tables = _trimmed(tables)
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


def _trimmed(tables: Tables) -> Tables:
    """Drop the last columns that no row uses."""
    width = 1 + int(np.flatnonzero(np.any(tables.prob > 0, axis=(0, 1)))[-1])
    return Tables(*(array[..., :width] for array in tables))


def _rows(prob: np.ndarray) -> np.ndarray:
    return prob / prob.sum(axis=-1, keepdims=True)


def _pair(prob: np.ndarray) -> tuple[Any, Any]:
    return jnp.asarray(prob, jnp.float32), jnp.asarray(running_sum(prob))


def _check(
    tables: Tables,
    observation: np.ndarray,
    first: np.ndarray,
    start: np.ndarray,
    terminal: np.ndarray,
    static: Mapping[str, Any],
) -> None:
    num_actions, num_states, _ = tables.prob.shape
    num_observations = observation.shape[-1]
    _check_shape("observation", observation[0], (num_states, num_observations))
    _check_shape("first_observation", first, (num_states, num_observations))
    _check_shape("start", start, (num_states,))
    _check_shape("terminal", terminal, (num_states,))
    if observation.shape[0] not in (1, num_actions):
        raise ValueError(f"observation must have 1 or {num_actions} tables, got {observation.shape[0]}")
    _check_rows("transitions", tables.prob)
    _check_rows("observation", observation)
    _check_rows("first_observation", first)
    _check_rows("start", start)
    _check_names("action_names", static, num_actions)
    _check_names("observation_names", static, num_observations)


def _check_shape(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape} (of states, observations), got {array.shape}")


def _check_rows(name: str, prob: np.ndarray) -> None:
    wrong = ~(np.abs(prob.sum(axis=-1) - 1) <= ROW_TOLERANCE) | (prob < 0).any(axis=-1)
    if np.any(wrong):
        where = tuple(int(i) for i in np.argwhere(wrong)[0])
        row = prob[where]
        raise ValueError(
            f"{name}{list(where)} must be probabilities that sum to 1, got {row} of sum {row.sum()}"
        )


def _check_names(name: str, static: Mapping[str, Any], size: int) -> None:
    given = static.get(name, ())
    if len(given) != size:
        raise ValueError(f"{name} must hold {size} names, got {len(given)}: {given}")
