"""An agent in Gymnasium environments: turns are the same in every mode, and it learns from all its spaces."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from jaxpomdp.agents.gym_agent import GymAgent
from jaxpomdp.agents.gym_turns import IDLE, Reaction, trials_of, turns_of
from jaxpomdp.agents.presets import TMAZE
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.experiments import arrays

LIMIT = 3
CONFIG = with_settings(
    TMAZE,
    {
        "states": 4,
        "node_cap": 4,
        "window": 12,
        "trials_per_phase": 6,
        "alpha": 0.2,
        "sticky": 0.0,
        "schedule.steps": 150,
        "gate": 0.0,
        "keep_best": 6,
    },
)
PARTS = {
    "discrete": spaces.Discrete(3, start=4),
    "multi": spaces.MultiDiscrete([2, 3]),
    "binary": spaces.MultiBinary(2),
    "box": spaces.Box(-9, 9, (2,)),
}


class Cue(gymnasium.Env):
    """Shows which of two actions is right, in every kind of observation; wrong twice and the trial goes on.

    Right: reward 1, terminated. After ``LIMIT`` actions the trial is truncated.
    """

    observation_space = spaces.Dict(PARTS)
    action_space = spaces.Discrete(2, start=1)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.right, self.t = int(self.np_random.integers(2)), 0
        return self.seen(), {}

    def seen(self):
        noise = self.np_random.normal(size=2) / 10
        return {
            "discrete": np.int64(4 + self.right),
            "multi": np.array([self.right, self.t % 3]),
            "binary": np.array([1, self.right], np.int8),
            "box": np.float32(3 * self.right + noise),
        }

    def step(self, action):
        assert action in (1, 2)
        self.t += 1
        good = action - 1 == self.right
        return self.seen(), float(good), good, not good and self.t >= LIMIT, {}


def copies_of(mode, count=2):
    return SyncVectorEnv([Cue] * count, autoreset_mode=mode)


def played(env, seed, rounds=8):
    """Take the first action always, at values of a half; return each copy's whole trials."""
    turns = turns_of(env)
    reaction = Reaction(np.zeros(turns.copies, int), np.full(turns.copies, 0.5))
    seen = [turns.reset(seed)]
    for _ in range(rounds):
        seen += turns.step(reaction.action)
    return [whole(seen, [reaction] * len(seen), s) for s in range(turns.copies)]


def whole(seen, reactions, s):
    """Cut one copy's trials, leaving out the last one, which has no end yet."""
    last = max(i for i, turn in enumerate(seen) if turn.ended[s])
    cut = [turn._replace(kind=np.where(np.arange(len(turn.kind)) == s, turn.kind, IDLE)) for turn in seen]
    return trials_of(cut[: last + 1], reactions[: last + 1])[s]


def test_trials_are_the_same_in_every_mode():
    """Copies of one seed, alone or together, reset in the same step or the next: the same trials."""
    alone = [played(Cue(), seed, rounds=16)[0] for seed in (3, 4)]
    for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP):
        for trials, expected in zip(played(copies_of(mode), 3, rounds=16), alone, strict=True):
            count = min(len(trials.lengths), len(expected.lengths))
            assert count >= 3
            steps = expected.lengths[:count].sum()
            for a, b in zip(fields(trials), fields(expected), strict=True):
                size = count if len(b) == len(expected.lengths) else steps
                np.testing.assert_array_equal(a[:size], b[:size])


def fields(trials):
    return (*trials[:3], *trials.observations, *trials[4:])


def test_trials_tell_terminated_from_truncated_and_keep_the_last_observation():
    (trials,) = played(Cue(), 3, rounds=14)
    begins = np.cumsum(trials.lengths) - trials.lengths
    for k, (begin, length) in enumerate(zip(begins, trials.lengths, strict=True)):
        right = int(trials.observations[3][begin])
        assert length == (LIMIT + 1 if right else 2)
        assert trials.terminated[k] == (not right)
        assert trials.tail[k] == (0.5 if right else 0)
        np.testing.assert_array_equal(trials.observations[5][begin : begin + length], np.arange(length) % 3)
        expected = np.zeros(length)
        expected[0] = not right
        np.testing.assert_array_equal(trials.rewards[begin : begin + length], expected)
    assert 0 < trials.terminated.mean() < 1


