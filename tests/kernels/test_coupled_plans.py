from __future__ import annotations

import re
from functools import partial
from math import prod

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.kernels import native
from jaxpomdp.kernels.coupled import CoupledChain, CoupledPosterior
from jaxpomdp.kernels.coupled_plans import choose_plan, coupled_posterior, marginal_posterior
from jaxpomdp.numerics import NEG
from tests.kernels.coupled_problems import CoupledProblem, random_coupled, stack_coupled
from tests.kernels.problems import quick_jit
from tests.kernels.test_coupled import as_batch, contradicting
from tests.kernels.test_native import Tapes, by_numpy, by_threads

needs_native = pytest.mark.skipif(not native.available(), reason="needs a compiler for the native kernels")
by_scan = quick_jit(partial(coupled_posterior, plan="scan"))
by_native = jax.jit(partial(coupled_posterior, plan="native"))
sweep_by_scan = quick_jit(partial(marginal_posterior, plan="scan"))
sweep_by_native = jax.jit(partial(marginal_posterior, plan="native"))
either_native = pytest.mark.parametrize("by_native", [by_native, sweep_by_native], ids=["exact", "marginal"])
HARD = {"starts": 0.1, "missing": 0.2, "padding": 3, "zeros": 0.4, "scale": 2.0}


def batch(models: int, tapes: int, **options) -> list[list[CoupledProblem]]:
    """Draw ``models`` problems and give each ``tapes`` different tapes."""
    return [[random_coupled(100 * s + b, model=s, **options) for b in range(tapes)] for s in range(models)]


def outer(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Add what is said of each chain, ``[..., N_c]``, to what it says of pairs, ``[..., N_1 N_2]``."""
    both = one[..., :, None].astype(float) + two[..., None, :]
    return np.maximum(both, NEG).reshape(*both.shape[:-2], -1)


def by_pairs(chains: CoupledChain, log_obs: tuple, *rest: jax.Array) -> CoupledPosterior:
    """Write the pair down as one chain, in float64 and NumPy, and sum each chain's share."""
    init, moves, rows = (outer(*map(np.asarray, part)) for part in (*chains, log_obs))
    one, two = (x.shape[-1] for x in log_obs)
    square = moves.reshape(*moves.shape[:2], one * two, one * two)
    seen = by_numpy(Tapes(np.exp(init), np.exp(square), rows, *map(np.asarray, rest)))
    gamma, initial = (x.reshape(*x.shape[:-1], one, two) for x in (seen.gamma, seen.initial))
    xi = seen.xi.reshape(*seen.xi.shape[:2], one, two, one, two)
    both = [(x.sum(axis=-1), x.sum(axis=-2)) for x in (gamma, xi, initial)]
    return CoupledPosterior(seen.log_evidence, *both)


def assert_same(
    got: CoupledPosterior, want: CoupledPosterior, rtol: float = 2e-5, atol: float = 2e-5
) -> None:
    for name, x, y in zip(got._fields, got, want, strict=True):
        for part, other in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True):
            np.testing.assert_allclose(part, other, err_msg=name, rtol=rtol, atol=atol)


@needs_native
@pytest.mark.parametrize("sizes", [(3, 2), (2, 17), (16, 4), (1, 5), (5, 1), (1, 1), (7, 9)], ids=str)
def test_native_equals_numpy(sizes: tuple[int, int]) -> None:
    """Chains of any size, several actions, structural zeros, missing steps, trials within tapes, padding."""
    inputs = stack_coupled(batch(2, 9, sizes=sizes, actions=3, steps=14, **HARD), np.float32)
    assert_same(by_native(*inputs), by_pairs(*inputs))


@needs_native
@pytest.mark.parametrize("scale", [30.0, 300.0])
def test_native_equals_numpy_however_sharp_the_observations(scale: float) -> None:
    inputs = stack_coupled(batch(2, 5, sizes=(4, 3), steps=14, zeros=0.5, scale=scale), np.float32)
    got = by_native(*inputs)
    assert_same(got, by_pairs(*inputs))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))


