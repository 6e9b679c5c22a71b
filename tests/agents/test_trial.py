"""The online phase: chance belongs to (seed, trial, step), and what happens is what the parts say."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.agents.control import ControlConfig, Schedule
from jaxpomdp.agents.experience import split_log
from jaxpomdp.agents.trial import Actor, run_trials
from jaxpomdp.envs import registry
from jaxpomdp.envs.host import HostWorld
from jaxpomdp.envs.tmaze import tmaze
from jaxpomdp.envs.wrappers import limited
from jaxpomdp.kernels import native
from jaxpomdp.kernels.control import ReplayData, replay_tape
from jaxpomdp.models import init as starts
from jaxpomdp.models.flat import FLAT

WORLD = tmaze(1, step_limit=4)
CONTROL = ControlConfig(alpha=0.2, gamma=0.9, lam=0.8, schedule=Schedule(0.5, 0.5, 1, "constant"))
SEEDS, TRIALS, STATES = (11, 12, 13), 3, 3
DRAWS = 6
"""Three numbers for a step of the world, then three for a choice."""


def keys_of(seeds):
    return jnp.stack([jax.random.key_data(jax.random.key(seed)) for seed in seeds])


def models_of(seeds):
    return starts.stack_models([starts.random_params(seed, STATES, 4, 6) for seed in seeds])


def actor_of(seeds, first_trial=2):
    count = jnp.zeros(len(seeds), jnp.int32)
    q = jnp.zeros((len(seeds), STATES, 4))
    return Actor(keys_of(seeds), q, count + first_trial, count)


def behaviour(seeds):
    actor, log, count = run_trials(FLAT, CONTROL, WORLD, models_of(seeds), actor_of(seeds), trials=TRIALS)
    return actor, split_log(log, int(count))


@pytest.fixture(scope="module")
def usual():
    return behaviour(SEEDS)


def assert_same(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def draws_of(seed, trial):
    key = jax.random.fold_in(jax.random.key(seed), trial)
    return np.asarray(jax.random.uniform(key, (WORLD.step_limit + 1, DRAWS)))


def test_seeds_keep_their_behaviour_when_they_change_places(usual):
    actor, trials = usual
    order = [2, 0, 1]
    moved_actor, moved = behaviour([SEEDS[i] for i in order])
    for place, i in enumerate(order):
        assert_same(moved[place], trials[i])
        np.testing.assert_allclose(moved_actor.q[place], actor.q[i], atol=1e-6)


def test_seeds_keep_their_behaviour_in_other_company(usual):
    _, others = behaviour((97, 98, 13))
    assert_same(others[2], usual[1][2])
    assert not np.array_equal(others[1].actions, usual[1][1].actions)


def by_hand(trials, seed, first_trial=2):
    """Step the world on the host with the numbers of (seed, trial, step) and the logged actions."""
    host, seen, rewards, terminated = HostWorld(WORLD), [], [], []
    actions = iter(trials.actions)
    for k, length in enumerate(trials.lengths):
        draws = draws_of(seed, first_trial + k)
        state, observation = host.reset(draws[0, :2])
        seen.append(observation)
        for t in range(length - 1):
            out = host.step(state, int(next(actions)), draws[t + 1, :3])
            state = out.state
            seen.append(out.observation)
            rewards.append(out.reward)
        next(actions)
        rewards.append(0.0)
        terminated.append(out.terminated)
    return seen, rewards, terminated


def test_trials_are_what_the_world_does_with_the_same_numbers(usual):
    for trials, seed in zip(usual[1], SEEDS, strict=True):
        seen, rewards, terminated = by_hand(trials, seed)
        np.testing.assert_array_equal(trials.observations[0], seen)
        np.testing.assert_allclose(trials.rewards, rewards, atol=1e-6)
        np.testing.assert_array_equal(trials.terminated, terminated)
        assert all(trials.terminated | (trials.lengths == WORLD.step_limit + 1))


def test_the_hand_would_notice_other_numbers(usual):
    seen = [by_hand(t, seed, first_trial=7)[0] for t, seed in zip(usual[1], SEEDS, strict=True)]
    assert any(not np.array_equal(t.observations[0], s) for t, s in zip(usual[1], seen, strict=True))


def test_exploration_is_where_its_number_says(usual):
    explored = 0
    for trials, seed in zip(usual[1], SEEDS, strict=True):
        begins = np.cumsum(trials.lengths) - trials.lengths
        for k, (begin, length) in enumerate(zip(begins, trials.lengths, strict=True)):
            u = draws_of(seed, 2 + k)[: length - 1, 3:5]
            made = u[:, 0] < 0.5
            explored += made.sum()
            actions = trials.actions[begin : begin + length - 1]
            np.testing.assert_array_equal(actions[made], (4 * u[made, 1]).astype(int))
    assert explored > 5


def beliefs_of(params, trials, s):
    """Filter a seed's trials in plain float64."""
    start, trans = np.exp(np.float64(params.log_init[s])), np.exp(np.float64(params.log_trans[s]))
    seen = np.exp(np.float64(params.emissions[0].log_prob[s]))[:, trials.observations[0]].T
    first = np.zeros(len(seen), bool)
    first[np.cumsum(trials.lengths) - trials.lengths] = True
    rows = []
    for t in range(len(seen)):
        prior = start if first[t] else rows[-1] @ trans[trials.actions[t - 1]]
        rows.append(prior * seen[t] / (prior * seen[t]).sum())
    return np.array(rows), first


