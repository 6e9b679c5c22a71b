"""Emission channels and the return model: densities, statistics and estimates, one class per distribution.

A channel is a pytree with ``N`` as the first axis of every leaf. Data come with any leading axes. Statistics
are linear in the states' posterior weights: ``features`` says of what, so that one matrix product serves all
channels of a model, and ``collect`` reads the sums. Absent states need finite leaves (variance one).
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array, pytree
from jaxpomdp.kernels import emissions
from jaxpomdp.models import estimates
from jaxpomdp.models.estimates import LOG_TWO_PI, Moments
from jaxpomdp.models.family import Prior

WIDE = 256
"""Above this many symbols, counts are scattered, not multiplied: one-hot rows would fill the memory."""


class GaussianStatistics(NamedTuple):
    """Moments of each state, and of all the data (for the variance floor)."""

    states: Moments
    pooled: Moments


@pytree
class Categorical:
    """Discrete observations: ``log_prob[N, O]``; observations are ints ``[...]``."""

    log_prob: Array

    def log_density(self, x: Array) -> Array:
        """Return ``log p(x | s)``, ``[..., N]``."""
        return emissions.categorical_log_prob(self.log_prob, x)

    def features(self, x: Array, mask: Array) -> Array:
        """Return one-hot rows ``[..., O]`` where ``mask[...]``; nothing for a wide alphabet."""
        symbols = self.log_prob.shape[-1]
        hot = jax.nn.one_hot(x, 0 if symbols > WIDE else symbols, dtype=self.log_prob.dtype)
        return hot * mask[..., None].astype(hot.dtype)

    def collect(self, sums: Array, x: Array, mask: Array, gamma: Array) -> Array:
        """Return expected counts ``[N, O]`` from the features' sums ``[F, N]``."""
        symbols = self.log_prob.shape[-1]
        if symbols <= WIDE:
            return sums.T
        seen = jnp.where(mask.reshape(-1, 1), gamma.reshape(-1, gamma.shape[-1]), 0)
        return jax.ops.segment_sum(seen, x.reshape(-1), symbols).T

    def updated(self, counts: Array, prior: Prior) -> Categorical:
        """Return the channel of highest posterior density given the counts."""
        return Categorical(estimates.dirichlet_mode(self.log_prob, counts, prior.observation))

    def feasible(self, x: Array, mask: Array, prior: Prior, carry: Array | None) -> Categorical:
        """Return itself: data set no limit here."""
        return self

    def log_prior(self, counts: Array, prior: Prior) -> Array:
        """Return the log density of the Dirichlet prior, up to a constant, per state ``[N]``."""
        return estimates.dirichlet_score(self.log_prob, prior.observation)

    def expected(self, counts: Array) -> Array:
        """Return the expected log-likelihood of counted data, per state ``[N]``."""
        return estimates.dirichlet_score(self.log_prob, counts)

    def as_counts(self, strength: float | Array) -> Array:
        """Return the counts that ``strength`` typical observations of each state would give, ``[N, O]``."""
        return strength * jnp.exp(self.log_prob)

    def to_free(self) -> Array:
        """Return logits."""
        return self.log_prob

    def from_free(self, free: Array) -> Categorical:
        """Return the channel with these logits and its own zeros."""
        return Categorical(estimates.free_rows(self.log_prob, free))

    def count_free(self) -> Array:
        """Return the number of free parameters per state, ``[N]``."""
        return estimates.count_free_entries(self.log_prob)

    def padded(self, spare: int) -> Categorical:
        """Return the channel with rows for ``spare`` more states."""
        return Categorical(estimates.pad_states(self.log_prob, spare, -math.log(self.log_prob.shape[-1])))

    def check_params(self, alive: np.ndarray, name: str) -> None:
        """Refuse rows of living states that do not sum to one."""
        estimates.check_rows(f"{name}.log_prob", self.log_prob, alive)

    def check(self, x: np.ndarray, observed: np.ndarray, name: str) -> None:
        """Refuse observations that are not symbols of this channel."""
        symbols = self.log_prob.shape[-1]
        if not np.issubdtype(x.dtype, np.integer):
            raise ValueError(f"{name} must be integers in 0..{symbols - 1}, got dtype {x.dtype}")
        unknown = observed & ((x < 0) | (x >= symbols))
        if unknown.any():
            raise ValueError(f"{name} must be in 0..{symbols - 1}, got {x[unknown][0]}")


