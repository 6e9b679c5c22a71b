"""Laws of inference: what may not change the result, and what the parts of a result owe each other."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.kernels.decoding import viterbi
from jaxpomdp.kernels.filtering import filter_tape, linked_steps
from jaxpomdp.kernels.posterior import posterior
from jaxpomdp.kernels.smoothing import smooth
from jaxpomdp.numerics import NEG
from tests.kernels.problems import Problem, quick_jit, random_problem, stack, with_tape

STATES, ACTIONS, STEPS = 4, 3, 9
SMOOTH, FILTER, VITERBI = (quick_jit(run) for run in (smooth, filter_tape, viterbi))
BATCH = quick_jit(lambda *x: posterior(*x, plan="grouped"))
CLOSE = {"rtol": 1e-9, "atol": 1e-11}

seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=12, deadline=None, derandomize=True)


@pytest.fixture(autouse=True, scope="module")
def _double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def draw(seed: int) -> Problem:
    """Draw a problem with structural zeros, several trials, missing steps and impossible ones."""
    rng = np.random.default_rng(seed)
    sizes = {"states": STATES, "actions": ACTIONS, "steps": STEPS}
    problem = random_problem(seed, **sizes, zeros=0.3, starts=0.25, missing=0.2, scale=3.0)
    problem.log_obs[rng.random(problem.log_obs.shape) < 0.1] = NEG
    return problem


def assert_same(got: object, want: object) -> None:
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_allclose(x, y, **CLOSE)


@few
@given(seeds, st.integers(1, STEPS - 1))
def test_padding_changes_nothing(seed: int, kept: int) -> None:
    """A tape cut short by padding is the shorter tape, whatever lies beyond."""
    problem = draw(seed)
    mask = np.arange(STEPS) < kept
    other = with_tape(problem, seed + 1, scale=50.0)
    mixed = [
        np.where(mask.reshape(-1, *[1] * (x.ndim - 1)), x, y)
        for x, y in zip(problem[2:5], other[2:5], strict=True)
    ]
    cut, spoilt = problem._replace(valid=mask), Problem(*problem[:2], *mixed, mask)
    for run in (SMOOTH, FILTER, VITERBI):
        assert_same(run(*spoilt.jax()), run(*cut.jax()))
    got = SMOOTH(*cut.jax())
    assert not got.gamma[kept:].any()


@few
@given(seeds, st.permutations(range(STATES)))
def test_names_of_states_do_not_matter(seed: int, order: list[int]) -> None:
    problem = draw(seed)
    log_init, log_trans, log_obs, *rest = problem
    moved = Problem(log_init[order], log_trans[:, order][:, :, order], log_obs[:, order], *rest)
    base, got = SMOOTH(*problem.jax()), SMOOTH(*moved.jax())
    want = (
        base.log_evidence,
        base.gamma[:, order],
        base.xi[:, order][:, :, order],
        base.initial[jnp.array(order)],
    )
    assert_same(tuple(got), want)
    assert_same(VITERBI(*moved.jax()).log_prob, VITERBI(*problem.jax()).log_prob)


@few
@given(seeds, st.permutations(range(ACTIONS)))
def test_names_of_actions_do_not_matter(seed: int, order: list[int]) -> None:
    problem = draw(seed)
    moved = problem._replace(log_trans=problem.log_trans[order], actions=np.argsort(order)[problem.actions])
    base, got = SMOOTH(*problem.jax()), SMOOTH(*moved.jax())
    assert_same(got, base._replace(xi=base.xi[jnp.array(order)]))


@few
@given(seeds)
def test_capacity_changes_nothing(seed: int) -> None:
    """Dead states, wherever they lie, take no part: their share is exactly zero."""
    problem = draw(seed)
    place = np.array([0, 2, 3, 5])
    log_init, log_obs = np.full(7, NEG), np.full((STEPS, 7), NEG)
    log_trans = np.full((ACTIONS, 7, 7), NEG)
    log_init[place], log_obs[:, place] = problem.log_init, problem.log_obs
    log_trans[:, place[:, None], place] = problem.log_trans
    base = SMOOTH(*problem.jax())
    got = SMOOTH(*Problem(log_init, log_trans, log_obs, *problem[3:]).jax())
    assert_same(got.log_evidence, base.log_evidence)
    assert_same(got.gamma[:, place], base.gamma)
    assert_same(got.xi[:, place][:, :, place], base.xi)
    dead = np.setdiff1d(np.arange(7), place)
    assert not got.gamma[:, dead].any()
    assert not got.xi[:, dead].any()
    assert not got.xi[:, :, dead].any()


@few
@given(seeds)
def test_trials_end_to_end_on_a_tape_are_trials_in_rows(seed: int) -> None:
    problem = draw(seed)
    begins = [*np.flatnonzero(problem.start), STEPS]
    whole, decoded = SMOOTH(*problem.jax()), VITERBI(*problem.jax())
    rows = [row_of(problem, a, b) for a, b in pairwise(begins)]
    parts, paths = [SMOOTH(*row.jax()) for row in rows], [VITERBI(*row.jax()) for row in rows]
    assert_same(whole.log_evidence, sum(part.log_evidence for part in parts))
    assert_same(whole.xi, sum(part.xi for part in parts))
    assert_same(whole.initial, sum(part.initial for part in parts))
    lengths = np.diff(begins)
    assert_same(whole.gamma, np.concatenate([p.gamma[:n] for p, n in zip(parts, lengths, strict=True)]))
    joined = np.concatenate([p.states[:n] for p, n in zip(paths, lengths, strict=True)])
    np.testing.assert_array_equal(decoded.states, joined)
    assert_same(decoded.log_prob, sum(path.log_prob for path in paths))


def row_of(problem: Problem, begin: int, end: int) -> Problem:
    """Move one trial to the front of a row of its own, of the same length, padded with zeros."""
    tape = []
    for x in problem[2:]:
        row = np.zeros_like(x)
        row[: end - begin] = x[begin:end]
        tape.append(row)
    return Problem(*problem[:2], *tape)


@few
@given(seeds)
def test_a_batch_is_its_members(seed: int) -> None:
    problems = [
        [draw(seed), with_tape(draw(seed), seed + 1)],
        [draw(seed + 2), with_tape(draw(seed + 2), seed + 3)],
    ]
    got = BATCH(*stack(problems))
    for s, row in enumerate(problems):
        each = [SMOOTH(*problem.jax()) for problem in row]
        assert_same(got.log_evidence[s], jnp.stack([one.log_evidence for one in each]))
        assert_same(got.gamma[s], jnp.stack([one.gamma for one in each]))
        assert_same(got.xi[s], each[0].xi + each[1].xi)
        assert_same(got.initial[s], each[0].initial + each[1].initial)


@few
@given(seeds)
def test_shares_add_up(seed: int) -> None:
    """Rows of gamma sum to one; what leaves and what arrives by xi is what gamma says is there."""
    problem = draw(seed)._replace(log_obs=draw(seed).log_obs.clip(-100))
    got = SMOOTH(*problem.jax())
    linked = np.asarray(linked_steps(jnp.asarray(problem.start), jnp.asarray(problem.valid)))
    np.testing.assert_allclose(got.gamma.sum(axis=1), 1, **CLOSE)
    for action in range(ACTIONS):
        leaving = linked & (problem.actions == action)
        assert_same(got.xi[action].sum(axis=1), got.gamma[leaving].sum(axis=0))
        assert_same(got.xi[action].sum(axis=0), got.gamma[np.flatnonzero(leaving) + 1].sum(axis=0))


@few
@given(seeds, st.integers(1, STEPS - 1))
def test_a_filter_does_not_look_ahead(seed: int, now: int) -> None:
    problem = draw(seed)
    other = with_tape(problem, seed + 1)
    log_obs = np.where(np.arange(STEPS)[:, None] < now, problem.log_obs, other.log_obs)
    base, got = FILTER(*problem.jax()), FILTER(*problem._replace(log_obs=log_obs).jax())
    assert_same(jax.tree.map(lambda x: x[:now], got), jax.tree.map(lambda x: x[:now], base))
    assert_same(got.predicted[now], base.predicted[now])


def test_compiling_changes_nothing() -> None:
    problem = draw(7)
    with jax.disable_jit():
        plain = smooth(*problem.jax())
    assert_same(SMOOTH(*problem.jax()), plain)
