from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.kernels import native
from jaxpomdp.kernels.memory import MemoryChain, MemoryCounts, MemoryPosterior, pair_chain
from jaxpomdp.kernels.memory_plans import choose_plan, memory_posterior
from jaxpomdp.kernels.native import memory_estep
from jaxpomdp.numerics import NEG
from tests.kernels.memory_problems import MemoryProblem, random_memory, stack_memory
from tests.kernels.problems import quick_jit
from tests.kernels.test_native import Tapes, by_numpy, by_threads

needs_native = pytest.mark.skipif(not native.available(), reason="needs a compiler for the native kernels")
by_scan = quick_jit(partial(memory_posterior, plan="pairs"))
by_native = jax.jit(partial(memory_posterior, plan="native"))
HARD = {"starts": 0.1, "missing": 0.2, "padding": 3, "zeros": 0.4, "scale": 2.0}


def batch(models: int, tapes: int, *, awake: tuple[int | None, ...] = (1,), **options) -> list:
    """Draw ``models`` problems, each with its number of awake states, and give each different tapes."""
    return [
        [random_memory(100 * s + b, model=s, awake=awake[s % len(awake)], **options) for b in range(tapes)]
        for s in range(models)
    ]


def by_pairs(chains: MemoryChain, rows: jax.Array, *rest: jax.Array) -> MemoryPosterior:
    """Write the pairs down as one chain, in float64 NumPy, and split each move by what may have made it."""
    n = rows.shape[-1]
    double = MemoryChain(*(jnp.asarray(np.asarray(x), float) for x in chains))
    init, moves = (np.exp(x) for x in jax.vmap(pair_chain)(double))
    seen = by_numpy(
        Tapes(init, moves, np.repeat(np.asarray(rows, float), n, axis=-1), *map(np.asarray, rest))
    )
    gamma = seen.gamma.reshape(*seen.gamma.shape[:-1], n, n)
    xi = seen.xi.reshape(*seen.xi.shape[:2], *[n] * 4)  # from (active, remembered) to the same
    counts = [shared(*x) for x in zip(xi, *(np.exp(x) for x in double[1:]), strict=True)]
    initial = seen.initial.reshape(-1, n, n).sum(2)
    together = MemoryCounts(*(np.stack(x) for x in zip(*counts, strict=True)))
    return MemoryPosterior(seen.log_evidence, gamma.sum(-1), xi.sum((3, 5)), initial, gamma.sum(-2), together)


def shared(xi: np.ndarray, trans: np.ndarray, lead: np.ndarray, heed: np.ndarray, note: np.ndarray) -> tuple:
    """Split the moves ``xi[a, o, r, o', m]`` of one model: by chain or by memory, noted or kept."""

    def part(mine: np.ndarray, other: np.ndarray) -> np.ndarray:
        return xi * np.divide(mine, mine + other, out=np.zeros_like(xi), where=mine + other > 0)

    same = np.eye(len(heed))
    whole = np.zeros_like(xi)
    by_chain = whole + trans[:, :, None, :, None] * heed[:, 0]
    by_memory = whole + (heed[:, 1, None] * lead).swapaxes(1, 2)[:, None, None]
    noted = whole + (same[:, None, :] * note[:, 0][None, :, None])[None, :, :, None]
    kept = whole + (same * note[:, 1, None])[None, None, :, None]
    own, led = part(by_chain, by_memory), part(by_memory, by_chain)
    heeded = own.sum((0, 1, 2, 3)), led.sum((0, 1, 2, 3))
    chosen = (part(x, y).sum((0, 1, 3, 4)) for x, y in ((noted, kept), (kept, noted)))
    return own.sum((2, 4)), led.sum((1, 2)).swapaxes(1, 2), np.stack(heeded, 1), np.stack([*chosen], 1)


def assert_same(got: MemoryPosterior, want: MemoryPosterior, rtol: float = 2e-5, atol: float = 2e-5) -> None:
    named = (x._asdict() | x.counts._asdict() for x in (got, want))
    for (name, x), y in zip(next(named).items(), next(named).values(), strict=True):
        if name != "counts":
            np.testing.assert_allclose(x, y, err_msg=name, rtol=rtol, atol=atol)


SIZES = [(3, None), (5, 0), (5, 1), (17, 3), (16, 16), (1, 0), (1, 1), (70, 4)]


