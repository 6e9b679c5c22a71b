"""The emission channel of real vectors with any covariance."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array, pytree
from jaxpomdp.kernels import emissions
from jaxpomdp.models import estimates
from jaxpomdp.models.emission import GaussianStatistics, check_vectors, pooled_width
from jaxpomdp.models.estimates import LOG_TWO_PI, Moments
from jaxpomdp.models.family import Prior


@pytree
class FullGaussian:
    """Real vectors with any covariance: ``mean[N, D]``, ``cov[N, D, D]``; observations ``[..., D]``."""

    mean: Array
    cov: Array

    def log_density(self, x: Array) -> Array:
        """Return ``log N(x; mean, cov)``, ``[..., N]``."""
        return emissions.full_log_prob(self.mean, self.cov, x)

    def features(self, x: Array, mask: Array) -> Array:
        """Return one, the distance from the data's mean and its outer product, ``[..., 1 + D + D^2]``."""
        ones, away = estimates.centred(x, mask)
        outer = (away[..., :, None] * away[..., None, :]).reshape(*away.shape[:-1], -1)
        return jnp.concatenate([ones, away, outer], axis=-1)

    def collect(self, sums: Array, x: Array, mask: Array, gamma: Array) -> GaussianStatistics:
        """Return weighted moments, scatter ``[N, D, D]``, from the features' sums."""
        pooled = estimates.pooled_moments(x, mask)
        weight, first, second = jnp.split(sums.T, [1, 1 + x.shape[-1]], axis=-1)
        second = second.reshape(*first.shape, -1)
        return GaussianStatistics(estimates.moments_from_sums(weight, first, second, pooled.mean), pooled)

    def updated(self, statistics: GaussianStatistics, prior: Prior) -> FullGaussian:
        """Return the channel of highest posterior density; states that no data reached keep their values."""
        states, pooled = statistics.states, estimates.pooled_variance(statistics.pooled)
        seen, weight = states.weight > 0, states.weight + prior.variance_strength
        width = jnp.diag(pooled[0])[None]
        mode = states.scatter + prior.variance_strength * width
        mode = mode / jnp.where(weight > 0, weight, 1)[..., None]
        cov = _lifted(jnp.where((weight > 0)[..., None], mode, self.cov), pooled, prior)
        return FullGaussian(jnp.where(seen, states.mean, self.mean), cov)

    def feasible(self, x: Array, mask: Array, prior: Prior, carry: GaussianStatistics | None) -> FullGaussian:
        """Lift covariances to the floor that the data set."""
        return FullGaussian(self.mean, _lifted(self.cov, pooled_width(x, mask, carry), prior))

    def log_prior(self, statistics: GaussianStatistics, prior: Prior) -> Array:
        """Return the log density of the inverse Wishart prior, up to a constant, per state ``[N]``."""
        width = jnp.diag(estimates.pooled_variance(statistics.pooled)[0])[None]
        return -0.5 * prior.variance_strength * self._deviance(width, 1.0)

    def expected(self, statistics: GaussianStatistics) -> Array:
        """Return the expected log-likelihood of the data behind the moments, per state ``[N]``."""
        weight, mean, scatter = statistics.states
        off = mean - self.mean
        spread = scatter + weight[..., None] * off[..., :, None] * off[..., None, :]
        constant = weight[..., 0] * self.mean.shape[-1] * LOG_TWO_PI
        return -0.5 * (constant + self._deviance(spread, weight[..., 0]))

    def _deviance(self, scatter: Array, weight: Array | float) -> Array:
        """Return ``weight log det cov + trace(cov^-1 scatter)``, ``[N]``."""
        whiten, log_det = emissions.whitening(self.cov)
        precision = jnp.einsum("nij,nik->njk", whiten, whiten, precision="highest")
        return weight * log_det + jnp.sum(precision * scatter, axis=(-2, -1))

    def as_counts(self, strength: float | Array) -> GaussianStatistics:
        """Return the moments that ``strength`` typical data of each state would give."""
        weight = jnp.full_like(self.mean[:, :1], strength)
        nothing = jnp.zeros_like(self.mean[:1])
        states = Moments(weight, self.mean, weight[..., None] * self.cov)
        return GaussianStatistics(states, Moments(nothing[:, :1], nothing, nothing))

    def to_free(self) -> dict[str, Array]:
        """Return means and Cholesky factors with a logarithmic diagonal."""
        factor = jnp.linalg.cholesky(self.cov)
        log_diagonal = jnp.log(jnp.diagonal(factor, axis1=-2, axis2=-1))
        return {"mean": self.mean, "factor": jnp.tril(factor, -1), "log_diagonal": log_diagonal}

    def from_free(self, free: dict[str, Array]) -> FullGaussian:
        """Return the channel with these means and factors."""
        eye = jnp.eye(self.mean.shape[-1], dtype=self.mean.dtype)[None]
        factor = jnp.tril(free["factor"], -1) + eye * jnp.exp(free["log_diagonal"])[..., None, :]
        return FullGaussian(free["mean"], jnp.einsum("nij,nkj->nik", factor, factor, precision="highest"))

    def count_free(self) -> Array:
        """Return the number of free parameters per state, ``[N]``."""
        dimension = self.mean.shape[-1]
        return jnp.full(self.mean.shape[:1], dimension + dimension * (dimension + 1) // 2)

    def padded(self, spare: int) -> FullGaussian:
        """Return the channel with rows for ``spare`` more states."""
        cov = estimates.pad_states(self.cov, spare, 0)
        eye = jnp.eye(cov.shape[-1], dtype=cov.dtype)[None]
        absent = jnp.arange(cov.shape[0]) >= self.cov.shape[0]
        return FullGaussian(
            estimates.pad_states(self.mean, spare, 0), jnp.where(absent[:, None, None], eye, cov)
        )

    def check_params(self, alive: np.ndarray, name: str) -> None:
        """Refuse covariances of living states that are not positive definite."""
        estimates.check_positive(f"{name}.cov (eigenvalues)", np.linalg.eigvalsh(self.cov), alive)

    def check(self, x: np.ndarray, observed: np.ndarray, name: str) -> None:
        """Refuse observations of another dimension, and numbers that are not finite."""
        check_vectors(x, observed, self.mean.shape[-1], name)


def _lifted(cov: Array, pooled: Array, prior: Prior) -> Array:
    return estimates.lift_covariance(cov, estimates.floor_share(prior) * pooled[0])
