"""Weighted mixtures against scikit-learn on repeated values, and how many components are chosen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.structure.evidence import bin_centres, bin_of, even_edges
from jaxpomdp.structure.mixture import Mixture, acceptable_fit, fewest_acceptable, fit_mixture, mixture_bins

GaussianMixture = pytest.importorskip("sklearn.mixture").GaussianMixture


def climb_on(values: np.ndarray, counts: np.ndarray, start: Mixture) -> Mixture:
    """Let scikit-learn run EM from a mixture, on each value repeated so many times."""
    repeated = np.repeat(values, counts)[:, None]
    reference = GaussianMixture(
        start.components,
        covariance_type="diag",
        reg_covar=0,
        tol=1e-9,
        max_iter=2000,
        weights_init=start.weight,
        means_init=start.mean[:, None],
        precisions_init=1 / start.var[:, None],
    ).fit(repeated)
    likelihood = float(reference.score(repeated) * len(repeated))
    columns = (reference.weights_, reference.means_[:, 0], reference.covariances_[:, 0])
    return Mixture(*columns, likelihood, reference.n_iter_)


def lumps(seed: int, size: int = 30) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = np.concatenate([rng.normal(0, 1, size), rng.normal(6, 1.5, size), rng.normal(15, 1, size)])
    return values, rng.integers(1, 5, len(values))


@pytest.mark.parametrize("components", [1, 2, 3])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_fit_with_weights_is_a_fixed_point_of_scikit_learn(seed: int, components: int) -> None:
    values, counts = lumps(seed)
    fit = fit_mixture(values, counts, components, iterations=2000, tolerance=1e-12)
    reference = climb_on(values, counts, fit)
    for name in ("weight", "mean", "var", "log_likelihood"):
        np.testing.assert_allclose(getattr(fit, name), getattr(reference, name), rtol=1e-4)


def test_the_oracle_tells_when_weights_are_ignored() -> None:
    values, counts = lumps(0)
    counts[:30] *= 5
    broken = fit_mixture(values, np.ones(len(values)), 2)
    assert not np.allclose(climb_on(values, counts, broken).weight, broken.weight, rtol=1e-2)


def test_as_good_as_scikit_learn_with_its_own_starts() -> None:
    for seed in range(5):
        values, counts = lumps(seed)
        own = GaussianMixture(3, reg_covar=1e-9, n_init=5, random_state=seed, tol=1e-7, max_iter=500)
        repeated = np.repeat(values, counts)[:, None]
        best = own.fit(repeated).score(repeated) * len(repeated)
        assert fit_mixture(values, counts, 3).log_likelihood > best - 1.0


@given(st.integers(0, 10_000), st.floats(0.01, 100), st.floats(-50, 50), st.floats(1e-6, 1e6))
@settings(max_examples=25, deadline=None)
def test_scale_shift_and_total_weight_change_nothing_else(
    seed: int, scale: float, shift: float, total: float
) -> None:
    values, counts = lumps(seed, 10)
    plain = fit_mixture(values, counts, 2)
    moved = fit_mixture(values * scale + shift, counts * total, 2)
    np.testing.assert_allclose(moved.weight, plain.weight, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(moved.mean, plain.mean * scale + shift, rtol=1e-3, atol=1e-3 * scale)
    np.testing.assert_allclose(moved.var, plain.var * scale**2, rtol=1e-2)


@given(
    st.lists(st.tuples(st.floats(-1e3, 1e3), st.floats(0, 1e3)), min_size=1, max_size=12),
    st.integers(1, 4),
    st.sampled_from([0.0, 1e-3]),
)
@settings(max_examples=150, deadline=None)
def test_any_data_give_a_mixture(rows: list[tuple[float, float]], components: int, floor: float) -> None:
    values, weights = np.array(rows).T
    fit = fit_mixture(
        values, weights, components, variance_floor=floor, restarts=1, rng=np.random.default_rng(0)
    )
    for array in (fit.weight, fit.mean, fit.var):
        assert array.shape == (components,)
        assert np.isfinite(array).all()
    np.testing.assert_allclose(fit.weight.sum(), 1)
    assert (fit.var >= floor).all()
    assert (fit.var > 0).all()
    assert (np.diff(fit.mean) >= 0).all()
    assert np.isfinite(fit.log_likelihood)


def test_values_without_any_weight_overflow_nothing() -> None:
    fit = fit_mixture(np.array([0.0, 3.0]), np.zeros(2), 1)
    assert np.isfinite([fit.mean[0], fit.var[0], fit.log_likelihood]).all()


def test_a_value_of_next_to_no_weight_is_absent() -> None:
    fit = fit_mixture(np.array([0.0, 3.0]), np.array([1.0, 5e-324]), 1)
    alone = fit_mixture(np.array([0.0]), np.array([1.0]), 1)
    np.testing.assert_array_equal([fit.weight, fit.mean, fit.var], [alone.weight, alone.mean, alone.var])


def test_a_rare_lump_is_found() -> None:
    fit = fit_mixture(np.array([0.0, 4.0]), np.array([99.0, 1.0]), 2)
    np.testing.assert_allclose(fit.mean, [0, 4], atol=1e-6)
    np.testing.assert_allclose(fit.weight, [0.99, 0.01], atol=1e-6)


def test_tiny_weights_do_not_divide_by_zero() -> None:
    values, counts = lumps(2)
    fit = fit_mixture(values, counts * 1e-300, 3)
    np.testing.assert_allclose(fit.mean, fit_mixture(values, counts, 3).mean, rtol=1e-6)


def test_the_likelihood_never_falls() -> None:
    values, counts = lumps(4)
    trace = [fit_mixture(values, counts, 3, iterations=k, tolerance=0).log_likelihood for k in range(1, 30)]
    assert (np.diff(trace) > -1e-9).all()


def test_merging_keeps_mean_and_variance() -> None:
    values, counts = lumps(1)
    fit = fit_mixture(values, counts, 4)
    for components in (3, 2, 1):
        merged = fit.merged(components)
        assert merged.components == components
        np.testing.assert_allclose(merged.weight.sum(), 1)
        mean = fit.weight @ fit.mean
        np.testing.assert_allclose(merged.weight @ merged.mean, mean)
        second = [m.weight @ (m.var + m.mean**2) for m in (fit, merged)]
        np.testing.assert_allclose(*second)
    assert fit.merged(9).components == 4


def binned(samples: np.ndarray, bins: int = 64) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    edges = even_edges(samples.min(), samples.max(), bins)
    hist = np.bincount(bin_of(samples, edges), minlength=bins).astype(float)
    return hist, edges, bin_centres(samples, np.ones(len(samples)), edges)


@pytest.mark.parametrize("true", [2, 3, 4])
def test_the_fewest_acceptable_components_are_the_true_ones(true: int) -> None:
    """A wrong rejection (at level .05) adds a component now and then; too few are never accepted."""
    rng = np.random.default_rng(true)
    found = []
    for _ in range(20):
        samples = rng.normal(6.0 * rng.integers(0, true, 600), 1.0)
        found.append(fewest_acceptable(*binned(samples), cells=30)[0].components)
    assert min(found) == true
    assert np.mean(np.array(found) == true) >= 0.8


def test_returns_of_two_values_need_two_components() -> None:
    mixture, accepted = fewest_acceptable(*binned(np.repeat([4.0, -0.1], [60, 40])), variance_floor=1e-4)
    assert accepted
    np.testing.assert_allclose(mixture.mean, [-0.1, 4.0], atol=1e-6)
    np.testing.assert_allclose(mixture.weight, [0.4, 0.6], atol=1e-6)


def test_without_an_acceptable_fit_bic_decides() -> None:
    samples = np.random.default_rng(0).uniform(size=20_000) ** 6
    mixture, accepted = fewest_acceptable(*binned(samples), components=(2, 3))
    hist, edges, centres = binned(samples)
    assert not accepted
    assert mixture.bic(hist.sum()) <= fit_mixture(centres, hist, 2).bic(hist.sum())
    assert acceptable_fit(hist, edges, mixture, cells=None).p_value < 0.05
    np.testing.assert_allclose(mixture_bins(edges, mixture).sum(), 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([], [], 1), "one shape"),
        (([1.0, 2.0], [1.0], 1), r"one shape .* got \(2,\) and \(1,\)"),
        (([1.0], [-1.0], 1), "not negative"),
        (([np.nan], [1.0], 1), "finite"),
        (([1.0], [1.0], 0), "at least 1"),
        (([1.0], [1.0], 1, 0.0, 10, 1e-6, 2), "rng must be given for restarts=2"),
    ],
)
def test_wrong_arguments_are_named(arguments: tuple, message: str) -> None:
    names = ("values", "weights", "components", "variance_floor", "iterations", "tolerance", "restarts")
    with pytest.raises(ValueError, match=message):
        fit_mixture(**dict(zip(names, arguments, strict=False)))
