"""The agent of a coupled hierarchy, small: it runs in the hallway, repeats, and its edits keep all laws."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxpomdp.agents.agent import Agent
from jaxpomdp.agents.control import Schedule
from jaxpomdp.agents.coupled_tree_kind import CoupledTreeModel
from jaxpomdp.agents.presets import HALLWAY
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.agents.tree_kind import HierarchicalModel
from jaxpomdp.envs.hallway import hallway_navigation
from jaxpomdp.experiments import arrays
from jaxpomdp.structure.coupled_tree import validate_coupled_tree
from tests.agents.small import SEEDS, assert_equal, rounds

WORLD = hallway_navigation(step_limit=20)
SETTINGS = {
    "schedule": Schedule(1.0, 0.2, 9000),
    "states": 9,
    "node_cap": 14,
    "window": 300,
    "trials_per_phase": 150,
    "edits_per_phase": 1,
    "order": "rotate",
    "operators": ("brother",),
    "tests.minimum_weight": 1.0,
    "tests.significance": 1.0,
    "tests.correction": "none",
    "return_bins": 4,
    "return_by_action": False,
    "keep_best": 40,
    "gate": 0.0,
}
"""From nine states the arrays have room for all that may come, so all is compiled once."""


def small(**settings):
    config = replace(HALLWAY, model=CoupledTreeModel(HierarchicalModel(levels=2, form="sober")))
    return Agent(WORLD, with_settings(config, SETTINGS | settings))


@pytest.fixture(scope="module")
def run():
    agent = small()
    return agent, rounds(agent, 3)


def test_edits_keep_all_laws(run):
    agent, states = run
    sizes = np.asarray(states[-1].params.alive).sum(-1)
    added = np.zeros(2, int)
    for row in agent.log:
        added[row["seed_index"]] += len(row["copied"])
        assert np.isfinite([row["log_evidence_before"], row["log_evidence_after"]]).all()
    assert (added > 0).all()
    np.testing.assert_array_equal(sizes, 9 + added)
    for state in states:
        for spec in agent.kind.unpack(state.params):
            validate_coupled_tree(spec)
            assert spec.num_states <= 14
        for leaf in jax.tree.leaves((state.params, state.actor.q)):
            assert np.isfinite(np.asarray(leaf)).all()


def test_nothing_but_cousin_splits_writes_the_memory(run):
    agent, states = run
    split = {row["seed_index"] for row in agent.log if row["operator"] == "cousin"}
    for s, spec in enumerate(agent.kind.unpack(states[-1].params)):
        assert spec.heeded.any() == (s in split)


def test_the_operators_are_the_trees_and_the_cousin_split():
    agent = small(operators=("uncle", "leaf"))
    kinds = [operator.kind for operator, _ in agent.kind.operators(agent.config.learner)]
    assert kinds == ["uncle", "leaf", "cousin"]


def test_a_run_repeats_and_a_saved_state_goes_on(run):
    assert_equal(rounds(small(), 1)[1], run[1][1])
    fresh = small()
    loaded = arrays.unflatten(fresh.init(SEEDS), arrays.flatten(run[1][1]))
    assert_equal(fresh.run(loaded)[0], run[1][2])


def test_without_the_cousin_split_the_memory_stays_empty(run):
    agent = small(cousin=False)
    states = rounds(agent, 2)
    assert "cousin" not in {row["operator"] for row in agent.log}
    assert not any(spec.heeded.any() for spec in agent.kind.unpack(states[-1].params))
    judged = agent.evaluate(states[-1], 5, jax.random.key(0))
    assert judged["steps"].shape == (2, 5)


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="keep must be between 0 and 1"):
        CoupledTreeModel(keep=2.0)
