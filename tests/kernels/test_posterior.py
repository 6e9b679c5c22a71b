from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import Posterior
from jaxpomdp.kernels import blocked, grouped, native
from jaxpomdp.kernels.grouped import capacities, group_rows, grouped_product, smooth_grouped
from jaxpomdp.kernels.posterior import choose_plan, posterior
from tests.kernels.problems import Problem, quick_jit, random_problem, stack, with_tape
from tests.kernels.test_smoothing import two_worlds
from tests.oracles.hmm import enumerate_tape

LONG = (1, 1, 100_000, 32)
CLOSE = {"rtol": 1e-10, "atol": 1e-10}
run = quick_jit(posterior, static_argnames="plan")
SINGLE = {"rtol": 2e-5, "atol": 2e-5}

needs_native = pytest.mark.skipif(not native.available(), reason="needs a compiler for the native kernels")
BATCHED = ["grouped", "blocked", pytest.param("native", marks=needs_native)]
WIDE = ["scan", "grouped", "blocked"]


def batch(models: int, tapes: int, **options: float) -> list[list[Problem]]:
    """Draw ``models`` problems and give each ``tapes`` different tapes."""
    first = [random_problem(seed, **options) for seed in range(models)]
    extra = {k: v for k, v in options.items() if k not in ("states", "actions", "steps", "zeros")}
    return [[with_tape(p, 100 + 10 * s + b, **extra) for b in range(tapes)] for s, p in enumerate(first)]


def assert_same(got: Posterior, want: Posterior, **close: float) -> None:
    for name, x, y in zip(got._fields, got, want, strict=True):
        np.testing.assert_allclose(x, y, err_msg=name, **close)


def assert_enumerated(problems: list[list[Problem]], got: Posterior, **close: float) -> None:
    for s, row in enumerate(problems):
        answers = [enumerate_tape(*problem) for problem in row]
        np.testing.assert_allclose(got.log_evidence[s], [a.log_evidence for a in answers], **close)
        np.testing.assert_allclose(got.gamma[s], [a.gamma for a in answers], **close)
        np.testing.assert_allclose(got.xi[s], sum(a.xi for a in answers), **close)
        np.testing.assert_allclose(got.initial[s], sum(a.initial for a in answers), **close)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("plan", WIDE)
def test_each_plan_equals_enumeration(plan: str) -> None:
    for options in ({"starts": 0.3, "missing": 0.2}, {"zeros": 0.4, "padding": 1}):
        problems = batch(2, 5, **options)
        assert_enumerated(problems, run(*stack(problems), plan=plan), **CLOSE)


@pytest.mark.parametrize("plan", BATCHED)
def test_plans_agree_in_float32_on_larger_batches(plan: str) -> None:
    problems = batch(3, 9, states=17, actions=4, steps=40, starts=0.05, missing=0.1, padding=3, scale=2.0)
    inputs = stack(problems, np.float32)
    assert_same(run(*inputs, plan=plan), run(*inputs, plan="scan"), **SINGLE)


@pytest.mark.parametrize("plan", BATCHED)
@pytest.mark.parametrize("skew", ["one action", "one tape", "many actions"])
def test_groups_of_any_size(plan: str, skew: str) -> None:
    actions, tapes = (40 if skew == "many actions" else 2), (1 if skew == "one tape" else 5)
    problems = batch(2, tapes, actions=actions, starts=0.1)
    if skew == "one action":
        problems = [[p._replace(actions=np.ones_like(p.actions)) for p in row] for row in problems]
    assert_enumerated(problems, run(*stack(problems, np.float32), plan=plan), **SINGLE)


@pytest.mark.parametrize("plan", ["scan", *BATCHED])
def test_a_tape_that_underflows_is_repaired_and_the_others_are_untouched(plan: str) -> None:
    bad, mild = two_worlds(100.0, 150.0), two_worlds(1.0, 2.0)
    problems = [[mild, mild, mild], [mild, bad, bad._replace(log_obs=-bad.log_obs)], [bad, bad, bad]]
    assert_enumerated(problems, run(*stack(problems, np.float32), plan=plan), **SINGLE)


