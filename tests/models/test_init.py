from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.models.data import trial_batch
from jaxpomdp.models.init import Real, observation_seeded, random_params, stack_models, with_capacity
from jaxpomdp.numerics import NEG
from tests.models.problems import assert_trees_close, batch

KEY = jax.random.key(0)


def test_random_rows_are_distributions_without_zeros() -> None:
    params = random_params(KEY, 5, 2, (4, 3), concentration=3, by_action=True)
    for rows in (params.log_init, params.log_trans, *(c.log_prob for c in params.emissions)):
        np.testing.assert_allclose(jnp.exp(rows).sum(axis=-1), 1, rtol=1e-5)
        assert (rows > np.log(1e-7)).all()
    assert params.returns.mean.shape == (5, 2)
    assert not jnp.array_equal(params.log_init, random_params(jax.random.key(1), 5, 2, 4).log_init)


def test_capacity_does_not_change_the_draw() -> None:
    plain = random_params(KEY, 3, 2, (4, Real(2), Real(2, full=True)))
    roomy = random_params(KEY, 3, 2, (4, Real(2), Real(2, full=True)), capacity=5)
    assert_trees_close(with_capacity(plain, 5), roomy, atol=0)
    assert_trees_close(jax.tree.map(lambda x: x[:3], roomy.emissions), plain.emissions, atol=0)
    assert (roomy.log_trans[:, 3:] == np.float32(NEG)).all()
    assert jnp.linalg.det(roomy.emissions[2].cov)[3] == 1


def test_each_state_is_peaked_on_its_own_symbol() -> None:
    params = observation_seeded(KEY, 6, 2, 4, peak=0.8)
    rows = jnp.exp(params.emissions[0].log_prob)
    np.testing.assert_array_equal(rows[:4].argmax(axis=1), [0, 1, 2, 3])
    np.testing.assert_allclose(rows[:4].max(axis=1), 0.8, rtol=1e-5)
    np.testing.assert_allclose(rows.sum(axis=1), 1, rtol=1e-5)
    assert float(rows[4:].max()) < 0.8


def test_the_most_frequent_symbols_come_first() -> None:
    tapes = trial_batch([[3, 3, 3, 1, 1, 0], [3, 1, None]])
    params = observation_seeded(KEY, 2, 1, 4, batch=tapes)
    np.testing.assert_array_equal(params.emissions[0].log_prob.argmax(axis=1), [3, 1])


def test_means_start_on_different_observations() -> None:
    vectors = np.random.default_rng(0).normal(size=(7, 2)).astype(np.float32)
    tapes = trial_batch([[*vectors[:4], None], vectors[4:]])
    params = observation_seeded(KEY, 7, 1, Real(2, full=True), batch=tapes)
    channel = params.emissions[0]
    assert {tuple(row) for row in np.asarray(channel.mean)} == {tuple(row) for row in vectors}
    width = np.diagonal(channel.cov, axis1=1, axis2=2)
    np.testing.assert_allclose(width, np.broadcast_to(0.1 * vectors.var(0), (7, 2)), rtol=1e-4)


def test_returns_start_at_the_scale_of_the_data() -> None:
    tapes = batch()
    kept = np.asarray(tapes.returns)[np.asarray(tapes.has_return)]
    params = random_params(KEY, 50, 2, 4, batch=tapes)
    np.testing.assert_allclose(params.returns.var, kept.var(), rtol=1e-4)
    assert abs(float(params.returns.mean.mean()) - kept.mean()) < 0.1 * kept.std()


def test_models_side_by_side() -> None:
    made = [observation_seeded(key, 6, 2, 4) for key in jax.random.split(KEY, 3)]
    together = stack_models(made)
    assert together.log_trans.shape == (3, 2, 6, 6)
    assert not jnp.array_equal(together.log_init[0], together.log_init[1])
    assert_trees_close(jax.tree.map(lambda x: x[1], together), made[1], atol=0)
    assert_trees_close(random_params(4, 3, 2, 4), random_params(4, 3, 2, 4), atol=0)


def test_errors() -> None:
    with pytest.raises(ValueError, match="states must be positive, got 0"):
        random_params(KEY, 0, 2, 4)
    with pytest.raises(ValueError, match="observations must be positive"):
        random_params(KEY, 2, 2, Real(0))
    with pytest.raises(ValueError, match="peak must be between"):
        observation_seeded(KEY, 2, 2, 4, peak=1.0)
    with pytest.raises(ValueError, match="capacity must be at least 3"):
        random_params(KEY, 3, 2, 4, capacity=2)
    with pytest.raises(ValueError, match="key must be one key"):
        random_params(jax.random.split(KEY), 3, 2, 4)
    with pytest.raises(ValueError, match="concentration must be positive"):
        random_params(KEY, 3, 2, 4, concentration=0.0)
    with pytest.raises(ValueError, match="models must have equal shapes"):
        stack_models([random_params(0, 3, 2, 4), random_params(0, 4, 2, 4)])
