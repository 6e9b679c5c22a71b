"""The two estimates every family is made of: a probability row from counts, a Gaussian from moments."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.models.family import Prior
from jaxpomdp.numerics import NEG, log_normalise, safe_log

LOG_TWO_PI = 1.8378770664093453
LEAST_FLOOR = 1e-9
"""A variance is never below this share of that of all the data: a density must stay finite."""


def pad_states(x: Array, spare: int, fill: float | bool, axes: tuple[int, ...] = (0,)) -> Array:
    """Return ``x`` with ``spare`` more entries of ``fill`` along the axes of states."""
    widths = [(0, spare if axis in axes else 0) for axis in range(x.ndim)]
    return jnp.pad(x, widths, constant_values=fill)


class Moments(NamedTuple):
    """Weight, mean and sum of squared deviations of weighted data.

    ``weight`` broadcasts against ``mean[..., D]``; ``scatter`` is ``[..., D]``, or ``[..., D, D]``.
    """

    weight: Array
    mean: Array
    scatter: Array


def weighted_sums(gamma: Array, features: Array) -> Array:
    """Return ``[F, N]``: the sum over all steps of ``features[..., F]`` times ``gamma[..., N]``.

    The barrier keeps XLA from moving a later transpose into the product, which makes it three times slower.
    """
    rows = gamma.reshape(-1, gamma.shape[-1])
    columns = features.reshape(rows.shape[0], -1)
    sums = jnp.einsum("tf,tn->fn", columns, rows, precision="highest")
    return jax.lax.optimization_barrier(sums)


def dirichlet_mode(old: Array, counts: Array, pseudo: float | Array) -> Array:
    """Return log rows ``log (counts + pseudo) / sum(counts + pseudo)`` along the last axis.

    Entries that are ``NEG`` in ``old`` stay so; a row with neither counts nor pseudo-counts stays ``old``.
    """
    mass = jnp.where(old > NEG / 2, counts + pseudo, 0)
    total = jnp.sum(mass, axis=-1, keepdims=True)
    return jnp.where(total > 0, safe_log(mass / jnp.where(total > 0, total, 1)), old)


def check_rows(name: str, log_prob: Any, rows: np.ndarray) -> None:
    """Refuse log-probability rows (last axis) that do not sum to one, where ``rows``; on the host.

    Raises:
        ValueError: naming the argument, with the sum that came.
    """
    total = np.exp(np.maximum(np.asarray(log_prob, dtype=np.float64), NEG)).sum(axis=-1)
    wrong = rows & (np.abs(total - 1) > 1e-3)
    if wrong.any():
        raise ValueError(f"{name} must have rows that sum to one, got a sum of {total[wrong][0]:.6g}")


def check_positive(name: str, variance: Any, rows: np.ndarray) -> None:
    """Refuse variances ``[..., N, D]`` that are not above zero, where ``rows[..., N]``; on the host.

    Raises:
        ValueError: naming the argument, with the variance that came.
    """
    least = np.asarray(variance).min(axis=-1)
    if (rows & ~(least > 0)).any():
        raise ValueError(f"{name} must be positive, got {least[rows].min():.6g}")


def dirichlet_score(log_prob: Array, counts: float | Array) -> Array:
    """Return each row's ``sum counts * log_prob`` over its possible entries: what counts are worth there."""
    return jnp.sum(jnp.where(log_prob > NEG / 2, counts * log_prob, 0), axis=-1)


def free_rows(old: Array, logits: Array) -> Array:
    """Return ``log softmax(logits)`` over the entries that are possible in ``old``; zeros stay."""
    return log_normalise(jnp.where(old > NEG / 2, logits, NEG))


def count_free_entries(log_prob: Array) -> Array:
    """Return how many entries of each row are free: the possible ones, less one for the sum."""
    return jnp.maximum(jnp.sum(log_prob > NEG / 2, axis=-1) - 1, 0)


def moments_from_sums(weight: Array, first: Array, second: Array, centre: Array) -> Moments:
    """Turn weighted sums of ``x - centre`` and of its square (or outer product) into moments.

    With a centre amid the data float32 loses nothing that the variance floor would not hide.
    """
    mean = first / jnp.where(weight > 0, weight, 1)
    if second.ndim > first.ndim:
        return Moments(weight, mean + centre, second - first[..., :, None] * mean[..., None, :])
    return Moments(weight, mean + centre, jnp.maximum(second - first * mean, 0))


