"""Random paths: from the model alone (ancestral), and from the model given a tape (posterior).

Every draw depends on the key and the number of the step, never on the tape's length or a place in a batch.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain
from jaxpomdp.kernels.emissions import step_keys
from jaxpomdp.kernels.filtering import linked_steps, trial_starts
from jaxpomdp.kernels.smoothing import filter_exact


def sample_path(key: Array, chain: Chain, actions: Array, start: Array, valid: Array) -> Array:
    """Draw a path: ``s_0 ~ init`` at each start, then ``s_t ~ T(a_{t-1}, s_{t-1}, .)``.

    Args:
        key: of ``jax.random``.
        chain: ``log_init[N]``, ``log_trans[A, N, N]``.
        actions: int ``[T]``.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.

    Returns:
        int ``[T]``, -1 at padding.
    """

    def step(before: Array, inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        step_key, action, begins = inputs
        row = jnp.where(begins, chain.log_init, chain.log_trans[action, before])
        state = jax.random.categorical(step_key, row)
        return state, state

    keys = step_keys(key, actions.shape[0])
    inputs = (keys, jnp.roll(actions, 1), trial_starts(start, valid))
    states = lax.scan(step, jnp.zeros((), jnp.argmax(chain.log_init).dtype), inputs)[1]
    return jnp.where(valid, states, -1)


def sample_posterior(
    key: Array, chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> Array:
    """Draw a path given the tape, by filtering forward and sampling backward.

    ``s_t ~ belief_t(i) T(a_t, i, s_{t+1})``, from the end. The filter runs in logarithms, so nothing
    underflows; map over keys to draw many paths from one forward pass.

    Args:
        key: of ``jax.random``.
        chain: ``log_init[N]``, ``log_trans[A, N, N]``.
        log_obs: ``[T, N]``; a missing step is a row of zeros, an impossible one is treated as missing.
        actions: int ``[T]``.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.

    Returns:
        int ``[T]``, -1 at padding.

    Source: Carter and Kohn (1994); Fruehwirth-Schnatter (1994).
    """
    belief = filter_exact(chain, log_obs, actions, start, valid).belief

    def step(following: Array, inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        step_key, row, action, goes_on = inputs
        leads = jnp.where(goes_on, chain.log_trans[action, :, following], 0)
        state = jax.random.categorical(step_key, row + leads)
        return state, state

    inputs = (step_keys(key, actions.shape[0]), belief, actions, linked_steps(start, valid))
    states = lax.scan(step, jnp.zeros((), jnp.argmax(chain.log_init).dtype), inputs, reverse=True)[1]
    return jnp.where(valid, states, -1)
