from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.kernels import decoding
from jaxpomdp.kernels.decoding import viterbi
from jaxpomdp.numerics import NEG
from tests.kernels.problems import quick_jit, random_problem
from tests.oracles.hmm import enumerate_tape

VITERBI = quick_jit(viterbi)
KINDS = {
    "plain": {},
    "tape": {"starts": 0.4},
    "missing": {"missing": 0.5},
    "zeros": {"zeros": 0.4},
    "padded": {"padding": 2, "starts": 0.3},
    "strong": {"scale": 200.0},
}


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("kind", KINDS)
def test_the_path_is_the_best_of_all(kind: str) -> None:
    for seed in range(4):
        problem = random_problem(seed, **KINDS[kind])
        got, want = VITERBI(*problem.jax()), enumerate_tape(*problem)
        np.testing.assert_array_equal(got.states, want.states)
        np.testing.assert_allclose(got.log_prob, want.best, rtol=1e-10, atol=1e-10)


@pytest.mark.usefixtures("x64")
def test_the_oracle_notices_a_broken_search(monkeypatch: pytest.MonkeyPatch) -> None:
    search = decoding._search
    monkeypatch.setattr(decoding, "_search", lambda c, x, a, f: search(c, x, jnp.roll(a, 1), f))
    run = quick_jit(lambda *x: viterbi(*x))
    problems = [random_problem(seed) for seed in range(6)]
    assert any(not np.isclose(run(*p.jax()).log_prob, enumerate_tape(*p).best, rtol=1e-10) for p in problems)


@pytest.mark.usefixtures("x64")
def test_an_impossible_step_is_passed_over() -> None:
    problem = random_problem(2, zeros=0.3)
    problem.log_obs[3] = NEG
    got, want = VITERBI(*problem.jax()), enumerate_tape(*problem)
    np.testing.assert_array_equal(got.states, want.states)
    np.testing.assert_allclose(got.log_prob, want.best, rtol=1e-10)


def test_float32_decodes_a_long_tape_like_float64() -> None:
    problem = random_problem(1, states=4, actions=3, steps=50_000, scale=2.0)
    single = VITERBI(*problem.jax(np.float32))
    with jax.enable_x64(True):
        double = VITERBI(*problem.jax())
    assert np.mean(np.asarray(single.states) != np.asarray(double.states)) < 1e-4
    np.testing.assert_allclose(single.log_prob, double.log_prob, rtol=1e-5)


def test_padding_is_marked() -> None:
    got = VITERBI(*random_problem(0, padding=2).jax(np.float32))
    np.testing.assert_array_equal(got.states[-2:], -1)
    assert (got.states[:-2] >= 0).all()
