"""Linear temporal-difference control on beliefs: one equation, one function, one agent.

``q[N, A]`` holds a value for every state and action, and ``Q(b, a) = sum_i b(i) q(i, a)`` (thesis section
3.3). Every choice is made by explicit uniform numbers, so it never depends on the position in a batch.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, last_steps


def action_values(q: Array, belief: Array) -> Array:
    """Return ``Q(b, a) = sum_i b(i) q(i, a)``, ``[A]``, from ``q[N, A]`` and ``belief[N]``."""
    return jnp.sum(belief[:, None] * q, axis=0)


def greedy(values: Array) -> Array:
    """Return the action of highest value; of equals the first."""
    return jnp.argmax(values).astype(jnp.int32)


def epsilon_greedy(values: Array, epsilon: Array, uniforms: Array) -> Array:
    """Return a uniformly random action with probability ``epsilon``, else the greedy one.

    Args:
        values: ``[A]``.
        epsilon: scalar in [0, 1].
        uniforms: ``[2]`` in [0, 1): whether to explore, and where to.
    """
    count = values.shape[-1]
    anywhere = jnp.minimum((uniforms[1] * count).astype(jnp.int32), count - 1)
    return jnp.where(uniforms[0] < epsilon, anywhere, greedy(values))


def boltzmann(values: Array, temperature: Array, uniform: Array) -> Array:
    """Draw an action with ``pi(a) ~ exp(Q(a) / temperature)`` (thesis section 2.3.1)."""
    cdf = jnp.cumsum(jax.nn.softmax(values / jnp.maximum(temperature, 1e-8)))
    return jnp.minimum(jnp.sum(uniform >= cdf, dtype=jnp.int32), values.shape[-1] - 1)


def mark(trace: Array, belief: Array, action: Array, decay: Array, *, replacing: bool = False) -> Array:
    """Decay the eligibility and mark what was just done: ``e := decay e + b(s) [a = a_t]`` (thesis 3.3).

    Args:
        trace: ``[N, A]``.
        belief: ``[N]``.
        action: int scalar.
        decay: ``gamma lambda``.
        replacing: take ``max(decay e, b(s))`` for the action instead of the sum (Singh and Sutton, 1996).
    """
    taken = belief[:, None] * (jnp.arange(trace.shape[-1]) == action)[None, :]
    faded = decay * trace
    return jnp.maximum(faded, taken) if replacing else faded + taken


class ReplayData(NamedTuple):
    """A tape to learn values from again: ``beliefs[T, N]``; ``actions``, ``rewards``, flags ``[T]``."""

    beliefs: Array
    actions: Array
    rewards: Array
    start: Array
    valid: Array
    terminated: Array


class _Links(NamedTuple):
    """What each step of a tape needs of the next one; all ``[T]`` but ``beliefs_tp1[T, N]``."""

    acts: Array
    ends: Array
    dies: Array
    beliefs_tp1: Array
    actions_tp1: Array


def _links(data: ReplayData) -> _Links:
    last = last_steps(data.valid, data.start)
    following = jax.tree.map(
        lambda x: jnp.roll(x, -1, axis=0), (last, data.terminated, data.beliefs, data.actions)
    )
    last_tp1, terminated_tp1, beliefs_tp1, actions_tp1 = following
    return _Links(data.valid & ~last, last_tp1, terminated_tp1, beliefs_tp1, actions_tp1)


def replay_tape(
    q: Array,
    data: ReplayData,
    alpha: Array,
    gamma: Array,
    lam: Array,
    *,
    replacing: bool = False,
    rule: str = "sarsa",
) -> Array:
    """Learn once more from a tape, in its order, by SARSA(lambda) or Q(lambda) on given beliefs.

    ``delta_t = r_t + gamma Q(b_{t+1}, a_{t+1}) - Q(b_t, a_t)``; ``e_t`` as in :func:`mark`;
    ``q := q + alpha delta_t e_t``. At the last step of a trial there is no action: its value is 0 if it
    terminated, else ``max_a Q(b, a)``. Q(lambda) always takes the maximum; its traces are not cut.

    Args:
        q: ``[N, A]``.
        data: the tape.
        alpha: learning rate.
        gamma: discount.
        lam: lambda.
        replacing: kind of trace.
        rule: ``sarsa`` or ``q``.

    Returns:
        The new ``q[N, A]``.
    """

    def step(carry: tuple[Array, Array], inputs: tuple[Any, ...]) -> tuple[tuple[Array, Array], None]:
        value, trace = carry
        belief, action, reward, first, link = inputs
        values_tp1 = action_values(value, link.beliefs_tp1)
        best_tp1 = jnp.max(values_tp1)
        chosen_tp1 = best_tp1 if rule == "q" else values_tp1[link.actions_tp1]
        next_value = jnp.where(link.ends, jnp.where(link.dies, 0, best_tp1), chosen_tp1)
        delta = reward + gamma * next_value - action_values(value, belief)[action]
        trace = mark(trace, belief, action, jnp.where(first, 0, gamma * lam), replacing=replacing)
        return (value + jnp.where(link.acts, alpha * delta, 0) * trace, trace), None

    inputs = (data.beliefs, data.actions, data.rewards, data.start, _links(data))
    return lax.scan(step, (q, jnp.zeros_like(q)), inputs)[0][0]
