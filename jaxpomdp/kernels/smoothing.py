"""The backward pass and expected counts: what a whole tape says about each of its steps.

Two routes to one ``Posterior``. ``smooth_scaled`` carries probabilities, renormalised at every step: fast,
and accurate unless a probability that mattered fell below the smallest float. It can tell: then the overlap
of what the past and the future allow is itself tiny at some step (``overlap_floor``). ``smooth_exact``
carries logarithms and takes a log-sum-exp over all pairs of states. ``smooth`` is the first, rescued by the
second only when needed.

Source: Rabiner (1989); thesis section 3.3. The overlap test is ours: everything lost to underflow is at most
``N`` times the smallest float at a step, so it changes a step whose overlap is above the floor by less than
the rounding of the dtype.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain, Posterior
from jaxpomdp.kernels.filtering import EXACT, Filtered, filter_tape, linked_steps, trial_starts
from jaxpomdp.numerics import NEG, log_sum_exp


def overlap_floor(dtype: jnp.dtype) -> float:
    """Return the overlap below which scaled results are not trusted: 1e-30 in float32, 1e-280 in float64."""
    return 1e-30 if jnp.finfo(dtype).bits <= 32 else 1e-280


def relative_likelihood(log_obs: Array, valid: Array) -> Array:
    """Return ``exp(log_obs - max log_obs)`` over the last axis: at most one; all ones at padding."""
    floored = jnp.maximum(log_obs, NEG)
    weight = jnp.exp(floored - jnp.max(floored, axis=-1, keepdims=True))
    return jnp.where(valid[..., None], weight, 1)


def backward_step(trans: Array, following: Array, inputs: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Go one step back: from ``future_{t+1}`` to ``future_t``, twice; ``inputs`` as ``backward_weights``."""
    here, action, goes_on = inputs
    beta = jnp.matmul(trans[action], following, precision=EXACT)
    peak = jnp.max(beta)
    beta = jnp.where(goes_on, beta / jnp.where(peak > 0, peak, 1), 1)
    return here * beta, here * beta


def backward_weights(trans: Array, weight: Array, actions: Array, linked: Array) -> Array:
    """Run backward: ``future_t = weight_t beta_t``, ``beta_t(i) ∝ sum_j trans(a_t, i, j) future_{t+1}(j)``.

    ``beta`` is scaled so that its largest entry is one.

    Args:
        trans: probabilities ``[A, N, N]``.
        weight: relative likelihoods ``[T, N]``.
        actions: int ``[T]``.
        linked: bool ``[T]``, the step leads to the next; else ``beta`` is one.

    Returns:
        ``future[T, N]``, in proportion to the probability of this and all later observations of the trial.
    """
    inputs = (weight, actions, linked)
    return lax.scan(partial(backward_step, trans), jnp.ones_like(weight[0]), inputs, reverse=True)[1]


def transition_counts(trans: Array, belief: Array, arriving: Array, actions: Array, linked: Array) -> Array:
    """Return expected transitions, ``[A, N, N]``: one matrix product per action, nothing of size ``T N^2``.

    ``xi(a, i, j) = trans(a, i, j) sum_t [a_t = a] belief_t(i) arriving_{t+1}(j)``.

    Args:
        trans: probabilities ``[A, N, N]``.
        belief: filtered probabilities ``[T, N]``.
        arriving: ``future`` over the step's overlap, ``[T, N]``.
        actions: int ``[T]``.
        linked: bool ``[T]``.
    """
    right = jnp.roll(arriving, -1, axis=0)

    def count(action: Array) -> Array:
        left = jnp.where((linked & (actions == action))[:, None], belief, 0)
        return jnp.matmul(left.T, right, precision=EXACT)

    return trans * lax.map(count, jnp.arange(trans.shape[0]))


