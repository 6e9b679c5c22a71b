from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import Posterior
from jaxpomdp.kernels import smoothing
from jaxpomdp.kernels.smoothing import smooth, smooth_exact, smooth_scaled
from jaxpomdp.numerics import NEG
from tests.kernels.problems import Problem, log_of, quick_jit, random_problem
from tests.oracles.hmm import Answer, enumerate_tape

CLOSE = {"rtol": 1e-10, "atol": 1e-10}
SMOOTH, EXACT, SCALED = (quick_jit(run) for run in (smooth, smooth_exact, smooth_scaled))
OPTIMISED = jax.jit(smooth)
ROUTES = {"smooth": SMOOTH, "exact": EXACT, "scaled": lambda *x: SCALED(*x)[0]}
KINDS = {
    "plain": {},
    "tape": {"starts": 0.4},
    "missing": {"missing": 0.5},
    "zeros": {"zeros": 0.4},
    "padded": {"padding": 2, "starts": 0.3},
    "one step": {"steps": 1},
    "one state": {"states": 1},
    "strong": {"scale": 30.0},
}


def assert_answers(got: Posterior, want: Answer, **close: float) -> None:
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, **close)
    np.testing.assert_allclose(got.gamma, want.gamma, **close)
    np.testing.assert_allclose(got.xi, want.xi, **close)
    np.testing.assert_allclose(got.initial, want.initial, **close)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("route", ROUTES)
def test_everything_equals_the_sum_over_all_paths(route: str, kind: str) -> None:
    for seed in range(3):
        problem = random_problem(seed, **KINDS[kind])
        assert_answers(ROUTES[route](*problem.jax()), enumerate_tape(*problem), **CLOSE)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", ["backward_weights", "transition_counts", "relative_likelihood"])
