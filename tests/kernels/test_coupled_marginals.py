from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import Chain
from jaxpomdp.kernels import coupled_marginals
from jaxpomdp.kernels.coupled import CoupledChain
from jaxpomdp.kernels.coupled_exact import smooth_joint
from jaxpomdp.kernels.coupled_marginals import filter_marginals, smooth_marginals, update_marginals
from jaxpomdp.kernels.smoothing import smooth
from jaxpomdp.numerics import NEG
from tests.kernels.coupled_problems import CoupledProblem, random_coupled, stack_coupled
from tests.kernels.problems import log_of, quick_jit, random_problem, random_rows
from tests.oracles.coupled import enumerate_coupled

TIGHT = {"rtol": 1e-10, "atol": 1e-10}
sweep = quick_jit(smooth_marginals)


def coupled_by(strength: float, seed: int, sizes: tuple[int, ...] = (3, 2), **options) -> CoupledProblem:
    """Tables that lie between a chain by itself (0) and a table of the joint state (1)."""
    problem = random_coupled(seed, sizes=sizes, **options)
    rng = np.random.default_rng((seed, 2))
    tables = []
    for c, table in enumerate(problem.log_trans):
        own = random_rows(rng, (table.shape[0], sizes[c], sizes[c]), 0.0)
        shape = [table.shape[0], *(n if k == c else 1 for k, n in enumerate(sizes)), sizes[c]]
        tables.append(log_of((1 - strength) * own.reshape(shape) + strength * np.exp(table)))
    return problem._replace(log_trans=tuple(tables))


def with_a_dead_state(problem: CoupledProblem, last: int) -> CoupledProblem:
    """Let nothing lead to the first chain's last state."""
    for table in (problem.log_init[0], problem.log_trans[0]):
        table[..., 0] = np.logaddexp(table[..., 0], table[..., last])
        table[..., last] = NEG
    return problem


def assert_equal(got, want) -> None:
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, **TIGHT)
    for name in ("gamma", "xi", "initial"):
        for x, y in zip(getattr(got, name), getattr(want, name), strict=True):
            np.testing.assert_allclose(x, y, err_msg=name, **TIGHT)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("sizes", [(3, 2), (2, 2, 2)])
def test_chains_that_ignore_each_other_are_smoothed_exactly(sizes: tuple[int, ...]) -> None:
    problem = coupled_by(0.0, 1, sizes, steps=4, starts=0.3, missing=0.3, padding=1)
    assert_equal(sweep(*problem.jax()), enumerate_coupled(*problem))


@pytest.mark.usefixtures("x64")
def test_one_chain_is_smoothed_exactly() -> None:
    flat = random_problem(8, states=4, starts=0.3, zeros=0.3, padding=1).jax()
    got = sweep(CoupledChain((flat[0].log_init,), (flat[0].log_trans,)), (flat[1],), *flat[2:])
    want = jax.jit(smooth)(Chain(*flat[0]), *flat[1:])
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, **TIGHT)
    np.testing.assert_allclose(got.gamma[0], want.gamma, **TIGHT)
    np.testing.assert_allclose(got.xi[0], want.xi, **TIGHT)


def errors(strength: float, models: int = 40, steps: int = 24) -> tuple[float, float]:
    """Return mean errors: of the log-evidence, in nats per step, and of marginals, in total variation."""
    problems = [[coupled_by(strength, seed, (4, 3), steps=steps, scale=1.5)] for seed in range(models)]
    chains, *tapes = stack_coupled(problems)
    batch = (chains, *jax.tree.map(lambda x: x[:, 0], tapes))
    near, true = (quick_jit(jax.vmap(kernel))(*batch) for kernel in (smooth_marginals, smooth_joint))
    evidence = jnp.abs(near.log_evidence - true.log_evidence) / steps
    apart = [0.5 * jnp.abs(x - y).sum(axis=-1) for x, y in zip(near.gamma, true.gamma, strict=True)]
    return float(evidence.mean()), float(sum(x.mean() for x in apart) / 2)


@pytest.mark.usefixtures("x64")
def test_the_error_grows_with_the_coupling_and_stays_small() -> None:
    found = [errors(strength) for strength in (0.0, 0.3, 1.0)]
    assert max(found[0]) < 1e-10
    assert found[0] < found[1] < found[2]
    assert found[2][0] < 0.02
    assert found[2][1] < 0.05


@pytest.mark.usefixtures("x64")
def test_enumeration_notices_a_faulty_sweep(monkeypatch: pytest.MonkeyPatch) -> None:
    """Promises that leave the wrong chain out."""
    sound = coupled_marginals._all_but
    monkeypatch.setattr(coupled_marginals, "_all_but", lambda rows, c: sound(rows, c if c < 0 else 1 - c))
    problem = coupled_by(0.0, 1)
    got, want = smooth_marginals(*problem.jax()), enumerate_coupled(*problem)
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, **TIGHT)
    assert not np.allclose(got.xi[0], want.xi[0], atol=1e-3)


def test_counts_agree_and_nothing_is_nan() -> None:
    """Three chains, structural zeros, impossible steps: every step moves each chain once."""
    problem = random_coupled(3, sizes=(2, 3, 2), steps=7, zeros=0.4, scale=30.0, starts=0.2, padding=1)
    problem.log_obs[1][3] = -1e30
    chain, rows, actions, start, valid = problem.jax(np.float32)
    got = sweep(chain, rows, actions, start, valid)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))
    moves = float((valid[1:] & ~start[1:]).sum())
    for gamma, xi in zip(got.gamma, got.xi, strict=True):
        np.testing.assert_allclose(gamma.sum(axis=-1), valid, rtol=1e-5)
        assert float(xi.sum()) == pytest.approx(moves, rel=1e-4)


@pytest.mark.usefixtures("x64")
def test_an_observation_that_no_state_within_reach_allows_is_ignored_both_ways() -> None:
    problem = with_a_dead_state(random_coupled(3), last=2)
    problem.log_obs[0][-1] = [NEG, NEG, 0.0]
    silent = random_coupled(3).log_obs[0]
    silent[-1] = 0
    got = sweep(*problem.jax())
    want = sweep(*problem._replace(log_obs=(silent, problem.log_obs[1])).jax())
    assert_equal(got, want._replace(log_evidence=want.log_evidence + NEG))


@pytest.mark.usefixtures("x64")
def test_filtering_online_is_filtering_a_tape() -> None:
    chain, rows, actions, start, valid = random_coupled(6, sizes=(2, 3, 2)).jax()
    filtered = quick_jit(filter_marginals)(chain, rows, actions, start, valid)
    belief = tuple(x[0] for x in filtered.belief)
    for t in range(1, 5):
        belief, log_norm = update_marginals(
            belief, chain.log_trans, actions[t - 1], tuple(x[t] for x in rows)
        )
        np.testing.assert_allclose(log_norm, filtered.log_norm[t], rtol=1e-10)
        for x, y in zip(belief, filtered.belief, strict=True):
            np.testing.assert_allclose(x, y[t], rtol=1e-10)