class _MeanAndVariance:
    """What the channels with leaves ``mean[N, D]`` and ``var[N, D]`` share."""

    mean: Array
    var: Array

    def _made(self, mean: Array, var: Array) -> Self:
        return type(self)(mean, var)  # type: ignore[call-arg]

    def updated(self, statistics: GaussianStatistics, prior: Prior) -> Self:
        """Return the channel of highest posterior density; entries that no data reached keep their values."""
        states, pooled = statistics.states, estimates.pooled_variance(statistics.pooled)
        var = estimates.variance_mode(self.var, states, pooled, prior)
        return self._made(jnp.where(states.weight > 0, states.mean, self.mean), var)

    def lifted(self, pooled: Array, prior: Prior) -> Self:
        """Lift variances to the floor, a share of the variance ``pooled[1, D]`` of all the data."""
        return self._made(self.mean, jnp.maximum(self.var, estimates.floor_share(prior) * pooled))

    def log_prior(self, statistics: GaussianStatistics, prior: Prior) -> Array:
        """Return the log density of the inverse gamma prior, up to a constant, per state ``[N]``."""
        pooled = estimates.pooled_variance(statistics.pooled)
        return estimates.inverse_gamma_score(self.var, pooled, prior.variance_strength)

    def expected(self, statistics: GaussianStatistics) -> Array:
        """Return the expected log-likelihood of the data behind the moments, per state ``[N]``."""
        return estimates.gaussian_score(self.mean, self.var, statistics.states)

    def as_counts(self, strength: float | Array) -> GaussianStatistics:
        """Return the moments that ``strength`` typical data of each entry would give."""
        weight = jnp.full_like(self.mean, strength)
        nothing = jnp.zeros_like(self.mean[:1])
        return GaussianStatistics(
            Moments(weight, self.mean, weight * self.var), Moments(nothing[:, :1], nothing, nothing)
        )

    def to_free(self) -> dict[str, Array]:
        """Return means and log variances."""
        return {"mean": self.mean, "log_var": jnp.log(self.var)}

    def from_free(self, free: dict[str, Array]) -> Self:
        """Return the channel with these means and log variances."""
        return self._made(free["mean"], jnp.exp(free["log_var"]))

    def count_free(self) -> Array:
        """Return the number of free parameters per state, ``[N]``."""
        return jnp.full(self.mean.shape[:1], 2 * self.mean.shape[-1])

    def padded(self, spare: int) -> Self:
        """Return the channel with rows for ``spare`` more states."""
        return self._made(estimates.pad_states(self.mean, spare, 0), estimates.pad_states(self.var, spare, 1))


@pytree
class DiagonalGaussian(_MeanAndVariance):
    """Real vectors with independent coordinates: ``mean[N, D]``, ``var[N, D]``; observations ``[..., D]``."""

    mean: Array
    var: Array

    def log_density(self, x: Array) -> Array:
        """Return ``log N(x; mean, var)`` summed over coordinates, ``[..., N]``."""
        return emissions.diagonal_log_prob(self.mean, self.var, x)

    def features(self, x: Array, mask: Array) -> Array:
        """Return one, ``x`` from the data's mean, and its square, where ``mask[...]``: ``[..., 1 + 2D]``."""
        ones, away = estimates.centred(x, mask)
        return jnp.concatenate([ones, away, away**2], axis=-1)

    def collect(self, sums: Array, x: Array, mask: Array, gamma: Array) -> GaussianStatistics:
        """Return weighted moments ``[N, D]`` from the features' sums."""
        pooled = estimates.pooled_moments(x, mask)
        weight, first, second = jnp.split(sums.T, [1, 1 + x.shape[-1]], axis=-1)
        return GaussianStatistics(estimates.moments_from_sums(weight, first, second, pooled.mean), pooled)

    def feasible(self, x: Array, mask: Array, prior: Prior, carry: GaussianStatistics | None) -> Self:
        """Lift variances to the floor that the data set."""
        return self.lifted(pooled_width(x, mask, carry), prior)

    def check_params(self, alive: np.ndarray, name: str) -> None:
        """Refuse variances of living states that are not positive."""
        estimates.check_positive(f"{name}.var", self.var, alive)

    def check(self, x: np.ndarray, observed: np.ndarray, name: str) -> None:
        """Refuse observations of another dimension, and numbers that are not finite."""
        check_vectors(x, observed, self.mean.shape[-1], name)


