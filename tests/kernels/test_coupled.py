from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import Chain
from jaxpomdp.kernels import coupled
from jaxpomdp.kernels.coupled import (
    CoupledChain,
    filter_joint,
    mixture_rows,
    product_rows,
    smooth_joint_scaled,
    update_joint,
)
from jaxpomdp.kernels.coupled_exact import smooth_both, smooth_joint, smooth_joint_exact
from jaxpomdp.kernels.coupled_paths import sample_coupled, sample_joint_posterior, viterbi_joint
from jaxpomdp.kernels.smoothing import smooth
from tests.kernels.coupled_problems import CoupledProblem, random_coupled
from tests.kernels.problems import log_of, quick_jit, random_problem, random_rows
from tests.oracles.coupled import CoupledAnswer, enumerate_coupled, mixture_table, product_table

TIGHT = {"rtol": 1e-10, "atol": 1e-10}
KINDS = [
    {},
    {"starts": 0.4, "missing": 0.4, "padding": 1},
    {"zeros": 0.4},
    {"sizes": (2, 3), "scale": 30.0},
    {"sizes": (4, 1), "actions": 3},
]
both = quick_jit(smooth_both)
exact = quick_jit(smooth_joint_exact)
decode = quick_jit(viterbi_joint)


def assert_answers(got, joint, want: CoupledAnswer, **tolerance: float) -> None:
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, **tolerance)
    np.testing.assert_allclose(joint, want.joint, **tolerance)
    for name in ("gamma", "xi", "initial"):
        for x, y in zip(getattr(got, name), getattr(want, name), strict=True):
            np.testing.assert_allclose(x, y, err_msg=name, **tolerance)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("options", KINDS)
@pytest.mark.parametrize("route", [both, exact])
def test_exact_inference_equals_enumeration(route, options: dict) -> None:
    for seed in range(3):
        problem = random_coupled(seed, **options)
        assert_answers(*route(*problem.jax()), enumerate_coupled(*problem), **TIGHT)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("options", KINDS)
def test_viterbi_equals_enumeration(options: dict) -> None:
    for seed in range(3):
        problem = random_coupled(seed, **options)
        want = enumerate_coupled(*problem)
        got = decode(*problem.jax())
        np.testing.assert_array_equal(got.states, want.states)
        np.testing.assert_allclose(got.log_prob, want.best, rtol=1e-12)


def shuffled(problem: CoupledProblem, orders: list[np.ndarray]) -> CoupledProblem:
    """Rename the states of each chain."""
    init = tuple(x[o] for x, o in zip(problem.log_init, orders, strict=True))
    trans = tuple(
        t[:, orders[0]][:, :, orders[1]][..., o] for t, o in zip(problem.log_trans, orders, strict=True)
    )
    rows = tuple(x[:, o] for x, o in zip(problem.log_obs, orders, strict=True))
    return problem._replace(log_init=init, log_trans=trans, log_obs=rows)


@pytest.mark.usefixtures("x64")
def test_names_of_states_do_not_matter() -> None:
    problem = random_coupled(3)
    orders = [np.array([2, 0, 1]), np.array([1, 0])]
    got, want = both(*shuffled(problem, orders).jax())[0], both(*problem.jax())[0]
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, rtol=1e-12)
    for x, y, order in zip(got.gamma, want.gamma, orders, strict=True):
        np.testing.assert_allclose(x, y[:, order], rtol=1e-10)


