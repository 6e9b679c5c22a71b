"""The two pictures of a trained agent, with a random model in place of a learned one."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from jaxpomdp.envs.registry import make
from jaxpomdp.envs.wrappers import limited
from jaxpomdp.experiments import runner, show
from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.record import RunDirectoryError
from jaxpomdp.models.family import Family
from jaxpomdp.models.flat import FLAT
from jaxpomdp.models.hierarchical import HIERARCHICAL, beliefs_of_nodes
from jaxpomdp.models.init import random_params, stack_models
from jaxpomdp.packing import pack, unpack_all
from jaxpomdp.structure.edits import Edit
from jaxpomdp.structure.operators import BROTHER_SPLIT, TreeSplit
from jaxpomdp.structure.tree_init import random_tree
from tests.experiments.fake import FakeConfig

WORLD = limited(make("tmaze-2"), 4)
CONFIG = RunConfig("tmaze-2", "still", seeds=(3, 4), trials=0, final_trials=2)


class Actor(NamedTuple):
    q: np.ndarray


class State(NamedTuple):
    params: Any
    actor: Actor


@dataclass(frozen=True)
class StillAgent:
    """It has a model and values and learns nothing."""

    config: FakeConfig = field(default_factory=FakeConfig)
    family: Family = FLAT

    def init(self, seeds):
        sizes = {"states": 4, "actions": 4, "observations": WORLD.num_observations, "capacity": 6}
        models = [random_params(int(seed), **sizes) for seed in seeds]
        return State(
            stack_models(models), Actor(np.tile(np.eye(6, 4, dtype=np.float32)[None], (len(seeds), 1, 1)))
        )

    def evaluate(self, state, trials, key):
        steps = np.tile(np.arange(1, trials + 1), (len(state.actor.q), 1))
        return {"steps": steps, "reward": steps, "discounted": steps, "success": steps > 1}

    def finish(self, state):
        return state


def build(config):
    return WORLD, StillAgent()


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    return runner.run(CONFIG, tmp_path_factory.mktemp("show") / "run", make=build, progress="none")


def test_show_draws_the_belief_and_the_model(done, tmp_path, monkeypatch):
    monkeypatch.setattr(show, "WALKS", 3)
    lines = show.show(done, tmp_path, seed=4, make=build)
    assert "belief.gif: tmaze-2, still, seed 4" in lines[0]
    assert lines[1].endswith("model.png: its 4 states")
    for name in ("belief.gif", "model.png"):
        assert (tmp_path / name).stat().st_size > 5_000


def test_show_refuses_a_seed_that_did_not_run_and_agents_without_a_model(done, tmp_path):
    with pytest.raises(RunDirectoryError, match="seed must be one of 3, 4, got 9"):
        show.show(done, tmp_path, seed=9, make=build)
    with pytest.raises(RunDirectoryError, match="no learned model"):
        show.learned(object(), object(), 0)


def test_the_mind_follows_the_model_and_acts_greedily():
    agent = StillAgent()
    family, params, q = show.learned(agent, agent.init([7]), 0)
    mind = show.mind_of(family, params, q)
    belief = mind.begin(2)
    init, trans = np.exp(np.asarray(params.log_init)), np.exp(np.asarray(params.log_trans))
    seen = np.exp(np.asarray(params.emissions[0].log_prob))
    expected = init * seen[:, 2] * np.asarray(params.alive)
    np.testing.assert_allclose(belief, expected / expected.sum(), rtol=1e-4)
    follow = (belief @ trans[1]) * seen[:, 3] * np.asarray(params.alive)
    np.testing.assert_allclose(mind.follow(belief, 1, 3), follow / follow.sum(), rtol=1e-4)
    assert mind.act(belief) == int(np.argmax(belief @ q))


def test_the_graph_leaves_out_absent_states():
    agent = StillAgent()
    family, params, q = show.learned(agent, agent.init([7]), 0)
    graph = show.graph_of(family, params, q, np.full(6, 1 / 6), WORLD.num_observations)
    assert graph.trans.shape == (4, 4, 4)
    np.testing.assert_allclose(graph.trans.sum(axis=-1), 1, rtol=1e-5)
    np.testing.assert_allclose(graph.observation.sum(axis=-1), 1, rtol=1e-5)
    assert jax.tree.map(len, graph._asdict())["value"] == 4


@dataclass(frozen=True)
class GrowingTree(StillAgent):
    """It has a tree, to which a phase does one edit of a fixed kind."""

    family: Family = HIERARCHICAL
    log: list = field(default_factory=list)

    def init(self, seeds):
        specs = [random_tree(int(seed), 5, 4, WORLD.num_observations, levels=2) for seed in seeds]
        return State(
            pack(specs, 12), Actor(np.tile(np.eye(12, 4, dtype=np.float32)[None], (len(seeds), 1, 1)))
        )

    def run(self, state):
        specs = []
        for s, spec in enumerate(unpack_all(state.params)):
            halves = np.full(spec.num_states, 0.5), np.full(spec.num_internal, 0.5)
            split = TreeSplit(("s1", "entry"), -1, (True, 1), *halves, 0.5, None, None, 0.9, None)
            edit = Edit("brother", 1, spec.num_states, (1,), 9.0, 9.0, 0.001, 0.5, 99.0, split)
            specs.append(BROTHER_SPLIT.apply(spec, edit))
            self.log.append({"seed_index": s} | edit.row())
        rows = {name: np.ones((len(specs), 5)) for name in ("steps", "reward", "discounted", "success")}
        phase = dict.fromkeys(("states", "log_evidence", "epsilon"), np.ones(len(specs)))
        return state._replace(params=pack(specs, 12)), rows | phase


@pytest.fixture
def grown(tmp_path):
    agent = GrowingTree()
    config = replace(CONFIG, agent="tree", trials=10)
    path = runner.run(config, tmp_path / "run", make=lambda _: (WORLD, agent), progress="none")
    return path, lambda _: (WORLD, agent)


def test_show_draws_a_tree_and_how_it_grew(grown, tmp_path, monkeypatch):
    monkeypatch.setattr(show, "WALKS", 3)
    lines = show.show(grown[0], tmp_path, seed=4, make=grown[1])
    assert lines[2].endswith("internal states")
    assert "tree.png: its 7 leaves" in lines[2]
    assert lines[3].endswith("growth.gif: its 2 edits")
    for name in ("belief.gif", "model.png", "tree.png", "growth.gif"):
        assert (tmp_path / name).stat().st_size > 5_000


def test_show_says_why_it_does_not_draw_growth(grown, tmp_path, monkeypatch):
    monkeypatch.setattr(show, "WALKS", 1)
    (grown[0] / "edits.jsonl").write_text("")
    assert "no growth.gif: the logged edits do not lead" in show.show(grown[0], tmp_path, make=grown[1])[3]


def test_the_belief_that_flows_is_that_of_the_models_nodes():
    """Drawn nodes are those of the spec; the device's are padded."""
    params = jax.tree.map(lambda x: x[0], GrowingTree().init([7]).params)
    tree = unpack_all(GrowingTree().init([7]).params)[0]
    belief = np.zeros((2, 12), np.float32)
    belief[:, :5] = np.random.default_rng(0).dirichlet(np.ones(5), 2)
    of_device = np.asarray(beliefs_of_nodes(params, belief))
    place = np.concatenate([np.arange(5), 12 + np.arange(tree.num_internal)])
    np.testing.assert_allclose(show.nodes_of(tree, params, belief), of_device[:, place], atol=1e-6)
