"""State splits: laws of the edit; how often the test fires on Gaussian returns and on planted mixtures."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.structure.edits import Allowance, Edit
from jaxpomdp.structure.evidence import even_edges, return_evidence
from jaxpomdp.structure.mixture import Mixture
from jaxpomdp.structure.spec import FlatSpec, validate
from jaxpomdp.structure.splits import (
    SplitConfig,
    StateSplit,
    apply_split,
    examine_states,
    propose_splits,
    shrink_split,
)
from tests.structure.worlds import evidence_of, log_evidence, random_spec


def an_edit(seed: int, n: int, components: int, action: int = 0, **changes: object) -> Edit:
    """Make up a split of a random state."""
    rng = np.random.default_rng(seed)
    mean, var = np.sort(rng.normal(size=components)), rng.gamma(2, size=components)
    mixture = Mixture(rng.dirichlet(np.ones(components)), mean, var, 0.0, 0)
    split = StateSplit(action, mixture, True, True, False, None, 0.2, seed)._replace(**changes)
    node = int(rng.integers(n))
    return Edit("state", node, n, (node,) * (components - 1), 1.0, 30.0, 0.001, 0.3, 100.0, split)


def gaussian_samples(seed: int, states: int, count: int = 300) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return list(
        rng.normal(rng.normal(0, 2, (states, 1)), rng.uniform(0.5, 1.5, (states, 1)), (states, count))
    )


def plant(samples: list[np.ndarray], state: int, seed: int = 0) -> list[np.ndarray]:
    """Turn a state's returns into two lumps four standard deviations apart."""
    lump = np.random.default_rng(seed).integers(0, 2, len(samples[state]))
    return [x + 4 * x.std() * lump if n == state else x for n, x in enumerate(samples)]


@given(
    st.integers(0, 10_000),
    st.integers(1, 6),
    st.integers(2, 4),
    st.booleans(),
    st.sampled_from([None, 0.0, 0.9, 1.0]),
    st.sampled_from([0.0, 0.5]),
)
@settings(max_examples=60, deadline=None)
def test_a_split_keeps_the_evidence_and_the_rows(
    seed: int, n: int, components: int, even: bool, stay: float | None, jitter: float
) -> None:
    spec, rng = random_spec(seed, n), np.random.default_rng(seed)
    edit = an_edit(seed, n, components, even=even, stay=stay, jitter=jitter)
    new = apply_split(spec, edit)
    validate(new)
    assert set(edit.origin) == set(range(n))
    assert len(edit.origin) == new.num_states
    for channel, old in zip(new.emissions, spec.emissions, strict=True):
        assert channel == old.take(edit.origin)
    observations, actions = rng.integers(0, 3, 25), rng.integers(0, 2, 24)
    np.testing.assert_allclose(
        log_evidence(new, observations, actions), log_evidence(spec, observations, actions), rtol=1e-10
    )


@given(st.integers(0, 1000), st.integers(2, 4), st.integers(0, 1), st.booleans())
@settings(max_examples=30, deadline=None)
def test_each_copy_takes_its_component(seed: int, components: int, action: int, shift: bool) -> None:
    spec = random_spec(seed, 4, per_action=True)
    edit = an_edit(seed, 4, components, action, shift=shift)
    new = apply_split(spec, edit)
    copies, mixture = np.flatnonzero(edit.origin == edit.node), edit.details.mixture
    np.testing.assert_allclose(new.return_mean[copies, action], mixture.mean)
    np.testing.assert_allclose(new.return_var[copies, action], mixture.var)
    moved = (mixture.mean - mixture.weight @ mixture.mean) * shift
    np.testing.assert_allclose(
        new.return_mean[copies, 1 - action], spec.return_mean[edit.node, 1 - action] + moved
    )
    others = np.flatnonzero(edit.origin != edit.node)
    np.testing.assert_array_equal(new.return_mean[others], spec.return_mean[edit.origin[others]])


def test_shares_are_as_the_settings_say() -> None:
    spec = random_spec(2, 3)
    edit = an_edit(2, 3, 2, jitter=0.0)
    node, others = edit.node, [n for n in range(3) if n != edit.node]
    old = np.exp(spec.log_trans)
    for even, wanted in ((True, np.array([0.5, 0.5])), (False, edit.details.mixture.weight)):
        new = np.exp(apply_split(spec, replace(edit, details=edit.details._replace(even=even))).log_trans)
        np.testing.assert_allclose(new[:, others][:, :, [node, 3]], old[:, others, node, None] * wanted)
    sticky = edit.details._replace(even=True, stay=0.9)
    new = np.exp(apply_split(spec, replace(edit, details=sticky)).log_trans)
    np.testing.assert_allclose(new[:, 3, 3], 0.9 * old[:, node, node])
    np.testing.assert_allclose(new[:, others][:, :, [node, 3]], old[:, others, node, None] * [0.5, 0.5])


