"""Evidence: what the weights of a histogram and its moments mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.structure.evidence import (
    ReturnEvidence,
    bin_centres,
    bin_of,
    even_edges,
    quantile_edges,
    return_evidence,
)


def sample(seed: int, steps: int = 40, states: int = 3, actions: int = 2) -> dict:
    rng = np.random.default_rng(seed)
    return {
        "returns": rng.normal(size=steps),
        "beliefs": rng.dirichlet(np.ones(states), steps),
        "edges": np.linspace(-1, 1, 9),
        "actions": rng.integers(0, actions, steps),
        "num_actions": actions,
        "trial": np.sort(rng.integers(0, 5, steps)),
    }


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_every_step_counts_once_wherever_its_return_lies(seed: int) -> None:
    data = sample(seed)
    evidence = return_evidence(**data)
    np.testing.assert_allclose(evidence.hist.sum(), 40)
    for a in range(2):
        np.testing.assert_allclose(evidence.weight[:, a], data["beliefs"][data["actions"] == a].sum(0))


@given(st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_pooling_actions_equals_gathering_without_them(seed: int) -> None:
    data = sample(seed)
    apart = return_evidence(**data)
    together = return_evidence(data["returns"], data["beliefs"], data["edges"])
    for name in ("hist", "mean", "var"):
        np.testing.assert_allclose(getattr(apart.per_state(), name), getattr(together, name), atol=1e-12)
    np.testing.assert_allclose(apart.pooled(), (data["returns"].mean(), data["returns"].var()))


def test_moments_are_those_of_the_returns_not_of_the_bins() -> None:
    returns = np.array([0.1, 0.2, 0.9])
    evidence = return_evidence(returns, np.ones((3, 1)), np.array([0.0, 1.0]))
    np.testing.assert_allclose([evidence.mean[0, 0], evidence.var[0, 0]], [returns.mean(), returns.var()])


def test_a_trial_counts_as_one_return() -> None:
    trial = np.repeat(np.arange(6), 20)
    beliefs = np.ones((120, 2)) * [0.9, 0.0]
    evidence = return_evidence(np.zeros(120), beliefs, np.array([0.0, 1.0]), trial=trial)
    np.testing.assert_allclose(evidence.effective[:, 0], [6, 0])
    assert evidence.mean[1, 0] == evidence.var[1, 0] == 0


def test_no_steps_give_empty_evidence() -> None:
    evidence = return_evidence(np.zeros(0), np.zeros((0, 2)), np.array([0.0, 1.0]))
    assert evidence.pooled() == (0.0, 0.0)
    assert evidence.weight.tolist() == [[0], [0]]


def test_bins_are_half_open_and_outer_bins_take_the_rest() -> None:
    edges = np.array([0.0, 1.0, 1.0, 2.0])
    assert bin_of(np.array([-5, 0, 0.5, 1, 2, 9]), edges).tolist() == [0, 0, 0, 2, 2, 2]
    centres = bin_centres(np.array([0.2, 0.4, 9.0]), np.array([1, 3, 1]), edges)
    np.testing.assert_allclose(centres, [0.35, 1.0, 9.0])


def test_edges() -> None:
    assert even_edges(0, 1, 2).tolist() == [0, 0.5, 1]
    assert len(np.unique(even_edges(1, 1, 1))) == 2
    assert quantile_edges(np.array([0, 0, 0, 0, 1.0]), 2).tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"edges": np.array([1.0, 0.0])}, "edges must not fall"),
        ({"hist": np.ones((2, 1, 3))}, r"hist must have shape \(any, any, 1\), got \(2, 1, 3\)"),
        ({"centres": np.ones(2)}, r"centres must have shape \(1\)"),
        ({"mean": np.ones((1, 1))}, r"mean must have shape \(2, 1\)"),
        ({"var": -np.ones((2, 1))}, "var must not be negative, got -1"),
        ({"effective": np.full((2, 1), np.nan)}, "effective must be finite"),
    ],
)
def test_wrong_evidence_is_named(change: dict, message: str) -> None:
    evidence = return_evidence(np.zeros(4), np.ones((4, 2)), np.array([0.0, 1.0]))
    assert isinstance(evidence, ReturnEvidence)
    with pytest.raises(ValueError, match=message):
        replace(evidence, **change)