@needs_native
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("states", "awake"), SIZES)
def test_native_equals_pairs_in_both_precisions(states: int, awake: int | None) -> None:
    """Any number of states, of them awake; several actions, missing steps, trials within tapes, padding."""
    options = {"states": states, "actions": 3, "steps": 14, "starts": 0.1, "missing": 0.2, "padding": 3}
    single = stack_memory(batch(2, 19, awake=(awake,), **options), np.float32)
    double = jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, single)
    got = by_native(*single)
    assert_same(got, by_scan(*single), rtol=5e-5, atol=5e-5)
    assert_same(got, by_scan(*double))


@needs_native
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("states", "awake"), [(2, None), (4, 0), (4, 1), (5, 3), (3, 3), (1, 1)])
def test_native_equals_numpy(states: int, awake: int | None) -> None:
    """Structural zeros too."""
    problems = batch(2, 5, awake=(awake,), states=states, actions=3, steps=14, **HARD)
    inputs = stack_memory(problems, np.float32)
    assert_same(by_native(*inputs), by_pairs(*inputs))


@needs_native
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("awake", [0, 1, 3, 4])
@pytest.mark.parametrize("scale", [30.0, 300.0])
def test_native_equals_numpy_however_sharp_the_observations(scale: float, awake: int) -> None:
    problems = batch(2, 5, awake=(awake,), states=4, steps=14, starts=0.1, zeros=0.5, scale=scale)
    inputs = stack_memory(problems, np.float32)
    got = by_native(*inputs)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))
    assert_same(got, by_pairs(*inputs))


@needs_native
@pytest.mark.usefixtures("x64")
def test_models_with_different_memories_share_a_batch() -> None:
    inputs = stack_memory(batch(5, 3, awake=(2, 0, 5, 1, 0), states=5, steps=12, starts=0.2), np.float32)
    assert_same(by_native(*inputs), by_pairs(*inputs))


def dead(problem: MemoryProblem) -> None:
    """Make the last state of a model one that is not there."""
    chain = problem.chain
    for table in (chain.log_init, chain.log_trans, chain.log_lead):
        table[..., 0] = np.logaddexp(table[..., 0], table[..., -1])
        table[..., -1] = NEG
    for table in (chain.log_trans, chain.log_lead):
        table[:, -1] = NEG
    for table in (chain.log_heed, chain.log_note):
        table[-1] = NEG


@needs_native
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("awake", [0, 1, 3])
def test_impossible_steps_and_dead_states(awake: int) -> None:
    """Spare states that nothing leads to; steps that no state, or no state within reach, allows."""
    problems = batch(2, 4, awake=(awake,), states=5, steps=12, zeros=0.3, scale=20.0)
    rng = np.random.default_rng(0)
    for row in problems:
        for problem in row:
            dead(problem)
            rows = problem.tape[0]
            rows[rng.random(rows.shape) < 0.2] = NEG
            rows[:, -1] = rows[3] = NEG
    inputs = stack_memory(problems, np.float32)
    got = by_native(*inputs)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))
    assert not any(x[..., -1].any() for x in (got.gamma, got.held, got.xi, got.initial, *got.counts[:2]))
    assert_same(got, by_pairs(*inputs))


@needs_native
@pytest.mark.usefixtures("x64")
def test_a_tape_that_underflows_is_repaired_and_the_others_are_untouched() -> None:
    """Early steps speak for one of two states that never meet, late ones for the other."""
    problems = batch(2, 3, awake=(0, 1), states=2, actions=1, steps=8)
    for s, row in enumerate(problems):
        for b, problem in enumerate(row):
            tables = (problem.chain.log_trans, problem.chain.log_lead)
            for table in tables:
                table[:] = np.where(np.eye(2, dtype=bool), 0, NEG)
            weight = 1 if (s, b) in ((0, 0), (1, 1)) else 50
            problem.tape[0][:] = weight * np.where(np.arange(8)[:, None] < 4, [0.0, -2.0], [-3.0, 0.0])
    inputs = stack_memory(problems, np.float32)
    assert_same(by_native(*inputs), by_pairs(*inputs))


@needs_native
@pytest.mark.usefixtures("x64")
def test_the_oracles_notice_an_action_that_comes_a_step_late() -> None:
    chains, rows, actions, *flags = stack_memory(batch(1, 3), np.float32)
    late = by_native(chains, rows, jnp.roll(actions, 1, -1), *flags)
    for oracle in (by_pairs, by_scan):
        with pytest.raises(AssertionError):
            assert_same(late, oracle(chains, rows, actions, *flags))