def test_jitter_comes_from_the_edit_alone() -> None:
    spec, edit = random_spec(0, 4), an_edit(0, 4, 3)
    assert apply_split(spec, edit) == apply_split(spec, edit)
    other = replace(edit, details=edit.details._replace(seed=1))
    assert apply_split(spec, other) != apply_split(spec, edit)


@given(st.integers(0, 1000), st.integers(2, 4), st.integers(1, 4))
@settings(max_examples=30, deadline=None)
def test_shrinking_fits_the_room(seed: int, components: int, room: int) -> None:
    edit = shrink_split(an_edit(seed, 3, components), room)
    assert len(edit.copied) == min(components - 1, room)
    assert apply_split(random_spec(seed, 3), edit).num_states == 3 + len(edit.copied)


def test_finds_a_planted_mixture_and_says_what_it_found() -> None:
    samples = plant(gaussian_samples(0, 8), 5)
    spec = random_spec(0, 8)
    edits = propose_splits(spec, evidence_of(samples))
    assert [edit.node for edit in edits] == [5]
    middle, apart = samples[5].mean(), 2 * samples[5].std() / np.sqrt(5)
    low, high = middle - apart, middle + apart
    np.testing.assert_allclose(edits[0].details.mixture.mean, [low, high], atol=0.4)
    assert edits[0].weight == 300
    row = json.loads(json.dumps(edits[0].row()))
    assert row["operator"] == "state"
    assert (row["node"], row["states_before"], row["states_after"]) == (5, 8, 9)
    assert row["p_value"] < 0.01


@pytest.mark.parametrize("correction", ["bonferroni", "holm", "benjamini-hochberg"])
def test_size_gaussian_returns_are_split_at_about_the_nominal_rate(correction: str) -> None:
    """A phase of 20 Gaussian states splits any at most about as often as the level .05."""
    config = SplitConfig(significance=0.05, correction=correction)
    spec = random_spec(0, 20)
    fired = [
        bool(propose_splits(spec, evidence_of(gaussian_samples(s, 20), bins=128), config, Allowance(edits=1)))
        for s in range(80)
    ]
    assert np.mean(fired) < 0.15


def test_size_without_correction_is_that_of_one_test() -> None:
    config = SplitConfig(significance=0.05, correction="none")
    rates = [
        examine_states(evidence_of(gaussian_samples(s, 20), bins=128), config).significant.mean()
        for s in range(60)
    ]
    assert 0.03 < np.mean(rates) < 0.08


def test_power_a_planted_state_is_split_first() -> None:
    spec = random_spec(0, 20)
    found = 0
    for s in range(40):
        evidence = evidence_of(plant(gaussian_samples(s, 20), s % 20, s), bins=128)
        edits = propose_splits(spec, evidence, allowance=Allowance(edits=1))
        found += bool(edits) and edits[0].node == s % 20
    assert found >= 38


def correlated(seed: int, trials: int = 60, steps: int = 20) -> dict:
    """Return steps whose returns are nearly those of their trial, Gaussian between trials."""
    rng = np.random.default_rng(seed)
    trial = np.repeat(np.arange(trials), steps)
    returns = rng.normal(size=trials)[trial] + 0.05 * rng.normal(size=len(trial))
    beliefs = np.ones((len(trial), 1))
    return {"returns": returns, "beliefs": beliefs, "edges": even_edges(-4, 4, 64), "trial": trial}


def test_counting_trials_and_not_steps_keeps_the_level_where_returns_of_a_trial_are_alike() -> None:
    rates = {}
    for count in ("weight", "effective"):
        config = SplitConfig(count=count, significance=0.05)
        tests = [examine_states(return_evidence(**correlated(s)), config) for s in range(150)]
        rates[count] = np.mean([t.significant for t in tests])
    assert rates["weight"] > 0.9
    assert rates["effective"] < 0.1


def test_deterministic_and_rare_returns_are_left_alone() -> None:
    noise = np.random.default_rng(0).choice([-1.0, 1.0], 300)
    samples = [np.full(300, 2.0), 5 + 0.001 * noise, noise[:20], noise]
    spec = random_spec(0, 4)
    assert [edit.node for edit in propose_splits(spec, evidence_of(samples))] == [3]
    least = SplitConfig(minimum_weight=301)
    assert propose_splits(spec, evidence_of(samples), least) == []
    assert propose_splits(spec, evidence_of(samples), SplitConfig(minimum_effect=50)) == []