def test_the_grouped_plan_says_which_tapes_it_cannot_vouch_for() -> None:
    bad, mild = two_worlds(100.0, 150.0), two_worlds(1.0, 2.0)
    got, trusted = quick_jit(smooth_grouped)(*stack([[mild, mild], [mild, bad]], np.float32))
    np.testing.assert_array_equal(trusted, [[True, True], [True, False]])
    np.testing.assert_allclose(got.xi[1], enumerate_tape(*mild).xi, rtol=1e-5)


@pytest.mark.parametrize("plan", ["scan", *BATCHED])
def test_impossible_steps_and_dead_states_give_no_nan(plan: str) -> None:
    problems = batch(2, 5, zeros=0.5, scale=50.0)
    rng = np.random.default_rng(0)
    for row in problems:
        for problem in row:
            problem.log_obs[rng.random(problem.log_obs.shape) < 0.4] = -1e30
    got = run(*stack(problems, np.float32), plan=plan)
    assert all(np.isfinite(leaf).all() for leaf in got)
    assert_enumerated(problems, got, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("plan", BATCHED)
def test_what_lies_in_the_padding_does_not_matter(plan: str) -> None:
    problems = batch(2, 5, padding=2)
    clean = stack(problems, np.float32)
    chains, log_obs, actions, start, valid = clean
    spoilt = jnp.where(valid[..., None], log_obs, jnp.nan), jnp.where(valid, actions, 77), start | ~valid
    got = run(chains, *spoilt, valid, plan=plan)
    assert_same(got, run(*clean, plan=plan), rtol=0, atol=0)


@pytest.mark.usefixtures("x64")
def test_the_oracle_notices_a_product_with_the_wrong_group(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(grouped, "group_rows", lambda a, linked, n: group_rows((a + 1) % n, linked, n))
    problems = batch(1, 5)
    got = quick_jit(lambda *x: smooth_grouped(*x)[0])(*stack(problems))
    want = sum(enumerate_tape(*problem).xi for problem in problems[0])
    assert not np.allclose(got.xi[0], want, atol=1e-3)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("length", [1, 2, 5, 6])
def test_blocks_of_any_length(length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocked, "block_length", lambda steps: length)
    problems = batch(2, 3, starts=0.3, missing=0.2, padding=1)
    assert_enumerated(problems, quick_jit(partial(posterior, plan="blocked"))(*stack(problems)), **CLOSE)


@pytest.mark.usefixtures("x64")
def test_the_oracle_notices_blocks_that_forget_how_probable_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    def forgetful(init: jax.Array, responses: blocked.Response) -> jax.Array:
        return right(init, responses._replace(log_prob=jnp.zeros_like(responses.log_prob)))

    right = blocked._predictions
    monkeypatch.setattr(blocked, "_predictions", forgetful)
    problem = random_problem(0, steps=9)
    got, _ = quick_jit(lambda *x: blocked.smooth_blocked(*x))(*problem.jax())
    assert not np.isclose(got.log_evidence, enumerate_tape(*problem).log_evidence, atol=1e-3)


def test_rows_are_sorted_by_action_in_order() -> None:
    actions = jnp.array([[2, 0, 1, 0, 2, 1, 0]])
    linked = jnp.array([[True, True, True, True, True, False, True]])
    groups = group_rows(actions, linked, 4)
    np.testing.assert_array_equal(groups.order, [[1, 3, 6, 2, 0, 4, 5]])
    np.testing.assert_array_equal(groups.size, [[3, 1, 2, 0]])
    np.testing.assert_array_equal(groups.offset, [[0, 3, 4, 6]])
    np.testing.assert_array_equal(groups.rank, [[0, 0, 0, 1, 1, 0, 2]])


@pytest.mark.parametrize("rows", [1, 4, 9, 50])
def test_grouped_products_are_products(rows: int) -> None:
    rng = np.random.default_rng(rows)
    actions, x = rng.integers(0, 3, (2, rows)), rng.random((2 * rows, 5), np.float32)
    matrices = rng.random((2, 3, 5, 5), np.float32)
    groups = group_rows(jnp.asarray(actions), jnp.ones((2, rows), bool), 3)
    got = grouped_product(groups, jnp.asarray(x), jnp.asarray(matrices)).reshape(2, rows, 5)
    want = [[x.reshape(2, rows, 5)[s, b] @ matrices[s, actions[s, b]] for b in range(rows)] for s in range(2)]
    np.testing.assert_allclose(got, want, rtol=1e-5)


def test_capacities_are_ascending_and_end_with_everything() -> None:
    assert capacities(50, 5) == (16, 20, 50)
    assert capacities(1, 4) == (1,)
    for tapes in range(1, 40):
        sizes = capacities(tapes, 3)
        assert sizes == tuple(sorted(set(sizes)))
        assert sizes[-1] == tapes


def test_auto_prefers_native_and_never_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "available", lambda: True)
    assert choose_plan("auto", jnp.float32, LONG) == "native"
    assert choose_plan("auto", jnp.float64, LONG) == "grouped"
    monkeypatch.setattr(native, "available", lambda: False)
    assert choose_plan("auto", jnp.float32, LONG) == "grouped"
    with pytest.raises(ValueError, match="native"):
        choose_plan("native", jnp.float32, LONG)


@pytest.mark.parametrize(
    ("sizes", "fastest"),
    [
        ((21, 12, 64, 16), "blocked"),
        ((21, 50, 251, 70), "scan"),
        ((1, 64, 1000, 256), "scan"),
        (LONG, "blocked"),
        ((1, 50, 251, 70), "blocked"),
        ((4, 50, 251, 70), "scan"),
        ((84, 50, 251, 70), "grouped"),
        ((336, 50, 251, 70), "grouped"),
    ],
)
def test_auto_takes_what_was_fastest_on_a_gpu(
    sizes: tuple[int, int, int, int], fastest: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As benchmarks/results/speed-gpu.json has it; a plan that is named is taken anywhere."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert choose_plan("auto", jnp.float32, sizes) == fastest
    assert choose_plan("grouped", jnp.float32, sizes) == "grouped"


def test_bad_arguments_are_named() -> None:
    inputs = stack(batch(2, 3), np.float32)
    with pytest.raises(ValueError, match=r"plan must be one of .*got 'fast'"):
        posterior(*inputs, plan="fast")
    with pytest.raises(ValueError, match=r"actions must have shape \(2, 3, 6\)"):
        posterior(inputs[0], inputs[1], inputs[2][:1], *inputs[3:])
    with pytest.raises(ValueError, match=r"log_trans must have shape \[2, A, 3, 3\]"):
        posterior(inputs[0]._replace(log_trans=inputs[0].log_trans[0]), *inputs[1:])
    with pytest.raises(ValueError, match=r"log_obs must have shape \[S, B, T, N\]"):
        posterior(inputs[0], inputs[1][0], *inputs[2:])


def test_a_batch_takes_no_memory_for_transitions_of_each_step() -> None:
    models, tapes, steps, states, actions = 2, 3, 5000, 24, 2
    numbers = [(models, states), (models, actions, states, states), (models, tapes, steps, states)]
    init, trans, log_obs = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in numbers)
    flags = [jax.ShapeDtypeStruct((models, tapes, steps), kind) for kind in (jnp.int32, jnp.bool_, jnp.bool_)]
    run = jax.jit(lambda init, trans, *x: posterior(grouped.Chain(init, trans), *x, plan="grouped"))
    used = run.lower(init, trans, log_obs, *flags).compile().memory_analysis().temp_size_in_bytes
    assert used < 4 * models * tapes * steps * states * 12
