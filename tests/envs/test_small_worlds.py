"""Hallways, T-mazes, maps, names and noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.envs import grid as grids
from jaxpomdp.envs.hallway import hallway, hallway_navigation
from jaxpomdp.envs.host import HostWorld
from jaxpomdp.envs.registry import make, names
from jaxpomdp.envs.tmaze import tmaze
from jaxpomdp.envs.world import World, model_of
from jaxpomdp.envs.wrappers import limited, noisy
from tests.envs.walks import share_ended

NORTH, EAST, SOUTH, WEST = range(4)
MIDDLE = np.full(3, 0.5)


def _walk(world: World, state: int, actions: list[int]) -> tuple[list[int], list[float]]:
    """Follow actions in a world without noise; returns observations and rewards."""
    observations, rewards = [], []
    host = HostWorld(world)
    for action in actions:
        state, observation, reward, _ = host.step(state, action, MIDDLE)
        observations.append(observation)
        rewards.append(round(reward, 5))
    return observations, rewards


def test_hallway_takes_five_steps_from_each_corner() -> None:
    world = hallway_navigation()
    corners = np.flatnonzero(world.start_prob)
    np.testing.assert_allclose(np.asarray(world.start_prob)[corners], 0.25)
    paths = [
        [EAST] * 3 + [SOUTH] * 2,
        [WEST] * 3 + [SOUTH] * 2,
        [EAST] * 3 + [NORTH] * 2,
        [WEST] * 3 + [NORTH] * 2,
    ]
    for corner, path in zip(corners.tolist(), paths, strict=True):
        observations, rewards = _walk(world, corner, path)
        assert rewards == [-0.1] * 4 + [5.0]
        assert observations[-1] == 16


def test_hallway_shows_walls_and_punishes_bumps() -> None:
    world = hallway_navigation()
    shown = np.asarray(world.first_observation_prob).argmax(axis=-1)
    assert shown[np.flatnonzero(world.start_prob)].tolist() == [8 + 1, 8 + 4, 2 + 1, 4 + 2]
    assert _walk(world, 0, [NORTH, WEST, EAST]) == ([9, 9, 10], [-1.0, -1.0, -0.1])
    assert len(set(shown.tolist())) < world.num_states / 2


def test_hallway_of_any_map() -> None:
    world = hallway("#.#\n.G.", goal=1, bump=-2, move=-3)
    assert world.num_states == 4
    assert np.count_nonzero(world.start_prob) == 3
    assert _walk(world, 1, [NORTH, EAST])[1] == [-2.0, 1.0]


@pytest.mark.parametrize(
    ("ascii_map", "message"),
    [
        ("*x+", r"got 'x' in row 0, column 1"),
        ("***", "must have a goal"),
        ("+", "a cell that is not a goal"),
        ("", "must have a goal"),
    ],
)
def test_bad_maps_are_refused(ascii_map: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        hallway(ascii_map)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.text("*+ ", min_size=1, max_size=5), min_size=1, max_size=4).filter(
        lambda m: "+" in "".join(m)
    )
)
def test_neighbours_are_mutual(rows: list[str]) -> None:
    grid = grids.parse("\n".join(rows))
    for cell in range(len(grid.cells)):
        for direction in range(4):
            there = grid.neighbour(cell, direction)
            assert grid.wall(cell, direction) == (there is None)
            assert there is None or grid.neighbour(there, (direction + 2) % 4) == cell


@pytest.mark.parametrize("signal", [0, 1])
@pytest.mark.parametrize("length", [1, 4, 9])
def test_tmaze_pays_for_the_arm_that_the_signal_named(length: int, signal: int) -> None:
    world = tmaze(length)
    right, wrong = (NORTH, SOUTH) if signal == 0 else (SOUTH, NORTH)
    along = [2] * (length - 1) + [3]
    observations, rewards = _walk(world, signal, [EAST] * length + [right])
    assert observations == [*along, 4 + signal]
    assert rewards == [0.0] * length + [4.0]
    assert _walk(world, signal, [EAST] * length + [wrong])[1][-1] == pytest.approx(-0.1)
    assert float(rewards[-1]) > world.success_above > -0.1


def test_tmaze_shows_the_signal_at_the_start_only() -> None:
    world = tmaze(3)
    assert np.asarray(world.first_observation_prob).argmax(axis=-1)[:2].tolist() == [0, 1]
    assert _walk(world, 1, [WEST, NORTH, EAST, WEST]) == ([1, 1, 2, 1], [-0.1, -0.1, 0.0, 0.0])
    junction = 6
    assert _walk(world, junction, [EAST]) == ([3], [-0.1])


def test_tmaze_leaves_time_to_explore() -> None:
    assert 0.7 < share_ended(tmaze(10), range(4), tmaze(10).step_limit) < 0.95
    assert tmaze(10, step_limit=77).step_limit == 77
    with pytest.raises(ValueError, match="length must be at least 1, got 0"):
        tmaze(0)


def test_names_make_worlds() -> None:
    assert names() == ("hallway", "maze57", "maze89", "tiger-grid", "tmaze")
    assert make("tmaze-12").num_states == 2 * 13 + 2
    assert make("tmaze", length=12).name == make("tmaze-12").name == "tmaze-12"
    assert make("maze89", step_limit=9).step_limit == 9
    assert float(make("hallway-noise").reward_noise) == pytest.approx(0.1)
    with pytest.raises(ValueError, match=r"name must be one of hallway, maze57.*got 'maze90'"):
        make("maze90")


def test_model_files_make_worlds(shared_dir: Path) -> None:
    world = make(str(shared_dir / "data" / "pomdp" / "hallway2.POMDP"), step_limit=30)
    assert (world.name, world.step_limit) == ("hallway2", 30)
    generated = make("maze89")
    np.testing.assert_array_equal(world.terminal, generated.terminal)
    np.testing.assert_allclose(model_of(world).trans, model_of(generated).trans, atol=1e-7)
    assert world.transition_prob.shape == generated.transition_prob.shape


def test_noise_mixes_actions_and_observations() -> None:
    world = hallway_navigation()
    clean, mixed = model_of(world), model_of(noisy(world, action=0.2, observation=0.3, reward=0.5))
    trans = np.asarray(clean.trans, np.float64)
    np.testing.assert_allclose(mixed.trans, 0.8 * trans + 0.2 * trans.mean(axis=0), atol=1e-6)
    reward = np.asarray(clean.reward, np.float64)
    np.testing.assert_allclose(mixed.reward, 0.8 * reward + 0.2 * reward.mean(axis=0), atol=1e-6)
    goes_on = ~np.asarray(world.terminal)
    expected = 0.7 * np.asarray(clean.obs, np.float64)[0, goes_on]
    expected[:, :16] += 0.3 / 16
    np.testing.assert_allclose(np.asarray(mixed.obs)[0, goes_on], expected, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(mixed.obs)[0, ~goes_on], np.asarray(clean.obs)[0, ~goes_on])


def test_noise_keeps_rewards_of_one_move_apart() -> None:
    world = noisy(tmaze(2), action=0.5, observation=0, reward=0)
    at_junction = np.asarray(world.reward)[NORTH, 4][np.asarray(world.transition_prob)[NORTH, 4] > 0]
    np.testing.assert_allclose(np.unique(at_junction), [-0.1, 0, 4], atol=1e-6)


def test_no_noise_changes_nothing() -> None:
    world = make("maze89")
    same = noisy(world, action=0, observation=0, reward=0)
    for before, after in zip(model_of(world), model_of(same), strict=True):
        np.testing.assert_allclose(before, after, atol=1e-7)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"action": 1.5}, r"action must be a probability in \[0, 1\], got 1.5"),
        ({"observation": -0.1}, "observation must be a probability"),
        ({"reward": -1}, "reward must not be negative"),
    ],
)
def test_bad_noise_is_refused(given: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        noisy(make("hallway"), **given)


def test_noise_refuses_what_tables_cannot_say(shared_dir: Path) -> None:
    tiger = str(shared_dir / "data" / "pomdp" / "tiger.95.POMDP")
    with pytest.raises(ValueError, match=r"action must be 0 in 'tiger\.95'"):
        noisy(make(tiger))
    quiet = noisy(make(tiger), action=0, observation=0.5)
    np.testing.assert_allclose(np.asarray(quiet.observation_prob).sum(axis=-1), 1, atol=1e-6)


def test_a_limit_is_a_setting() -> None:
    assert limited(make("hallway"), 7).step_limit == 7
    with pytest.raises(ValueError, match="step_limit must be at least 1, got 0"):
        limited(make("hallway"), 0)
