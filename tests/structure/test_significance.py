"""Chi-square tests against SciPy, their rates on data that obey the hypothesis, and corrections."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from jaxpomdp.structure.evidence import bin_of
from jaxpomdp.structure.significance import (
    adjust,
    goodness_of_fit,
    homogeneity,
    merge_cells,
    normal_bins,
    normality,
    sum_cells,
    two_sample,
)

EDGES = np.linspace(-4, 4, 65)


def histograms(samples: np.ndarray, edges: np.ndarray = EDGES) -> np.ndarray:
    bins = len(edges) - 1
    place = bin_of(samples, edges) + np.arange(len(samples))[:, None] * bins
    return np.bincount(place.ravel(), minlength=len(samples) * bins).reshape(-1, bins).astype(float)


@given(st.integers(0, 10_000), st.integers(2, 8))
@settings(max_examples=30, deadline=None)
def test_goodness_of_fit_is_scipys(seed: int, bins: int) -> None:
    rng = np.random.default_rng(seed)
    probability = (rng.dirichlet(np.ones(bins)) + 1 / bins) / 2
    observed = rng.multinomial(500, probability).astype(float)
    expected = stats.chisquare(observed, 500 * probability, ddof=0)
    result = goodness_of_fit(observed, probability)
    np.testing.assert_allclose([result.statistic, result.p_value], expected)
    assert result.dof == bins - 1


@given(st.integers(0, 10_000), st.integers(2, 4), st.integers(2, 5), st.booleans())
@settings(max_examples=30, deadline=None)
def test_homogeneity_is_scipys(seed: int, rows: int, columns: int, ordered: bool) -> None:
    counts = np.random.default_rng(seed).integers(40, 90, (rows, columns)).astype(float)
    expected = stats.chi2_contingency(counts, correction=False)
    result = homogeneity(counts, ordered=ordered)
    np.testing.assert_allclose([result.statistic, result.p_value], [expected.statistic, expected.pvalue])
    assert result.dof == expected.dof
    np.testing.assert_allclose(result.effect, stats.contingency.association(counts.astype(int)))


def test_the_oracle_tells_when_the_expected_counts_are_wrong() -> None:
    counts = np.array([[30.0, 10, 5], [10, 30, 9]])
    expected = stats.chi2_contingency(counts, correction=False).statistic
    assert not np.isclose(homogeneity(counts.T[:2]).statistic, expected)
    assert not np.isclose(goodness_of_fit(counts[0], np.full(3, 1 / 3)).statistic, expected)


def test_tests_are_vectorised() -> None:
    rng = np.random.default_rng(0)
    hist = histograms(rng.normal(size=(6, 200))).reshape(2, 3, -1)
    mean, var = rng.normal(size=(2, 3)), 1 + rng.random((2, 3))
    together = normality(hist, EDGES, mean, var)
    for i, j in np.ndindex(2, 3):
        alone = normality(hist[i, j], EDGES, mean[i, j], var[i, j])
        np.testing.assert_allclose([x[i, j] for x in together], alone)
    tables = rng.integers(0, 30, (4, 3, 5)).astype(float)
    for k, table in enumerate(tables):
        np.testing.assert_allclose([x[k] for x in homogeneity(tables)], homogeneity(table))


@given(st.lists(st.floats(0, 9), min_size=1, max_size=12), st.floats(0.5, 20))
@settings(max_examples=60, deadline=None)
def test_cells_are_neighbours_and_expect_enough(expected: list[float], least: float) -> None:
    values = np.array(expected)
    cell, cells = merge_cells(values, least)
    assert set(np.diff(cell)) <= {0, 1}
    assert cell[0] == 0
    assert cell[-1] == cells - 1
    sums = sum_cells(values, cell)
    np.testing.assert_allclose(sums.sum(), values.sum())
    assert cells == 1 or (sums[:cells] >= least).all()
    assert (sums[cells:] == 0).all()


def test_rare_columns_are_pooled_and_empty_rows_left_out() -> None:
    counts = np.array([[50.0, 1, 40, 1, 2], [45, 1, 60, 2, 1], [0, 0, 0, 0, 0]])
    pooled = np.array([[40.0, 50, 4], [60, 45, 4]])
    result = homogeneity(counts, least_expected=3)
    np.testing.assert_allclose(result.statistic, stats.chi2_contingency(pooled, correction=False).statistic)
    assert result.dof == 2


def test_nothing_to_compare_is_never_significant() -> None:
    for counts in (np.zeros((2, 3)), np.array([[5.0, 9], [0, 0]]), np.array([[9.0], [4.0]])):
        result = homogeneity(counts)
        assert result.p_value == 1
        assert np.isfinite(result).all()
    result = normality(np.zeros(64), EDGES, np.array(0.0), np.array(1.0))
    assert result.p_value == 1
    assert np.isfinite(result).all()


def test_bins_of_a_normal_sum_to_one_with_their_tails() -> None:
    probability = normal_bins(np.array([-1.0, 0, 1]), np.array([0.0, 50.0]), np.array([1.0, 1.0]))
    np.testing.assert_allclose(probability, [[0.5, 0.5], [0, 1]], atol=1e-12)


@pytest.mark.parametrize("count", [60, 300, 2000])
def test_normality_keeps_its_level(count: int) -> None:
    """Size: fitted Gaussians are rejected at about the nominal rate (dof as for grouped estimates)."""
    rng = np.random.default_rng(count)
    x = 0.3 + 0.8 * rng.normal(size=(3000, count))
    p = normality(histograms(x), EDGES, x.mean(1), x.var(1)).p_value
    assert 0.03 < (p < 0.05).mean() < 0.08
    assert (p < 0.01).mean() < 0.025


def test_a_given_gaussian_is_tested_with_all_degrees_of_freedom() -> None:
    x = np.random.default_rng(5).normal(size=(3000, 300))
    p = normality(histograms(x), EDGES, np.zeros(3000), np.ones(3000), fitted=0).p_value
    assert 0.035 < (p < 0.05).mean() < 0.065


def lumps_bins(gap: float, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bins' probabilities under two even lumps, and under the Gaussian of the same moments."""
    centre = np.array(gap / 2 * scale)
    lumps = (normal_bins(EDGES, -centre, scale**2) + normal_bins(EDGES, centre, scale**2)) / 2
    return lumps, normal_bins(EDGES, np.array(0.0), scale**2 + centre**2)