@pytest.mark.usefixtures("x64")
def test_spare_states_change_nothing() -> None:
    problem = random_coupled(4, zeros=0.2)
    wide = random_coupled(4, sizes=(5, 4))
    for small, big in zip((*problem[0], *problem[2]), (*wide[0], *wide[2]), strict=True):
        big[...] = -1e30
        big[tuple(slice(n) for n in small.shape)] = small
    for small, big in zip(problem.log_trans, wide.log_trans, strict=True):
        big[:, :3, :2] = -1e30
        big[:, :3, :2, : small.shape[-1]] = small
    spare = wide._replace(actions=problem.actions, start=problem.start, valid=problem.valid)
    got, want = both(*spare.jax())[0], enumerate_coupled(*problem)
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(got.gamma[0][:, :3], want.gamma[0], rtol=1e-10)
    np.testing.assert_allclose(got.xi[1][:, :3, :2, :2], want.xi[1], **TIGHT)
    assert sum(float(x.sum()) for x in got.xi) == pytest.approx(sum(x.sum() for x in want.xi))


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("chains", [2, 3])
def test_tables_of_moves(chains: int) -> None:
    rng = np.random.default_rng(chains)
    pairs = [random_rows(rng, (2, 2 + k, 3), 0.4) for k in range(chains)]
    weights = rng.dirichlet(np.ones(chains))
    logs = [jnp.asarray(log_of(pair)) for pair in pairs]
    for own in range(chains):
        np.testing.assert_allclose(jnp.exp(product_rows(logs, own)), product_table(pairs, own), **TIGHT)
    got = mixture_rows(logs, jnp.log(weights))
    np.testing.assert_allclose(jnp.exp(got), mixture_table(pairs, weights), **TIGHT)


@pytest.mark.usefixtures("x64")
def test_chains_that_ignore_each_other_are_two_chains() -> None:
    """Both rules: a flat row of the other chain in the product, no weight for it in the mixture."""
    one, two = random_problem(1, states=3), random_problem(2, states=2)._replace(actions=[])
    two = two._replace(actions=one.actions)
    alone = [jax.jit(smooth)(*problem.jax()) for problem in (one, two)]
    own = [jnp.asarray(problem.log_trans) for problem in (one, two)]
    even = [jnp.full((2, 2, 3), -jnp.log(3.0)), jnp.full((2, 3, 2), -jnp.log(2.0))]
    pairs = [[own[0], even[0]], [even[1], own[1]]]
    sole = [jnp.array([0.0, -1e30]), jnp.array([-1e30, 0.0])]
    for tables in (
        tuple(product_rows(pairs[c], c) for c in range(2)),
        tuple(mixture_rows(pairs[c], sole[c]) for c in range(2)),
    ):
        chain = CoupledChain((jnp.asarray(one.log_init), jnp.asarray(two.log_init)), tables)
        rows = (jnp.asarray(one.log_obs), jnp.asarray(two.log_obs))
        got = both(chain, rows, *one.jax()[2:])[0]
        total = alone[0].log_evidence + alone[1].log_evidence
        np.testing.assert_allclose(got.log_evidence, total, rtol=1e-12)
        np.testing.assert_allclose(got.gamma[0], alone[0].gamma, **TIGHT)
        np.testing.assert_allclose(got.gamma[1], alone[1].gamma, **TIGHT)
        np.testing.assert_allclose(got.xi[0].sum(axis=2), alone[0].xi, **TIGHT)
        np.testing.assert_allclose(got.xi[1].sum(axis=1), alone[1].xi, **TIGHT)


@pytest.mark.usefixtures("x64")
def test_enumeration_notices_a_faulty_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """The futures of the two chains' moves weighted by the wrong action's table."""
    sound = coupled.joint_futures

    def faulty(trans, arriving):
        return sound((trans[0][::-1], trans[1]), arriving)

    monkeypatch.setattr(coupled, "joint_futures", faulty)
    problem = random_coupled(0)
    got, want = smooth_joint(*problem.jax()), enumerate_coupled(*problem)
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, **TIGHT)
    assert not np.allclose(got.xi[1], want.xi[1], atol=1e-3)


def contradicting() -> CoupledProblem:
    """What is seen favours one state by more than a float32 can hold, then the other, and neither is left."""
    problem = random_coupled(0, sizes=(2, 2), steps=6)
    stay = log_of(np.eye(2)[None])
    trans = (np.stack([stay, stay], axis=2)[[0, 0]].reshape(2, 2, 2, 2), problem.log_trans[1])
    lean = np.zeros((6, 2))
    lean[:2, 0], lean[3:, 1] = 150.0, 200.0
    return problem._replace(log_trans=trans, log_obs=(lean, problem.log_obs[1]))


