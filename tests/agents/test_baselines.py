"""References: what they are told, that they keep to it, and that they reach what is known of them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.agents import baselines
from jaxpomdp.agents.baselines import FixedAgent, FixedConfig, observation_model, true_model
from jaxpomdp.agents.trial import first_belief, memory_of, next_belief
from jaxpomdp.envs.hallway import hallway_navigation
from jaxpomdp.envs.maze89 import maze89
from jaxpomdp.envs.pomdp_file import read_pomdp
from jaxpomdp.envs.pomdp_world import from_pomdp
from jaxpomdp.envs.world import model_of
from jaxpomdp.kernels import planning
from jaxpomdp.models.flat import FLAT

KEY = jax.random.key(7)


def goal_percent(agent, state, trials=251):
    return 100 * agent.evaluate(agent.finish(state), trials, KEY)["success"].mean()


def exact_random_walk(world, actions):
    """Chance to reach the goal within the limit, by powers of the mean transition matrix."""
    model = model_of(world)
    step = np.asarray(model.trans, np.float64)[actions].mean(axis=0)
    belief = np.asarray(model.start, np.float64) @ np.linalg.matrix_power(step, world.step_limit)
    return 100 * belief[np.asarray(model.terminal)].sum()


def check_random_walk(name, actions):
    world = maze89()
    agent = baselines.make(name, world, {})
    found = goal_percent(agent, agent.init([3, 4]), trials=1500)
    assert found == pytest.approx(exact_random_walk(world, actions), abs=2.5)


def test_a_random_walk_without_no_op_reaches_the_goal_as_often_as_computed():
    check_random_walk("random", [1, 2, 3, 4])


@pytest.mark.slow
def test_a_random_walk_of_all_actions_reaches_the_goal_as_often_as_computed():
    check_random_walk("random-all", [0, 1, 2, 3, 4])
    with pytest.raises(AssertionError):
        check_random_walk("random-all", [1, 2, 3, 4])


def test_a_fixed_agent_goes_on_where_it_stopped_and_repeats_itself():
    world = hallway_navigation()
    agent = baselines.make("random", world, {"trials_per_phase": 5})
    state = agent.init([1, 2])
    later, first = agent.run(state)
    _, second = agent.run(later)
    _, again = agent.run(state)
    assert first["steps"].shape == (2, 5)
    np.testing.assert_array_equal(first["steps"], again["steps"])
    assert (first["steps"] != second["steps"]).any()
    assert (first["steps"][0] != first["steps"][1]).any()
    np.testing.assert_array_equal(later.trials, [5, 5])
    in_other_company = agent.run(agent.init([2, 9]))[1]
    np.testing.assert_array_equal(in_other_company["steps"][0], first["steps"][1])


def test_seeds_take_plans_in_turn():
    agent = FixedAgent(hallway_navigation(), FixedConfig(baselines.PlannerConfig("qmdp"), plans=2))
    state = agent.init([5, 6, 7])
    assert state.policy.vectors.shape[0] == 3
    np.testing.assert_array_equal(state.policy.vectors[0], state.policy.vectors[2])


def test_without_memory_the_belief_is_the_last_observation():
    memory = memory_of(FLAT, observation_model(maze89()))
    belief = first_belief(FLAT, memory, (jnp.int32(3),))
    np.testing.assert_allclose(belief, np.eye(17)[3], atol=1e-6)
    belief = next_belief(FLAT, memory, belief, jnp.int32(1), (jnp.int32(11),))
    np.testing.assert_allclose(belief, np.eye(17)[11], atol=1e-6)


def test_the_true_belief_is_that_of_the_planners():
    world = maze89()
    truth, memory = model_of(world), memory_of(FLAT, true_model(world))
    belief = first_belief(FLAT, memory, (jnp.int32(5),))
    joint = np.asarray(truth.start * truth.first[:, 5])
    np.testing.assert_allclose(belief, joint / joint.sum(), atol=1e-6)
    ours = next_belief(FLAT, memory, belief, jnp.int32(1), (jnp.int32(9),))
    np.testing.assert_allclose(ours, planning.update(belief, 1, 9, truth.trans, truth.obs), atol=1e-6)


def test_seeded_values_are_qmdp():
    world = hallway_navigation()
    agent = baselines.make("seeded-q", world, {"alpha": 0.0})
    state = agent.init([0])
    model = model_of(world)
    q = planning.value_iteration(
        *planning.end_trials(model.trans, model.reward, model.terminal), world.discount
    )
    np.testing.assert_allclose(state.actor.q[0], q.T, atol=1e-6)
    assert agent.config.control.gamma == world.discount


def test_a_world_whose_observations_belong_to_actions_is_refused(shared_dir):
    tiger = from_pomdp(read_pomdp(shared_dir / "data/pomdp/tiger.95.POMDP"), name="tiger")
    with pytest.raises(
        ValueError, match="world 'tiger' must have observations that depend on the state alone"
    ):
        baselines.make("belief-sarsa", tiger, {})


def test_unknown_names_and_settings_are_refused():
    with pytest.raises(ValueError, match="reference must be one of belief-sarsa, memoryless"):
        baselines.make("oracle", maze89(), {})
    with pytest.raises(ValueError, match="plans must be at least 1, got 0"):
        FixedConfig(plans=0)


@pytest.mark.slow
def test_memoryless_sarsa_reaches_what_is_known_of_it():
    agent = baselines.make("memoryless", maze89(), {})
    state = agent.init(range(5))
    while np.asarray(state.actor.steps).mean() < 500_000:
        state, _ = agent.run(state)
    assert 60 <= goal_percent(agent, state) <= 87
