"""The best policy so far: how it is judged, and when an agent goes back to it or begins again."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.agents import best as keeping
from jaxpomdp.agents.agent import Agent
from jaxpomdp.agents.presets import HUDHMM_TMAZE, TMAZE
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.envs.tmaze import tmaze

K = 20


def params_of(number):
    return {"table": jnp.full((1, 2), float(number))}


def q_of(number):
    return jnp.full((1, 3, 2), float(number))


def test_a_standing_is_the_worse_of_a_long_and_a_short_average():
    rising = np.r_[np.zeros(K - 2), 1, 1][None]
    falling = np.r_[np.ones(K - 2), 0, 1][None]
    np.testing.assert_allclose(keeping.standing(rising)[0], [0.1])
    np.testing.assert_allclose(keeping.standing(falling)[0], [0.8])
    np.testing.assert_allclose(keeping.standing(falling)[1], falling.std() / np.sqrt(K))


def test_a_policy_that_was_just_spoilt_is_not_kept():
    """The long average still rises while old, bad trials leave the window; what is kept stays."""
    best = keeping.none_yet(params_of(0), q_of(0))
    climbing = np.r_[np.zeros(8), np.ones(12)][None]
    best = keeping.judged(best, climbing, params_of(1), q_of(1), 2)
    spoilt = np.r_[np.zeros(4), np.ones(13), 0, 0, 0][None]
    assert spoilt.mean() > climbing.mean()
    best = keeping.judged(best, spoilt, params_of(2), q_of(2), 2)
    np.testing.assert_array_equal(best.q, q_of(1))
    np.testing.assert_array_equal(best.params["table"], params_of(1)["table"])
    assert best.age == [2]
    better = np.r_[np.zeros(2), np.ones(18)][None]
    best = keeping.judged(best, better, params_of(3), q_of(3), 2)
    np.testing.assert_array_equal(best.q, q_of(3))
    np.testing.assert_allclose(best.score, 0.9)
    assert best.age == [0]


def chances(wins):
    """Return a window of good trials, the latest of them as given."""
    return np.r_[np.ones(K - len(wins)), wins][None]


def test_luck_that_ends_with_its_probation_makes_no_best_policy():
    """A policy that was spoilt just now profits from its predecessors' trials and its own lucky ones."""
    at_once = keeping.none_yet(params_of(0), q_of(0))
    waits = keeping.none_yet(params_of(0), q_of(0), probation=4)
    late = np.r_[0.0, np.ones(K - 1)][None]
    told = [
        (1, late),
        (1, late),
        (1, late),
        (2, chances([1, 1])),
        (2, chances([1, 0])),
        (2, chances([1, 0, 0, 1])),
    ]
    for number, recent in told:
        now = (params_of(number), q_of(number), 2)
        at_once, waits = keeping.judged(at_once, recent, *now), keeping.judged(waits, recent, *now, 4)
    np.testing.assert_array_equal(at_once.q, q_of(2))
    np.testing.assert_array_equal(waits.q, q_of(1))
    np.testing.assert_array_equal(waits.params["table"], params_of(1)["table"])
    assert at_once.score == [1.0]
    assert waits.score == [1.0]


def test_an_agent_with_a_probation_ends_with_a_policy_that_served_it():
    waits = keeping.none_yet(params_of(0), q_of(0), probation=4)
    good = chances([])
    assert not keeping.given_up(waits, good, 1.0)[0]
    for _ in range(2):
        waits = keeping.judged(waits, good, params_of(1), q_of(1), 2, 4)
    np.testing.assert_array_equal(waits.q, q_of(0))
    for _ in range(2):
        waits = keeping.judged(waits._replace(score=np.array([0.5])), good, params_of(2), q_of(2), 2, 4)
    np.testing.assert_array_equal(waits.q, q_of(1))
    assert keeping.given_up(waits, good, 1.0)[0]
    assert not keeping.given_up(
        keeping.none_yet(params_of(0), q_of(0))._replace(score=waits.score), good, 1.0
    )[0]


def test_an_agent_that_begins_again_lets_no_policy_wait_that_it_gave_up():
    waits = keeping.none_yet(params_of(1), q_of(1), probation=4)._replace(served=np.array([2]))
    anew = keeping.waiting_anew(waits, np.array([True]), params_of(2), q_of(2))
    np.testing.assert_array_equal(anew.waiting[1], q_of(2))
    assert anew.served == [0]
    same = keeping.waiting_anew(waits, np.array([False]), params_of(2), q_of(2))
    np.testing.assert_array_equal(same.waiting[1], q_of(1))
    assert same.served == [2]


def test_settings_may_come_in_any_order():
    for settings in ({"keep_best": 0, "probation": 0}, {"probation": 70, "keep_best": 80}):
        learner = with_settings(HUDHMM_TMAZE, settings).learner
        assert (learner.keep_best, learner.probation) == (settings["keep_best"], settings["probation"])
    whole = {"theta": 0.7, "learner": TMAZE.learner, "learner.split.stay": 0.5}
    learner = with_settings(HUDHMM_TMAZE, whole).learner
    assert (learner.probation, learner.theta, learner.split.stay) == (0, 0.7, 0.5)
    with pytest.raises(ValueError, match="keep_best must be at least 0, got -1"):
        with_settings(TMAZE, {"keep_best": -1})


def test_a_probation_longer_than_the_average_is_refused():
    with pytest.raises(ValueError, match="probation must be from 0 to keep_best = 60, got 61"):
        with_settings(TMAZE, {"probation": 61})


def test_where_nothing_is_left_to_chance_a_hair_is_no_difference():
    best = keeping.none_yet(params_of(0), q_of(0))._replace(score=np.array([1.0]))
    assert not keeping.clearly_worse(best, np.full((1, K), 0.995), 3.0)[0]
    assert keeping.clearly_worse(best, np.full((1, K), 0.98), 3.0)[0]


def test_a_window_that_is_not_full_counts_as_worse_than_any_best():
    unfull = np.r_[np.nan, np.ones(K - 1)][None]
    best = keeping.none_yet(params_of(0), q_of(0))
    assert not keeping.clearly_worse(best, unfull, 1.0)[0]
    assert keeping.clearly_worse(best._replace(score=np.array([-5.0])), unfull, 1.0)[0]


def waiting(patience):
    settings = {"patience": patience, "keep_best": 10, "window": 20, "gate": 0.0, "em_iterations": 0}
    settings |= {"edits_per_phase": 0, "replay_passes": 0, "alpha": 0.0}
    return Agent(tmaze(1, step_limit=6), with_settings(TMAZE, settings))


def after(agent, rounds):
    state = agent.init(range(3))
    for _ in range(rounds):
        state, _ = agent.run(state)
    return state


def test_an_agent_that_gets_no_better_begins_again():
    start, patient, impatient = waiting(0).init(range(3)), after(waiting(0), 8), after(waiting(10), 8)
    np.testing.assert_array_equal(start.params.log_trans, patient.params.log_trans)
    changed = np.asarray(impatient.params.log_trans != start.params.log_trans).reshape(3, -1).any(axis=1)
    assert changed.all()
    assert (impatient.best.age < 40).all()
    again = after(waiting(10), 8)
    np.testing.assert_array_equal(again.params.log_trans, impatient.params.log_trans)
