from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from jaxpomdp.models import emission
from jaxpomdp.models.emission import Categorical, DiagonalGaussian, ReturnModel
from jaxpomdp.models.estimates import weighted_sums
from jaxpomdp.models.flat import FLAT
from jaxpomdp.models.full_gaussian import FullGaussian
from jaxpomdp.numerics import NEG
from tests.models.problems import batch, model, rich_model, rich_trials, to_batch, to_params

MADE = rich_model()
X = np.random.default_rng(3).normal(size=(4, 5, 2))


def test_densities_equal_scipy() -> None:
    full = FullGaussian(jnp.asarray(MADE["mean"]), jnp.asarray(MADE["cov"])).log_density(jnp.asarray(X))
    variance = np.diagonal(MADE["cov"], axis1=1, axis2=2)
    diagonal = DiagonalGaussian(jnp.asarray(MADE["mean"]), jnp.asarray(variance)).log_density(jnp.asarray(X))
    assert full.shape == diagonal.shape == (4, 5, 3)
    for s in range(3):
        mean = MADE["mean"][s]
        want = multivariate_normal.logpdf(X, mean, MADE["cov"][s])
        np.testing.assert_allclose(full[..., s], want, rtol=1e-4)
        want = norm.logpdf(X, mean, np.sqrt(variance[s])).sum(-1)
        np.testing.assert_allclose(diagonal[..., s], want, rtol=1e-4)


@pytest.mark.parametrize("columns", [1, 2])
def test_returns_use_the_action_taken(columns: int) -> None:
    rng = np.random.default_rng(0)
    mean, var = rng.normal(size=(3, columns)), rng.uniform(0.5, 2, size=(3, columns))
    returns, actions = rng.normal(size=(4, 5)), rng.integers(2, size=(4, 5))
    density = ReturnModel(jnp.asarray(mean), jnp.asarray(var)).log_density(
        jnp.asarray(returns), jnp.asarray(actions)
    )
    slot = actions if columns == 2 else 0 * actions
    for s in range(3):
        want = norm.logpdf(returns, mean[s][slot], np.sqrt(var[s][slot]))
        np.testing.assert_allclose(density[..., s], want, rtol=1e-4)


def test_a_wide_alphabet_counts_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    channel = Categorical(jnp.zeros((3, 6)))
    x, mask = jnp.asarray(rng.integers(6, size=(4, 5))), jnp.asarray(rng.random((4, 5)) < 0.7)
    gamma = jnp.asarray(rng.dirichlet(np.ones(3), (4, 5)))

    def counts() -> np.ndarray:
        features = channel.features(x, mask)
        return np.asarray(channel.collect(weighted_sums(gamma, features), x, mask, gamma))

    narrow = counts()
    monkeypatch.setattr(emission, "WIDE", 5)
    assert channel.features(x, mask).shape[-1] == 0
    np.testing.assert_allclose(counts(), narrow, rtol=1e-5)
    by_hand = np.zeros((3, 6))
    for o, there, row in zip(np.ravel(x), np.ravel(mask), gamma.reshape(-1, 3), strict=True):
        by_hand[:, o] += there * np.asarray(row)
    np.testing.assert_allclose(narrow, by_hand, rtol=1e-5)


def test_acting_ignores_returns_and_learning_does_not() -> None:
    params, tapes = model(capacity=4), batch()
    acting = FLAT.log_obs(params, tapes.observations, tapes.observed)
    _, blind = FLAT.learning(params, tapes, 0.0)
    _, seeing = FLAT.learning(params, tapes, 0.5)
    np.testing.assert_array_equal(acting, blind)
    alive = np.asarray(params.alive)
    change = np.asarray(seeing - blind)[..., alive]
    assert (change[~np.asarray(tapes.has_return)] == 0).all()
    density = params.returns.log_density(tapes.returns, tapes.actions)[..., alive]
    there = np.asarray(tapes.has_return)
    np.testing.assert_allclose(change[there], 0.5 * np.asarray(density)[there], atol=1e-5)


def test_missing_steps_and_absent_states() -> None:
    params, tapes = model(capacity=4), batch()
    log_obs = np.asarray(FLAT.log_obs(params, tapes.observations, tapes.observed))
    missing = ~np.asarray(tapes.observed)
    assert missing.any()
    assert (log_obs[missing][:, :3] == 0).all()
    assert (log_obs[..., 3] == np.float32(NEG)).all()
    chain = FLAT.acting(params)
    assert float(chain.log_init[3]) == np.float32(NEG)
    assert (chain.log_trans[:, 3] == np.float32(NEG)).all()


def test_gradients_stay_finite() -> None:
    params, tapes = to_params(rich_model()), to_batch(rich_trials())

    def total(free):
        at = FLAT.from_free(params, free, emission.Prior())
        return jnp.sum(FLAT.learning(at, tapes, 0.5)[1])

    gradient = jax.jit(jax.grad(total))(FLAT.to_free(params))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(gradient))
