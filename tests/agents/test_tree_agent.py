"""The hierarchical agent, small: it runs, repeats, grows by every operator, logs its edits, and learns."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jaxpomdp.agents.agent import Agent, make_agent
from jaxpomdp.agents.control import Schedule
from jaxpomdp.agents.presets import LEARNERS
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.agents.tree_kind import HierarchicalModel
from jaxpomdp.envs.tmaze import tmaze
from jaxpomdp.experiments import arrays
from jaxpomdp.structure.tree import validate_tree
from tests.agents.small import SEEDS, assert_equal, rounds

WORLD = tmaze(1, step_limit=6)
SETTINGS = {
    "schedule": Schedule(1.0, 0.2, 600),
    "alpha": 0.1,
    "states": 6,
    "node_cap": 12,
    "window": 90,
    "trials_per_phase": 30,
    "tests.minimum_weight": 1.0,
    "tests.significance": 1.0,
    "tests.correction": "none",
    "order": "rotate",
    "return_by_action": False,
    "keep_best": 30,
    "gate": 0.0,
}


def small(**settings):
    return Agent(WORLD, with_settings(LEARNERS["hudhmm-tmaze"], SETTINGS | settings))


@pytest.fixture(scope="module")
def run():
    agent = small()
    return agent, rounds(agent, 4)


def test_a_run_grows_and_repeats_itself(run):
    agent, states = run
    sizes = np.asarray(states[-1].params.alive).sum(-1)
    added = np.zeros(2, int)
    for row in agent.log:
        added[row["seed_index"]] += len(row["copied"])
    assert (added > 0).all()
    np.testing.assert_array_equal(sizes, 6 + added)
    assert_equal(rounds(small(), 2)[2], states[2])


def test_grown_trees_are_sound(run):
    agent, states = run
    for state in states:
        for spec in agent.kind.unpack(state.params):
            validate_tree(spec)
            assert spec.num_states <= 12


def test_a_saved_state_goes_on_to_the_same_result(run):
    fresh = small()
    loaded = arrays.unflatten(fresh.init(SEEDS), arrays.flatten(run[1][1]))
    assert_equal(fresh.run(loaded)[0], run[1][2])


def test_every_edit_is_logged_with_its_evidence(run):
    for row in run[0].log:
        assert row["operator"] in ("leaf", "observation", "brother", "uncle", "parent")
        assert {"node", "statistic", "p_value", "weight", "top", "copied"} <= set(row)
        assert np.isfinite([row["log_evidence_before"], row["log_evidence_after"]]).all()


@pytest.mark.parametrize("operator", ["observation", "brother", "uncle", "parent"])
def test_operators_can_be_chosen(operator):
    agent = small(operators=(operator,), levels=3, states=10, node_cap=30)
    rounds(agent, 3)
    assert {row["operator"] for row in agent.log} <= {operator}


def test_operators_take_turns():
    agent = small(edits_per_phase=1, node_cap=40)
    rounds(agent, 4)
    first = [row["operator"] for row in agent.log if row["seed_index"] == 0]
    assert len(set(first)) > 1


def test_the_first_tree_may_be_given():
    agent = small(shape="[0, 1, [2, 3], [4, 5]]")
    for spec in agent.kind.unpack(agent.init(SEEDS).params):
        assert spec.leaf_parent.tolist() == [0, 0, 1, 1, 2, 2]
    with pytest.raises(ValueError, match="shape must hold 6 leaves, got 2"):
        small(shape="[0, 1]").init(SEEDS)
    with pytest.raises(ValueError, match="shape must be like"):
        small(shape="[0, 1").init(SEEDS)


def test_a_sober_tree_has_two_levels():
    agent = small(form="sober", states=9, levels=2)
    for spec in agent.kind.unpack(agent.init(SEEDS).params):
        assert spec.depth.max() == 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"form": "tall"}, "form must be one of diverse, sober"),
        ({"operators": ("cut",)}, "operators must be of"),
        ({"levels": 0}, "levels must be at least 1"),
        ({"concentration": 0.0}, "concentration must be positive"),
    ],
)
def test_bad_settings_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        HierarchicalModel(**settings)


@pytest.mark.slow
def test_it_learns_the_t_maze():
    """Three of four seeds take the right arm at the end: a hidden bit is carried through a tree."""
    agent = make_agent("hudhmm-tmaze", tmaze(4))
    state = agent.init(range(4))
    for _ in range(60):
        state, _ = agent.run(state)
    judged = agent.evaluate(agent.finish(state), 50, jax.random.key(1))
    assert (judged["success"].mean(1) >= 0.95).sum() >= 3