@pytest.fixture(scope="module")
def trained():
    agent, phases = GymAgent(Cue(), CONFIG), []
    rows = agent.train(copies_of(AutoresetMode.NEXT_STEP), 48, seed=1, progress=phases.append)
    return agent, rows, phases


def test_it_learns_from_all_kinds_of_observation(trained):
    agent, rows, phases = trained
    assert rows["steps"].shape == (2, 48)
    assert len(phases) == 8
    judged = agent.evaluate(copies_of(AutoresetMode.NEXT_STEP), 12, seed=9)
    assert judged["steps"].mean() < rows["steps"][:, :12].mean()
    assert judged["steps"].mean() <= 1.5


def test_equal_seeds_give_equal_runs_which_can_be_stopped_and_stored(trained):
    agent, rows, _ = trained
    other, env = GymAgent(Cue(), CONFIG), copies_of(AutoresetMode.NEXT_STEP)
    first = other.train(env, 9, seed=1)
    second = other.train(env, 3)
    np.testing.assert_array_equal(first["steps"], rows["steps"][:, :9])
    assert second["steps"].shape == (2, 3)
    stored = arrays.flatten(other.state)
    jax.tree.map(np.testing.assert_array_equal, arrays.unflatten(agent.state, stored), other.state)


def test_acting_outside_answers_what_is_seen(trained):
    agent, _, _ = trained
    env, right = Cue(), []
    for seed in range(6):
        agent.begin_trial()
        observation, _ = env.reset(seed=seed)
        right.append(agent.act(observation, copy=1) == env.right + 1)
    assert np.mean(right) > 0.8


def test_a_tabular_world_is_learned_through_gymnasium():
    import jaxpomdp.envs.gym  # noqa: F401

    env = gymnasium.make_vec("jaxpomdp/TMaze-v0", num_envs=2, length=1, step_limit=8)
    agent = GymAgent(env, CONFIG)
    rows = agent.train(env, 36, seed=0)
    assert rows["steps"][:, -6:].mean() < rows["steps"][:, :6].mean()


def test_rehearsals_in_gymnasium_teach_no_values_and_end_the_phase():
    import jaxpomdp.envs.gym  # noqa: F401

    env = gymnasium.make_vec("jaxpomdp/TMaze-v0", num_envs=2, length=1, step_limit=8)
    config = replace(CONFIG, learner=replace(CONFIG.learner, rehearsals=2))
    agent, phases = GymAgent(env, config), []
    exploring = config.learner.trials_per_phase - 2
    agent.train(env, exploring, seed=0)
    before = agent.state
    agent.train(env, 1)
    assert np.isinf(agent.state.best.score).all(), "judged before the phase was over"
    np.testing.assert_array_equal(agent.state.actor.q, before.actor.q)
    rows = agent.train(env, 1 + exploring + 2, progress=lambda row: phases.append(row["steps"].shape[1]))
    assert phases == [1, exploring, 2]
    assert rows["steps"].shape == (2, exploring + 3)
    assert not np.array_equal(agent.state.actor.q, before.actor.q)


def test_spaces_that_cannot_be_learned_are_refused():
    with pytest.raises(TypeError, match="the action space must be Discrete, got Box"):
        GymAgent((spaces.Discrete(2), spaces.Box(-1, 1, (1,))))
    with pytest.raises(TypeError, match="observation must come from a space that is Discrete, MultiDiscrete"):
        GymAgent((spaces.Text(5), spaces.Discrete(2)))


def test_misuse_is_refused():
    agent = GymAgent(Cue(), CONFIG)
    with pytest.raises(ValueError, match="the agent must be trained first"):
        agent.act(Cue().reset(seed=0)[0])
    with pytest.raises(ValueError, match="trials must be at least 1, got 0"):
        agent.train(Cue(), 0)
    with pytest.raises(ValueError, match="env must have the spaces of GymAgent"):
        GymAgent((spaces.Discrete(2), spaces.Discrete(2)), CONFIG).train(Cue(), 1)
    with pytest.raises(ValueError, match="env must reset by itself"):
        agent.train(copies_of(AutoresetMode.DISABLED), 1)


def test_other_copies_than_seeds_are_refused(trained):
    with pytest.raises(ValueError, match="env must have 2 copies, one for each seed, got 1"):
        trained[0].evaluate(Cue(), 1)
