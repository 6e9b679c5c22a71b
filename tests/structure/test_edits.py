"""Cloning: the evidence of observations stays, rows stay stochastic, every state comes from somewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.structure.edits import (
    Allowance,
    Shares,
    clone_state,
    compose,
    even_shares,
    grown,
    jittered,
    sticky_among,
)
from jaxpomdp.structure.spec import NEG, validate
from tests.structure.worlds import log_evidence, random_spec


def random_shares(seed: int, n: int, a: int, copies: int) -> Shares:
    rng = np.random.default_rng(seed)
    return Shares(
        rng.dirichlet(np.ones(copies)),
        rng.dirichlet(np.ones(copies), (a, n)),
        rng.dirichlet(np.ones(copies), (a, copies)),
    )


@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 4))
@settings(max_examples=50, deadline=None)
def test_a_clone_has_the_same_evidence_whatever_the_shares(seed: int, n: int, copies: int) -> None:
    spec, rng = random_spec(seed, n), np.random.default_rng(seed)
    node = int(rng.integers(n))
    clone = clone_state(spec, node, random_shares(seed, n, 2, copies))
    validate(clone)
    assert clone.num_states == n + copies - 1
    observations, actions = rng.integers(0, 3, 30), rng.integers(0, 2, 29)
    before, after = (log_evidence(model, observations, actions) for model in (spec, clone))
    np.testing.assert_allclose(before, after, rtol=1e-10)


def test_the_forward_pass_tells_when_copies_differ() -> None:
    spec, rng = random_spec(0, 4), np.random.default_rng(0)
    clone = clone_state(spec, 1, random_shares(0, 4, 2, 2))
    rotated = clone.log_trans.copy()
    rotated[:, -1] = np.roll(rotated[:, -1], 1, axis=-1)
    observations, actions = rng.integers(0, 3, 30), rng.integers(0, 2, 29)
    broken = log_evidence(replace(clone, log_trans=rotated), observations, actions)
    assert not np.isclose(broken, log_evidence(spec, observations, actions), rtol=1e-6)


@given(st.integers(0, 1000), st.integers(2, 6), st.integers(2, 4))
@settings(max_examples=25, deadline=None)
def test_lumping_the_copies_gives_the_model_back(seed: int, n: int, copies: int) -> None:
    spec = random_spec(seed, n)
    clone = clone_state(spec, seed % n, random_shares(seed, n, 2, copies))
    lump = np.eye(n)[grown(n, seed % n, copies)]
    np.testing.assert_allclose(np.exp(clone.log_trans) @ lump, lump @ np.exp(spec.log_trans), atol=1e-12)
    np.testing.assert_allclose(np.exp(clone.log_init) @ lump, np.exp(spec.log_init), atol=1e-12)


def test_shares_go_where_they_should() -> None:
    spec = random_spec(1, 3)
    shares = random_shares(1, 3, 2, 2)
    old, new = np.exp(spec.log_trans), np.exp(clone_state(spec, 1, shares).log_trans)
    np.testing.assert_allclose(new[:, 0][:, [1, 3]], old[:, 0, 1, None] * shares.incoming[:, 0])
    np.testing.assert_allclose(new[:, [1, 3]][:, :, [1, 3]], old[:, 1, 1, None, None] * shares.among)
    np.testing.assert_allclose(new[:, 3, [0, 2]], old[:, 1, [0, 2]])


def test_the_impossible_stays_impossible() -> None:
    spec = random_spec(1, 6)
    shares = Shares(np.array([1.0, 0]), np.tile([1.0, 0], (1, 6, 1)), np.tile(np.eye(2), (1, 1, 1)))
    clone = clone_state(spec, 0, shares)
    assert (clone.log_trans >= NEG).all()
    assert ((clone.log_trans == NEG) | (clone.log_trans > -100)).all()
    assert (clone.log_trans[:, 1:6, 6] == NEG).all()
    assert (spec.log_trans == NEG).any()


def test_numbers_keep_their_type() -> None:
    clone = clone_state(random_spec(0, 3, dtype=np.float32), 0, random_shares(0, 3, 2, 2))
    assert clone.log_trans.dtype == clone.log_init.dtype == clone.return_var.dtype == np.float32


@given(st.integers(2, 5), st.floats(0, 1), st.integers(0, 100))
@settings(max_examples=30, deadline=None)
def test_sticky_and_jittered_shares_sum_to_one(copies: int, stay: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for shares in (even_shares(copies), rng.dirichlet(np.ones(copies)), np.eye(copies)[0]):
        among = sticky_among(shares, stay)
        np.testing.assert_allclose(among.sum(-1), 1)
        np.testing.assert_allclose(np.diag(among), stay)
        np.testing.assert_allclose(jittered(among, 0.3, rng).sum(-1), 1)


def test_origins_compose() -> None:
    assert compose(grown(3, 0, 2), grown(4, 3, 3)).tolist() == [0, 1, 2, 0, 0, 0]


def test_wrong_arguments_are_named() -> None:
    spec, shares = random_spec(0, 3), random_shares(0, 3, 2, 2)
    with pytest.raises(ValueError, match=r"node must be a state 0 \.\. 2, got 3"):
        clone_state(spec, 3, shares)
    with pytest.raises(ValueError, match=r"shares.incoming must have shape \(2, 3, 2\)"):
        clone_state(spec, 0, shares._replace(incoming=np.ones((2, 4, 2)) / 2))
    with pytest.raises(ValueError, match=r"shares.among must be positive and sum to 1"):
        clone_state(spec, 0, shares._replace(among=np.ones((2, 2, 2))))
    with pytest.raises(ValueError, match=r"resting must have shape \(3\), got \(2,\)"):
        Allowance(resting=np.ones(2, bool)).free(3)