@needs_native
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("options", [{}, {"zeros": 0.4}, {"starts": 0.4, "missing": 0.4, "padding": 1}])
def test_native_equals_scan_in_both_precisions(options: dict) -> None:
    single = as_batch(random_coupled(1, **options))
    double = jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, single)
    got = by_native(*single)
    assert_same(got, by_scan(*single))
    assert_same(got, by_scan(*double))


@needs_native
def test_a_tape_that_underflows_is_repaired_and_the_others_are_untouched() -> None:
    bad = contradicting()
    mild = bad._replace(log_obs=(bad.log_obs[0] / 100, bad.log_obs[1]))
    inputs = stack_coupled([[mild, bad, mild], [bad, bad, bad]], np.float32)
    assert_same(by_native(*inputs), by_pairs(*inputs))


def hopeless() -> tuple:
    """Spare states that nothing leads to; steps that no state, or no state within reach, allows."""
    problems = batch(2, 4, sizes=(5, 4), steps=12, zeros=0.3, scale=20.0)
    rng = np.random.default_rng(0)
    for row in problems:
        for problem in row:
            for c, last in enumerate((4, 3)):
                for table in (problem.log_init[c], problem.log_trans[c]):
                    table[..., 0] = np.logaddexp(table[..., 0], table[..., last])
                    table[..., last] = NEG
                problem.log_obs[c][rng.random(problem.log_obs[c].shape) < 0.2] = NEG
            problem.log_obs[0][3] = NEG
    return stack_coupled(problems, np.float32)


def spares_nothing(got: CoupledPosterior) -> bool:
    return not any(x[..., -1].any() for x in (*got.gamma, *got.xi, *got.initial))


@needs_native
def test_impossible_steps_and_dead_states() -> None:
    got = by_native(*hopeless())
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))
    assert spares_nothing(got)
    assert_same(got, by_pairs(*hopeless()))


@needs_native
def test_the_oracle_notices_an_action_that_comes_a_step_late() -> None:
    chains, rows, actions, *flags = stack_coupled(batch(1, 3), np.float32)
    with pytest.raises(AssertionError):
        assert_same(
            by_native(chains, rows, jnp.roll(actions, 1, -1), *flags), by_pairs(chains, rows, actions, *flags)
        )


@needs_native
@either_native
def test_what_lies_in_the_padding_does_not_matter(by_native) -> None:
    clean = stack_coupled(batch(2, 5, padding=2), np.float32)
    chains, rows, actions, start, valid = clean
    spoilt = tuple(jnp.where(valid[..., None], x, jnp.nan) for x in rows), jnp.where(valid, actions, 77)
    assert_same(by_native(chains, *spoilt, start | ~valid, valid), by_native(*clean), rtol=0, atol=0)


@needs_native
@either_native
def test_results_do_not_depend_on_the_number_of_threads(by_native, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = stack_coupled(batch(3, 11, sizes=(9, 5), steps=30), np.float32)
    one, *more = by_threads(lambda: by_native(*inputs), monkeypatch)
    for other in more:
        assert_same(one, other, rtol=0, atol=0)


@needs_native
@either_native
def test_it_works_under_vmap(by_native) -> None:
    chains, rows, *rest = stack_coupled(batch(2, 3), np.float32)
    both = jax.tree.map(lambda x: jnp.stack([x, -x]), rows)
    mapped = jax.jit(jax.vmap(lambda x: by_native(chains, x, *rest)))(both)
    for k in range(2):
        one = by_native(chains, jax.tree.map(lambda x, k=k: x[k], both), *rest)
        assert_same(jax.tree.map(lambda x, k=k: x[k], mapped), one)


@needs_native
@either_native
@pytest.mark.parametrize("empty", [(0, 2, 5), (2, 0, 5), (2, 2, 0)], ids=str)
def test_empty_batches_give_empty_results(by_native, empty: tuple[int, ...]) -> None:
    even = CoupledChain(
        (jnp.zeros((empty[0], 3)), jnp.zeros((empty[0], 2))),
        (jnp.zeros((empty[0], 1, 3, 2, 3)), jnp.zeros((empty[0], 1, 3, 2, 2))),
    )
    rows = (jnp.zeros((*empty, 3)), jnp.zeros((*empty, 2)))
    flags = jnp.ones(empty, bool)
    got = by_native(even, rows, jnp.zeros(empty, jnp.int32), flags, flags)
    assert got.gamma[0].shape == (*empty, 3)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(got))


