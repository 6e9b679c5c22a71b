from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxpomdp.kernels.sampling import sample_path, sample_posterior
from tests.kernels.problems import Problem, quick_jit, random_problem
from tests.kernels.test_smoothing import two_worlds
from tests.oracles.hmm import enumerate_tape, log_of, path_weights

DRAWS = 4000


def many_paths(problem: Problem, draws: int = DRAWS) -> np.ndarray:
    """Draw posterior paths; the forward pass is shared."""
    run = quick_jit(jax.vmap(sample_posterior, in_axes=(0, None, None, None, None, None)))
    return np.asarray(run(jax.random.split(jax.random.key(0), draws), *problem.jax(np.float32)))


def ancestral(problem: Problem, draws: int = DRAWS) -> np.ndarray:
    chain, _, *rest = problem.jax(np.float32)
    run = quick_jit(jax.vmap(sample_path, in_axes=(0, None, None, None, None)))
    return np.asarray(run(jax.random.split(jax.random.key(1), draws), chain, *rest))


def assert_frequencies(paths: np.ndarray, listed: np.ndarray, weight: np.ndarray) -> None:
    """Compare how often each path came with how often it should (chi-square); none of weight zero came."""
    states = listed.max() + 1
    code = paths @ states ** np.arange(paths.shape[1])
    index = {c: k for k, c in enumerate(listed @ states ** np.arange(listed.shape[1]))}
    seen = np.bincount([index[c] for c in code], minlength=len(listed))
    probability = np.exp(weight - np.logaddexp.reduce(weight))
    assert not seen[probability == 0].any()
    often = probability * len(paths) >= 5
    seen = np.append(seen[often], seen[~often].sum())
    expected = np.append(probability[often], probability[~often].sum()) * len(paths)
    keep = expected > 1
    assert stats.chisquare(seen[keep], expected[keep] * seen[keep].sum() / expected[keep].sum()).pvalue > 1e-4


@pytest.mark.parametrize("zeros", [0.0, 0.3])
def test_posterior_paths_come_as_often_as_they_should(zeros: float) -> None:
    problem = random_problem(3, states=3, steps=4, zeros=zeros, missing=0.3)
    rows = [log_of(x) for x in problem[:3]]
    assert_frequencies(many_paths(problem), *path_weights(*rows, problem.actions))


def test_ancestral_paths_come_as_often_as_they_should() -> None:
    problem = random_problem(4, states=3, steps=4, zeros=0.3)
    rows = [log_of(x) for x in problem[:2]]
    assert_frequencies(ancestral(problem), *path_weights(*rows, np.zeros((4, 3)), problem.actions))


def test_the_frequencies_notice_the_wrong_action() -> None:
    problem = random_problem(4, states=3, steps=4)
    rows = [log_of(x) for x in problem[:3]]
    late = problem._replace(actions=1 - problem.actions)
    with pytest.raises(AssertionError):
        assert_frequencies(many_paths(late), *path_weights(*rows, problem.actions))


def test_trials_on_a_tape_are_drawn_apart_and_padding_is_marked() -> None:
    problem = random_problem(5, steps=6, starts=0.5, padding=2)
    paths, want = many_paths(problem), enumerate_tape(*problem)
    assert (paths[:, 4:] == -1).all()
    often = np.stack([(paths == s).mean(axis=0) for s in range(3)], axis=1)
    np.testing.assert_allclose(often, want.gamma, atol=5 * 0.5 / np.sqrt(DRAWS))
    free = ancestral(problem)
    begins = (free[:, np.flatnonzero(problem.start)[-1]][:, None] == np.arange(3)).mean(axis=0)
    np.testing.assert_allclose(begins, np.exp(problem.log_init), atol=5 * 0.5 / np.sqrt(DRAWS))


def test_a_world_lost_to_underflow_is_still_drawn() -> None:
    paths = many_paths(two_worlds(100.0, 150.0), 50)
    assert (paths == 1).all()


def test_draws_do_not_depend_on_padding_or_batch() -> None:
    problem = random_problem(6, steps=6)
    longer = Problem(*problem[:2], *(np.concatenate([x, np.zeros_like(x)]) for x in problem[2:]))
    key = jax.random.key(3)
    chain, log_obs, *rest = problem.jax(np.float32)
    chain_2, log_obs_2, *rest_2 = longer.jax(np.float32)
    free, given = quick_jit(sample_path), quick_jit(sample_posterior)
    np.testing.assert_array_equal(free(key, chain, *rest), free(key, chain_2, *rest_2)[:6])
    drawn = given(key, chain, log_obs, *rest)
    np.testing.assert_array_equal(drawn, given(key, chain_2, log_obs_2, *rest_2)[:6])
    together = quick_jit(jax.vmap(sample_posterior, in_axes=(0, None, None, None, None, None)))
    keys = jnp.stack([jax.random.key(9), key])
    np.testing.assert_array_equal(together(keys, chain, log_obs, *rest)[1], drawn)
