"""Chi-square tests on weighted histograms, vectorised over leading axes, and corrections for many tests.

Every test forms ``X^2 = sum_cells (observed - expected)^2 / expected`` and compares it with a chi-square
distribution. Weights may be fractions (expected counts under a belief). Neighbouring bins are merged into
cells until each expects enough, since the approximation needs an expected count of about five (Cochran 1954).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np
from scipy import special

Correction = Literal["none", "bonferroni", "holm", "benjamini-hochberg"]


class ChiSquare(NamedTuple):
    """Outcome of tests, arrays of one shape.

    Attributes:
        statistic: ``X^2``.
        dof: degrees of freedom; below one nothing could be tested, and ``p_value`` is 1.
        p_value: chance of a statistic at least as large under the hypothesis.
        effect: size of the deviation whatever the weight: Cohen's w = sqrt(X^2 / weight) against a
            distribution, Cramer's V in [0, 1] for tables.
    """

    statistic: np.ndarray
    dof: np.ndarray
    p_value: np.ndarray
    effect: np.ndarray


def chi_square(statistic: np.ndarray, dof: np.ndarray, effect: np.ndarray) -> ChiSquare:
    """Attach p-values, ``P(chi2_dof >= X^2)``, to statistics."""
    p_value = np.where(dof >= 1, special.chdtrc(np.maximum(dof, 1), statistic), 1.0)
    return ChiSquare(statistic, dof, p_value, effect)


def merge_cells(expected: np.ndarray, least: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    """Merge neighbouring bins from the left until each cell expects at least ``least``.

    What is left over at the right end joins the last cell.

    Args:
        expected: ``[..., bins]``.
        least: ``[...]`` or a number, positive.

    Returns:
        ``cell[..., bins]``, the number of the cell each bin goes to, and ``cells[...]``, how many there are
        (at least one, which may expect less).

    >>> cell, cells = merge_cells(np.array([3.0, 3.0, 9.0, 1.0]), 5)
    >>> cell.tolist(), int(cells)
    ([0, 0, 1, 1], 2)
    """
    gathered = np.zeros(expected.shape[:-1])
    closed = np.zeros(expected.shape[:-1], int)
    cell = np.zeros(expected.shape, int)
    for b in range(expected.shape[-1]):
        cell[..., b] = closed
        gathered = gathered + expected[..., b]
        full = gathered >= least
        closed = closed + full
        gathered = np.where(full, 0.0, gathered)
    cells = np.maximum(closed, 1)
    return np.minimum(cell, cells[..., None] - 1), cells


def sum_cells(values: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Sum ``values[..., bins]`` over the bins of each cell: ``[..., bins]``, zero beyond the last cell."""
    bins = values.shape[-1]
    rows = np.arange(values.size // bins).reshape(*values.shape[:-1], 1) * bins
    place = np.broadcast_to(cell, values.shape) + rows
    return np.bincount(place.ravel(), values.ravel(), values.size).reshape(values.shape)


def goodness_of_fit(
    observed: np.ndarray,
    probability: np.ndarray,
    *,
    fitted: int = 0,
    cells: int | None = None,
    least_expected: float = 5.0,
) -> ChiSquare:
    """Test whether weighted counts come from a given distribution; dof = cells - 1 - fitted.

    Args:
        observed: ``[..., bins]`` weights.
        probability: ``[..., bins]`` under the hypothesis.
        fitted: number of the distribution's parameters that were fitted to these data.
        cells: merge bins into about this many cells of equal probability (``None``: as many as possible).
        least_expected: expected weight that a cell needs.

    >>> result = goodness_of_fit(np.array([8.0, 12.0]), np.array([0.5, 0.5]))
    >>> float(result.statistic), int(result.dof), round(float(result.p_value), 4)
    (0.8, 1, 0.3711)
    """
    total = observed.sum(-1)
    expected = total[..., None] * probability
    least = np.maximum(least_expected, total / cells if cells else 0.0) * (1 - 1e-9)
    cell, count = merge_cells(expected, least)
    seen, wanted = sum_cells(observed, cell), sum_cells(expected, cell)
    statistic = ((seen - wanted) ** 2 / np.where(wanted > 0, wanted, 1)).sum(-1)
    return chi_square(statistic, count - 1 - fitted, np.sqrt(statistic / np.where(total > 0, total, 1)))


def bin_probability(edges: np.ndarray, cdf: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the probability of each bin of a grid, the outer two taking the tails.

    Args:
        edges: ``[bins + 1]``.
        cdf: maps the inner edges ``[bins - 1]`` to ``[..., bins - 1]``.
    """
    inner = cdf(edges[1:-1])
    ones = np.ones((*inner.shape[:-1], 1))
    return np.diff(np.concatenate([0 * ones, inner, ones], axis=-1))


def normal_bins(edges: np.ndarray, mean: np.ndarray, var: np.ndarray) -> np.ndarray:
    """Return the probability ``[..., bins]`` of each bin under ``N(mean[...], var[...])``.

    >>> normal_bins(np.array([-1.0, 0.0, 1.0]), np.zeros(1), np.ones(1)).tolist()
    [[0.5, 0.5]]
    """
    mean, deviation = np.asarray(mean)[..., None], np.sqrt(np.asarray(var))[..., None]
    return bin_probability(edges, lambda x: special.ndtr((x - mean) / deviation))


def normality(
    hist: np.ndarray,
    edges: np.ndarray,
    mean: np.ndarray,
    var: np.ndarray,
    *,
    fitted: int = 2,
    cells: int | None = 10,
    least_expected: float = 5.0,
) -> ChiSquare:
    """Test whether binned returns come from the Gaussian ``N(mean, var)`` (thesis 3.3).

    The bins are merged into cells of about equal probability under the Gaussian.

    Args:
        hist: ``[..., bins]`` weights.
        edges: ``[bins + 1]``.
        mean: ``[...]``.
        var: ``[...]``, positive.
        fitted: 2 when mean and variance come from the same data, 0 when they are given.
        cells: how many cells at most (``None``: as the grid allows).
        least_expected: expected weight that a cell needs.
    """
    probability = normal_bins(edges, mean, var)
    return goodness_of_fit(hist, probability, fitted=fitted, cells=cells, least_expected=least_expected)


def homogeneity(counts: np.ndarray, *, ordered: bool = False, least_expected: float = 5.0) -> ChiSquare:
    """Test whether the rows of weighted tables ``counts[..., R, C]`` share one distribution.

    Expected = row total x column total / total; dof = (R - 1)(cells - 1), rows without weight left out.
    Columns in which the lightest row expects too little are pooled: with neighbours if ``ordered``, else rare
    with rare.

    >>> result = homogeneity(np.array([[30.0, 10.0], [10.0, 30.0]]))
    >>> float(result.statistic), int(result.dof), float(result.effect)
    (20.0, 1, 0.5)
    """
    counts = counts if ordered else _common_first(counts)
    rows, total = counts.sum(-1), counts.sum((-2, -1))
    share = rows / np.where(total > 0, total, 1)[..., None]
    lightest = np.where(share > 0, share, np.inf).min(-1)
    lightest = np.where(np.isfinite(lightest), lightest, 0)
    cell, cells = merge_cells(counts.sum(-2) * lightest[..., None], least_expected)
    table = sum_cells(counts, np.broadcast_to(cell[..., None, :], counts.shape))
    expected = share[..., None] * table.sum(-2, keepdims=True)
    statistic = ((table - expected) ** 2 / np.where(expected > 0, expected, 1)).sum((-2, -1))
    live = (rows > 0).sum(-1)
    smaller = np.maximum(np.minimum(live, cells) - 1, 1)
    effect = np.sqrt(statistic / np.where(total > 0, total * smaller, 1))
    return chi_square(statistic, np.maximum(live - 1, 0) * (cells - 1), effect)


def two_sample(left: np.ndarray, right: np.ndarray, *, least_expected: float = 5.0) -> ChiSquare:
    """Test whether two binned samples ``[..., bins]`` on one grid share a distribution (thesis 6.3.2)."""
    return homogeneity(np.stack([left, right], axis=-2), ordered=True, least_expected=least_expected)


def adjust(p_value: np.ndarray, correction: Correction, tested: np.ndarray | None = None) -> np.ndarray:
    """Correct p-values for how many tests were made; compare the result with the significance level.

    ``bonferroni``: m p. ``holm``: step-down, the same guarantee (any false finding) with more power.
    ``benjamini-hochberg``: step-up, bounds the expected share of false findings (1995).

    Args:
        p_value: any shape.
        correction: the method.
        tested: bool, same shape: tests that were made; the others get 1 and do not count.

    Raises:
        ValueError: unknown method.

    >>> adjust(np.array([0.01, 0.02, 0.5]), "bonferroni").tolist()
    [0.03, 0.06, 1.0]
    """
    if correction not in _METHODS:
        raise ValueError(f"correction must be one of {', '.join(_METHODS)}, got {correction!r}")
    made = np.ones(np.shape(p_value), bool) if tested is None else tested
    adjusted = np.ones(np.shape(p_value))
    p = np.asarray(p_value)[made]
    order = np.argsort(p, kind="stable")
    sorted_back = np.empty(len(p))
    sorted_back[order] = _METHODS[correction](p[order])
    adjusted[made] = np.minimum(sorted_back, 1.0)
    return adjusted


def _holm(ascending: np.ndarray) -> np.ndarray:
    return np.maximum.accumulate(ascending * np.arange(len(ascending), 0, -1))


def _benjamini_hochberg(ascending: np.ndarray) -> np.ndarray:
    scaled = ascending * len(ascending) / np.arange(1, len(ascending) + 1)
    return np.minimum.accumulate(scaled[::-1])[::-1]


_METHODS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": lambda p: p,
    "bonferroni": lambda p: p * len(p),
    "holm": _holm,
    "benjamini-hochberg": _benjamini_hochberg,
}


def _common_first(counts: np.ndarray) -> np.ndarray:
    """Sort the columns of each table by falling total, so that rare ones are neighbours."""
    order = np.argsort(-counts.sum(-2), axis=-1, kind="stable")
    return np.take_along_axis(counts, order[..., None, :], axis=-1)