def doubled(inputs: tuple) -> tuple:
    return jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, inputs)


@needs_native
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("sizes", [(3, 2), (2, 17), (16, 4), (1, 5), (5, 1), (7, 9)], ids=str)
def test_the_native_sweep_over_marginals_equals_scan_in_both_precisions(sizes: tuple[int, int]) -> None:
    """As ``test_native_equals_numpy``; more tapes than a chunk, more steps than are counted at once."""
    inputs = stack_coupled(batch(2, 17, sizes=sizes, actions=3, steps=30, **HARD), np.float32)
    got = sweep_by_native(*inputs)
    assert_same(got, sweep_by_scan(*inputs))
    assert_same(got, sweep_by_scan(*doubled(inputs)))


@needs_native
@pytest.mark.usefixtures("x64")
def test_the_native_sweep_with_impossible_steps_and_dead_states() -> None:
    got = sweep_by_native(*hopeless())
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))
    assert spares_nothing(got)
    assert_same(got, sweep_by_scan(*doubled(hopeless())))


def improbable() -> tuple:
    """Both chains go, each with probability 1e-33, where no float holds the product; sight is as sharp."""
    problem = random_coupled(0, sizes=(3, 2), steps=12)
    for table, last in zip(problem.log_trans, (2, 1), strict=True):
        table[...] = np.log(1 / last)
        table[..., last] = np.log(1e-33)
    for row in problem.log_obs:
        row[4:7] = -76.0
        row[4:7, -1] = 0.0
    return stack_coupled([[problem]], np.float32)


@needs_native
@pytest.mark.usefixtures("x64")
def test_the_native_sweep_loses_nothing_in_products_of_small_numbers() -> None:
    got, want = sweep_by_native(*improbable()), sweep_by_scan(*doubled(improbable()))
    assert_same(got, want)
    assert not np.allclose(sweep_by_scan(*improbable()).xi[0], want.xi[0], atol=1e-2)


@needs_native
@pytest.mark.parametrize("scale", [30.0, 300.0])
def test_the_native_sweep_is_finite_however_sharp_the_observations(scale: float) -> None:
    inputs = stack_coupled(batch(2, 5, sizes=(4, 3), steps=14, zeros=0.5, scale=scale), np.float32)
    got, valid = sweep_by_native(*inputs), inputs[-1]
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))
    for gamma in got.gamma:
        np.testing.assert_allclose(gamma.sum(axis=-1), valid, rtol=1e-5)


@needs_native
def test_scan_notices_a_native_sweep_whose_actions_come_a_step_late() -> None:
    chains, rows, actions, *flags = stack_coupled(batch(1, 3), np.float32)
    late = sweep_by_native(chains, rows, jnp.roll(actions, 1, -1), *flags)
    with pytest.raises(AssertionError):
        assert_same(late, sweep_by_scan(chains, rows, actions, *flags))


def test_three_chains_have_one_plan() -> None:
    inputs = stack_coupled([[random_coupled(0, sizes=(2, 3, 2))]], np.float32)
    assert choose_plan("auto", inputs[0]) == "scan"
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(sweep_by_scan(*inputs)))
    with pytest.raises(ValueError, match="plan 'native' needs two chains, got 3"):
        marginal_posterior(*inputs, plan="native")
    with pytest.raises(ValueError, match=r"plan must be one of .*got 'pairs'"):
        marginal_posterior(*inputs, plan="pairs")


def largest_array(function, *arguments) -> int:
    """Return the numbers in the largest array of a compiled function."""
    text = str(jax.jit(function).lower(*arguments).compile().as_text())
    return max(prod(map(int, shape.split(","))) for shape in re.findall(r"\w\[(\d[\d,]*)\]", text))


