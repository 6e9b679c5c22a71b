from __future__ import annotations

import hypothesis.strategies as st
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from jaxpomdp.models import estimates
from jaxpomdp.models.estimates import Moments, add_statistics, scale_statistics
from jaxpomdp.models.family import Prior
from jaxpomdp.numerics import NEG

seeds = st.integers(0, 2**31 - 1)


def moments(x: np.ndarray, weight: np.ndarray, outer: bool) -> Moments:
    """Moments of rows ``x[K, D]`` for one state, in float64 NumPy."""
    total = weight.sum()
    mean = (weight[:, None] * x).sum(0) / total
    away = x - mean
    scatter = np.einsum("k,ki,kj->ij", weight, away, away) if outer else (weight[:, None] * away**2).sum(0)
    return Moments(np.array([[total]]), mean[None], scatter[None])


@settings(max_examples=20, deadline=None)
@given(seed=seeds, outer=st.booleans(), offset=st.sampled_from([0.0, 1e3]))
def test_statistics_of_parts_add_up_to_those_of_the_whole(seed: int, outer: bool, offset: float) -> None:
    rng = np.random.default_rng(seed)
    x, weight = rng.normal(size=(9, 2)) + offset, rng.uniform(0.1, 1, size=9)
    parts = [moments(x[part], weight[part], outer) for part in (slice(0, 4), slice(4, 9))]
    tree = [{"m": part, "n": np.array([1.0, float(i)])} for i, part in enumerate(parts)]
    joined = add_statistics(*tree)
    for got, want in zip(joined["m"], moments(x, weight, outer), strict=True):
        np.testing.assert_allclose(got, want, rtol=2e-4, atol=1e-4)
    np.testing.assert_allclose(joined["n"], [2, 1])


def test_scaling_weights_and_not_means() -> None:
    made = Moments(jnp.array([[2.0]]), jnp.array([[5.0]]), jnp.array([[3.0]]))
    half = scale_statistics({"m": made, "n": jnp.array([4.0])}, 0.5)
    np.testing.assert_allclose(half["m"], [[[1.0]], [[5.0]], [[1.5]]])
    np.testing.assert_allclose(half["n"], [2.0])
    nothing = Moments(*jnp.zeros((3, 1, 1)))
    np.testing.assert_allclose(add_statistics(nothing, made), made)
    np.testing.assert_allclose(add_statistics(nothing, nothing), nothing)


def test_rows_by_hand() -> None:
    old = jnp.array([[-1.0, -1.0, NEG], [NEG, NEG, NEG], [-2.0, -3.0, -4.0]])
    counts = jnp.array([[3.0, 0.0, 5.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
    bare = estimates.dirichlet_mode(old, counts, 0.0)
    np.testing.assert_allclose(bare, [[0.0, NEG, NEG], [NEG, NEG, NEG], [-2.0, -3.0, -4.0]])
    smooth = jnp.exp(estimates.dirichlet_mode(old, counts, 0.5))
    np.testing.assert_allclose(smooth, [[3.5 / 4, 0.5 / 4, 0], [0, 0, 0], [1 / 3] * 3], rtol=1e-6)
    np.testing.assert_allclose(estimates.dirichlet_score(old, counts), [-3.0, 0.0, 0.0])
    np.testing.assert_array_equal(estimates.count_free_entries(old), [1, 0, 2])


def test_variances_by_hand() -> None:
    data = Moments(jnp.array([[4.0], [4.0], [0.0]]), jnp.zeros((3, 1)), jnp.array([[8.0], [0.0], [0.0]]))
    old, pooled = jnp.full((3, 1), 7.0), jnp.array([[10.0]])
    bare = Prior(variance_floor=0.1)
    np.testing.assert_allclose(estimates.variance_mode(old, data, pooled, bare)[:, 0], [2.0, 1.0, 7.0])
    strong = Prior(variance_floor=0.0, variance_strength=4.0)
    np.testing.assert_allclose(estimates.variance_mode(old, data, pooled, strong)[:, 0], [6.0, 5.0, 10.0])


def test_covariances_are_lifted_as_little_as_can_be() -> None:
    """Eigenvalues below the limit rise to it, the others and their directions stay."""
    cov = jnp.array([[[4.0, 0.0], [0.0, 0.01]], [[2.0, 1.0], [1.0, 2.0]]])
    lifted = estimates.lift_covariance(cov, jnp.array([1.0, 0.25]))
    np.testing.assert_allclose(lifted[0], [[4.0, 0.0], [0.0, 0.25]], atol=1e-6)
    np.testing.assert_allclose(lifted[1], cov[1], atol=1e-5)


def test_constant_data_have_a_width() -> None:
    x = jnp.full((5, 1), 3.0)
    width = estimates.pooled_variance(estimates.pooled_moments(x, jnp.ones(5, bool)))
    assert float(width[0, 0]) == pytest.approx(9e-6, rel=1e-3)
    nothing = estimates.pooled_moments(x * jnp.nan, jnp.zeros(5, bool))
    assert all(bool(jnp.isfinite(part).all()) for part in nothing)


def test_float32_moments_far_from_zero_keep_their_variance() -> None:
    rng = np.random.default_rng(0)
    x = (1000 + rng.normal(size=(400, 1))).astype(np.float32)
    mask = jnp.ones(400, bool)
    ones, away = estimates.centred(jnp.asarray(x), mask)
    sums = estimates.weighted_sums(jnp.ones((400, 1)), jnp.concatenate([ones, away, away**2], axis=-1)).T
    centre = estimates.pooled_moments(jnp.asarray(x), mask).mean
    found = estimates.moments_from_sums(sums[:, :1], sums[:, 1:2], sums[:, 2:], centre)
    assert float(found.scatter[0, 0] / 400) == pytest.approx(x.astype(np.float64).var(), rel=1e-5)
