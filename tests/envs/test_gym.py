"""Worlds as Gymnasium environments, single and in numbers."""

from __future__ import annotations

import subprocess
import sys
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import jaxpomdp.envs.gym as gym_worlds
from jaxpomdp.envs.gym_env import WorldEnv
from jaxpomdp.envs.gym_vector import WorldVectorEnv
from jaxpomdp.envs.hallway import hallway
from jaxpomdp.envs.registry import make
from jaxpomdp.envs.world import model_of

EAST = 1


def _settings(name: str) -> dict[str, str]:
    return {"world": "tmaze-3"} if name == "World" else {}


@pytest.mark.parametrize("name", gym_worlds.IDS)
def test_every_world_passes_the_checker(name: str) -> None:
    env = gymnasium.make(f"jaxpomdp/{name}-v0", **_settings(name))
    check_env(env.unwrapped)
    env.close()


def test_names_with_the_module_in_front_need_no_import() -> None:
    code = (
        "import gymnasium, sys; env = gymnasium.make('jaxpomdp.envs.gym:jaxpomdp/TMaze-v0', length=2);"
        "print(env.unwrapped.world.name)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "tmaze-2"


def test_importing_worlds_leaves_gymnasium_and_pictures_alone() -> None:
    code = (
        "import sys, jaxpomdp.envs.registry, jaxpomdp.envs.spaces, jaxpomdp.envs.drawing, jaxpomdp.envs.text;"
        "print([m for m in ('gymnasium', 'matplotlib', 'PIL', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_registering_twice_is_quiet() -> None:
    gym_worlds.register()


def test_settings_reach_the_world() -> None:
    env = gymnasium.make("jaxpomdp/TMaze-v0", length=7, step_limit=5)
    assert (env.unwrapped.world.name, env.unwrapped.world.step_limit) == ("tmaze-7", 5)
    assert env.observation_space == gymnasium.spaces.Discrete(6)


def test_a_world_of_ones_own_is_an_environment() -> None:
    env = gymnasium.make("jaxpomdp/World-v0", world=hallway("S*+", step_limit=9))
    assert env.unwrapped.world.step_limit == 9
    check_env(env.unwrapped)


def test_a_trial_ends_by_termination_with_its_last_observation() -> None:
    env = WorldEnv("tmaze-2")
    signal, info = env.reset(seed=4)
    assert info == {"state": signal}
    for _ in range(2):
        *_, terminated, truncated, info = env.step(EAST)
        assert not terminated
        assert not truncated
        assert "success" not in info
    right = 0 if signal == 0 else 2
    observation, reward, terminated, truncated, info = env.step(right)
    assert (observation, reward, terminated, truncated) == (4 + signal, 4.0, True, False)
    assert info["success"] is True


def test_a_trial_at_the_limit_is_truncated_unless_it_ended() -> None:
    env = WorldEnv("tmaze-2", step_limit=3)
    env.reset(seed=0)
    flags = [env.step(EAST)[2:4] for _ in range(3)]
    assert flags == [(False, False), (False, False), (False, True)]
    signal, _ = env.reset(seed=0)
    env.step(EAST), env.step(EAST)
    _, reward, terminated, truncated, info = env.step(2 if signal == 0 else 0)
    assert (terminated, truncated, info["success"]) == (True, False, False)
    assert reward == pytest.approx(-0.1)


@pytest.mark.parametrize("maker", [WorldEnv, WorldVectorEnv])
def test_bad_arguments_are_refused(maker: type) -> None:
    with pytest.raises(ValueError, match="render_mode must be None or one of"):
        maker("hallway", render_mode="human")
    with pytest.raises(ValueError, match="settings go with the name of a world"):
        maker(make("hallway"), step_limit=3)


@pytest.mark.parametrize("name", ["maze89", "tmaze-4"])
def test_renderings_follow_the_agent(name: str) -> None:
    pictures, texts = WorldEnv(name, render_mode="rgb_array"), WorldEnv(name, render_mode="ansi")
    frames = []
    for env in (pictures, texts):
        env.reset(seed=1)
        frames.append([env.render()])
        for _ in range(6):
            env.step(EAST)
            frames[-1].append(env.render())
    assert all(f.dtype == np.uint8 and f.shape == frames[0][0].shape for f in frames[0])
    assert len({f.tobytes() for f in frames[0]}) == len(set(frames[1])) > 1
    assert WorldEnv(name).render() is None


def _play(envs: WorldVectorEnv, steps: int, seed: int = 3) -> list[tuple]:
    envs.reset(seed=seed)
    rng = np.random.default_rng(0)
    return [envs.step(rng.integers(4, size=envs.num_envs)) for _ in range(steps)]


def test_vector_worlds_are_made_by_gymnasium() -> None:
    envs = gymnasium.make_vec("jaxpomdp/TMaze-v0", num_envs=5, length=3)
    assert isinstance(envs, WorldVectorEnv)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    observations, info = envs.reset(seed=1)
    assert observations in envs.observation_space
    assert info["state"].shape == (5,)
    observations, rewards, terminations, truncations, _ = envs.step(envs.action_space.sample())
    assert observations in envs.observation_space
    assert (rewards.dtype, terminations.dtype, truncations.dtype) == (np.float64, bool, bool)
    envs.close()


def test_next_step_mode_keeps_the_last_observation_and_resets_afterwards() -> None:
    envs = WorldVectorEnv("tmaze-1", num_envs=6, step_limit=4)
    rows = _play(envs, 40)
    for before, after in pairwise(rows):
        observations, _, terminated, truncated, info = before
        over = terminated | truncated
        np.testing.assert_array_equal(observations >= 4, terminated)
        assert not np.any(terminated & truncated)
        if over.any():
            np.testing.assert_array_equal(info["_success"], over)
            assert not np.any(info["success"] & ~terminated)
        assert np.all(after[0][over] < 2)
        assert np.all(after[1][over] == 0)
        assert not np.any((after[2] | after[3])[over])
    assert sum(row[3].sum() for row in rows) > 0
    assert sum(row[2].sum() for row in rows) > 0


def test_same_step_mode_preserves_the_last_observation_in_info() -> None:
    envs = WorldVectorEnv("tmaze-1", num_envs=6, step_limit=4, autoreset_mode="SameStep")
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    ended = 0
    for observations, rewards, terminated, truncated, info in _play(envs, 40):
        over = terminated | truncated
        assert np.all(observations[over] < 2)
        if not over.any():
            assert "final_obs" not in info
            continue
        np.testing.assert_array_equal(info["_final_obs"], over)
        last = np.array([-1 if seen is None else seen for seen in info["final_obs"]])
        np.testing.assert_array_equal(last >= 4, terminated)
        np.testing.assert_array_equal(info["final_info"]["success"], terminated & (rewards > 2))
        assert np.all((info["final_info"]["state"] >= 4) == terminated, where=over)
        ended += over.sum()
    assert ended > 20


def test_trials_of_both_modes_are_equally_long() -> None:
    """Truncation comes after exactly ``step_limit`` actions, whichever way copies begin anew."""
    for mode in AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP:
        envs = WorldVectorEnv("tmaze-9", num_envs=2, step_limit=5, autoreset_mode=mode)
        envs.reset(seed=0)
        cut = [envs.step(np.array([EAST, EAST]))[3].tolist() for _ in range(12)]
        gap = 6 if mode is AutoresetMode.NEXT_STEP else 5
        assert [i for i, flags in enumerate(cut) if all(flags)] == list(range(4, 12, gap))


def test_a_copy_does_not_depend_on_the_others() -> None:
    many, few = WorldVectorEnv("maze89-noise", num_envs=8), WorldVectorEnv("maze89-noise", num_envs=2)
    seen_many, seen_few = [many.reset(seed=11)[0][3:5]], [few.reset(seed=14)[0]]
    for _ in range(20):
        seen_many.append(many.step(np.full(8, EAST))[0][3:5])
        seen_few.append(few.step(np.full(2, EAST))[0])
    np.testing.assert_array_equal(seen_many, seen_few)
    np.testing.assert_array_equal(few.reset(seed=[5, 14])[0][1], seen_few[0][0])


def test_vector_copies_follow_the_tables() -> None:
    envs = WorldVectorEnv("maze89", num_envs=4000, autoreset_mode="SameStep")
    model = model_of(envs.world)
    _, info = envs.reset(seed=0)
    after = envs.step(np.full(4000, EAST))[4]["state"]
    expected = np.asarray(model.trans)[EAST][info["state"]].mean(axis=0)
    goes_on = ~np.asarray(model.terminal)
    assert np.abs(np.bincount(after, minlength=92) / 4000 - expected)[goes_on].max() < 0.01


def test_vector_copies_render() -> None:
    envs = WorldVectorEnv("hallway", num_envs=3, render_mode="rgb_array")
    assert envs.render() is None
    envs.reset(seed=0)
    pictures = envs.render()
    assert len(pictures) == 3
    assert pictures[0].dtype == np.uint8


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"num_envs": 0}, "num_envs must be at least 1, got 0"),
        ({"autoreset_mode": AutoresetMode.DISABLED}, "autoreset_mode must be NEXT_STEP or SAME_STEP"),
    ],
)
def test_bad_vectors_are_refused(given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        WorldVectorEnv("hallway", **given)


def test_bad_calls_are_refused() -> None:
    envs = WorldVectorEnv("hallway", num_envs=2)
    with pytest.raises(ValueError, match="reset must be called before step"):
        envs.step([0, 0])
    with pytest.raises(ValueError, match="seed must be one number or 2, got 3"):
        envs.reset(seed=[1, 2, 3])
    envs.reset(seed=0)
    for actions in ([0], [0, 4], [-1, 0]):
        with pytest.raises(ValueError, match=r"actions must have shape \(2,\) with values in 0..3"):
            envs.step(actions)
    env = WorldEnv("hallway")
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must be in 0\.\.3, got 4"):
        env.step(4)
