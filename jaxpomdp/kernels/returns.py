"""Discounted returns along a tape, and their belief-weighted distribution in each state."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, last_steps


def discounted_returns(rewards: Array, valid: Array, start: Array, gamma: Array, tail: Array) -> Array:
    """Return ``R[t] = r[t] + gamma R[t+1]`` along one tape; ``R = tail`` at the last step of each trial.

    Args:
        rewards: float ``[T]``, paid for the action of each step.
        valid: bool ``[T]``.
        start: bool ``[T]``.
        gamma: discount.
        tail: float ``[T]``, read at last steps only: 0 where the trial terminated; a bootstrap value, or 0,
            where it was cut off.

    Returns:
        float ``[T]``, zero at padding.
    """

    def step(following: Array, inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        reward, is_last, end = inputs
        here = jnp.where(is_last, end, reward + gamma * following)
        return here, here

    last = last_steps(valid, start)
    _, returns = lax.scan(step, jnp.zeros((), rewards.dtype), (rewards, last, tail), reverse=True)
    return jnp.where(valid, returns, 0)


def return_histogram(
    gamma: Array, returns: Array, actions: Array, counted: Array, edges: Array, choices: int
) -> Array:
    """Return how the returns are distributed in each state, weighted by belief: ``[N, K, bins]``.

    ``hist[n, k, j] = sum_t gamma[t, n] [a_t = k] [edges[j] <= R_t < edges[j+1]]``; the outer bins are open.

    Args:
        gamma: ``[..., N]``, posterior weight of each state at each step.
        returns: ``[...]``.
        actions: int ``[...]``.
        counted: bool ``[...]``, steps whose return counts.
        edges: ``[bins + 1]``.
        choices: ``K``: 1 (all actions together) or ``A``.
    """
    bins = edges.shape[-1] - 1
    place = jnp.clip(jnp.searchsorted(edges, returns.reshape(-1), side="right") - 1, 0, bins - 1)
    choice = actions.reshape(-1) if choices > 1 else 0
    cell = jnp.where(counted.reshape(-1), place + bins * choice, -1)
    one_hot = jax.nn.one_hot(cell, choices * bins, dtype=gamma.dtype)
    weights = gamma.reshape(-1, gamma.shape[-1])
    return jnp.matmul(weights.T, one_hot, precision="highest").reshape(-1, choices, bins)
