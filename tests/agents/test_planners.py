"""Planners on worlds whose best results are known, and the fairness of the evaluation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.agents.planners import PlannerConfig, plan
from jaxpomdp.agents.policies import Policy, act, evaluate_policy, value
from jaxpomdp.envs.hallway import hallway_navigation
from jaxpomdp.envs.maze89 import maze57, maze89
from jaxpomdp.envs.pomdp_file import read_pomdp
from jaxpomdp.envs.pomdp_world import from_pomdp
from jaxpomdp.envs.world import model_of

SMALL = PlannerConfig(beliefs=60, rounds=1, explorers=8, horizon=40, capacity=64)
SIGNPOST = """discount: 0.9
states: left right sign-left sign-right good bad
actions: l r look
observations: nothing points-left points-right end
start: 0.5 0.5 0 0 0 0
T: * : good : good 1
T: * : bad : bad 1
T: l : left : good 1
T: l : sign-left : good 1
T: l : right : bad 1
T: l : sign-right : bad 1
T: r : left : bad 1
T: r : sign-left : bad 1
T: r : right : good 1
T: r : sign-right : good 1
T: look : left : sign-left 1
T: look : right : sign-right 1
T: look : sign-left : sign-left 1
T: look : sign-right : sign-right 1
O: * : left : nothing 1
O: * : right : nothing 1
O: * : sign-left : points-left 1
O: * : sign-right : points-right 1
O: * : good : end 1
O: * : bad : end 1
R: * : * : good : * 1
R: * : * : bad : * -1
E: good bad
"""


@pytest.fixture(scope="module")
def signpost():
    return from_pomdp(read_pomdp(SIGNPOST), step_limit=10)


@pytest.fixture(scope="module")
def known(signpost):
    return plan(model_of(signpost), 0.9, SMALL, seed=3)


def test_only_a_planner_that_values_knowing_looks_first(signpost, known):
    model = model_of(signpost)
    assert act(known, model.start, jnp.array(0.5)) == 2
    assert value(known, model.start) == pytest.approx(0.9, abs=1e-5)
    rows = evaluate_policy(signpost, known, trials=40)
    assert rows["success"].all()
    np.testing.assert_array_equal(rows["steps"], 2)
    np.testing.assert_allclose(rows["discounted"], 0.9, rtol=1e-6)
    # QMDP thinks that the state will be known after one step, so looking gains it nothing
    guess = plan(model, 0.9, PlannerConfig("qmdp"))
    assert value(guess, model.start) == pytest.approx(0.9, abs=1e-5)
    most_likely = evaluate_policy(signpost, plan(model, 0.9, PlannerConfig("most-likely")), trials=40)
    assert 0.2 < most_likely["success"].mean() < 0.8
    np.testing.assert_array_equal(most_likely["steps"], 1)


def test_bounds_are_in_order(signpost, known):
    model = model_of(signpost)
    at = {m: float(value(plan(model, 0.9, PlannerConfig(m)), model.start)) for m in ("qmdp", "informed")}
    perseus = float(value(known, model.start))
    assert perseus <= at["informed"] + 1e-5
    assert at["informed"] <= at["qmdp"] + 1e-5


def test_a_plan_repeats_itself(signpost, known):
    jax.tree.map(np.testing.assert_array_equal, known, plan(model_of(signpost), 0.9, SMALL, seed=3))


def test_the_hallway_is_solved_by_qmdp():
    world = hallway_navigation()
    policy = plan(model_of(world), world.discount, PlannerConfig("qmdp"))
    rows = evaluate_policy(world, policy, trials=300, seed=1)
    assert rows["success"].all()
    assert rows["steps"].mean() == pytest.approx(5.0, abs=0.5)


def test_a_trial_does_not_depend_on_how_many_run_beside_it(signpost):
    policy = plan(model_of(signpost), 0.9, PlannerConfig("most-likely"))
    few, many = (evaluate_policy(signpost, policy, trials=n, seed=5) for n in (7, 40))
    for name in few:
        np.testing.assert_array_equal(few[name], many[name][:7])
    other = evaluate_policy(signpost, policy, trials=40, seed=6)
    assert (other["success"] != many["success"]).any()


def test_trials_stop_at_the_limit():
    world = maze89(step_limit=20)
    still = Policy(jnp.zeros((1, 92)), jnp.zeros(1, jnp.int32), jnp.array(False))
    rows = evaluate_policy(world, still, trials=5)
    np.testing.assert_array_equal(rows["steps"], 20)
    assert not rows["success"].any()
    assert not rows["reward"].any()


def test_ties_between_likely_states_are_broken_by_the_number_given():
    policy = Policy(jnp.eye(3), jnp.arange(3), jnp.array(True))
    belief = jnp.array([0.4, 0.2, 0.4])
    assert [int(act(policy, belief, jnp.array(u))) for u in (0.0, 0.49, 0.5, 0.99)] == [0, 0, 2, 2]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "guess"}, "method must be one of"),
        ({"rounds": 0}, "rounds must be at least 1, got 0"),
        ({"beliefs": 500, "explorers": 1, "horizon": 10}, r"at most 3 \* explorers \* horizon = 30, got 500"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(ValueError, match=message):
        PlannerConfig(**settings)


def test_a_discount_of_one_is_refused(signpost):
    with pytest.raises(ValueError, match=r"discount must lie in \[0, 1\), got 1.0"):
        plan(model_of(signpost), 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(("maze", "median", "discounted"), [(maze89, 28, 0.34), (maze57, 14, 0.52)])
def test_perseus_reaches_the_reference_on_the_mazes(maze, median, discounted):
    world = maze()
    rows = evaluate_policy(world, plan(model_of(world), 0.95), trials=500)
    assert rows["success"].mean() >= 0.98
    assert np.median(rows["steps"]) <= median
    assert rows["discounted"].mean() >= discounted


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "maze", "goal"),
    [
        ("qmdp", maze89, (0.18, 0.36)),
        ("qmdp", maze57, (0.42, 0.58)),
        ("most-likely", maze89, (0.95, 1)),
        ("most-likely", maze57, (0.97, 1)),
    ],
)
def test_heuristics_reach_their_references_on_the_mazes(method, maze, goal):
    world = maze()
    rows = evaluate_policy(world, plan(model_of(world), 0.95, PlannerConfig(method)), trials=500)
    assert goal[0] <= rows["success"].mean() <= goal[1]
