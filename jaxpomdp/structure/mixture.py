"""Mixtures of Gaussians in one dimension, fitted to weighted values by EM, and how many components are enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from jaxpomdp.structure.significance import ChiSquare, bin_probability, goodness_of_fit

LEAST_MASS = 1e-9
"""Share of the total weight under which a component keeps its old mean and variance."""


@dataclass(frozen=True, eq=False)
class Mixture:
    """``p(x) = sum_j weight[j] N(x; mean[j], var[j])``, components by rising mean, and how well it fits.

    Attributes:
        weight: ``[m]``, sums to one.
        mean: ``[m]``.
        var: ``[m]``.
        log_likelihood: ``sum_i w_i log p(x_i)`` over the data it was fitted to.
        iterations: EM iterations that were run.
    """

    weight: np.ndarray
    mean: np.ndarray
    var: np.ndarray
    log_likelihood: float
    iterations: int

    @property
    def components(self) -> int:
        """Number of components, m."""
        return len(self.weight)

    def bic(self, count: float) -> float:
        """Return ``(3 m - 1) log(count) - 2 log-likelihood``; smaller is better (Schwarz 1978)."""
        return (3 * self.components - 1) * np.log(max(count, 1.0)) - 2 * self.log_likelihood

    def merged(self, components: int) -> Mixture:
        """Return a mixture of at most so many components: the lightest joins its nearest, moments kept.

        ``log_likelihood`` stays that of the mixture before merging.
        """
        weight, mean, var = self.weight, self.mean, self.var
        while len(weight) > max(components, 1):
            weight, mean, var = _merge_lightest(weight, mean, var)
        return Mixture(weight, mean, var, self.log_likelihood, self.iterations)


def fit_mixture(
    values: np.ndarray,
    weights: np.ndarray,
    components: int,
    *,
    variance_floor: float = 0.0,
    iterations: int = 200,
    tolerance: float = 1e-6,
    restarts: int = 1,
    rng: np.random.Generator | None = None,
) -> Mixture:
    """Fit a mixture to values with weights by EM and return the best of the restarts.

    E-step: ``r[i, j] = weight[j] N(x_i; mean[j], var[j]) / p(x_i)``. M-step: moments weighted by ``w_i r[i, j]``.
    The first start is at the quantiles of the data (no randomness); the others draw centres as k-means++ does.
    A component left without weight keeps its moments; weights that are all zero give the start back.

    Args:
        values: ``[I]``.
        weights: ``[I]``, not negative, any scale.
        components: m.
        variance_floor: least variance of a component (a tiny share of the data's is always kept).
        iterations: at most so many.
        tolerance: stop when the mean log-likelihood gains less than this.
        restarts: number of starts, 1 = the quantiles alone.
        rng: source of the random starts; needed when ``restarts > 1``.

    Raises:
        ValueError: shapes disagree, a weight is negative, or a number is out of range.

    >>> mixture = fit_mixture(np.array([0.0, 0.1, 5.0, 5.1]), np.ones(4), 2)
    >>> mixture.mean.round(2).tolist(), mixture.weight.round(2).tolist()
    ([0.05, 5.05], [0.5, 0.5])
    """
    values, weights = np.asarray(values, float), np.asarray(weights, float)
    _check(values, weights, components, restarts, rng)
    total = float(weights.sum())
    share = weights / total if total > 0 else weights
    floor = _floor(values, share, variance_floor)
    starts = [_quantile_centres(values, share, components)]
    starts += [_random_centres(values, share, components, rng) for _ in range(restarts - 1) if rng is not None]
    fits = [_climb(values, share, centres, floor, iterations, tolerance) for centres in starts]
    best = max(fits, key=lambda fit: fit.log_likelihood)
    return replace(best, log_likelihood=best.log_likelihood * total)


def mixture_bins(edges: np.ndarray, mixture: Mixture) -> np.ndarray:
    """Return the probability ``[bins]`` of each bin of a grid under the mixture."""

    def cdf(x: np.ndarray) -> np.ndarray:
        return special.ndtr((x[:, None] - mixture.mean) / np.sqrt(mixture.var)) @ mixture.weight

    return bin_probability(edges, cdf)


def acceptable_fit(
    hist: np.ndarray, edges: np.ndarray, mixture: Mixture, *, cells: int | None, least_expected: float = 5.0
) -> ChiSquare:
    """Test by chi-square whether weighted counts come from the mixture fitted to them.

    dof = cells - 1 - (3 m - 1), at least one: with few cells the test accepts only what fits closely.
    """
    result = goodness_of_fit(hist, mixture_bins(edges, mixture), cells=cells, least_expected=least_expected)
    dof = np.maximum(result.dof - (3 * mixture.components - 1), 1)
    return result._replace(dof=dof, p_value=special.chdtrc(dof, result.statistic))


def fewest_acceptable(
    hist: np.ndarray,
    edges: np.ndarray,
    centres: np.ndarray,
    *,
    components: Sequence[int] = (2, 3, 4),
    significance: float = 0.05,
    cells: int | None = None,
    variance_floor: float = 0.0,
    restarts: int = 1,
    rng: np.random.Generator | None = None,
) -> tuple[Mixture, bool]:
    """Fit mixtures of rising size; return the first that chi-square does not reject (thesis 3.3) and ``True``.

    When all are rejected: the one with the best BIC, and ``False``.

    Args:
        hist: ``[bins]`` weights.
        edges: ``[bins + 1]``.
        centres: ``[bins]``, the value that stands for each bin.
        components: sizes to try.
        significance: level of the test of fit.
        cells: as in ``goodness_of_fit``.
        variance_floor: as in ``fit_mixture``.
        restarts: as in ``fit_mixture``.
        rng: as in ``fit_mixture``.
    """
    count = float(hist.sum())
    fits = []
    for size in sorted(components):
        fit = fit_mixture(centres, hist, size, variance_floor=variance_floor, restarts=restarts, rng=rng)
        if acceptable_fit(hist, edges, fit, cells=cells).p_value > significance:
            return fit, True
        fits.append(fit)
    return min(fits, key=lambda fit: fit.bic(count)), False


def _check(
    values: np.ndarray, weights: np.ndarray, components: int, restarts: int, rng: np.random.Generator | None
) -> None:
    if values.ndim != 1 or values.shape != weights.shape or not len(values):
        raise ValueError(f"values and weights must be two [I] arrays, I > 0, got {values.shape}, {weights.shape}")
    if not (np.isfinite(values).all() and np.isfinite(weights).all() and (weights >= 0).all()):
        raise ValueError("values must be finite, and weights finite and not negative")
    if components < 1 or restarts < 1:
        raise ValueError(f"components and restarts must be at least 1, got {components} and {restarts}")
    if restarts > 1 and rng is None:
        raise ValueError(f"rng must be given when restarts={restarts} exceeds 1")


def _floor(values: np.ndarray, share: np.ndarray, floor: float) -> float:
    """Keep every component wider than rounding, so that no density is infinite."""
    mean = values @ share
    spread = (values - mean) ** 2 @ share
    return max(floor, 1e-9 * spread, 1e-12 * mean**2, np.finfo(float).tiny)


def _quantile_centres(values: np.ndarray, share: np.ndarray, components: int) -> np.ndarray:
    """Return the values that halve ``m`` slices of equal weight."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(share[order])
    wanted = (np.arange(components) + 0.5) / components * reached[-1]
    return values[order][np.minimum(np.searchsorted(reached, wanted), len(values) - 1)]


def _random_centres(
    values: np.ndarray, share: np.ndarray, components: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw centres one by one, likelier the farther from those drawn (k-means++, Arthur and Vassilvitskii 2007)."""
    chance = share
    centres: list[float] = []
    for _ in range(components):
        total = chance.sum()
        centres.append(float(rng.choice(values, p=chance / total if total > 0 else None)))
        chance = share * ((values[:, None] - np.array(centres)) ** 2).min(1)
    return np.array(centres)


def _climb(
    values: np.ndarray, share: np.ndarray, centres: np.ndarray, floor: float, iterations: int, tolerance: float
) -> Mixture:
    """Run EM from centres: weight even, each variance that of the values nearest to the centre."""
    nearest = np.abs(values[:, None] - centres).argmin(1)
    hard = np.eye(len(centres))[nearest] * share[:, None]
    even = np.full(len(centres), 1 / len(centres))
    spread = np.full(len(centres), max((values - values @ share) ** 2 @ share, floor))
    weight, mean, var = _maximise(values, hard, (even, centres, spread), floor)
    last = -np.inf
    for step in range(iterations + 1):
        log_joint = _log_joint(values, weight, mean, var)
        log_density = special.logsumexp(log_joint, axis=1)
        now = float(share @ log_density)
        if now - last < tolerance or step == iterations:
            break
        last = now
        soft = np.exp(log_joint - log_density[:, None]) * share[:, None]
        weight, mean, var = _maximise(values, soft, (weight, mean, var), floor)
    order = np.argsort(mean, kind="stable")
    return Mixture(weight[order], mean[order], var[order], now, step)


def _log_joint(values: np.ndarray, weight: np.ndarray, mean: np.ndarray, var: np.ndarray) -> np.ndarray:
    """Return ``log weight[j] + log N(x_i; mean[j], var[j])``, ``[I, m]``."""
    log_weight = np.log(np.maximum(weight, np.finfo(float).tiny))
    return log_weight - 0.5 * (np.log(2 * np.pi * var) + (values[:, None] - mean) ** 2 / var)


def _maximise(
    values: np.ndarray, soft: np.ndarray, old: tuple[np.ndarray, np.ndarray, np.ndarray], floor: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights, means and variances from ``soft[I, m]``; a component without weight keeps its moments."""
    mass = soft.sum(0)
    if mass.sum() <= 0:
        return old
    alive = mass > LEAST_MASS * mass.sum()
    divisor = np.where(alive, mass, 1)
    mean = np.where(alive, values @ soft / divisor, old[1])
    var = np.where(alive, ((values[:, None] - mean) ** 2 * soft).sum(0) / divisor, old[2])
    return mass / mass.sum(), mean, np.maximum(var, floor)


def _merge_lightest(
    weight: np.ndarray, mean: np.ndarray, var: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join the lightest component with the one of nearest mean, keeping the pair's mean and variance."""
    light = int(weight.argmin())
    gaps = np.where(np.arange(len(mean)) == light, np.inf, np.abs(mean - mean[light]))
    pair = [light, int(gaps.argmin())]
    total = weight[pair].sum()
    part = weight[pair] / total if total > 0 else np.array([0.5, 0.5])
    centre = part @ mean[pair]
    joined = [total, centre, part @ (var[pair] + (mean[pair] - centre) ** 2)]
    columns = [np.append(np.delete(x, pair), y) for x, y in zip((weight, mean, var), joined, strict=True)]
    order = np.argsort(columns[1], kind="stable")
    return columns[0][order], columns[1][order], columns[2][order]