def test_a_light_component_is_not_worth_a_state() -> None:
    samples = [np.concatenate([np.random.default_rng(0).normal(size=990), np.full(10, 30.0)])]
    spec = random_spec(0, 1)
    assert propose_splits(spec, evidence_of(samples), SplitConfig(minimum_share=0.05)) == []
    assert propose_splits(spec, evidence_of(samples), SplitConfig(minimum_share=0.001)) != []


@pytest.mark.parametrize("rank", ["statistic", "effect", "likelihood", "spread"])
def test_ranks_put_the_best_first(rank: str) -> None:
    rng = np.random.default_rng(0)
    lump = rng.integers(0, 2, 600)
    samples = [lump[:100] * 3 + rng.normal(0, 0.3, 100), lump * 30 + rng.normal(0, 4, 600)]
    spec, evidence = random_spec(0, 2), evidence_of(samples, bins=256)
    edits = propose_splits(spec, evidence, SplitConfig(rank=rank))
    assert len(edits) == 2
    assert edits[0].score >= edits[1].score
    one = propose_splits(spec, evidence, SplitConfig(rank=rank), Allowance(edits=1))
    assert [edit.node for edit in one] == [edits[0].node]


def test_the_telling_action_is_split_on() -> None:
    rng = np.random.default_rng(0)
    actions = rng.integers(0, 2, 800)
    lump = rng.integers(0, 2, 800)
    returns = rng.normal(size=800) + np.where(actions == 1, 6 * lump, 0)
    evidence = return_evidence(
        returns, np.ones((800, 1)), even_edges(-4, 10, 64), actions=actions, num_actions=2
    )
    edit = propose_splits(random_spec(0, 1, per_action=True), evidence)[0]
    assert edit.details.action == 1
    np.testing.assert_allclose(edit.details.mixture.mean, [0, 6], atol=0.3)


def test_permuting_states_permutes_the_splits() -> None:
    samples = plant(plant(gaussian_samples(3, 6), 1), 4)
    order = np.array([4, 2, 0, 5, 1, 3])
    plain = propose_splits(random_spec(0, 6), evidence_of(samples))
    moved = propose_splits(random_spec(0, 6), evidence_of([samples[n] for n in order]))
    assert sorted(order[e.node] for e in moved) == sorted(e.node for e in plain) == [1, 4]
    for edit in moved:
        twin = next(e for e in plain if e.node == order[edit.node])
        np.testing.assert_allclose(edit.details.mixture.mean, twin.details.mixture.mean)


def test_resting_states_are_not_split_nor_counted_as_tests() -> None:
    samples = plant(plant(gaussian_samples(3, 6), 1), 4)
    resting = np.array([False, True, False, False, False, False])
    edits = propose_splits(random_spec(0, 6), evidence_of(samples), allowance=Allowance(resting=resting))
    assert [edit.node for edit in edits] == [4]
    assert propose_splits(random_spec(0, 6), evidence_of(samples), allowance=Allowance(room=0)) == []


def test_soft_beliefs_find_the_state_too() -> None:
    rng = np.random.default_rng(0)
    owner = rng.integers(0, 3, 1500)
    returns = rng.normal(size=1500) + np.where(owner == 2, 6.0 * rng.integers(0, 2, 1500), 0)
    beliefs = 0.85 * np.eye(3)[owner] + 0.05
    evidence = return_evidence(returns, beliefs, even_edges(-4, 10, 64))
    assert propose_splits(random_spec(0, 3), evidence)[0].node == 2


def test_wrong_arguments_are_named() -> None:
    spec = random_spec(0, 3)
    with pytest.raises(ValueError, match=r"\(3, 1\) as the spec, got \(2, 1\)"):
        propose_splits(spec, evidence_of(gaussian_samples(0, 2)))
    with pytest.raises(ValueError, match=r"kind 'state' for 3 states, got 'state' for 4"):
        apply_split(spec, an_edit(0, 4, 2))
    assert isinstance(apply_split(spec, an_edit(0, 4, 2).moved(3)), FlatSpec)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"correction": "fisher"}, "correction must be one of none, bonferroni, holm.*got 'fisher'"),
        ({"rank": "luck"}, "rank must be one of statistic"),
        ({"significance": 2.0}, "significance must be between 0 and 1, got 2.0"),
        ({"stay": -0.1}, "stay must be None or between 0 and 1"),
        ({"jitter": float("nan")}, "jitter must be at least 0, got nan"),
        ({"cells": 3}, "cells must be at least 4"),
        ({"components": (1, 2)}, "components must be sizes of 2 or more"),
    ],
)
def test_settings_out_of_range_are_named(setting: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SplitConfig(**setting)