@needs_native
@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("name", ["log_lead", "log_heed", "log_note"])
def test_the_oracles_notice_a_memory_of_another_state(name: str) -> None:
    chains, *tapes = stack_memory(batch(1, 3, awake=(2,)), np.float32)
    wrong = chains._replace(**{name: jnp.roll(getattr(chains, name), 1, axis=-2)})
    for oracle in (by_pairs, by_scan):
        with pytest.raises(AssertionError):
            assert_same(by_native(wrong, *tapes), oracle(chains, *tapes))


@needs_native
def test_what_lies_in_the_padding_does_not_matter() -> None:
    clean = stack_memory(batch(2, 5, padding=2), np.float32)
    chains, rows, actions, start, valid = clean
    spoilt = jnp.where(valid[..., None], rows, jnp.nan), jnp.where(valid, actions, 77)
    got = by_native(chains, *spoilt, start | ~valid, valid)
    assert_same(got, by_native(*clean), rtol=0, atol=0)
    assert not any(x[~valid].any() for x in (got.gamma, got.held))


@needs_native
def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = stack_memory(batch(3, 40, awake=(2, 0, 9), states=9, steps=30), np.float32)
    one, *more = by_threads(lambda: by_native(*inputs), monkeypatch)
    for other in more:
        assert_same(one, other, rtol=0, atol=0)


@needs_native
def test_it_works_under_vmap() -> None:
    chains, rows, *rest = stack_memory(batch(2, 3), np.float32)
    both = jnp.stack([rows, -rows])
    mapped = jax.jit(jax.vmap(lambda x: memory_posterior(chains, x, *rest, plan="native")))(both)
    for k in range(2):
        assert_same(jax.tree.map(lambda x, k=k: x[k], mapped), by_native(chains, both[k], *rest))


@needs_native
@pytest.mark.parametrize("empty", [(0, 2, 5), (2, 0, 5), (2, 2, 0)], ids=str)
def test_empty_batches_give_empty_results(empty: tuple[int, ...]) -> None:
    square, choice = jnp.zeros((empty[0], 1, 3, 3)), jnp.zeros((empty[0], 3, 2))
    even = MemoryChain(jnp.zeros((empty[0], 3)), square, square, choice, choice)
    flags = jnp.ones(empty, bool)
    got = by_native(even, jnp.zeros((*empty, 3)), jnp.zeros(empty, jnp.int32), flags, flags)
    assert got.held.shape == (*empty, 3)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(got))


@pytest.mark.usefixtures("x64")
def test_a_memory_asleep_costs_nothing_and_changes_nothing() -> None:
    """One of two models is asleep: both plans agree on everything."""
    problems = batch(2, 1, awake=(0, None), states=4, steps=30, starts=0.2, missing=0.1, padding=2)
    problems[0][0].chain.log_heed[:] = 0, NEG
    inputs = stack_memory(problems)
    awake, pairs = (memory_posterior(*inputs, plan=plan) for plan in ("awake", "pairs"))
    assert_same(awake, pairs, rtol=1e-10, atol=1e-10)


def test_auto_prefers_native_and_never_needs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    single, double = (jnp.dtype(x) for x in ("float32", "float64"))
    monkeypatch.setattr(native, "available", lambda: True)
    assert choose_plan("auto", single) == "native"
    assert choose_plan("auto", double) == "awake"
    with pytest.raises(ValueError, match="plan 'native' needs float32 on a CPU with a compiler, got float64"):
        choose_plan("native", double)
    monkeypatch.setattr(native, "available", lambda: False)
    assert choose_plan("auto", single) == "awake"


def test_wrong_arguments_are_named() -> None:
    chains, *tapes = stack_memory(batch(1, 1), np.float32)
    with pytest.raises(ValueError, match=r"plan must be one of .*got 'scan'"):
        memory_posterior(chains, *tapes, plan="scan")
    with pytest.raises(ValueError, match="actions must have shape"):
        memory_posterior(chains, tapes[0], tapes[1][:, :, 1:], *tapes[2:])
    with pytest.raises(ValueError, match="log_init must have shape"):
        memory_posterior(chains._replace(log_init=chains.log_init[:, 1:]), *tapes)
    with pytest.raises(ValueError, match=r"lead must be float32\[1, 2, 3, 3\], got .*\[1, 1, 3, 3\]"):
        memory_estep(chains._replace(log_lead=chains.log_lead[:, :1]), *tapes)
    with pytest.raises(ValueError, match=r"note must be float32\[1, 3, 2\], got .*\[1, 3, 1\]"):
        memory_estep(chains._replace(log_note=chains.log_note[..., :1]), *tapes)
