"""EM against the world: it finds the model that made the data, and agrees with another library."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.models.data import trial_batch
from jaxpomdp.models.em import EMConfig, fit
from jaxpomdp.models.family import Prior
from jaxpomdp.models.init import random_params
from jaxpomdp.models.selection import fit_restarts
from tests.models.problems import LIGHT, SCALED

TRANS = np.array([[[0.9, 0.1], [0.2, 0.8]], [[0.1, 0.9], [0.7, 0.3]]])
SYMBOLS = np.array([[0.8, 0.15, 0.05], [0.1, 0.1, 0.8]])
RETURNS = np.array([1.0, 3.0])


def sampled(trials: int = 40, steps: int = 50) -> dict:
    """Trials of a two-state world under random actions; the reward at each step is the state's."""
    rng = np.random.default_rng(0)
    made: dict = {"observations": [], "actions": [], "rewards": []}
    for _ in range(trials):
        state, symbols, actions, rewards = 0, [], [], []
        for _ in range(steps):
            symbols.append(int(rng.choice(3, p=SYMBOLS[state])))
            actions.append(int(rng.integers(2)))
            rewards.append(float(RETURNS[state] + 0.3 * rng.normal()))
            state = int(rng.choice(2, p=TRANS[actions[-1], state]))
        made["observations"].append(symbols)
        made["actions"].append(actions[:-1])
        made["rewards"].append(rewards[:-1])
    return made


def test_it_recovers_the_model_that_made_the_data() -> None:
    """Best of three starts; with gamma 0 the return of a state is its reward."""
    tapes = trial_batch(**sampled(), gamma=0.0)
    params, report = fit_restarts(
        LIGHT,
        lambda key: random_params(key, 2, 2, 3, batch=tapes),
        tapes,
        EMConfig(theta=0.5, iterations=150),
        key=jax.random.key(0),
        restarts=3,
    )
    assert not report.fell.any()
    order = np.argsort(np.asarray(params.returns.mean[:, 0]))
    found = np.exp(np.asarray(params.log_trans))[:, order][:, :, order]
    np.testing.assert_allclose(found, TRANS, atol=0.06)
    np.testing.assert_allclose(np.exp(params.emissions[0].log_prob)[order], SYMBOLS, atol=0.06)
    np.testing.assert_allclose(params.returns.mean[order, 0], RETURNS, atol=0.06)
    np.testing.assert_allclose(np.sqrt(params.returns.var[order, 0]), 0.3, atol=0.06)
    assert float(jnp.exp(params.log_init[order[0]])) > 0.95


@pytest.mark.usefixtures("x64")
def test_without_actions_it_equals_hmmlearn() -> None:
    """Ten plain Baum-Welch steps on two sequences, parameter by parameter."""
    hmm = pytest.importorskip("hmmlearn.hmm")
    rng = np.random.default_rng(1)
    sequences = [rng.integers(3, size=n) for n in (30, 20)]
    start = random_params(jax.random.key(2), 3, 1, 3)
    peer = hmm.CategoricalHMM(3, n_iter=10, tol=-np.inf, init_params="", n_features=3)
    peer.startprob_ = np.exp(start.log_init)
    peer.transmat_ = np.exp(start.log_trans[0])
    peer.emissionprob_ = np.exp(start.emissions[0].log_prob)
    peer.fit(np.concatenate(sequences)[:, None], [len(sequence) for sequence in sequences])
    bare = Prior(transition=0.0, initial=0.0, observation=0.0)
    params, report = fit(
        SCALED, start, trial_batch(sequences), EMConfig(iterations=10, tolerance=0.0, prior=bare)
    )
    np.testing.assert_allclose(np.exp(params.log_init), peer.startprob_, atol=1e-9)
    np.testing.assert_allclose(np.exp(params.log_trans[0]), peer.transmat_, atol=1e-9)
    np.testing.assert_allclose(np.exp(params.emissions[0].log_prob), peer.emissionprob_, atol=1e-9)
    np.testing.assert_allclose(report.trace[:10], list(peer.monitor_.history)[-10:], rtol=1e-9)
