"""The two pictures of a trained agent, with a random model in place of a learned one."""

from __future__ import annotations

from dataclasses import dataclass, field
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
from jaxpomdp.models.init import random_params, stack_models
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
