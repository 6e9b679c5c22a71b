"""Worlds made of model files, against the generated mazes and by their rules."""

from __future__ import annotations

import numpy as np
import pytest

from jaxpomdp.envs.maze89 import maze57, maze89
from jaxpomdp.envs.pomdp_file import read_pomdp, write_pomdp
from jaxpomdp.envs.pomdp_world import FIRST_SYMBOL, from_pomdp, read_world, reset_states, to_pomdp
from jaxpomdp.envs.world import model_of

TEXT = """discount: 0.9
values: cost
states: left right done goal
actions: go look
observations: l r d g
start: 0.5 0.5 0 0
T: go : left : right 0.5
T: go : left : goal 0.5
T: go : right : done 1
T: look identity
T: go : done : done 1
T: * : goal reset
O: * identity
R: go : left : * : * 3
R: * : goal : * : * -2
R: look : right : * : r 1
"""


@pytest.mark.parametrize(("name", "maze"), [("hallway2.POMDP", maze89), ("hallway.POMDP", maze57)])
def test_the_mazes_of_the_files_are_the_generated_ones(shared_dir, name, maze):
    world = from_pomdp(read_pomdp(shared_dir / "data/pomdp" / name), goal_states="reset")
    for ours, theirs in zip(model_of(maze()), model_of(world), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=6e-5)
    np.testing.assert_array_equal(maze().terminal, world.terminal)


def test_costs_goals_and_absorbing_states():
    world = from_pomdp(read_pomdp(TEXT), goal_states=["goal"], name="toy", step_limit=9)
    model = model_of(world)
    assert (world.name, world.step_limit, world.discount) == ("toy", 9, pytest.approx(0.9))
    np.testing.assert_array_equal(world.terminal, [False, False, True, True])
    np.testing.assert_allclose(model.reward, [[-3 + 0.5 * 2, 0, 0, 0], [0, -1, 0, 0]])
    np.testing.assert_allclose(model.trans[:, 3], [[0, 0, 0, 1]] * 2)
    np.testing.assert_array_equal(world.first_observation_prob, np.eye(4))


def test_goals_by_number_by_reset_or_not_at_all():
    parsed = read_pomdp(TEXT)
    np.testing.assert_array_equal(reset_states(parsed), [False, False, False, True])
    for goals in ([3], "reset", ["goal"]):
        np.testing.assert_array_equal(from_pomdp(parsed, goal_states=goals).terminal, [0, 0, 1, 1])
    endless = model_of(from_pomdp(parsed))
    np.testing.assert_allclose(endless.trans[0, 3], [0.5, 0.5, 0, 0])
    np.testing.assert_allclose(endless.reward[:, 3], 2)


def test_end_states_end_trials():
    world = from_pomdp(read_pomdp(TEXT + "E: right\n"))
    np.testing.assert_array_equal(world.terminal, [0, 1, 1, 0])


def test_a_symbol_for_the_first_observation_where_observations_belong_to_actions():
    world = from_pomdp(read_pomdp(TEXT + "O: look uniform\n"))
    assert world.observation_names == ("l", "r", "d", "g", FIRST_SYMBOL)
    np.testing.assert_array_equal(world.first_observation_prob, [[0, 0, 0, 0, 1]] * 4)
    np.testing.assert_array_equal(world.observation_prob[..., 4], 0)
    np.testing.assert_allclose(world.observation_prob[1, :, :4], 0.25)


@pytest.mark.parametrize(
    ("text", "settings", "message"),
    [
        (TEXT, {"goal_states": ["cellar"]}, "goal_states must be among the 4 states, got 'cellar'"),
        (TEXT, {"goal_states": [7]}, "got 7"),
        (TEXT, {"goal_states": "goal"}, "states or 'reset', got 'goal'"),
        (TEXT, {"goal_states": ["left"]}, "'left' does not"),
        (TEXT.replace("discount: 0.9", ""), {}, "discount must be given"),
    ],
)
def test_refusals(text, settings, message):
    with pytest.raises(ValueError, match=message):
        from_pomdp(read_pomdp(text), **settings)


@pytest.mark.parametrize(
    ("file", "terminal"),
    [
        ("hallway2.POMDP", 4),
        ("cheese.95.POMDP", 1),
        ("tiger.95.POMDP", 0),
        ("gym-pomdps/heavenhell_2.pomdp", 4),
        ("pomdpx/Hallway.pomdpx", 4),
    ],
)
def test_files_become_worlds_that_end_where_they_start_again(shared_dir, file, terminal):
    world = read_world(shared_dir / "data/pomdp" / file)
    assert int(world.terminal.sum()) == terminal
    assert world.name == file.rpartition("/")[2].rpartition(".")[0]


def test_a_goal_that_is_never_left_may_pay_what_it_likes(shared_dir):
    file = shared_dir / "data/pomdp/pobax/tiger-alt-start.POMDP"
    assert not read_world(file).terminal.any()
    world = read_world(file, goal_states=["terminal"])
    np.testing.assert_array_equal(world.terminal, [0, 0, 0, 0, 1])
    np.testing.assert_array_equal(model_of(world).reward[:, :2], [[-1, -1], [-100, 10], [10, -100]])


def test_a_world_written_and_read_is_the_same_world():
    world = maze89()
    parsed = read_pomdp(write_pomdp(to_pomdp(world)))
    again = from_pomdp(parsed)
    for before, after in zip(model_of(world), model_of(again), strict=True):
        np.testing.assert_allclose(before, after, atol=1e-7)
    assert parsed.end_states == (68, 69, 70, 71)