def smooth_scaled(
    chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> tuple[Posterior, Array]:
    """Smooth one tape with renormalised probabilities; arguments as ``smooth``.

    Returns:
        The posterior, and a bool scalar: it can be trusted (no underflow that matters).
    """
    trans, linked = jnp.exp(chain.log_trans), linked_steps(start, valid)
    filtered = filter_tape(chain, log_obs, actions, start, valid)
    future = backward_weights(trans, relative_likelihood(log_obs, valid), actions, linked)
    return join_passes(trans, filtered, future, actions, start, valid)


def join_passes(
    trans: Array, filtered: Filtered, future: Array, actions: Array, start: Array, valid: Array
) -> tuple[Posterior, Array]:
    """Join what the past and the future say of each step: ``gamma_t ∝ predicted_t future_t``.

    Args:
        trans: probabilities ``[A, N, N]``.
        filtered: the forward pass.
        future: the backward pass, ``[T, N]``, as ``backward_weights`` scales it.
        actions: int ``[T]``.
        start: bool ``[T]``.
        valid: bool ``[T]``.

    Returns:
        As ``smooth_scaled``.
    """
    linked = linked_steps(start, valid)
    joint = filtered.predicted * future
    overlap = jnp.sum(joint, axis=-1, keepdims=True)
    trusted = overlap >= overlap_floor(overlap.dtype)
    scale = jnp.where(trusted, 1 / jnp.where(trusted, overlap, 1), 0)
    gamma = joint * scale
    xi = transition_counts(trans, filtered.belief, future * scale, actions, linked)
    initial = jnp.sum(jnp.where(trial_starts(start, valid)[:, None], gamma, 0), axis=0)
    return Posterior(jnp.sum(filtered.log_norm), gamma, xi, initial), jnp.all(trusted[:, 0] | ~valid)


def filter_exact(chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Filtered:
    """Filter one tape in logarithms: as ``filter_tape``, but belief and prediction come back as logarithms.

    Slow (``N^2`` exponentials per step) and without underflow: a state of probability 1e-300 can come back.
    """

    def step(carried: Array, inputs: tuple[Array, ...]) -> tuple[Array, Filtered]:
        row, action, first = inputs
        predicted = jnp.where(first, chain.log_init, carried)
        shift = jnp.max(jnp.where(predicted > NEG / 2, row, NEG))
        possible = shift > NEG / 2
        joint = jnp.maximum(predicted + (row - shift), NEG)
        norm = log_sum_exp(joint)
        belief = jnp.where(possible, jnp.where(joint > NEG / 2, joint - norm, NEG), predicted)
        following = log_sum_exp(belief[:, None] + chain.log_trans[action], axis=0)
        return following, Filtered(belief, predicted, jnp.where(possible, norm + shift, NEG))

    rows = jnp.where(valid[:, None], log_obs, 0)
    _, (belief, predicted, log_norm) = lax.scan(
        step, chain.log_init, (rows, actions, trial_starts(start, valid))
    )
    belief, predicted = (jnp.where(valid[:, None], x, NEG) for x in (belief, predicted))
    return Filtered(belief, predicted, jnp.where(valid, log_norm, 0))


def _backward_exact(
    log_trans: Array, rows: Array, log_belief: Array, actions: Array, linked: Array
) -> tuple[Array, Array]:
    """Return ``log future[T, N]`` up to a constant per step, and the expected transitions ``[A, N, N]``.

    ``rows[T, N]`` are ``NEG`` in states out of reach, which then do not set the scale for the others.
    """

    def step(carry: tuple[Array, Array], inputs: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        following, xi = carry
        row, before, action, goes_on = inputs
        leads = log_trans[action] + following[None, :]
        beta = jnp.where(row > NEG / 2, log_sum_exp(leads), NEG)
        beta = jnp.where(goes_on, beta - jnp.max(beta), 0)
        future = jnp.maximum(jnp.where(beta > NEG / 2, row + beta, NEG), NEG)
        pair = jnp.where(goes_on, _shares(before[:, None] + leads), 0)
        return (future, xi.at[action].add(pair)), future

    carry = (jnp.zeros_like(rows[0]), jnp.zeros_like(log_trans))
    (_, xi), future = lax.scan(step, carry, (rows, log_belief, actions, linked), reverse=True)
    return future, xi


def heeded_rows(predicted: Array, log_obs: Array) -> Array:
    """Shift rows by the best likelihood within reach; ``NEG`` out of reach, zeros at an impossible step."""
    reachable = predicted > NEG / 2
    best = jnp.max(jnp.where(reachable, log_obs, NEG), axis=-1, keepdims=True)
    heeded = jnp.where(best > NEG / 2, jnp.maximum(log_obs - best, NEG), 0)
    return jnp.where(reachable, heeded, NEG)


def _shares(log_weight: Array) -> Array:
    """Return ``exp(log_weight)`` scaled to sum to one over all entries; zeros when all are ``NEG``.

    Divided by its own sum, so that what large logarithms lose to rounding is lost to all entries alike.
    """
    weight = jnp.where(log_weight > NEG / 2, jnp.exp(log_weight - jnp.max(log_weight)), 0)
    total = jnp.sum(weight)
    return weight / jnp.where(total > 0, total, 1)


def smooth_exact(chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Smooth one tape in logarithms: the textbook definition, slow and exact; arguments as ``smooth``."""
    linked = linked_steps(start, valid)
    filtered = filter_exact(chain, log_obs, actions, start, valid)
    rows = heeded_rows(filtered.predicted, log_obs)
    future, xi = _backward_exact(chain.log_trans, rows, filtered.belief, actions, linked)
    gamma = jax.vmap(_shares)(filtered.predicted + future)
    initial = jnp.sum(jnp.where(trial_starts(start, valid)[:, None], gamma, 0), axis=0)
    return Posterior(jnp.sum(filtered.log_norm), gamma, xi, initial)


def smooth(chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Smooth one tape: ``gamma_t(i) = p(s_t = i | tape)`` and the expected transitions under each action.

    An impossible step (zero likelihood in every state the past allows) is treated as a missing one and adds
    ``NEG`` to the log-evidence; nothing is ever NaN. The exact route runs only when underflow mattered.

    Args:
        chain: ``log_init[N]``, ``log_trans[A, N, N]``; structural zeros are ``NEG``.
        log_obs: ``[T, N]``, unnormalised is fine; a missing step is a row of zeros.
        actions: int ``[T]``; the last of a trial is ignored.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.

    Returns:
        ``Posterior`` with ``log_evidence[]``, ``gamma[T, N]``, ``xi[A, N, N]``, ``initial[N]``.
    """
    tape = (log_obs, actions, start, valid)
    scaled, trusted = smooth_scaled(chain, *tape)
    # A loop of zero or one turns: under vmap a `cond` would always run both branches, a loop need not.
    _, posterior = lax.while_loop(
        lambda carry: ~carry[0],
        lambda carry: (jnp.ones_like(carry[0]), smooth_exact(chain, *tape)),
        (trusted, scaled),
    )
    return posterior