@needs_native
def test_no_array_has_the_size_of_a_pair_times_a_pair() -> None:
    """One model, one action, one short tape: all else is smaller than (N_1 N_2)^2."""
    chains, *tapes = stack_coupled([[random_coupled(0, sizes=(6, 5), actions=1, steps=3)]], np.float32)
    for kernel in (coupled_posterior, marginal_posterior):
        assert largest_array(partial(kernel, plan="native"), chains, *tapes) == 6 * 5 * 6
    together = largest_array(lambda one, two: one[..., None] + two[..., None, :], *chains.log_trans)
    assert together == (6 * 5) ** 2


def test_auto_prefers_native_and_never_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    single, double = (CoupledChain((x, x), (x, x)) for x in (np.zeros((1, 40), t) for t in ("f4", "f8")))
    monkeypatch.setattr(native, "available", lambda: True)
    assert choose_plan("auto", single) == "native"
    assert choose_plan("auto", double) == "scan"
    with pytest.raises(ValueError, match="plan 'native' needs float32 on a CPU with a compiler, got float64"):
        choose_plan("native", double)
    monkeypatch.setattr(native, "available", lambda: False)
    assert choose_plan("auto", single) == "scan"


def test_auto_takes_no_mixed_numbers_to_native(monkeypatch: pytest.MonkeyPatch) -> None:
    single = np.zeros((1, 40), np.float32)
    monkeypatch.setattr(native, "available", lambda: True)
    chains = CoupledChain((single, single), (single, single))
    assert choose_plan("auto", chains, (single, single)) == "native"
    assert choose_plan("auto", chains, (single, single.astype(float))) == "scan"


@needs_native
def test_an_impossible_tape_changes_no_bit_of_those_after_it() -> None:
    """What lies behind the last pair in the belief's vectors once turned NaN there, for all later tapes."""
    chains, rows, *rest = stack_coupled(batch(1, 6, sizes=(3, 5)), np.float32)
    dead = chains._replace(log_init=(chains.log_init[0].at[:, 0].set(NEG), chains.log_init[1]))
    only_dead = rows[0].at[:, 0].set(NEG).at[:, 0, :, 0].set(0)
    spoilt = coupled_posterior(dead, (only_dead, rows[1]), *rest, plan="native")
    clean = coupled_posterior(dead, rows, *rest, plan="native")
    for one, other in zip(
        (*spoilt.gamma, spoilt.log_evidence), (*clean.gamma, clean.log_evidence), strict=True
    ):
        np.testing.assert_array_equal(one[:, 1:], other[:, 1:])


def test_bad_arguments_are_named() -> None:
    (init, trans), rows, actions, *flags = stack_coupled(batch(2, 3), np.float32)
    with pytest.raises(ValueError, match=r"plan must be one of .*got 'pairs'"):
        coupled_posterior(CoupledChain(init, trans), rows, actions, *flags, plan="pairs")
    with pytest.raises(ValueError, match=r"trans\[0\] must have shape \[S, A, N_1, N_2, N_1\]"):
        native.coupled_estep(init, (trans[0][0], trans[1]), rows, actions, *flags)
    with pytest.raises(
        ValueError, match=r"trans\[1\] must be float32\[2, 2, 3, 2, 2\], got .*\[2, 2, 3, 2, 3\]"
    ):
        native.coupled_estep(init, (trans[0], trans[0]), rows, actions, *flags)
    with pytest.raises(ValueError, match=r"log_obs\[1\] must be float32.*, got float16"):
        native.coupled_estep(init, trans, (rows[0], rows[1].astype(jnp.float16)), actions, *flags)


@needs_native
def test_chains_without_states_are_answered() -> None:
    """They once ended the process: a division by zero."""
    (init, trans), rows, *rest = stack_coupled(batch(1, 2, sizes=(3, 2)), np.float32)
    none = (trans[0][:, :, :0, :, :0], trans[1][:, :, :0])
    seen = native.coupled_estep((init[0][:, :0], init[1]), none, (rows[0][..., :0], rows[1]), *rest)
    assert seen.gamma[0].shape == rows[0][..., :0].shape