def test_what_underflows_is_repaired() -> None:
    problem = contradicting()
    want = enumerate_coupled(*problem)
    assert not quick_jit(smooth_joint_scaled)(*problem.jax(np.float32))[2]
    assert_answers(*both(*problem.jax(np.float32)), want, rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("x64")
def test_impossible_steps_are_missing_ones() -> None:
    problem = random_coupled(5, zeros=0.5, scale=20.0)
    problem.log_obs[0][2] = -1e30
    problem.log_obs[1][3, 0] = -1e30
    got, joint = both(*problem.jax())
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(got))
    assert_answers(got, joint, enumerate_coupled(*problem), **TIGHT)
    assert_answers(*exact(*problem.jax()), enumerate_coupled(*problem), **TIGHT)


@pytest.mark.usefixtures("x64")
def test_filtering_online_is_filtering_a_tape() -> None:
    chain, rows, actions, start, valid = random_coupled(6).jax()
    filtered = quick_jit(filter_joint)(chain, rows, actions, start, valid)
    belief = filtered.belief[0]
    for t in range(1, 5):
        belief, log_norm = update_joint(belief, chain.log_trans, actions[t - 1], tuple(x[t] for x in rows))
        np.testing.assert_allclose(belief, filtered.belief[t], rtol=1e-10)
        np.testing.assert_allclose(log_norm, filtered.log_norm[t], rtol=1e-10)


def test_samples_have_the_right_frequencies() -> None:
    """From the model: moves as the tables say. Given the tape: marginals as smoothed."""
    problem = random_coupled(7, steps=4)
    chain, rows, actions, start, valid = problem.jax(np.float32)
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = quick_jit(jax.vmap(lambda k: sample_joint_posterior(k, chain, rows, actions, start, valid)))(keys)
    want = enumerate_coupled(*problem)
    share = jnp.mean(jax.nn.one_hot(drawn[..., 0] * 2 + drawn[..., 1], 6), axis=0)
    np.testing.assert_allclose(share, want.joint.reshape(4, 6), atol=0.04)
    free = quick_jit(jax.vmap(lambda k: sample_coupled(k, chain, actions, start, valid)))(keys)
    blind = problem._replace(log_obs=tuple(np.zeros_like(x) for x in problem.log_obs))
    share = jnp.mean(jax.nn.one_hot(free[..., 0] * 2 + free[..., 1], 6), axis=0)
    np.testing.assert_allclose(share, enumerate_coupled(*blind).joint.reshape(4, 6), atol=0.04)


def test_three_chains_are_refused_by_exact_inference() -> None:
    problem = random_coupled(0, sizes=(2, 2, 2)).jax(np.float32)
    for kernel in (
        filter_joint,
        smooth_joint,
        viterbi_joint,
        partial(sample_joint_posterior, jax.random.key(0)),
    ):
        with pytest.raises(ValueError, match="chain must have two chains for exact inference, got 3"):
            kernel(*problem)


def test_a_flat_chain_is_a_chain_coupled_to_nothing() -> None:
    flat = random_problem(8, states=4, actions=2, steps=5).jax(np.float32)
    table = flat[0].log_trans[:, :, None, :]
    still = CoupledChain((flat[0].log_init, jnp.zeros(1)), (table, jnp.zeros((2, 4, 1, 1))))
    got = both(still, (flat[1], jnp.zeros((5, 1))), *flat[2:])[0]
    want = jax.jit(smooth)(Chain(*flat[0]), *flat[1:])
    np.testing.assert_allclose(got.log_evidence, want.log_evidence, rtol=1e-5)
    np.testing.assert_allclose(got.gamma[0], want.gamma, atol=1e-5)
    np.testing.assert_allclose(got.xi[0][:, :, 0], want.xi, atol=1e-5)


def as_batch(problem: CoupledProblem) -> tuple:
    """Return a problem in float32 as two models with two tapes each, unequal on purpose."""
    chain, log_obs, *rest = problem.jax(np.float32)
    other = jax.tree.map(lambda x: x[::-1], (chain.log_trans[0], chain.log_trans[1]))
    chains = jax.tree.map(lambda x, y: jnp.stack([x, y]), chain, CoupledChain(chain.log_init, other))
    tapes = jax.tree.map(lambda x: jnp.stack([jnp.stack([x, x[::-1]])] * 2), (log_obs, *rest))
    return (chains, *tapes)