@pytest.mark.parametrize(("gap", "count"), [(3.0, 200), (4.0, 60), (2.0, 2000), (4.0, 100), (3.0, 400)])
def test_normality_finds_two_lumps_as_often_as_theory_says(gap: float, count: int) -> None:
    """Power: P(noncentral chi-square with the lumps' own X^2 as noncentrality > critical value)."""
    rng = np.random.default_rng(7)
    lump = rng.integers(0, 2, (400, count)) - 0.5
    x = 0.7 * (rng.normal(size=(400, count)) + gap * lump)
    found = normality(histograms(x), EDGES, x.mean(1), x.var(1), cells=20).p_value < 0.01
    true, fitted = lumps_bins(gap, 0.7)
    ideal = goodness_of_fit(count * true, fitted, fitted=2, cells=20)
    expected = stats.ncx2.sf(stats.chi2.isf(0.01, ideal.dof), ideal.dof, ideal.statistic)
    assert abs(found.mean() - expected) < 0.1


def test_theory_tells_a_test_without_power() -> None:
    true, fitted = lumps_bins(4.0, 0.7)
    assert goodness_of_fit(100 * true, fitted, fitted=2).statistic > 10
    assert goodness_of_fit(100 * true, true, fitted=2).statistic < 1e-9


def test_five_standard_deviations_apart_are_always_found() -> None:
    rng = np.random.default_rng(7)
    x = 0.5 * (rng.normal(size=(300, 100)) + 5 * (rng.integers(0, 2, (300, 100)) - 0.5))
    assert (normality(histograms(x), EDGES, x.mean(1), x.var(1)).p_value < 0.01).mean() > 0.97


def test_two_samples_keep_their_level_and_find_a_shift() -> None:
    rng = np.random.default_rng(3)
    left, right = rng.normal(size=(2, 2000, 120))
    same = two_sample(histograms(left), histograms(right)).p_value
    moved = two_sample(histograms(left), histograms(right + 1)).p_value
    assert 0.03 < (same < 0.05).mean() < 0.07
    assert (moved < 0.01).mean() > 0.95


def test_corrections_by_hand() -> None:
    p = np.array([[0.01, 0.04], [0.03, 0.005]])
    np.testing.assert_allclose(adjust(p, "none"), p)
    np.testing.assert_allclose(adjust(p, "bonferroni"), [[0.04, 0.16], [0.12, 0.02]])
    np.testing.assert_allclose(adjust(p, "holm"), [[0.03, 0.06], [0.06, 0.02]])
    expected = stats.false_discovery_control(p.ravel(), method="bh").reshape(2, 2)
    np.testing.assert_allclose(adjust(p, "benjamini-hochberg"), expected)


def test_tests_not_made_do_not_count() -> None:
    p, tested = np.array([0.01, 0.2, 0.02]), np.array([True, False, True])
    np.testing.assert_allclose(adjust(p, "bonferroni", tested), [0.02, 1, 0.04])
    assert adjust(p, "holm", np.zeros(3, bool)).tolist() == [1, 1, 1]


def test_unknown_correction_is_named() -> None:
    with pytest.raises(ValueError, match=r"one of none, bonferroni, holm.* got 'fisher'"):
        adjust(np.array([0.1]), "fisher")  # type: ignore[arg-type]