def test_the_oracle_notices_a_broken_kernel(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = getattr(smoothing, name)
    monkeypatch.setattr(smoothing, name, lambda *x: kernel(*x).at[..., 0].multiply(1 + 1e-8))
    problem = random_problem(0)
    with pytest.raises(AssertionError):
        assert_answers(quick_jit(lambda *x: smooth(*x))(*problem.jax()), enumerate_tape(*problem), **CLOSE)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("run", [SMOOTH, EXACT])
def test_the_oracle_notices_actions_shifted_by_a_step(run: object) -> None:
    problem = random_problem(1)
    late = problem._replace(actions=np.roll(problem.actions, 1))
    with pytest.raises(AssertionError):
        assert_answers(run(*late.jax()), enumerate_tape(*problem), **CLOSE)


def long_problem(steps: int, states: int) -> Problem:
    return random_problem(1, states=states, actions=3, steps=steps, zeros=0.3, scale=2.0)


def test_float32_agrees_with_float64_over_a_trial() -> None:
    problem = long_problem(251, 20)
    single = OPTIMISED(*problem.jax(np.float32))
    with jax.enable_x64(True):
        double = OPTIMISED(*problem.jax())
    np.testing.assert_allclose(single.log_evidence, double.log_evidence, rtol=1e-5)
    np.testing.assert_allclose(single.gamma, double.gamma, atol=1e-5)
    np.testing.assert_allclose(single.xi, double.xi, atol=1e-5 * 251)


def test_float32_agrees_with_float64_over_a_hundred_thousand_steps() -> None:
    problem = long_problem(100_000, 4)
    single = OPTIMISED(*problem.jax(np.float32))
    with jax.enable_x64(True):
        double = OPTIMISED(*problem.jax())
    np.testing.assert_allclose(single.log_evidence, double.log_evidence, rtol=1e-5)
    np.testing.assert_allclose(single.gamma, double.gamma, atol=1e-5)
    np.testing.assert_allclose(single.xi, double.xi, rtol=1e-4)


def test_a_long_tape_takes_no_memory_for_transitions_of_each_step() -> None:
    steps, states, actions = 100_000, 32, 2
    shapes = [(states,), (actions, states, states), (steps, states)]
    numbers = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    flags = [jax.ShapeDtypeStruct((steps,), kind) for kind in (jnp.int32, jnp.bool_, jnp.bool_)]
    run = jax.jit(lambda init, trans, *tape: smooth(smoothing.Chain(init, trans), *tape))
    used = run.lower(*numbers, *flags).compile().memory_analysis().temp_size_in_bytes
    assert used < 4 * steps * states * 12
    assert used < 4 * steps * states * states / 2


# Underflow. A chain of two worlds that never mix, and evidence that first rules one out, then the other in.


def two_worlds(early: float, late: float) -> Problem:
    log_trans = log_of(np.array([[[1.0, 0.0], [0.0, 1.0]]]))
    log_obs = np.array([[0.0, -early], [0.0, -early], [-late, 0.0], [-late, 0.0]])
    flags = np.arange(4) == 0
    actions = np.zeros(4, int)
    return Problem(np.log([0.5, 0.5]), log_trans, log_obs, actions, flags, np.ones(4, bool))


def naive_scaled(
    chain: smoothing.Chain, log_obs: jax.Array, actions: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Carry renormalised probabilities and trust them: the log-evidence and the last belief."""
    trans, weight = jnp.exp(chain.log_trans), jnp.exp(log_obs)
    belief, log_evidence = jnp.exp(chain.log_init) * weight[0], 0.0
    for t in range(1, log_obs.shape[0]):
        log_evidence += jnp.log(belief.sum())
        belief = (belief / belief.sum()) @ trans[actions[t - 1]] * weight[t]
    return log_evidence + jnp.log(belief.sum()), belief / belief.sum()


@pytest.mark.parametrize(("early", "late"), [(100.0, 150.0), (40.0, 500.0), (300.0, 300.0)])
def test_rescue_when_a_lost_world_comes_back(early: float, late: float) -> None:
    problem = two_worlds(early, late)
    want = enumerate_tape(*problem)
    assert_answers(SMOOTH(*problem.jax(np.float32)), want, rtol=1e-5, atol=1e-5)
    assert_answers(EXACT(*problem.jax(np.float32)), want, rtol=1e-5, atol=1e-5)


def test_rescue_in_float64_too() -> None:
    problem = two_worlds(1000.0, 2000.0)
    with jax.enable_x64(True):
        assert_answers(SMOOTH(*problem.jax()), enumerate_tape(*problem), **CLOSE)


def test_the_naive_kernel_fails_where_the_rescue_is_right() -> None:
    problem = two_worlds(100.0, 150.0)
    chain, log_obs, actions, *_ = problem.jax(np.float32)
    log_evidence, belief = naive_scaled(chain, log_obs, actions)
    want = enumerate_tape(*problem)
    assert not np.isclose(log_evidence, want.log_evidence, rtol=1e-5)
    assert not np.allclose(belief, want.gamma[-1], atol=1e-3)
    assert not np.isfinite(log_evidence)


def test_slow_loss_that_no_single_step_shows() -> None:
    """Each step takes a factor ``e^-10`` only; the lost world wins in the end by what it regains."""
    trend = np.where(np.arange(40) < 18, 10.0, -10.0)
    log_obs = np.stack([np.zeros(40), -trend], axis=1)
    ones = np.ones(40, bool)
    start = np.arange(40) == 0
    problem = Problem(np.log([0.5, 0.5]), two_worlds(0, 0).log_trans, log_obs, np.zeros(40, int), start, ones)
    scaled, trusted = SCALED(*problem.jax(np.float32))
    got = SMOOTH(*problem.jax(np.float32))
    assert not trusted
    assert scaled.gamma[-1, 1] < 0.5
    np.testing.assert_allclose(got.gamma[:, 1], 1, atol=1e-5)
    np.testing.assert_allclose(got.log_evidence, np.log(0.5) + 40, rtol=1e-5)


def test_the_naive_sum_is_used_when_nothing_underflows() -> None:
    """The rescue is lazy: its loop turns zero times for an ordinary tape, once for one that underflows."""
    for problem, turns in ((random_problem(0, scale=5.0), 0), (two_worlds(100.0, 150.0), 1)):
        calls: list[int] = []

        def counted(*inputs: object, calls: list[int] = calls) -> Posterior:
            jax.debug.callback(lambda: calls.append(1))
            return smooth_exact(*inputs)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(smoothing, "smooth_exact", counted)
            jax.block_until_ready(quick_jit(lambda *x: smooth(*x))(*problem.jax(np.float32)))
            jax.effects_barrier()
        assert len(calls) == turns


# Impossible steps, dead states, degenerate chains.


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("seed", range(4))
def test_an_impossible_step_is_a_missing_step_that_costs_neg(seed: int) -> None:
    problem = random_problem(seed, zeros=0.5, states=3, steps=6)
    problem.log_obs[3] = np.where(np.arange(3) == seed % 3, 0.3, NEG)
    problem.log_obs[4] = np.where(np.arange(3) == (seed + 1) % 3, 0.1, NEG)
    problem.log_obs[1] = NEG
    want = enumerate_tape(*problem)
    got = SMOOTH(*problem.jax())
    assert want.log_evidence <= NEG
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, rtol=1e-10)
    np.testing.assert_allclose(got.gamma, want.gamma, **CLOSE)
    np.testing.assert_allclose(got.xi, want.xi, **CLOSE)


@pytest.mark.parametrize("route", ROUTES)
def test_nothing_is_ever_nan(route: str) -> None:
    for seed in range(8):
        problem = random_problem(seed, zeros=0.6, scale=10.0 ** (seed % 5))
        rng = np.random.default_rng(seed)
        problem.log_obs[rng.random(problem.log_obs.shape) < 0.5] = NEG
        if seed == 7:
            problem.log_trans[:, 2] = NEG
        assert all(np.isfinite(leaf).all() for leaf in ROUTES[route](*problem.jax(np.float32)))


def test_a_state_without_a_way_out_ends_in_zeros() -> None:
    log_trans = np.full((1, 2, 2), NEG)
    flags = np.arange(4) % 2 == 0
    problem = Problem(
        np.log([0.5, 0.5]), log_trans, np.zeros((4, 2)), np.zeros(4, int), flags, np.ones(4, bool)
    )
    got = SMOOTH(*problem.jax(np.float32))
    np.testing.assert_allclose(got.gamma, [[0.5, 0.5], [0, 0], [0.5, 0.5], [0, 0]])
    assert got.log_evidence <= np.float32(NEG)
    assert not got.xi.any()


@pytest.mark.usefixtures("x64")
def test_likelihoods_may_be_any_positive_multiple() -> None:
    problem = random_problem(2)
    shift = np.linspace(-300, 300, 6)[:, None]
    got = SMOOTH(*problem._replace(log_obs=problem.log_obs + shift).jax())
    base = SMOOTH(*problem.jax())
    np.testing.assert_allclose(got.log_evidence, base.log_evidence + shift.sum(), rtol=1e-10)
    np.testing.assert_allclose(got.gamma, base.gamma, **CLOSE)
    np.testing.assert_allclose(got.xi, base.xi, **CLOSE)


def test_one_lane_that_underflows_changes_no_other() -> None:
    """Under vmap the rescue runs for all lanes, and only the lane that needs it takes the result."""
    easy = random_problem(0, states=2, actions=1, steps=4)
    bad = two_worlds(100.0, 150.0)
    batch = jax.tree.map(lambda *x: jnp.stack(x), easy.jax(np.float32), bad.jax(np.float32))
    got = quick_jit(jax.vmap(smooth))(*batch)
    alone = SCALED(*easy.jax(np.float32))[0]
    np.testing.assert_allclose(got.gamma[0], alone.gamma, rtol=1e-6)
    assert_answers(jax.tree.map(lambda x: x[1], got), enumerate_tape(*bad), rtol=1e-5, atol=1e-5)


def test_the_derivative_of_the_scaled_evidence_is_defined_under_jit() -> None:
    chain, *tape = random_problem(4).jax(np.float32)
    grad = quick_jit(jax.grad(lambda c: smooth_scaled(c, *tape)[0].log_evidence))(chain)
    np.testing.assert_allclose(grad.log_trans, SCALED(chain, *tape)[0].xi, atol=1e-5)
