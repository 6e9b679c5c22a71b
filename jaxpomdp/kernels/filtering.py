"""The forward pass: belief over states given the past, one step at a time or along a whole tape.

Source: thesis section 3.3, ``b_t(i) = eta p(o_t | i) sum_j T(j, a_{t-1}, i) b_{t-1}(j)``; Rabiner (1989).

A probability below the smallest float of its dtype becomes zero here, as in every filter that carries
probabilities; ``smoothing`` notices when that mattered and works in logarithms then.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain
from jaxpomdp.numerics import NEG, safe_log

EXACT = lax.Precision.HIGHEST
"""Matrix products in the full precision of their dtype: accelerators would round float32 to fewer bits."""


class Filtered(NamedTuple):
    """The forward pass over one tape; every row is zero at padding.

    ``predicted[T, N]`` is the belief before the step's observation and ``belief[T, N]`` after it;
    ``log_norm[T]`` is the log-probability of the observation given the past (they sum to the log-evidence).
    """

    belief: Array
    predicted: Array
    log_norm: Array


def observe(predicted: Array, log_obs: Array) -> tuple[Array, Array]:
    """Take in one observation: ``belief(i) = predicted(i) exp(log_obs(i)) / exp(log_norm)``.

    An impossible observation (zero probability in every state that ``predicted`` holds) is ignored:
    the belief stays ``predicted`` and ``log_norm`` is ``NEG``.

    Args:
        predicted: probabilities ``[N]``.
        log_obs: log-probability of the observation in each state, ``[N]``, unnormalised is fine;
            all zeros say that nothing was observed.

    Returns:
        ``belief[N]`` and the scalar ``log_norm = log sum_i predicted(i) exp(log_obs(i))``.

    Example:
        >>> belief, log_norm = observe(jnp.array([0.5, 0.5]), jnp.log(jnp.array([0.9, 0.1])))
        >>> [round(float(p), 3) for p in belief], round(float(jnp.exp(log_norm)), 3)
        ([0.9, 0.1], 0.5)
    """
    # Shift by the best likelihood within reach before adding: sums of small numbers keep their last digits.
    shift = lax.stop_gradient(jnp.max(jnp.where(predicted > 0, log_obs, NEG)))
    log_joint = safe_log(predicted) + (log_obs - shift)
    peak = lax.stop_gradient(jnp.max(log_joint))
    joint = jnp.exp(log_joint - peak)
    total = jnp.sum(joint)
    possible = shift > NEG / 2
    belief = jnp.where(possible, joint / total, predicted)
    return belief, jnp.where(possible, jnp.log(total) + peak + shift, NEG)


def propagate(belief: Array, trans: Array, action: Array) -> Array:
    """Push a belief through transition probabilities: ``predicted(j) = sum_i belief(i) trans(action, i, j)``.

    Args:
        belief: probabilities ``[N]``.
        trans: probabilities ``[A, N, N]``, from row to column.
        action: int scalar.
    """
    return jnp.matmul(belief, trans[action], precision=EXACT)


def predict(belief: Array, log_trans: Array, action: Array) -> Array:
    """Say where an action leads: ``propagate`` for log-probabilities ``log_trans[A, N, N]``."""
    return propagate(belief, jnp.exp(log_trans), action)


def update_belief(belief: Array, log_trans: Array, action: Array, log_obs: Array) -> tuple[Array, Array]:
    """Update a belief by one step of acting and seeing (thesis 3.3; for a given POMDP model, 2.2).

    For a learned model ``log_obs[N]`` is its emission log-probability; for a given POMDP whose observation
    depends on the action it is the row ``log O(action, ., o)``.

    Returns:
        As ``observe``: ``belief[N]`` and the log-probability of the observation given the past.
    """
    return observe(predict(belief, log_trans, action), log_obs)


def predict_steps(belief: Array, log_trans: Array, actions: Array) -> Array:
    """Predict the state after each of ``actions[K]``, with nothing observed on the way: ``[K, N]``."""
    trans = jnp.exp(log_trans)

    def step(carried: Array, action: Array) -> tuple[Array, Array]:
        predicted = propagate(carried, trans, action)
        return predicted, predicted

    return lax.scan(step, belief, actions)[1]


def predict_observation(belief: Array, log_trans: Array, action: Array, log_emit: Array) -> Array:
    """Predict the next observation: ``p(o) = sum_j predicted(j) exp(log_emit(j, o))``, probabilities ``[O]``.

    Args:
        belief: probabilities ``[N]`` now.
        log_trans: log-probabilities ``[A, N, N]``.
        action: int scalar, taken now.
        log_emit: log-probabilities ``[N, O]`` of each symbol in each state.
    """
    return jnp.matmul(predict(belief, log_trans, action), jnp.exp(log_emit), precision=EXACT)


def trial_starts(start: Array, valid: Array) -> Array:
    """Mark the steps that begin a trial, ``bool[..., T]``: marked ones, the first, and any after padding."""
    nothing = jnp.zeros_like(valid[..., :1])
    before = jnp.concatenate([nothing, valid[..., :-1]], axis=-1)
    return valid & (start | ~before)


def linked_steps(start: Array, valid: Array) -> Array:
    """Mark the steps whose action leads to the next step of the same trial, ``bool[..., T]``."""
    nothing = jnp.zeros_like(valid[..., :1])
    goes_on = valid & ~trial_starts(start, valid)
    return jnp.concatenate([goes_on[..., 1:], nothing], axis=-1)


def filter_step(
    init: Array, trans: Array, carried: Array, inputs: tuple[Array, Array, Array]
) -> tuple[Array, Filtered]:
    """Filter one step: ``predicted = carried``, or ``init`` at a start; then ``observe`` and ``propagate``.

    Args:
        init: probabilities ``[N]``.
        trans: probabilities ``[A, N, N]``.
        carried: ``[N]``, what the step before says of this one.
        inputs: ``log_obs[N]``, the action, and whether a trial starts here.

    Returns:
        What this step says of the next one, ``[N]``, and the step itself.
    """
    row, action, first = inputs
    predicted = jnp.where(first, init, carried)
    belief, log_norm = observe(predicted, row)
    return propagate(belief, trans, action), Filtered(belief, predicted, log_norm)


def without_padding(filtered: Filtered, valid: Array) -> Filtered:
    """Set rows of a filtered tape to zero at padding."""
    return jax.tree.map(lambda x: jnp.where(valid.reshape(valid.shape + (1,) * (x.ndim - 1)), x, 0), filtered)


def filter_tape(chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Filtered:
    """Filter one tape: ``predicted_t = belief_{t-1} T(a_{t-1})``, or ``init`` at a start; then ``observe``.

    Args:
        chain: ``log_init[N]``, ``log_trans[A, N, N]``.
        log_obs: ``[T, N]``; a missing step is a row of zeros.
        actions: int ``[T]``.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.
    """
    init, trans = jnp.exp(chain.log_init), jnp.exp(chain.log_trans)
    first = trial_starts(start, valid)
    rows = jnp.where(valid[:, None], log_obs, 0)
    _, filtered = lax.scan(partial(filter_step, init, trans), init, (rows, actions, first))
    return without_padding(filtered, valid)
