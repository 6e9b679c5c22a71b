"""Log-densities of what a state emits, in every state at once, and draws from them.

Data come with any leading axes ``[...]`` (one step, a tape, a batch); the result has ``N`` as its last axis.
Gaussians are evaluated from differences to the mean, never from expanded squares, which cancel in float32.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array
from jaxpomdp.kernels.filtering import EXACT

LOG_TWO_PI = math.log(2 * math.pi)


def categorical_log_prob(log_prob: Array, symbols: Array) -> Array:
    """Return ``log p(o | s)`` by a gather, ``[..., N]``; symbols out of range are clipped into it.

    Args:
        log_prob: ``[N, O]``.
        symbols: int ``[...]``.
    """
    return jnp.take(log_prob.T, symbols, axis=0, mode="clip")


def diagonal_log_prob(mean: Array, var: Array, x: Array) -> Array:
    """Return ``log N(x; mean_s, diag var_s)``, ``[..., N]``.

    Args:
        mean: ``[N, D]``.
        var: ``[N, D]``, in squared units of ``x``.
        x: ``[..., D]``.
    """
    flat = x.reshape(-1, 1, x.shape[-1])
    distance = jnp.sum((flat - mean[None]) ** 2 * (1 / var)[None], axis=-1)
    constant = jnp.sum(LOG_TWO_PI + jnp.log(var), axis=-1)
    return (-0.5 * (distance + constant[None])).reshape(*x.shape[:-1], -1)


def whitening(cov: Array) -> tuple[Array, Array]:
    """Return ``W[..., D, D]`` with ``W^T W = cov^-1``, and ``log det cov``."""
    factor = jnp.linalg.cholesky(cov)
    eye = jnp.broadcast_to(jnp.eye(cov.shape[-1], dtype=cov.dtype), cov.shape)
    diagonal = jnp.diagonal(factor, axis1=-2, axis2=-1)
    return jax.scipy.linalg.solve_triangular(factor, eye, lower=True), 2 * jnp.sum(jnp.log(diagonal), axis=-1)


def full_log_prob(mean: Array, cov: Array, x: Array) -> Array:
    """Return ``log N(x; mean_s, cov_s)``, ``[..., N]``, with one Cholesky factor per state.

    Args:
        mean: ``[N, D]``.
        cov: ``[N, D, D]``, symmetric and positive definite.
        x: ``[..., D]``.
    """
    whiten, log_det = whitening(cov)
    away = x.reshape(-1, 1, x.shape[-1]) - mean[None]
    scaled = jnp.einsum("nij,rnj->rni", whiten, away, precision=EXACT)
    constant = mean.shape[-1] * LOG_TWO_PI + log_det
    return (-0.5 * (jnp.sum(scaled**2, axis=-1) + constant[None])).reshape(*x.shape[:-1], -1)


def return_log_density(mean: Array, var: Array, returns: Array, actions: Array | None = None) -> Array:
    """Return ``log N(R; mean, var)`` of the return in each state, ``[..., N]``.

    Args:
        mean: ``[N]``, or ``[N, A]`` when returns are modelled per state and action.
        var: as ``mean``, in squared units of return.
        returns: ``[...]``.
        actions: int ``[...]``, needed when there is an axis of actions.
    """
    if mean.ndim == 2:
        mean, var = (jnp.take(table.T, actions, axis=0, mode="clip") for table in (mean, var))
    away = (returns[..., None] - _align(mean, returns)) ** 2
    return -0.5 * (away / _align(var, returns) + LOG_TWO_PI + jnp.log(_align(var, returns)))


def _align(table: Array, returns: Array) -> Array:
    """Give a table ``[N]`` the leading axes of the returns; leave one that has them."""
    return table if table.ndim > 1 else table.reshape((1,) * returns.ndim + table.shape)


def tempered(log_obs: Array, log_return: Array, theta: float | Array, has_return: Array) -> Array:
    """Return ``log p(o | s) N(R; s)^theta`` where the return is modelled, else ``log p(o | s)`` (thesis 3.3).

    Args:
        log_obs: ``[..., N]``.
        log_return: ``[..., N]``.
        theta: weight of utility, at least zero; at zero returns are ignored.
        has_return: bool ``[...]``.
    """
    return log_obs + jnp.where(has_return[..., None], theta * log_return, 0)


def unless_missing(log_obs: Array, observed: Array) -> Array:
    """Make the rows ``[..., N]`` of missing steps zero: they say nothing about the state."""
    return jnp.where(observed[..., None], log_obs, 0)


def sample_symbols(key: Array, log_prob: Array, states: Array) -> Array:
    """Draw a symbol in each of ``states[T]`` from ``log_prob[N, O]``: int ``[T]``.

    A draw depends on the key and the number of the step alone; at padding (-1) it means nothing.
    """
    keys = step_keys(key, states.shape[0])
    return jax.vmap(jax.random.categorical)(keys, log_prob[states])


def sample_vectors(key: Array, mean: Array, cov: Array, states: Array) -> Array:
    """Draw a vector in each of ``states[T]`` from ``mean[N, D]``, ``cov[N, D, D]``: ``[T, D]``.

    As ``sample_symbols``, by key and step.
    """
    keys = step_keys(key, states.shape[0])
    noise = jax.vmap(lambda k: jax.random.normal(k, mean.shape[-1:], mean.dtype))(keys)
    factor = jnp.linalg.cholesky(cov)[states]
    return mean[states] + jnp.einsum("tij,tj->ti", factor, noise, precision=EXACT)


def step_keys(key: Array, steps: int) -> Array:
    """Return one key per step, which depends on the step's number alone."""
    return jax.vmap(lambda t: jax.random.fold_in(key, t))(jnp.arange(steps))
