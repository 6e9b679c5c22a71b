"""Policies on beliefs that do not learn, and how good they are.

A policy is a set of vectors with actions: it takes the action of the vector with the largest ``alpha . b``.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.envs import world as worlds
from jaxpomdp.envs.world import TrueModel, World
from jaxpomdp.kernels import planning
from jaxpomdp.numerics import normalise


class Policy(NamedTuple):
    """``vectors[K, N]`` with their ``actions[K]``; ``sharpen[]`` takes the most likely state for certain.

    A row that is not used holds ``NEG`` throughout, so that policies from one planner have one shape.
    """

    vectors: Array
    actions: Array
    sharpen: Array


def act(policy: Policy, belief: Array, uniform: Array) -> Array:
    """Return the action ``actions[argmax_k alpha_k . b]`` for one belief.

    Args:
        policy: the vectors.
        belief: ``[N]``.
        uniform: a number in [0, 1) that picks among what is exactly equal: vectors, and for ``sharpen``
            states. Taking always the first would run in circles in a world with symmetries.

    Returns:
        An int scalar.
    """
    state, rest = _best(belief, uniform)
    certain = jax.nn.one_hot(state, belief.shape[0], dtype=belief.dtype)
    belief = jnp.where(policy.sharpen, certain, belief)
    return policy.actions[_best(policy.vectors @ belief, rest)[0]]


def _best(scores: Array, uniform: Array) -> tuple[Array, Array]:
    """Return the index of a largest score, drawn among equals, and what that left of the uniform number."""
    equals = jnp.cumsum(scores >= jnp.max(scores))
    scaled = uniform * equals[-1]
    chosen = jnp.minimum(scaled.astype(jnp.int32), equals[-1] - 1)
    return jnp.sum(equals <= chosen), scaled - chosen


def value(policy: Policy, belief: Array) -> Array:
    """Return ``max_k alpha_k . b`` for one belief: for Perseus what the policy earns at least from there."""
    return jnp.max(policy.vectors @ belief)


def first_belief(model: TrueModel, observation: Array) -> Array:
    """Return the belief ``[N]`` after the observation at a reset."""
    return normalise(model.start * model.first[:, observation], model.start)


def evaluate_policy(
    world: World, policy: Policy, *, model: TrueModel | None = None, trials: int = 251, seed: int = 0
) -> dict[str, np.ndarray]:
    """Let a policy act in a world and say how each trial went.

    Args:
        world: where it acts, for at most ``world.step_limit`` actions a trial.
        policy: from :func:`plan`.
        model: what it tracks its belief by; by default the truth.
        trials: how many, side by side.
        seed: of the draws, which depend on (seed, trial, step) alone.

    Returns:
        ``steps`` int, ``reward``, ``discounted`` = ``sum_t gamma^t r_t``, ``success``, each ``[trials]``.
    """
    model = worlds.model_of(world) if model is None else model
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(seed), jnp.arange(trials))
    return {name: np.asarray(x) for name, x in rollouts(world, policy, model, keys)._asdict().items()}


class Rows(NamedTuple):
    """What each trial came to: see :func:`evaluate_policy`."""

    steps: Array
    reward: Array
    discounted: Array
    success: Array


class _Trial(NamedTuple):
    """One trial under way; when it is over nothing changes any more."""

    state: Array
    belief: Array
    over: Array
    rows: Rows


@jax.jit
def rollouts(world: World, policy: Policy, model: TrueModel, keys: Array) -> Rows:
    """Run one trial for each of ``keys[trials]``, all side by side, until the last is over."""
    draw = partial(jax.random.uniform, shape=(world.step_limit + 1, worlds.UNIFORMS_PER_STEP + 1))
    uniforms = jax.vmap(draw)(keys)
    advance = jax.vmap(partial(_advance, world, policy, model), in_axes=(0, 0, None))

    def going(carry: tuple[Array, _Trial]) -> Array:
        return (carry[0] < world.step_limit) & ~jnp.all(carry[1].over)

    def body(carry: tuple[Array, _Trial]) -> tuple[Array, _Trial]:
        return carry[0] + 1, advance(carry[1], uniforms[:, carry[0]], carry[0])

    begin = jax.vmap(partial(_first_step, world, model))(uniforms[:, -1])
    return lax.while_loop(going, body, (jnp.zeros((), jnp.int32), begin))[1].rows


def _first_step(world: World, model: TrueModel, uniforms: Array) -> _Trial:
    state, observation = worlds.reset(world, uniforms[: worlds.UNIFORMS_PER_RESET])
    nothing = jnp.zeros((), world.reward.dtype)
    rows = Rows(jnp.zeros((), jnp.int32), nothing, nothing, jnp.array(False))
    return _Trial(state, first_belief(model, observation), world.terminal[state], rows)


def _advance(
    world: World, policy: Policy, model: TrueModel, now: _Trial, uniforms: Array, t: Array
) -> _Trial:
    action = act(policy, now.belief, uniforms[-1])
    out = worlds.step(world, now.state, action, uniforms[:-1])
    rows = Rows(
        now.rows.steps + 1,
        now.rows.reward + out.reward,
        now.rows.discounted + world.discount**t * out.reward,
        out.terminated & (out.reward > world.success_above),
    )
    belief = planning.update(now.belief, action, out.observation, model.trans, model.obs)
    after = _Trial(out.state, belief, out.terminated, rows)
    return jax.tree.map(lambda x, y: jnp.where(now.over, x, y), now, after)