@pytree
class ReturnModel(_MeanAndVariance):
    """Gaussian of the return in each state: ``mean[N, K]``, ``var[N, K]``; ``K`` is 1, or ``A`` (by action).

    Source: thesis section 3.3, ``p(o, R | s) = p(o | s) N(R; mu(s), var(s))^theta``.
    """

    mean: Array
    var: Array

    def log_density(self, returns: Array, actions: Array) -> Array:
        """Return ``log N(R; mean, var)`` for ``returns[...]`` after ``actions[...]``, ``[..., N]``.

        As ``kernels.emissions.return_log_density``, but logarithms are taken once per state and action, not
        once per step and state.
        """
        tables = (self.mean, 1 / self.var, LOG_TWO_PI + jnp.log(self.var))
        mean, precision, constant = (self._rows(table, actions) for table in tables)
        return -0.5 * ((returns[..., None] - mean) ** 2 * precision + constant)

    def _rows(self, table: Array, actions: Array) -> Array:
        if table.shape[-1] == 1:
            return jnp.broadcast_to(table[:, 0], (*actions.shape, table.shape[0]))
        return jnp.take(table.T, actions, axis=0, mode="clip")

    def features(self, returns: Array, actions: Array, mask: Array) -> Array:
        """Return one, ``R`` from the mean return, and its square, in the action's slot: ``[..., 3K]``."""
        choices = self.mean.shape[-1]
        index = actions if choices > 1 else jnp.zeros_like(actions)
        ones, away = estimates.centred(returns[..., None], mask)
        chosen = jax.nn.one_hot(index, choices, dtype=returns.dtype) * ones
        return jnp.concatenate([chosen, chosen * away, chosen * away**2], axis=-1)

    def collect(self, sums: Array, returns: Array, mask: Array) -> GaussianStatistics:
        """Return weighted moments ``[N, K]`` from the features' sums."""
        pooled = estimates.pooled_moments(returns[..., None], mask)
        weight, first, second = jnp.split(sums.T, 3, axis=-1)
        return GaussianStatistics(estimates.moments_from_sums(weight, first, second, pooled.mean), pooled)

    def feasible(self, returns: Array, mask: Array, prior: Prior, carry: GaussianStatistics | None) -> Self:
        """Lift variances to the floor that the modelled returns set."""
        return self.lifted(pooled_width(returns[..., None], mask, carry), prior)


def pooled_width(x: Array, mask: Array, carry: GaussianStatistics | None) -> Array:
    """Return the variance ``[1, D]`` of all the data ``x[..., D]`` where ``mask[...]``, and of carried."""
    pooled = estimates.pooled_moments(x, mask)
    return estimates.pooled_variance(
        pooled if carry is None else estimates.add_statistics(carry.pooled, pooled)
    )


def check_vectors(x: np.ndarray, observed: np.ndarray, dimension: int, name: str) -> None:
    """Refuse observations that are not finite vectors of this dimension.

    Raises:
        ValueError: naming the channel.
    """
    if not np.issubdtype(x.dtype, np.floating) or x.ndim != observed.ndim + 1 or x.shape[-1] != dimension:
        raise ValueError(f"{name} must be floats [..., {dimension}], got {x.dtype}{list(x.shape)}")
    if not np.isfinite(x[observed]).all():
        raise ValueError(f"{name} must be finite where observed, got NaN or infinity")
