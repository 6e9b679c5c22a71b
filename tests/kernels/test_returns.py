"""Discounted returns by hand, and return histograms against the evidence that structure gathers."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.kernels import returns as kernel
from jaxpomdp.structure.evidence import return_evidence

GAMMA = 0.5
REWARDS = np.array([1.0, 2.0, 9.0, 4.0, 9.0, 9.0, 9.0])
VALID = np.array([True] * 6 + [False])
START = np.array([True, False, False, True, False, True, False])
TAIL = np.array([8.0, 8.0, 0.0, 8.0, 6.0, 3.0, 8.0])
BY_HAND = np.array([1 + 0.5 * 2, 2, 0, 4 + 0.5 * 6, 6, 3, 0])
"""Trials: three steps that terminated, two that were cut off at value 6, one step of value 3; padding."""


def found_returns(start=START, tail=TAIL):
    arrays = (jnp.asarray(x) for x in (REWARDS, VALID, start))
    return np.asarray(kernel.discounted_returns(*arrays, GAMMA, jnp.asarray(tail)))


def test_returns_by_hand(x64):
    np.testing.assert_allclose(found_returns(), BY_HAND, atol=1e-15)


def test_what_follows_padding_does_not_reach_back(x64):
    arrays = [np.insert(x, 6, x[6]) for x in (REWARDS, VALID, START, TAIL)]
    rewards, valid, start, tail = (jnp.asarray(x) for x in arrays)
    found = kernel.discounted_returns(rewards, valid, start, GAMMA, tail)
    np.testing.assert_allclose(found, np.append(BY_HAND, 0), atol=1e-15)


def test_the_hand_would_notice_lost_starts_and_tails(x64):
    one_trial = START & (np.arange(7) == 0)
    assert np.abs(found_returns(start=one_trial) - BY_HAND).max() > 0.1
    assert np.abs(found_returns(tail=0 * TAIL) - BY_HAND).max() > 0.1


T, N, A, BINS = 40, 3, 2, 5


def steps():
    rng = np.random.default_rng(0)
    gamma = rng.dirichlet(np.ones(N), T)
    counted = rng.random(T) < 0.8
    return gamma, rng.normal(size=T), rng.integers(0, A, T), counted, np.linspace(-1.5, 1.5, BINS + 1)


@pytest.mark.parametrize("choices", [1, A])
def test_histograms_are_the_evidence(x64, choices):
    gamma, returns, actions, counted, edges = steps()
    arrays = [jnp.asarray(x) for x in (gamma, returns, actions, counted, edges)]
    by_action = {"actions": actions, "num_actions": A} if choices > 1 else {}
    expected = return_evidence(returns, gamma * counted[:, None], edges, **by_action).hist
    np.testing.assert_allclose(kernel.return_histogram(*arrays, choices), expected, atol=1e-12)
    everything = [*arrays[:3], jnp.ones(T, bool), arrays[4]]
    assert np.abs(np.asarray(kernel.return_histogram(*everything, choices)) - expected).max() > 0.1


def test_the_evidence_would_notice_swapped_actions(x64):
    gamma, returns, actions, counted, edges = steps()
    expected = return_evidence(returns, gamma * counted[:, None], edges, actions=actions, num_actions=A).hist
    swapped = [jnp.asarray(x) for x in (gamma, returns, 1 - actions, counted, edges)]
    assert np.abs(np.asarray(kernel.return_histogram(*swapped, A)) - expected).max() > 0.1


def test_leading_axes_are_summed_over(x64):
    gamma, returns, actions, counted, edges = (jnp.asarray(x) for x in steps())
    rows = [x.reshape(4, 10, *x.shape[1:]) for x in (gamma, returns, actions, counted)]
    flat = kernel.return_histogram(gamma, returns, actions, counted, edges, A)
    np.testing.assert_allclose(kernel.return_histogram(*rows, edges, A), flat, atol=1e-12)
