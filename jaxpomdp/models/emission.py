"""Emission channels and the return model: densities, statistics and estimates, one class per distribution.

A channel is a pytree with ``N`` as the first axis of every leaf. Data come with any leading axes;
``gamma[..., N]`` are the states' posterior weights at each step.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, pytree
from jaxpomdp.models import estimates
from jaxpomdp.models.estimates import LOG_TWO_PI, Moments
from jaxpomdp.models.family import Prior


class GaussianStatistics(NamedTuple):
    """Moments of each state, and of all the data (for the variance floor)."""

    states: Moments
    pooled: Moments


def weighted_sums(gamma: Array, features: Array) -> Array:
    """Return ``[N, F]``: the sum over all steps of ``gamma[..., N]`` times ``features[..., F]``."""
    rows = gamma.reshape(-1, gamma.shape[-1])
    return jnp.matmul(rows.T, features.reshape(rows.shape[0], -1), precision="highest")


@pytree
class Categorical:
    """Discrete observations: ``log_prob[N, O]``; observations are ints ``[...]``."""

    log_prob: Array

    def log_density(self, x: Array) -> Array:
        """Return ``log p(x | s)``, ``[..., N]``."""
        return jnp.take(self.log_prob.T, x, axis=0, mode="clip")

    def statistics(self, x: Array, mask: Array, gamma: Array) -> Array:
        """Return expected counts ``[N, O]`` of the steps where ``mask[...]``."""
        one_hot = jax.nn.one_hot(x, self.log_prob.shape[-1], dtype=gamma.dtype)
        return weighted_sums(gamma, one_hot * mask[..., None].astype(gamma.dtype))

    def updated(self, counts: Array, prior: Prior) -> Categorical:
        """Return the channel of highest posterior density given the counts."""
        return Categorical(estimates.dirichlet_mode(self.log_prob, counts, prior.observation))

    def constrained(self, x: Array, mask: Array, prior: Prior) -> Categorical:
        """Return itself: data set no limit here."""
        return self

    def log_prior(self, counts: Array, prior: Prior) -> Array:
        """Return the log density of the Dirichlet prior, up to a constant, per state ``[N]``."""
        return estimates.dirichlet_score(self.log_prob, prior.observation)

    def expected(self, counts: Array) -> Array:
        """Return the expected log-likelihood of counted data."""
        return estimates.dirichlet_score(self.log_prob, counts)


@pytree
class DiagonalGaussian:
    """Real vectors with independent coordinates: ``mean[N, D]``, ``var[N, D]``; observations ``[..., D]``."""

    mean: Array
    var: Array

    def log_density(self, x: Array) -> Array:
        """Return ``log N(x; mean, var)`` summed over coordinates, ``[..., N]``."""
        rows = x.reshape(-1, 1, x.shape[-1])
        scaled = (rows - self.mean[None]) ** 2 * (1 / self.var)[None]
        constant = jnp.sum(LOG_TWO_PI + jnp.log(self.var), axis=-1)
        density = -0.5 * (jnp.sum(scaled, axis=-1) + constant[None])
        return density.reshape(*x.shape[:-1], -1)

    def statistics(self, x: Array, mask: Array, gamma: Array) -> GaussianStatistics:
        """Return weighted moments ``[N, D]`` of the steps where ``mask[...]``."""
        pooled = estimates.pooled_moments(x, mask)
        away = jnp.where(mask[..., None], x - jnp.broadcast_to(pooled.mean[0], x.shape), 0)
        ones = mask[..., None].astype(x.dtype)
        sums = weighted_sums(gamma, jnp.concatenate([ones, away, away**2], axis=-1))
        weight, first, second = jnp.split(sums, [1, 1 + x.shape[-1]], axis=-1)
        return GaussianStatistics(estimates.moments_from_sums(weight, first, second, pooled.mean), pooled)

    def updated(self, statistics: GaussianStatistics, prior: Prior) -> DiagonalGaussian:
        """Return the channel of highest posterior density; states that no data reached keep their values."""
        return DiagonalGaussian(*_updated(self.mean, self.var, statistics, prior))

    def constrained(self, x: Array, mask: Array, prior: Prior) -> DiagonalGaussian:
        """Lift variances to the floor that the data set."""
        floor = prior.variance_floor * estimates.pooled_variance(estimates.pooled_moments(x, mask))
        return DiagonalGaussian(self.mean, jnp.maximum(self.var, floor))

    def log_prior(self, statistics: GaussianStatistics, prior: Prior) -> Array:
        """Return the log density of the inverse gamma prior, up to a constant."""
        pooled = estimates.pooled_variance(statistics.pooled)
        return estimates.inverse_gamma_score(self.var, pooled, prior.variance_strength)

    def expected(self, statistics: GaussianStatistics) -> Array:
        """Return the expected log-likelihood of the data behind the moments."""
        return estimates.gaussian_score(self.mean, self.var, statistics.states)


@pytree
class ReturnModel:
    """Gaussian of the return in each state: ``mean[N, K]``, ``var[N, K]``; ``K`` is 1, or ``A`` (by action).

    Source: thesis section 3.3, ``p(o, R | s) = p(o | s) N(R; mu(s), var(s))^theta``.
    """

    mean: Array
    var: Array

    def log_density(self, returns: Array, actions: Array) -> Array:
        """Return ``log N(R; mean, var)`` for ``returns[...]`` after ``actions[...]``, ``[..., N]``."""
        precision, constant = 1 / self.var, LOG_TWO_PI + jnp.log(self.var)
        mean, precision, constant = (self._rows(table, actions) for table in (self.mean, precision, constant))
        return -0.5 * ((returns[..., None] - mean) ** 2 * precision + constant)

    def _rows(self, table: Array, actions: Array) -> Array:
        if table.shape[-1] == 1:
            return jnp.broadcast_to(table[:, 0], (*actions.shape, table.shape[0]))
        return jnp.take(table.T, actions, axis=0, mode="clip")

    def _weights(self, mask: Array, actions: Array, dtype: Any) -> Array:
        choices = self.mean.shape[-1]
        index = actions if choices > 1 else jnp.zeros_like(actions)
        return jax.nn.one_hot(index, choices, dtype=dtype) * mask[..., None].astype(dtype)

    def statistics(self, returns: Array, actions: Array, mask: Array, gamma: Array) -> GaussianStatistics:
        """Return weighted moments ``[N, K]`` of the returns where ``mask[...]``."""
        pooled = estimates.pooled_moments(returns[..., None], mask)
        away = jnp.where(mask, returns - pooled.mean[0, 0], 0)[..., None]
        chosen = self._weights(mask, actions, gamma.dtype)
        sums = weighted_sums(gamma, jnp.concatenate([chosen, chosen * away, chosen * away**2], axis=-1))
        moments = estimates.moments_from_sums(*jnp.split(sums, 3, axis=-1), pooled.mean)
        return GaussianStatistics(moments, pooled)

    def updated(self, statistics: GaussianStatistics, prior: Prior) -> ReturnModel:
        """Return the model of highest posterior density; entries that no data reached keep their values."""
        return ReturnModel(*_updated(self.mean, self.var, statistics, prior))

    def constrained(self, returns: Array, mask: Array, prior: Prior) -> ReturnModel:
        """Lift variances to the floor that the modelled returns set."""
        pooled = estimates.pooled_variance(estimates.pooled_moments(returns[..., None], mask))
        return ReturnModel(self.mean, jnp.maximum(self.var, prior.variance_floor * pooled))

    def log_prior(self, statistics: GaussianStatistics, prior: Prior) -> Array:
        """Return the log density of the inverse gamma prior, up to a constant."""
        pooled = estimates.pooled_variance(statistics.pooled)
        return estimates.inverse_gamma_score(self.var, pooled, prior.variance_strength)

    def expected(self, statistics: GaussianStatistics) -> Array:
        """Return the expected log-likelihood of the returns behind the moments."""
        return estimates.gaussian_score(self.mean, self.var, statistics.states)


def _updated(mean: Array, var: Array, statistics: GaussianStatistics, prior: Prior) -> tuple[Array, Array]:
    states, pooled = statistics.states, estimates.pooled_variance(statistics.pooled)
    seen = states.weight > 0
    new_mean = jnp.where(seen, states.mean, mean)
    new_var = estimates.variance_mode(var, states, pooled, prior.variance_floor, prior.variance_strength)
    return new_mean, new_var