def pooled_moments(x: Array, mask: Array) -> Moments:
    """Return the moments ``[1, D]`` of all the rows ``x[..., D]`` where ``mask[...]``."""
    here = mask.reshape(-1, 1)
    rows = x.reshape(-1, x.shape[-1])
    total = jnp.sum(here.astype(x.dtype), axis=0, keepdims=True)
    mean = jnp.sum(jnp.where(here, rows, 0), axis=0, keepdims=True) / jnp.maximum(total, 1)
    return Moments(total, mean, jnp.sum(jnp.where(here, rows - mean, 0) ** 2, axis=0, keepdims=True))


def pooled_variance(pooled: Moments) -> Array:
    """Return the variance of all the data; constant data get a width of a thousandth of their scale."""
    variance = pooled.scatter / jnp.maximum(pooled.weight, 1)
    return jnp.maximum(variance, 1e-6 * pooled.mean**2 + 1e-12)


def centred(x: Array, mask: Array) -> tuple[Array, Array]:
    """Return ``mask[..., 1]`` as numbers, and ``x[..., D]`` less the data's mean, zero where not ``mask``."""
    here = mask[..., None]
    mean = jnp.broadcast_to(pooled_moments(x, mask).mean[0], x.shape)
    return here.astype(x.dtype), jnp.where(here, x - mean, 0)


def floor_share(prior: Prior) -> float:
    """Return the least variance in units of that of all the data."""
    return max(prior.variance_floor, LEAST_FLOOR)


def variance_mode(old: Array, moments: Moments, pooled: Array, prior: Prior) -> Array:
    """Return the variances that maximise the data's and the inverse gamma prior's density above a floor.

    ``(scatter + strength * pooled) / (weight + strength)``, at least ``floor * pooled``; ``old`` where there
    is neither weight nor prior.
    """
    strength = prior.variance_strength
    weight = moments.weight + strength
    mode = (moments.scatter + strength * pooled) / jnp.where(weight > 0, weight, 1)
    return jnp.maximum(jnp.where(weight > 0, mode, old), floor_share(prior) * pooled)


def lift_covariance(cov: Array, least: Array) -> Array:
    """Return the likeliest covariances ``[N, D, D]`` with ``cov >= diag(least[D])``: eigenvalues are clipped.

    The clipping is done in coordinates where the limit is the identity.
    """
    scale = jnp.sqrt(least)
    outer = scale[:, None] * scale[None, :]
    values, vectors = jnp.linalg.eigh(cov / outer[None])
    lifted = vectors * jnp.maximum(values, 1)[..., None, :]
    return jnp.einsum("nij,nkj->nik", lifted, vectors, precision="highest") * outer[None]


def gaussian_score(mean: Array, variance: Array, moments: Moments) -> Array:
    """Return each row's ``sum weight * E[log N(x; mean, variance)]`` of the data behind the moments."""
    spread = moments.scatter + moments.weight * (moments.mean - mean) ** 2
    return -0.5 * jnp.sum(moments.weight * (LOG_TWO_PI + jnp.log(variance)) + spread / variance, axis=-1)


def inverse_gamma_score(variance: Array, pooled: Array, strength: float) -> Array:
    """Return each row's log prior, up to a constant: ``-strength/2 * (log v + pooled / v)`` summed."""
    return -0.5 * strength * jnp.sum(jnp.log(variance) + pooled / variance, axis=-1)


def _merge(a: Moments, b: Moments) -> Moments:
    weight = a.weight + b.weight
    share = b.weight / jnp.where(weight > 0, weight, 1)
    delta = b.mean - a.mean
    outer = a.scatter.ndim > a.mean.ndim
    square = delta[..., :, None] * delta[..., None, :] if outer else delta**2
    between = (a.weight * share)[..., None] if outer else a.weight * share
    return Moments(weight, a.mean + share * delta, a.scatter + b.scatter + between * square)


def _is_moments(x: object) -> bool:
    return isinstance(x, Moments)


def add_statistics(a: Any, b: Any) -> Any:
    """Return the statistics of two batches taken together; counts add, moments merge without cancellation."""

    def add(x: Any, y: Any) -> Any:
        return _merge(x, y) if _is_moments(x) else x + y

    return jax.tree.map(add, a, b, is_leaf=_is_moments)


def scale_statistics(statistics: Any, factor: float | Array) -> Any:
    """Return statistics of which every step counts ``factor`` times (a decay, or the strength of a prior)."""

    def scale(x: Any) -> Any:
        return Moments(x.weight * factor, x.mean, x.scatter * factor) if _is_moments(x) else x * factor

    return jax.tree.map(scale, statistics, is_leaf=_is_moments)
