"""The coupled agent, small: it runs with every coupling and inference, repeats, grows, acts by strand 0."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jaxpomdp.agents import coupled_kind, experience, learner
from jaxpomdp.agents.agent import Agent, make_agent
from jaxpomdp.agents.control import Schedule
from jaxpomdp.agents.coupled_kind import CoupledModel
from jaxpomdp.agents.presets import LEARNERS
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.agents.trial import memory_of
from jaxpomdp.envs.tmaze import tmaze
from jaxpomdp.experiments import arrays
from jaxpomdp.models.coupled import COUPLED_PRODUCT
from jaxpomdp.models.em import e_step
from jaxpomdp.structure.evidence import return_evidence
from tests.agents.small import SEEDS, assert_equal, rounds

WORLD = tmaze(1, step_limit=6)
SETTINGS = {
    "schedule": Schedule(1.0, 0.0, 60),
    "alpha": 0.1,
    "states": 6,
    "node_cap": 8,
    "window": 12,
    "trials_per_phase": 6,
    "minimum_weight": 8.0,
    "split.significance": 0.9,
    "correction": "none",
    "return_by_action": False,
    "keep_best": 6,
    "gate": 0.0,
    "return_states": 2,
    "return_cap": 4,
}


def small(**settings):
    return Agent(WORLD, with_settings(LEARNERS["cudhmm-tmaze"], SETTINGS | settings))


@pytest.fixture(scope="module")
def run():
    agent = small()
    return agent, rounds(agent, 3)


def test_a_run_grows_both_strands_and_repeats_itself(run):
    agent, states = run
    sizes = [np.asarray(strand.alive).sum(-1) for strand in states[-1].params.strands]
    edits = np.bincount([row["seed_index"] for row in agent.log], minlength=2)
    assert edits.sum() >= 1
    np.testing.assert_array_equal(sizes[0] > 6, edits > 0)
    np.testing.assert_array_equal(sizes[1], np.minimum(2 + edits, 4))
    assert_equal(rounds(small(), 1)[1], states[1])


def test_a_saved_state_goes_on_to_the_same_result(run):
    fresh = small()
    loaded = arrays.unflatten(fresh.init(SEEDS), arrays.flatten(run[1][1]))
    assert_equal(fresh.run(loaded)[0], run[1][2])


@pytest.mark.parametrize("coupling", ["product", "mixture"])
@pytest.mark.parametrize("inference", ["exact", "approximate"])
def test_every_variant_stays_finite_and_can_be_judged(coupling, inference):
    agent = small(coupling=coupling, inference=inference, added="components")
    state = agent.finish(rounds(agent, 2)[-1])
    for leaf in jax.tree.leaves((state.params, state.actor.q)):
        assert np.isfinite(np.asarray(leaf)).all()
    judged = agent.evaluate(state, 5, jax.random.key(0))
    assert judged["steps"].shape == (2, 5)


def test_values_and_memory_are_of_strand_0(run):
    agent, states = run
    params = states[-1].params
    assert states[-1].actor.q.shape == (*params.alive.shape, WORLD.num_actions)
    memory = memory_of(agent.family, params)
    total = np.asarray(memory.trans).sum(-1)
    np.testing.assert_allclose(
        total, np.broadcast_to(np.asarray(params.alive)[:, None], total.shape), atol=1e-5
    )


def test_evidence_is_that_of_strand_0(run):
    agent, states = run
    settings = agent.config.learner
    tapes = experience.tapes_of(states[-1].experience)
    batch = learner.with_returns(
        jax.device_put(tapes.batch), jax.numpy.asarray(tapes.tail), gamma=0.9, bootstrap=False
    )
    params = states[-1].params
    found = jax.device_get(agent.kind.gather(params, batch, jax.numpy.asarray(tapes.trial), settings))
    seen = e_step(COUPLED_PRODUCT, params, batch, learner.em_config(settings))
    for s, spec in enumerate(agent.kind.unpack(params)):
        counted = np.asarray(batch.valid & batch.has_return)[s]
        ours = agent.kind.evidence(found, s, spec)
        wanted = return_evidence(
            np.asarray(batch.returns)[s][counted],
            np.asarray(seen.gamma[0])[s][counted][:, : spec.num_states],
            ours.edges,
        )
        assert ours.mean.shape == (spec.num_states, 1)
        np.testing.assert_allclose(ours.weight, wanted.weight, rtol=1e-3, atol=1e-3)
        np.testing.assert_allclose(ours.mean * ours.weight, wanted.mean * wanted.weight, atol=1e-2)


def test_a_start_does_not_depend_on_room():
    kind = small().kind
    settings = small().config.learner
    sizes = coupled_kind.Sizes(2, 3)
    tight, wide = (kind.unpack(_stacked(kind.start(7, sizes, settings, room))) for room in ((6, 2), (9, 4)))
    assert tight == wide


def _stacked(params):
    return jax.tree.map(lambda x: x[None], params)


def test_presets_are_found_by_name_and_take_settings():
    agent = make_agent("cudhmm", WORLD, coupling="mixture", inference="approximate")
    assert agent.family.name == "coupled_mixture_approximate"
    with pytest.raises(ValueError, match="coupling must be one of product, mixture, got 'sum'"):
        make_agent("cudhmm", WORLD, coupling="sum")
    with pytest.raises(ValueError, match=r"return_states must be in 1 .. return_cap=2, got 3"):
        CoupledModel(return_states=3, return_cap=2)
