"""Paths of coupled chains: the most likely one of two chains (Viterbi), and random ones."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.kernels.coupled import CoupledChain, check_two, joint_density
from jaxpomdp.kernels.coupled_exact import filter_joint_exact, reduce_pairs
from jaxpomdp.kernels.decoding import Decoded
from jaxpomdp.kernels.emissions import step_keys
from jaxpomdp.kernels.filtering import linked_steps, trial_starts
from jaxpomdp.numerics import NEG


def _apart(pairs: Array, valid: Array, second: int) -> Array:
    """Turn numbers of joint states ``[T]`` into states ``[T, 2]``, -1 at padding."""
    return jnp.where(valid[:, None], jnp.stack(jnp.divmod(pairs, second), axis=-1), -1)


def viterbi_joint(
    chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> Decoded:
    """Find the most likely joint path of two coupled chains; ``states[T, 2]``, -1 at padding.

    As ``decoding.viterbi``: an impossible step is treated as missing and adds ``NEG`` to ``log_prob``. Of
    equal paths the one with the lower pair ``(o, r)``, compared from the end, is taken.

    Args:
        chain: of two chains.
        log_obs: ``[T, N_1]`` and ``[T, N_2]``; rows of zeros where nothing was seen.
        actions: int ``[T]``.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.

    Raises:
        ValueError: there are not two chains.
    """
    check_two(chain)
    init = jnp.maximum(joint_density(chain.log_init), NEG)
    shape = init.shape

    def step(carried: Array, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        row, action, begins = inputs
        tables = [table[action] for table in chain.log_trans]
        before = reduce_pairs(lambda x: jnp.argmax(x, axis=0), carried, *tables)
        best = reduce_pairs(lambda x: jnp.max(x, axis=0), carried, *tables)
        predicted = jnp.where(begins, init, best)
        joint = jnp.where(predicted > NEG / 2, jnp.maximum(predicted + row, NEG), NEG)
        possible = jnp.max(joint) > NEG / 2
        joint = jnp.where(possible, joint, predicted)
        gain = jnp.max(joint)
        score = jnp.where(joint > NEG / 2, joint - gain, NEG)
        return score, (score.reshape(-1), before.reshape(-1), jnp.where(possible, gain, NEG))

    rows = jnp.where(valid[:, None, None], jnp.maximum(joint_density(log_obs), NEG), 0)
    inputs = (rows, jnp.roll(actions, 1), trial_starts(start, valid))
    score, before, gain = lax.scan(step, init, inputs)[1]

    def trace(following: Array, inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        row, after, goes_on = inputs
        state = jnp.where(goes_on, after[following], jnp.argmax(row))
        return state, state

    steps = (score, jnp.roll(before, -1, axis=0), linked_steps(start, valid))
    pairs = lax.scan(trace, jnp.zeros((), before.dtype), steps, reverse=True)[1]
    return Decoded(_apart(pairs, valid, shape[1]), jnp.sum(jnp.where(valid, gain, 0)))


def sample_coupled(key: Array, chain: CoupledChain, actions: Array, start: Array, valid: Array) -> Array:
    """Draw a path of any number of coupled chains: given all states before, each moves by itself.

    Draws depend on the key, the number of the step and that of the chain.

    Args:
        key: of ``jax.random``.
        chain: of ``C`` chains.
        actions: int ``[T]``.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.

    Returns:
        int ``[T, C]``, -1 at padding.
    """
    chains = len(chain.log_init)

    def step(before: Array, inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        step_key, action, begins = inputs
        place = tuple(before[k] for k in range(chains))
        rows = [table[(action, *place)] for table in chain.log_trans]
        rows = [jnp.where(begins, init, row) for init, row in zip(chain.log_init, rows, strict=True)]
        keys = [jax.random.fold_in(step_key, k) for k in range(chains)]
        states = jnp.stack([jax.random.categorical(k, row) for k, row in zip(keys, rows, strict=True)])
        return states, states

    inputs = (step_keys(key, actions.shape[0]), jnp.roll(actions, 1), trial_starts(start, valid))
    first = jnp.zeros(chains, jnp.argmax(chain.log_init[0]).dtype)
    return jnp.where(valid[:, None], lax.scan(step, first, inputs)[1], -1)


def sample_joint_posterior(
    key: Array, chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> Array:
    """Draw a joint path of two chains given the tape, by filtering forward and sampling backward.

    Arguments as ``viterbi_joint``.

    Returns:
        int ``[T, 2]``, -1 at padding.

    Source: Carter and Kohn (1994); Fruehwirth-Schnatter (1994).
    """
    belief = filter_joint_exact(chain, log_obs, actions, start, valid).belief
    second = belief.shape[2]

    def step(following: Array, inputs: Any) -> tuple[Array, Array]:
        step_key, row, action, goes_on = inputs
        place = jnp.divmod(following, second)
        leads = sum(table[action][..., x] for table, x in zip(chain.log_trans, place, strict=True))
        score = jnp.maximum(row + jnp.where(goes_on, leads, 0), NEG)
        state = jax.random.categorical(step_key, score.reshape(-1))
        return state, state

    inputs = (step_keys(key, actions.shape[0]), belief, actions, linked_steps(start, valid))
    pairs = lax.scan(step, jnp.zeros((), jnp.argmax(belief[0]).dtype), inputs, reverse=True)[1]
    return _apart(pairs, valid, second)
