"""Worlds as tables: what an agent acts in, drawn by explicit uniform numbers on the device.

A world is a pytree of arrays with static names and limits. ``step`` and ``reset`` are for ONE agent and are
lifted by ``jax.vmap`` over seeds while the world is shared. A draw is an inverse cumulative distribution at a
number in [0, 1) that the caller supplies, so it never depends on the position in a batch.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array

UNIFORMS_PER_RESET = 2
"""How many numbers ``reset`` consumes: for the state, for the observation."""

UNIFORMS_PER_STEP = 3
"""How many numbers ``step`` consumes: for the transition, the observation, the noise on the reward."""


@dataclasses.dataclass(frozen=True)
class Layout:
    """Where the states of a world lie on a map, for drawing only.

    Attributes:
        rows: the map, one string a row, in the characters of :mod:`jaxpomdp.envs.grid`.
        cells: for each state its ``(row, column)``.
        headings: for each state the direction faced (0 north, 1 east, 2 south, 3 west), or -1 without one.
    """

    rows: tuple[str, ...]
    cells: tuple[tuple[int, int], ...]
    headings: tuple[int, ...]


_STATIC = {"static": True}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class World:
    """The tables of a partially observable world with ``N`` states, ``A`` actions and ``O`` observations.

    ``K`` is the largest number of outcomes of one action in one state; shorter rows are padded with
    probability zero. Every ``*_cdf`` is the running sum of the table before it along the last axis and ends
    in exactly 1.

    Attributes:
        successors: int32 ``[A, N, K]``, the state that each outcome leads to.
        transition_prob, transition_cdf: float32 ``[A, N, K]``, ``P(outcome k | s, a)``.
        reward: float32 ``[A, N, K]``, paid for outcome ``k`` of action ``a`` in ``s``.
        observation_prob, observation_cdf: float32 ``[1 or A, N, O]``, ``P(o | a, arrived s)``; the first axis
            is 1 where the observation does not depend on the action.
        first_observation_prob, first_observation_cdf: float32 ``[N, O]``, seen at a reset.
        start_prob, start_cdf: float32 ``[N]``.
        terminal: bool ``[N]``; a terminal state keeps the agent for ever and pays nothing.
        reward_noise: float32 ``[]``; uniform(-x, x) is added to every reward.
        name, discount: static; ``discount`` is the gamma that the world is usually judged with.
        step_limit: static; a trial has at most so many actions. The caller counts them.
        success_above: static; a trial succeeds if it ends in a terminal state with a last reward above this.
        action_names, observation_names: static, one text each; their lengths are ``A`` and ``O``.
        senses: static; the directions of an observation made of wall bits, highest bit first, or empty.
        layout: static; where the states lie, or None.
    """

    successors: Array
    transition_prob: Array
    transition_cdf: Array
    reward: Array
    observation_prob: Array
    observation_cdf: Array
    first_observation_prob: Array
    first_observation_cdf: Array
    start_prob: Array
    start_cdf: Array
    terminal: Array
    reward_noise: Array
    name: str = dataclasses.field(default="world", metadata=_STATIC)
    discount: float = dataclasses.field(default=0.95, metadata=_STATIC)
    step_limit: int = dataclasses.field(default=251, metadata=_STATIC)
    success_above: float = dataclasses.field(default=0.0, metadata=_STATIC)
    action_names: tuple[str, ...] = dataclasses.field(default=(), metadata=_STATIC)
    observation_names: tuple[str, ...] = dataclasses.field(default=(), metadata=_STATIC)
    senses: tuple[str, ...] = dataclasses.field(default=(), metadata=_STATIC)
    layout: Layout | None = dataclasses.field(default=None, metadata=_STATIC)

    @property
    def num_states(self) -> int:
        """``N``."""
        return self.terminal.shape[-1]

    @property
    def num_actions(self) -> int:
        """``A``."""
        return self.successors.shape[-3]

    @property
    def num_observations(self) -> int:
        """``O``."""
        return self.observation_prob.shape[-1]


class Step(NamedTuple):
    """What one action brought: new ``state`` and ``observation``, ``reward`` paid, and ``terminated``."""

    state: Array
    observation: Array
    reward: Array
    terminated: Array


class TrueModel(NamedTuple):
    """A world as dense tables, for planners and for agents that are told the truth.

    ``trans[A, N, N]`` (row: from, column: to), ``obs[1 or A, N, O]`` at arrival, expected ``reward[A, N]``,
    ``start[N]``, ``terminal[N]`` and ``first[N, O]``, the observation at a reset.
    """

    trans: Array
    obs: Array
    reward: Array
    start: Array
    terminal: Array
    first: Array


def _draw(cdf: Array, uniform: Array) -> Array:
    """Return the least index whose ``cdf[K]`` exceeds ``uniform``; a zero probability is never drawn."""
    return jnp.sum(uniform >= cdf, axis=-1, dtype=jnp.int32)


def reset(world: World, uniforms: Array) -> tuple[Array, Array]:
    """Begin a trial: ``s0 ~ start`` and ``o0 ~ first_observation[s0]``.

    Args:
        world: the tables.
        uniforms: float ``[2]`` in [0, 1), for the state and for the observation.

    Returns:
        The state and the observation, int32 scalars.
    """
    state = _draw(world.start_cdf, uniforms[0])
    return state, _draw(world.first_observation_cdf[state], uniforms[1])


def step(world: World, state: Array, action: Array, uniforms: Array) -> Step:
    """Act once: ``k ~ P(. | s, a)``, ``s' = successors[a, s, k]``, ``o' ~ P(. | a, s')``.

    Args:
        world: the tables.
        state: int scalar.
        action: int scalar.
        uniforms: float ``[3]`` in [0, 1), for the outcome, the observation and the noise on the reward.

    Returns:
        :class:`Step` of scalars. From a terminal state the agent goes nowhere and earns nothing.
    """
    outcome = _draw(world.transition_cdf[action, state], uniforms[0])
    arrived = world.successors[action, state, outcome]
    seen_after = action if world.observation_cdf.shape[0] > 1 else 0
    observation = _draw(world.observation_cdf[seen_after, arrived], uniforms[1])
    noise = jnp.where(world.terminal[state], 0, world.reward_noise * (2 * uniforms[2] - 1))
    reward = world.reward[action, state, outcome] + noise
    return Step(arrived, observation, reward, world.terminal[arrived])


def reset_key(world: World, key: Array) -> tuple[Array, Array]:
    """Begin a trial with numbers drawn from ``key``; see :func:`reset`."""
    return reset(world, jax.random.uniform(key, (UNIFORMS_PER_RESET,)))


def step_key(world: World, state: Array, action: Array, key: Array) -> Step:
    """Act once with numbers drawn from ``key``; see :func:`step`."""
    return step(world, state, action, jax.random.uniform(key, (UNIFORMS_PER_STEP,)))


def model_of(world: World) -> TrueModel:
    """Return the world as dense tables; ``trans[a, s, s']`` sums the outcomes that lead to ``s'``.

    Made on the host, so it is not for compiled functions.
    """
    successors, prob = np.asarray(world.successors), np.asarray(world.transition_prob)
    trans = np.zeros((world.num_actions, world.num_states, world.num_states), prob.dtype)
    a, s = np.arange(world.num_actions)[:, None, None], np.arange(world.num_states)[None, :, None]
    np.add.at(trans, (a, s, successors), prob)
    reward = np.sum(prob * np.asarray(world.reward), axis=-1)
    return TrueModel(
        jnp.asarray(trans),
        world.observation_prob,
        jnp.asarray(reward),
        world.start_prob,
        world.terminal,
        world.first_observation_prob,
    )


def running_sum(prob: np.ndarray) -> np.ndarray:
    """Return the cumulative sum along the last axis in float32, exactly 1 from the last positive entry on."""
    prob = np.asarray(prob, np.float64)
    total = np.cumsum(prob, axis=-1)
    positive_from_here = np.flip(np.cumsum(np.flip(prob, -1), axis=-1), -1)
    last = np.ones_like(prob[..., :1], bool)
    none_after = np.concatenate([positive_from_here[..., 1:] <= 0, last], axis=-1)
    return np.where(none_after, 1.0, total / total[..., -1:]).astype(np.float32)
