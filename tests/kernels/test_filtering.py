from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.kernels import filtering
from jaxpomdp.kernels.filtering import filter_tape, linked_steps, observe, predict, trial_starts
from jaxpomdp.numerics import NEG
from tests.kernels.problems import quick_jit, random_problem
from tests.oracles.hmm import enumerate_tape

FILTER = quick_jit(filter_tape)
CLOSE = {"rtol": 1e-10, "atol": 1e-10}


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", range(4))
def test_the_belief_is_the_share_of_paths_that_end_in_each_state(seed: int) -> None:
    problem = random_problem(seed, zeros=0.2 * (seed % 2), starts=0.3, missing=0.2)
    got = FILTER(*problem.jax())
    for t in range(6):
        cut = problem._replace(valid=np.arange(6) <= t)
        np.testing.assert_allclose(got.belief[t], enumerate_tape(*cut).gamma[t], **CLOSE)
        blind = cut._replace(log_obs=np.where(np.arange(6)[:, None] == t, 0.0, cut.log_obs))
        np.testing.assert_allclose(got.predicted[t], enumerate_tape(*blind).gamma[t], **CLOSE)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", range(3))
def test_the_normalisers_sum_to_the_evidence(seed: int) -> None:
    problem = random_problem(seed, starts=0.3, padding=seed)
    got = FILTER(*problem.jax())
    np.testing.assert_allclose(got.log_norm.sum(), enumerate_tape(*problem).log_evidence, **CLOSE)


def test_padding_is_zero_and_may_hold_anything() -> None:
    problem = random_problem(0, padding=2)
    spoilt = problem._replace(log_obs=np.where(problem.valid[:, None], problem.log_obs, np.nan))
    got, clean = FILTER(*spoilt.jax(np.float32)), FILTER(*problem.jax(np.float32))
    for x, y in zip(got, clean, strict=True):
        np.testing.assert_array_equal(x, y)
        assert not np.any(x[-2:])


def test_an_impossible_observation_is_ignored_and_reported() -> None:
    belief, log_norm = observe(jnp.array([1.0, 0.0]), jnp.array([NEG, 0.0]))
    np.testing.assert_array_equal(belief, [1, 0])
    assert log_norm == np.float32(NEG)


def test_a_likelihood_far_below_the_smallest_float_still_counts() -> None:
    belief, log_norm = observe(jnp.array([0.5, 0.5, 0.0]), jnp.array([-800.0, -801.0, 0.0]))
    np.testing.assert_allclose(belief, [1 / (1 + np.exp(-1)), 1 / (1 + np.exp(1)), 0], rtol=1e-6)
    np.testing.assert_allclose(log_norm, -800 + np.log(0.5 + 0.5 * np.exp(-1)), rtol=1e-6)


def test_a_likelihood_far_above_one_is_fine_too() -> None:
    belief, log_norm = observe(jnp.array([0.5, 0.5]), jnp.array([300.0, 300.0]))
    np.testing.assert_allclose(belief, [0.5, 0.5])
    np.testing.assert_allclose(log_norm, 300)


def test_a_belief_with_nowhere_to_go_stays_zero_and_finite() -> None:
    log_trans = jnp.full((1, 2, 2), NEG)
    belief, log_norm = filtering.update_belief(jnp.array([0.3, 0.7]), log_trans, 0, jnp.zeros(2))
    np.testing.assert_array_equal(belief, [0, 0])
    assert log_norm == np.float32(NEG)


def test_prediction_follows_the_action() -> None:
    log_trans = jnp.log(jnp.array([[[0.9, 0.1], [0.5, 0.5]], [[0.2, 0.8], [0.3, 0.7]]]))
    belief = jnp.array([0.5, 0.5])
    np.testing.assert_allclose(predict(belief, log_trans, 0), [0.7, 0.3], rtol=1e-6)
    np.testing.assert_allclose(predict(belief, log_trans, 1), [0.25, 0.75], rtol=1e-6)


def test_predicting_several_steps_is_predicting_one_several_times() -> None:
    chain = random_problem(3).jax(np.float32)[0]
    belief = jnp.exp(chain.log_init)
    ahead = filtering.predict_steps(belief, chain.log_trans, jnp.array([1, 0, 1]))
    for action, row in zip((1, 0, 1), ahead, strict=True):
        belief = predict(belief, chain.log_trans, action)
        np.testing.assert_allclose(row, belief, rtol=1e-6)


def test_the_next_observation_has_the_probability_that_observing_it_reports() -> None:
    problem = random_problem(5)
    chain = problem.jax(np.float32)[0]
    log_emit = jnp.log(jnp.array([[0.7, 0.3], [0.1, 0.9], [0.5, 0.5]]))
    belief = jnp.array([0.2, 0.5, 0.3])
    told = filtering.predict_observation(belief, chain.log_trans, 1, log_emit)
    for symbol in range(2):
        _, log_norm = filtering.update_belief(belief, chain.log_trans, 1, log_emit[:, symbol])
        np.testing.assert_allclose(told[symbol], np.exp(log_norm), rtol=1e-6)


def test_starts_and_links() -> None:
    start = jnp.array([False, False, True, False, False, False])
    valid = jnp.array([True, True, True, True, False, True])
    np.testing.assert_array_equal(trial_starts(start, valid), [1, 0, 1, 0, 0, 1])
    np.testing.assert_array_equal(linked_steps(start, valid), [1, 0, 1, 0, 0, 0])


@pytest.mark.usefixtures("x64")
def test_the_gradient_of_the_evidence_is_the_expected_counts() -> None:
    problem = random_problem(7, starts=0.3)
    chain, log_obs, *rest = problem.jax()

    def evidence(chain: object, log_obs: jax.Array) -> jax.Array:
        return filter_tape(chain, log_obs, *rest).log_norm.sum()

    by_chain, by_obs = quick_jit(jax.grad(evidence, argnums=(0, 1)))(chain, log_obs)
    answer = enumerate_tape(*problem)
    np.testing.assert_allclose(by_obs, answer.gamma, **CLOSE)
    np.testing.assert_allclose(by_chain.log_trans, answer.xi, **CLOSE)
    np.testing.assert_allclose(by_chain.log_init, answer.initial, **CLOSE)


def test_gradients_stay_finite_with_structural_zeros() -> None:
    chain, log_obs, *rest = random_problem(8, zeros=0.4).jax(np.float32)
    log_obs = log_obs.at[2].set(NEG)
    grad = jax.grad(lambda c, x: filter_tape(c, x, *rest).log_norm.sum(), argnums=(0, 1))
    grads = quick_jit(grad)(chain, log_obs)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))
