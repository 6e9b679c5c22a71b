"""The whole agent, small: rounds repeat, stop and go on exactly; who is held, kept and judged."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.agents import experience, learner, trial
from jaxpomdp.agents.agent import Agent, AgentConfig, make_agent
from jaxpomdp.agents.control import ControlConfig, Schedule
from jaxpomdp.agents.presets import TMAZE, UDHMM
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.agents.trial import run_trials
from jaxpomdp.envs.tmaze import tmaze
from jaxpomdp.experiments import arrays
from jaxpomdp.models import init as starts

WORLD = tmaze(1, step_limit=6)
SEEDS = (5, 6, 7)
PHASES = 3
SETTINGS = {
    "schedule": Schedule(1.0, 0.0, 60),
    "alpha": 0.1,
    "states": 6,
    "node_cap": 8,
    "window": 12,
    "trials_per_phase": 6,
    "minimum_weight": 8.0,
    "split.significance": 0.5,
    "keep_best": 6,
    "revert_margin": 1.0,
    "patience": 0,
    "gate": 0.0,
}
KEY = jax.random.key(1)
COMPILED = (trial._run, learner.refit, learner.replay, learner.gather_evidence, learner.with_returns)


def small(**settings):
    return Agent(WORLD, with_settings(TMAZE, SETTINGS | settings))


def rounds(agent, state, count):
    """Return the states before and after every round, and the rows."""
    states, rows = [state], []
    for _ in range(count):
        state, row = agent.run(states[-1])
        states.append(state)
        rows.append(row)
    return states, rows


def sizes():
    return np.array([function._cache_size() for function in COMPILED])


class Run:
    """A run of several phases, with what it compiled."""

    def __init__(self):
        before = sizes()
        self.agent = small()
        self.states, self.rows = rounds(self.agent, self.agent.init(SEEDS), PHASES)
        self.compiled = sizes() - before


@pytest.fixture(scope="module")
def run():
    return Run()


def assert_equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)


def outcomes(row):
    return {
        name: row[name] for name in ("steps", "reward", "discounted", "success", "states", "log_evidence")
    }


def test_a_run_compiles_each_function_at_most_once(run):
    compiled = dict(zip((f.__name__ for f in COMPILED), run.compiled.tolist(), strict=True))
    assert max(compiled.values()) == 1, compiled


def test_rows_have_one_number_a_trial(run):
    for row in run.rows:
        assert row["steps"].shape == row["success"].shape == (3, 6)
        assert (row["steps"] >= 1).all()
        assert (row["steps"] <= WORLD.step_limit).all()
        assert row["states"].shape == row["acting"].shape == (3,)
    np.testing.assert_array_equal(run.states[-1].actor.trials, PHASES * 6)


def test_splits_are_logged_and_grow_the_model(run):
    grown = np.asarray(run.states[-1].params.alive).sum(-1)
    edits = np.bincount([row["seed_index"] for row in run.agent.log], minlength=3)
    assert edits.sum() >= 1
    assert ((grown > 6) == (edits > 0)).all()
    np.testing.assert_array_equal(run.rows[-1]["states"], grown)


def test_a_saved_state_goes_on_to_the_same_result(run):
    fresh = small()
    template = fresh.init(SEEDS)
    loaded = arrays.unflatten(template, arrays.flatten(run.states[1]))
    assert_equal(loaded, run.states[1])
    states, rows = rounds(fresh, loaded, PHASES - 1)
    assert_equal(states[-1], run.states[-1])
    for row, expected in zip(rows, run.rows[1:], strict=True):
        assert_equal(outcomes(row), outcomes(expected))


def test_a_run_repeats_itself(run):
    agent = small()
    state, row = agent.run(agent.init(SEEDS))
    assert_equal(outcomes(row), outcomes(run.rows[0]))
    assert_equal(state, run.states[1])


def test_experience_holds_the_latest_trials(run):
    store = run.states[-1].experience
    np.testing.assert_array_equal(store.lengths[:, 6:] - 1, run.rows[-1]["steps"])
    np.testing.assert_array_equal(store.lengths[:, :6] - 1, run.rows[-2]["steps"])


def test_the_best_score_is_the_best_standing_so_far(run):
    averages = np.stack(
        [np.minimum(row["discounted"].mean(axis=1), row["discounted"][:, -1]) for row in run.rows]
    )
    for state, best in zip(run.states[1:], np.maximum.accumulate(averages), strict=True):
        np.testing.assert_allclose(state.best.score, best)
    np.testing.assert_array_equal(run.states[-1].recent, run.rows[-1]["discounted"])


def test_rehearsals_come_last_are_greedy_and_teach_no_values():
    agent = small(rehearsals=2, schedule=Schedule(1.0, 1.0, 1, "constant"))
    state = agent.init(SEEDS)
    state = state._replace(actor=replace(state.actor, q=state.actor.q.at[..., 2].set(50)))
    actor, new = agent._act(state)
    free = run_trials(agent.family, agent.config.control, WORLD, state.params, state.actor, trials=4)[0]
    np.testing.assert_array_equal(actor.q, free.q)
    np.testing.assert_array_equal(actor.trials, 6)
    for trials in new:
        assert len(trials.lengths) == 4 + 2
        explored, rehearsed = np.split(trials.actions, [trials.lengths[:4].sum()])
        made = np.delete(rehearsed, np.cumsum(trials.lengths[4:]) - 1)
        assert (made == 2).all()
        assert not (explored == 2).all()
    after, rows = agent.run(state)
    assert rows["steps"].shape == (3, 6)
    np.testing.assert_array_equal(after.experience.lengths[:, -6:] - 1, rows["steps"])


def test_a_phase_of_rehearsals_alone_is_refused():
    with pytest.raises(ValueError, match="rehearsals must be from 0 to trials_per_phase - 1 = 5, got 6"):
        small(rehearsals=6)


def test_finish_goes_back_where_an_earlier_policy_was_better(run):
    state = run.states[-1]
    best = state.best._replace(score=np.array([99.0, -99.0, 99.0]), q=state.actor.q + 1)
    state = state._replace(best=best, recent=np.zeros((3, 6)))
    ended = run.agent.finish(state)
    moved = np.asarray(ended.actor.q - state.actor.q > 0.5).reshape(3, -1)
    np.testing.assert_array_equal(moved.all(axis=1), [True, False, True])
    assert not moved[1].any()
    np.testing.assert_array_equal(ended.params.log_trans[0], state.best.params.log_trans[0])
    np.testing.assert_array_equal(ended.params.log_trans[1], state.params.log_trans[1])


def test_finish_stays_where_the_difference_may_be_chance(run):
    state = run.states[-1]
    recent = np.tile([0.0, 2.0], (3, 3))
    best = state.best._replace(
        score=recent.mean(axis=1) + np.array([0.5, 0.65, 0.5]),
        q=state.actor.q + 1,
        error=np.array([0.4, 0.4, 0]),
    )
    ended = run.agent.finish(state._replace(best=best, recent=recent))
    moved = np.asarray(ended.actor.q - state.actor.q > 0.5).reshape(3, -1).all(axis=1)
    np.testing.assert_array_equal(moved, [False, True, True])


def test_an_unfinished_average_is_no_reason_to_go_back(run):
    ended = run.agent.finish(run.states[0])
    assert_equal(ended, run.states[0])


def test_seeds_that_do_well_keep_their_model(run):
    agent = small(gate=0.7, edits_per_phase=0)
    after, _ = agent.run(run.states[1])
    returns = experience.start_returns(after.experience, 0.999, latest=20)
    held = [r.mean() > 0 and r.std() < 0.7 * r.mean() for r in returns]
    for s, is_held in enumerate(held):
        same = np.array_equal(after.params.log_trans[s], run.states[1].params.log_trans[s])
        assert same == is_held
    everyone = agent._held(after._replace(experience=certain(after.experience)))
    assert everyone.all()
    assert not agent._held(run.states[0]).any()


def certain(store):
    """Return experience in which every trial pays the same."""
    begins = np.cumsum(store.lengths, axis=1) - store.lengths
    rewards = np.zeros_like(store.rewards)
    np.put_along_axis(rewards, begins, 1.0, axis=1)
    return store._replace(rewards=rewards)


def given_values(seeds, best_action=1):
    params = starts.stack_models([starts.random_params(int(seed), 2, 4, 6) for seed in seeds])
    return params, jnp.zeros((len(seeds), 2, 4)).at[:, :, best_action].set(1.0)


def test_evaluation_is_greedy_and_changes_nothing():
    control = ControlConfig(alpha=0.5, schedule=Schedule(1.0, 1.0, 1, "constant"))
    agent = Agent(WORLD, AgentConfig(control, None), fixed=given_values)
    state = agent.init(SEEDS)
    before = arrays.flatten(state)
    rows = agent.evaluate(state, 4, KEY)
    assert_equal(arrays.flatten(state), before)
    np.testing.assert_array_equal(rows["steps"], WORLD.step_limit)
    assert not rows["success"].any()
    assert_equal(agent.evaluate(state, 4, KEY), rows)


def test_settings_are_found_by_name():
    changed = with_settings(UDHMM, {"theta": 0.4, "split.stay": 0.5, "learner.prior.variance_floor": 0.1})
    assert (changed.learner.theta, changed.learner.split.stay) == (0.4, 0.5)
    assert changed.learner.prior.variance_floor == 0.1
    assert replace(changed.learner, theta=0.0, split=UDHMM.learner.split, prior=UDHMM.learner.prior) == (
        UDHMM.learner
    )
    assert make_agent("udhmm", WORLD, alpha=0.5).config.control.alpha == 0.5


def test_settings_that_are_no_settings_are_refused():
    both = "learner.prior.variance_floor, learner.split.variance_floor"
    with pytest.raises(ValueError, match=f"setting 'variance_floor' is ambiguous: {both}"):
        with_settings(UDHMM, {"variance_floor": 1.0})
    with pytest.raises(
        ValueError, match=r"setting 'thta' is unknown; the settings are control, control\.alpha"
    ):
        with_settings(UDHMM, {"thta": 1.0})
    with pytest.raises(ValueError, match="theta must be at least 0, got -1"):
        make_agent("udhmm", WORLD, theta=-1)
    with pytest.raises(ValueError, match=r"agent must be one of cudhmm, .*pda, udhmm"):
        make_agent("udhm", WORLD)
    with pytest.raises(ValueError, match=r"config\.learner must be given where no fixed model is"):
        Agent(WORLD, AgentConfig(learner=None))


def test_learning_beats_the_random_walk():
    agent = small(edits_per_phase=0)
    _, rows = rounds(agent, agent.init(SEEDS), 12)
    walk = rows[0]["steps"].mean()
    assert np.mean([row["steps"].mean() for row in rows[-3:]]) < 0.8 * walk


@pytest.mark.slow
def test_udhmm_learns_to_remember_the_signal():
    agent = make_agent("udhmm-tmaze", tmaze(4))
    state = agent.init(range(3))
    for _ in range(300 // agent.config.learner.trials_per_phase):
        state, _ = agent.run(state)
    success = agent.evaluate(agent.finish(state), 50, KEY)["success"].mean(axis=1)
    assert np.median(success) >= 0.95
