from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxpomdp.kernels import emissions

CLOSE = {"rtol": 1e-10, "atol": 1e-10}


def gaussians(seed: int, states: int = 4, size: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(states, size, size))
    cov = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(size)
    return rng.normal(size=(states, size)), cov, rng.normal(size=(5, 2, size))


def test_symbols_are_looked_up_in_every_state() -> None:
    log_prob = jnp.log(jnp.array([[0.1, 0.9], [0.6, 0.4]]))
    got = emissions.categorical_log_prob(log_prob, jnp.array([[0, 1], [1, 1]]))
    np.testing.assert_allclose(np.exp(got), [[[0.1, 0.6], [0.9, 0.4]], [[0.9, 0.4], [0.9, 0.4]]], rtol=1e-6)
    np.testing.assert_array_equal(emissions.categorical_log_prob(log_prob, jnp.array(1)), log_prob[:, 1])


@pytest.mark.usefixtures("x64")
def test_full_covariance_equals_an_independent_implementation() -> None:
    mean, cov, x = gaussians(0)
    got = emissions.full_log_prob(jnp.asarray(mean), jnp.asarray(cov), jnp.asarray(x))
    want = [stats.multivariate_normal.logpdf(x, m, c) for m, c in zip(mean, cov, strict=True)]
    np.testing.assert_allclose(got, np.moveaxis(want, 0, -1), **CLOSE)


@pytest.mark.usefixtures("x64")
def test_diagonal_covariance_is_full_covariance_without_the_rest() -> None:
    mean, cov, x = gaussians(1)
    var = np.diagonal(cov, axis1=1, axis2=2)
    got = emissions.diagonal_log_prob(jnp.asarray(mean), jnp.asarray(var), jnp.asarray(x))
    full = emissions.full_log_prob(
        jnp.asarray(mean), jnp.asarray(var[:, :, None] * np.eye(3)), jnp.asarray(x)
    )
    np.testing.assert_allclose(got, full, **CLOSE)
    np.testing.assert_allclose(
        got[2, 1, 0], stats.norm.logpdf(x[2, 1], mean[0], np.sqrt(var[0])).sum(), **CLOSE
    )


def test_a_mean_far_from_zero_costs_no_digits() -> None:
    mean, var = jnp.full((1, 2), 1e4), jnp.full((1, 2), 1e-2)
    near = emissions.diagonal_log_prob(mean, var, jnp.full((2,), 1e4 + 0.0625))
    want = 2 * stats.norm.logpdf(0.0625, 0, 0.1)
    np.testing.assert_allclose(near, [want], rtol=1e-5)


@pytest.mark.usefixtures("x64")
def test_returns_per_state_and_per_action() -> None:
    mean, var = jnp.array([[0.0, 1.0], [2.0, 3.0]]), jnp.array([[1.0, 2.0], [0.5, 4.0]])
    returns, actions = jnp.array([0.5, -1.0, 2.0]), jnp.array([0, 1, 1])
    got = emissions.return_log_density(mean, var, returns, actions)
    for t in range(3):
        a = int(actions[t])
        np.testing.assert_allclose(
            got[t], stats.norm.logpdf(returns[t], mean[:, a], np.sqrt(var[:, a])), **CLOSE
        )
    alone = emissions.return_log_density(mean[:, 0], var[:, 0], returns)
    np.testing.assert_allclose(alone[0], got[0], **CLOSE)
    np.testing.assert_allclose(
        emissions.return_log_density(mean[:, 1], var[:, 1], returns[1]), got[1], **CLOSE
    )


def test_utility_is_tempered_and_missing_steps_say_nothing() -> None:
    log_obs, log_return = jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.array([[10.0, 20.0], [30.0, 40.0]])
    has_return = jnp.array([True, False])
    got = emissions.tempered(log_obs, log_return, 0.2, has_return)
    np.testing.assert_allclose(got, [[3, 6], [3, 4]], rtol=1e-6)
    np.testing.assert_array_equal(emissions.unless_missing(got, jnp.array([False, True])), [[0, 0], [3, 4]])


def test_missing_returns_may_hold_anything() -> None:
    log_return = emissions.return_log_density(jnp.zeros(2), jnp.ones(2), jnp.array([jnp.nan, 0.0]))
    got = emissions.tempered(jnp.zeros((2, 2)), log_return, 0.5, jnp.array([False, True]))
    assert np.isfinite(got).all()


def test_draws_have_the_moments_of_their_state() -> None:
    mean, cov, _ = gaussians(2, states=2)
    states = jnp.tile(jnp.array([0, 1]), 20_000)
    x = emissions.sample_vectors(
        jax.random.key(0), jnp.asarray(mean, jnp.float32), jnp.asarray(cov, jnp.float32), states
    )
    for s in range(2):
        drawn = np.asarray(x)[s::2]
        error = np.sqrt(np.diagonal(cov[s]) / len(drawn))
        assert (np.abs(drawn.mean(axis=0) - mean[s]) < 5 * error).all()
        np.testing.assert_allclose(np.cov(drawn.T), cov[s], atol=0.1 * np.abs(cov[s]).max())
    log_prob = jnp.log(jnp.array([[0.2, 0.8, 0.0], [0.5, 0.25, 0.25]]))
    symbols = np.asarray(emissions.sample_symbols(jax.random.key(1), log_prob, states))
    for s in range(2):
        often = np.bincount(symbols[s::2], minlength=3) / 20_000
        np.testing.assert_allclose(often, np.exp(log_prob[s]), atol=0.02)
    assert not (symbols[::2] == 2).any()