def test_learning_in_the_loop_is_learning_from_the_tape(usual):
    actor, all_trials = usual
    params = models_of(SEEDS)
    for s, trials in enumerate(all_trials):
        beliefs, first = beliefs_of(params, trials, s)
        over = np.zeros(len(first), bool)
        over[np.cumsum(trials.lengths) - 1] = trials.terminated
        size = TRIALS * (WORLD.step_limit + 1)
        padded = [np.concatenate([x, np.zeros((size - len(x), *x.shape[1:]), x.dtype)]) for x in (
            beliefs.astype(np.float32), trials.actions, trials.rewards, first, np.ones_like(first), over
        )]  # fmt: skip
        q = replay_tape(jnp.zeros((STATES, 4)), ReplayData(*map(jnp.asarray, padded)), 0.2, 0.9, 0.8)
        np.testing.assert_allclose(actor.q[s], q, atol=2e-6)
        assert np.abs(np.asarray(q)).max() > 1e-3


def test_counts_go_on(usual):
    actor, all_trials = usual
    np.testing.assert_array_equal(actor.trials, 5)
    np.testing.assert_array_equal(actor.steps, [(t.lengths - 1).sum() for t in all_trials])


def test_two_calls_are_one(usual):
    models = models_of(SEEDS)
    actor, pieces = actor_of(SEEDS), []
    for _ in range(TRIALS):
        actor, log, count = run_trials(FLAT, CONTROL, WORLD, models, actor, trials=1)
        pieces.append(split_log(log, int(count)))
    for s, whole in enumerate(usual[1]):
        np.testing.assert_array_equal(np.concatenate([p[s].actions for p in pieces]), whole.actions)
        np.testing.assert_array_equal(np.concatenate([p[s].lengths for p in pieces]), whole.lengths)
    np.testing.assert_allclose(actor.q, usual[0].q, atol=1e-6)


@pytest.mark.skipif(not native.available(), reason="needs a C++ compiler for the native kernels")
@pytest.mark.parametrize(
    ("rule", "replacing", "exploration", "world"),
    [
        ("sarsa", False, "epsilon", "maze89"),
        ("q", False, "boltzmann", "maze89"),
        ("q", True, "epsilon", "hallway-noise"),
    ],
)
def test_the_native_kernel_does_what_the_loop_does(rule, replacing, exploration, world):
    world = limited(registry.make(world), 60)
    config = replace(
        CONTROL, alpha=0.05, rule=rule, replacing=replacing, exploration=exploration, sticky=0.5,
        schedule=Schedule(0.4, 0.1, 100),
    )  # fmt: skip
    sizes = (19, world.num_actions, world.num_observations)
    models = starts.stack_models([starts.random_params(seed, *sizes, capacity=24) for seed in SEEDS])
    q = jax.random.normal(jax.random.key(1), (len(SEEDS), 24, world.num_actions))
    actor = replace(actor_of(SEEDS), q=q)
    loop, kernel = (
        run_trials(FLAT, config, world, models, actor, trials=2, plan=plan) for plan in ("loop", "native")
    )
    np.testing.assert_allclose(kernel[0].q, loop[0].q, atol=5e-6)
    assert_same(kernel[0].steps, loop[0].steps)
    for one, other in zip(split_log(*loop[1:]), split_log(*kernel[1:]), strict=True):
        for name, mine, theirs in zip(one._fields, one, other, strict=True):
            np.testing.assert_allclose(theirs, mine, atol=1e-5, err_msg=name)


def test_a_plan_that_cannot_run_is_refused():
    with pytest.raises(ValueError, match="plan must be one of"):
        run_trials(FLAT, CONTROL, WORLD, models_of(SEEDS), actor_of(SEEDS), trials=1, plan="fast")


def test_a_model_may_be_shared():
    one = jax.tree.map(lambda x: x[:1], models_of(SEEDS))
    copies = jax.tree.map(lambda x: jnp.repeat(x, len(SEEDS), axis=0), one)
    for plan in ("loop", "auto"):
        shared, many = (
            run_trials(FLAT, CONTROL, WORLD, models, actor_of(SEEDS), trials=2, plan=plan)
            for models in (one, copies)
        )
        np.testing.assert_allclose(shared[0].q, many[0].q, atol=1e-6)


@pytest.mark.slow
def test_without_learning_values_stay():
    actor = replace(actor_of(SEEDS), q=jnp.full((len(SEEDS), STATES, 4), 0.5).at[:, :, 1].set(1.0))
    after, *_ = run_trials(FLAT, CONTROL, WORLD, models_of(SEEDS), actor, trials=TRIALS, learning=False)
    np.testing.assert_array_equal(after.q, actor.q)
