"""The offline phase in parts: returns, evidence for splits, who is held, and learning from stored tapes."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.agents import experience, learner
from jaxpomdp.agents.control import ControlConfig
from jaxpomdp.agents.experience import Trials
from jaxpomdp.agents.learner import LearnerConfig
from jaxpomdp.kernels.control import ReplayData, replay_tape
from jaxpomdp.models import init as starts
from jaxpomdp.models.em import EMConfig, e_step
from jaxpomdp.models.flat import FLAT
from jaxpomdp.structure.evidence import return_evidence

A, SYMBOLS, STATES, BINS = 2, 4, 3, 6
EM = EMConfig(iterations=1, theta=0.3)


def random_trials(seed, lengths):
    rng = np.random.default_rng(seed)
    size, over = sum(lengths), np.arange(len(lengths)) % 2 == 0
    return Trials(
        np.array(lengths),
        over,
        np.where(over, 0, 5).astype(np.float32),
        (rng.integers(0, SYMBOLS, size).astype(np.int32),),
        rng.integers(0, A, size).astype(np.int32),
        rng.normal(size=size).astype(np.float32),
    )


@pytest.fixture(scope="module")
def tapes():
    store = experience.no_experience(2, 6, (np.int32(0),))
    return experience.tapes_of(
        experience.remember(store, [random_trials(0, [4, 5, 2]), random_trials(1, [7, 3])]), least=8
    )


@pytest.fixture(scope="module")
def batch(tapes):
    return with_returns(tapes, bootstrap=True)


@pytest.fixture(scope="module")
def params():
    make = lambda seed: starts.random_params(seed, STATES, A, SYMBOLS, by_action=True, capacity=4)  # noqa: E731
    return starts.stack_models([make(0), make(1)])


def with_returns(tapes, bootstrap):
    return learner.with_returns(
        jax.device_put(tapes.batch), jnp.asarray(tapes.tail), gamma=0.5, bootstrap=bootstrap
    )


@pytest.mark.parametrize("bootstrap", [True, False])
def test_returns_go_on_only_where_a_trial_was_cut_off(tapes, bootstrap):
    filled = with_returns(tapes, bootstrap)
    returns, rewards = np.asarray(filled.returns), tapes.batch.rewards
    seen = set()
    for s, row, t in zip(*np.nonzero(tapes.batch.valid), strict=True):
        if tapes.batch.has_return[s, row, t]:
            expected = rewards[s, row, t] + 0.5 * returns[s, row, t + 1]
        else:
            over = bool(tapes.batch.terminated[s, row, t])
            expected = 5.0 if bootstrap and not over else 0.0
            seen.add(over)
        assert returns[s, row, t] == pytest.approx(expected, abs=1e-6)
    assert seen == {True, False}


@pytest.mark.parametrize("by_trial", [True, False])
def test_evidence_is_that_of_structure(tapes, batch, params, by_trial):
    found = learner.gather_evidence(FLAT, params, batch, jnp.asarray(tapes.trial), EM, BINS, by_trial)
    gamma = np.asarray(jax.jit(e_step, static_argnums=(0, 3))(FLAT, params, batch, EM).gamma, np.float64)
    for s in range(2):
        counted = np.asarray(batch.has_return[s])
        returns = np.asarray(batch.returns[s])[counted]
        ours = learner.evidence_of_seed(jax.device_get(found), s, np.asarray(params.alive[s]))
        np.testing.assert_allclose(ours.edges, np.linspace(returns.min(), returns.max(), BINS + 1), atol=1e-5)
        theirs = return_evidence(
            returns,
            gamma[s][counted][:, :STATES],
            ours.edges,
            actions=np.asarray(batch.actions[s])[counted],
            num_actions=A,
            trial=tapes.trial[s][counted] if by_trial else None,
        )
        expected = theirs.effective if by_trial else theirs.weight
        np.testing.assert_allclose(ours.effective, expected, rtol=1e-4)
        assert ours.hist.shape == (STATES, A, BINS)
        for name in ("hist", "mean", "var", "centres"):
            np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), atol=1e-4, err_msg=name)


def test_held_models_stay_and_the_others_move(batch, params):
    held = jnp.array([True, False])
    fitted, evidence = learner.refit(FLAT, params, batch, held, EM, 1)
    for old, new in zip(jax.tree.leaves(params), jax.tree.leaves(fitted), strict=True):
        np.testing.assert_array_equal(new[0], old[0])
    assert np.abs(np.asarray(fitted.log_trans[1] - params.log_trans[1])).max() > 1e-3
    assert float(evidence[0]) == 0
    assert float(evidence[1]) < 0


def test_replay_is_learning_from_the_tapes_through_new_beliefs(batch, params):
    control = ControlConfig(alpha=0.1, gamma=0.9, lam=0.8)
    q = jnp.asarray(np.random.default_rng(2).normal(size=(2, 4, A)), jnp.float32)
    found = learner.replay(FLAT, params, batch, q, control, 2, 0.8)
    beliefs = learner.filter_batch(FLAT, params, batch)
    data = ReplayData(beliefs, batch.actions, batch.rewards, batch.start, batch.valid, batch.terminated)
    flat = jax.tree.map(lambda x: x.reshape(2, -1, *x.shape[3:]), data)
    expected = q
    for _ in range(2):
        expected = jax.vmap(lambda value, tape: replay_tape(value, tape, 0.1, 0.9, 0.8))(expected, flat)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(np.asarray(found - q)).max() > 1e-2


def test_beliefs_on_tapes_are_those_of_an_agent(batch, params):
    beliefs = np.asarray(learner.filter_batch(FLAT, params, batch))
    start, trans = np.exp(np.float64(params.log_init)), np.exp(np.float64(params.log_trans))
    show = np.exp(np.float64(params.emissions[0].log_prob)) * np.asarray(params.alive)[:, :, None]
    for s, row, t in zip(*np.nonzero(np.asarray(batch.valid)), strict=True):
        first = bool(batch.start[s, row, t])
        action = int(batch.actions[s, row, t - 1])
        prior = start[s] if first else np.float64(beliefs[s, row, t - 1]) @ trans[s, action]
        expected = prior * show[s][:, int(batch.observations[0][s, row, t])]
        np.testing.assert_allclose(beliefs[s, row, t], expected / expected.sum(), atol=1e-5)


def test_settings_that_mean_nothing_are_refused():
    with pytest.raises(ValueError, match="window must be at least 1, got 0"):
        LearnerConfig(window=0)
    with pytest.raises(ValueError, match="initial must be 'observation' or 'random', got 'peaked'"):
        LearnerConfig(initial="peaked")
    with pytest.raises(ValueError, match="theta must be at least 0, got nan"):
        LearnerConfig(theta=float("nan"))
