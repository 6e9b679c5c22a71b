"""Mixtures of Gaussians in one dimension, fitted to weighted values by EM; how many components are enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from jaxpomdp.structure.significance import ChiSquare, bin_probability, goodness_of_fit

LEAST_MASS = 1e-9
"""Share of the total weight under which a component keeps its old mean and variance."""


NEGLIGIBLE = 1e-100
"""Share of the weight below which a value is as good as absent: variances made of it would underflow."""


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
    iterations: int = 100,
    tolerance: float = 1e-6,
    restarts: int = 0,
    rng: np.random.Generator | None = None,
) -> Mixture:
    """Fit a mixture to values with weights by EM and return the best of the restarts.

    E-step: ``r[i, j] = weight[j] N(x_i; mean[j], var[j]) / p(x_i)``; M-step: moments under ``w_i r[i, j]``.
    Two starts need no randomness: centres at the quantiles, and far from each other (so that a rare lump
    gets one). More are drawn as k-means++ does. A component left without weight keeps its moments; weights
    that are all zero give the start back.

    Args:
        values: ``[I]``.
        weights: ``[I]``, not negative, any scale.
        components: m.
        variance_floor: least variance of a component (a tiny share of the data's is always kept).
        iterations: at most so many.
        tolerance: stop when the mean log-likelihood gains less than this.
        restarts: number of random starts besides the two.
        rng: source of the random starts; needed when there are any.

    Raises:
        ValueError: shapes disagree, a weight is negative, or a number is out of range.

    >>> mixture = fit_mixture(np.array([0.0, 0.1, 5.0, 5.1]), np.ones(4), 2)
    >>> mixture.mean.round(2).tolist(), mixture.weight.round(2).tolist()
    ([0.05, 5.05], [0.5, 0.5])
    """
    values, weights = np.asarray(values, float), np.asarray(weights, float)
    _check(values, weights, components, restarts, rng)
    total = float(weights.sum())
    if total > 0:
        present = weights > NEGLIGIBLE * total
        values, weights = values[present], weights[present]
    share = weights / (total or 1.0)
    floor = _floor(values, share, variance_floor)
    starts = [_quantile_centres(values, share, components), _far_centres(values, share, components)]
    starts += [_far_centres(values, share, components, rng) for _ in range(restarts)]
    best = _climb(values, share, np.array(starts), floor, iterations, tolerance)
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
    restarts: int = 0,
    rng: np.random.Generator | None = None,
) -> tuple[Mixture, bool]:
    """Fit mixtures of rising size; return the first that chi-square accepts (thesis 3.3) and ``True``.

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
        shapes = f"{values.shape} and {weights.shape}"
        raise ValueError(f"values and weights must have one shape [I], I > 0, got {shapes}")
    if not (np.isfinite(values).all() and np.isfinite(weights).all() and (weights >= 0).all()):
        raise ValueError("values must be finite, and weights finite and not negative")
    if components < 1 or restarts < 0:
        raise ValueError(f"components must be at least 1 and restarts 0, got {components} and {restarts}")
    if restarts and rng is None:
        raise ValueError(f"rng must be given for restarts={restarts}")


def _floor(values: np.ndarray, share: np.ndarray, floor: float) -> float:
    """Keep every component wider than rounding, so that no density is infinite.

    Where nothing has weight, all values count alike.
    """
    share = share if share.any() else np.full(len(share), 1 / len(share))
    mean = float(values @ share)
    spread = float((values - mean) ** 2 @ share)
    return max(floor, 1e-9 * spread, 1e-12 * mean**2, float(np.finfo(float).tiny))


def _quantile_centres(values: np.ndarray, share: np.ndarray, components: int) -> np.ndarray:
    """Return the values that halve ``m`` slices of equal weight."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(share[order])
    wanted = (np.arange(components) + 0.5) / components * reached[-1]
    return values[order][np.minimum(np.searchsorted(reached, wanted), len(values) - 1)]


def _far_centres(
    values: np.ndarray, share: np.ndarray, components: int, rng: np.random.Generator | None = None
) -> np.ndarray:
    """Choose centres one by one in proportion to weight x squared distance from those chosen (k-means++).

    Arthur and Vassilvitskii 2007; without ``rng`` the most likely value is taken each time.
    """
    chance = share
    centres: list[float] = []
    for _ in range(components):
        total = chance.sum()
        even = np.full(len(values), 1 / len(values))
        likely = chance / total if total > 0 else even
        centres.append(float(values[likely.argmax()] if rng is None else rng.choice(values, p=likely)))
        chance = share * ((values[:, None] - np.array(centres)) ** 2).min(1)
    return np.array(centres)


def _climb(
    values: np.ndarray,
    share: np.ndarray,
    centres: np.ndarray,
    floor: float,
    iterations: int,
    tolerance: float,
) -> Mixture:
    """Run EM from all starts ``centres[R, m]`` at once, until none gains; return the best.

    Even weights at first, and the moments of the values nearest to each centre.
    """
    components = centres.shape[-1]
    nearest = np.abs(values[:, None] - centres[:, None]).argmin(-1)
    even, spread = np.full(centres.shape, 1 / components), max((values - values @ share) ** 2 @ share, floor)
    hard = np.eye(components)[nearest] * share[:, None]
    _, mean, var = _maximise(values, hard, (even, centres, np.full(centres.shape, spread)), floor)
    weight, last = even, -np.inf
    for step in range(iterations + 1):
        soft, log_density = _responsibilities(values, weight, mean, var)
        now = log_density @ share
        if step == iterations or (now - last < tolerance).all():
            break
        last = now
        soft *= share[:, None]
        weight, mean, var = _maximise(values, soft, (weight, mean, var), floor)
    best = int(now.argmax())
    order = np.argsort(mean[best], kind="stable")
    return Mixture(weight[best][order], mean[best][order], var[best][order], float(now[best]), step)


def _responsibilities(
    values: np.ndarray, weight: np.ndarray, mean: np.ndarray, var: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``p(j | x_i)``, ``[R, I, m]``, and ``log p(x_i)``, ``[R, I]``."""
    constant = np.log(np.maximum(weight, np.finfo(float).tiny)) - 0.5 * np.log(2 * np.pi * var)
    away = (values[:, None] - mean[:, None]) ** 2
    log_joint = constant[:, None] - away * (0.5 / var)[:, None]
    peak = log_joint.max(-1)
    joint = np.exp(log_joint - peak[..., None])
    total = joint.sum(-1)
    joint /= total[..., None]
    return joint, peak + np.log(total)


def _maximise(
    values: np.ndarray, soft: np.ndarray, old: tuple[np.ndarray, np.ndarray, np.ndarray], floor: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return weights, means, variances ``[R, m]`` from ``soft[R, I, m]``; a weightless component stays."""
    mass = soft.sum(1)
    total = mass.sum(-1, keepdims=True)
    if not total.all():
        return old
    alive = mass > LEAST_MASS * total
    divisor = np.where(alive, mass, 1)
    mean = np.where(alive, values @ soft / divisor, old[1])
    squares = np.einsum("rim,rim->rm", (values[:, None] - mean[:, None]) ** 2, soft)
    var = np.where(alive, squares / divisor, old[2])
    return mass / total, mean, np.maximum(var, floor)


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
