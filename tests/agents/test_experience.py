"""Memory of trials: exactly the last K, and tapes on which each lies once and whole."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.agents import experience
from jaxpomdp.agents.experience import Trials

WINDOW = 4
phases_of_lengths = st.lists(
    st.tuples(*[st.lists(st.integers(2, 9), min_size=1, max_size=5)] * 2), min_size=1, max_size=3
)


def trials_of(lengths, serial):
    """Return trials of which every step is unlike any other: numbered from ``serial``."""
    size = sum(lengths)
    steps = serial + np.arange(size)
    over = np.array([(serial + i) % 2 == 0 for i in range(len(lengths))])
    return Trials(
        np.array(lengths),
        over,
        np.where(over, 0, serial + np.arange(len(lengths))).astype(np.float32),
        (steps.astype(np.int32), np.stack([steps, -steps], axis=-1).astype(np.float32)),
        (steps % 7).astype(np.int32),
        steps.astype(np.float32) / 2,
    )


def singles(trials):
    """Cut into trials, one of ``Trials`` each."""
    ends = np.cumsum(trials.lengths)
    return [
        Trials(
            trials.lengths[i : i + 1],
            trials.terminated[i : i + 1],
            trials.tail[i : i + 1],
            tuple(channel[end - length : end] for channel in trials.observations),
            trials.actions[end - length : end],
            trials.rewards[end - length : end],
        )
        for i, (end, length) in enumerate(zip(ends, trials.lengths, strict=True))
    ]


def remembered(phases):
    """Return the store after all phases, and what each seed should remember, trial by trial."""
    store = experience.no_experience(2, WINDOW, (np.int32(0), np.zeros(2, np.float32)))
    expected, serial = [[], []], 0
    for phase in phases:
        new = []
        for s, lengths in enumerate(phase):
            new.append(trials_of(lengths, serial))
            expected[s] += singles(new[-1])
            serial += sum(lengths)
        store = experience.remember(store, new)
    return store, [seed[-WINDOW:] for seed in expected]


def assert_equal_trials(found, expected):
    assert len(found) == len(expected)
    for one, other in zip(found, expected, strict=True):
        pairs = zip(parts(one), parts(other), strict=True)
        for a, b in pairs:
            np.testing.assert_array_equal(a, b)


def parts(trial):
    return (*trial[:3], *trial.observations, *trial[4:])


@settings(max_examples=30, deadline=None)
@given(phases_of_lengths)
def test_the_last_trials_are_kept_exactly(phases):
    store, expected = remembered(phases)
    for s in range(2):
        assert_equal_trials(singles(experience.of_seed(store, s)), expected[s])


def read_tape(tapes, s):
    """Read a seed's tapes step by step: a list of trials, in the order of their numbers."""
    batch, found = tapes.batch, {}
    rows, width = batch.valid.shape[1:]
    for row in range(rows):
        for t in range(width):
            if not batch.valid[s, row, t]:
                assert not batch.start[s, row, t]
                assert not batch.has_return[s, row, t]
                assert tapes.trial[s, row, t] == -1
                continue
            number = int(tapes.trial[s, row, t])
            if batch.start[s, row, t]:
                assert number not in found
                found[number] = []
            found[number].append((row, t))
    return [found[number] for number in sorted(found)]


@settings(max_examples=15, deadline=None)
@given(phases_of_lengths)
def test_tapes_hold_each_trial_once_and_whole(phases):
    store, expected = remembered(phases)
    tapes = experience.tapes_of(store, least=8)
    for s in range(2):
        read = read_tape(tapes, s)
        assert len(read) == len(expected[s])
        for places, trial in zip(read, expected[s], strict=True):
            check_trial(tapes, s, places, trial)


def check_trial(tapes, s, places, trial):
    rows, steps = np.array(places).T
    assert (rows == rows[0]).all()
    np.testing.assert_array_equal(steps, steps[0] + np.arange(trial.lengths[0]))
    batch, last = tapes.batch, len(places) - 1
    for channel, values in zip(batch.observations, trial.observations, strict=True):
        np.testing.assert_array_equal(channel[s, rows, steps], values)
    np.testing.assert_array_equal(batch.actions[s, rows, steps], trial.actions)
    np.testing.assert_array_equal(batch.rewards[s, rows, steps], trial.rewards)
    is_last = np.arange(len(places)) == last
    np.testing.assert_array_equal(batch.start[s, rows, steps], np.arange(len(places)) == 0)
    np.testing.assert_array_equal(batch.has_return[s, rows, steps], ~is_last)
    np.testing.assert_array_equal(batch.terminated[s, rows, steps], is_last & trial.terminated[0])
    np.testing.assert_array_equal(batch.observed[s, rows, steps], True)
    np.testing.assert_array_equal(tapes.tail[s, rows, steps], np.where(is_last, trial.tail[0], 0))


def test_the_reading_would_notice_a_cut_trial():
    store, expected = remembered([([5, 6], [7])])
    tapes = experience.tapes_of(store, least=8)
    tapes.batch.start[0, 0, 2] = True
    with pytest.raises(AssertionError):
        read_tape(tapes, 0)
    tapes.batch.start[0, 0, 2] = False
    tapes.batch.actions[0, 0, 1] += 1
    with pytest.raises(AssertionError):
        check_trial(tapes, 0, read_tape(tapes, 0)[0], expected[0][0])


def test_start_returns_are_discounted_and_of_the_latest_trials():
    store = experience.no_experience(1, 3, (np.int32(0),))
    trials = Trials(
        np.array([3, 2]),
        np.array([True, False]),
        np.zeros(2, np.float32),
        (np.zeros(5, np.int32),),
        np.zeros(5, np.int32),
        np.array([1, 2, 9, 4, 9], np.float32),
    )
    store = experience.remember(store, [trials])
    np.testing.assert_allclose(experience.start_returns(store, 0.5, latest=5)[0], [2.0, 4.0])
    np.testing.assert_allclose(experience.start_returns(store, 0.5, latest=1)[0], [4.0])
    empty = experience.no_experience(1, 3, (np.int32(0),))
    assert len(experience.start_returns(empty, 0.5, latest=5)[0]) == 0


class FakeLog(NamedTuple):
    observation: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    arrived: np.ndarray
    active: np.ndarray
    ended: np.ndarray
    terminated: np.ndarray
    best: np.ndarray


def test_a_log_is_cut_where_trials_ended():
    columns = [[1, 2, 5, 0], [3, 0, 1, 9], [0.5, 1, 2, 9], [2, 3, 6, 9]]
    flags = [[1, 1, 1, 0], [0, 1, 1, 0], [0, 1, 0, 1], [7, 8, 9, 9]]
    columns = [np.array(values)[None] for values in columns]
    log = FakeLog(*columns, *(np.array(flag, bool)[None] for flag in flags[:3]), np.array(flags[3])[None])
    (trials,) = experience.split_log(log, 4)
    np.testing.assert_array_equal(trials.lengths, [3, 2])
    np.testing.assert_array_equal(trials.observations[0], [1, 2, 3, 5, 6])
    np.testing.assert_array_equal(trials.actions, [3, 0, 0, 1, 0])
    np.testing.assert_array_equal(trials.rewards, [0.5, 1, 0, 2, 0])
    np.testing.assert_array_equal(trials.terminated, [True, False])
    np.testing.assert_array_equal(trials.tail, [0, 9])


def test_rows_of_very_long_trials_are_not_half_empty():
    """A trial just over a power of two doubled every array, and a T-maze of length 200 ran out of memory."""
    store = experience.no_experience(1, 2, (np.int32(0), np.zeros(2, np.float32)))
    store = experience.remember(store, [trials_of([4101, 4101], 0)])
    tapes = experience.tapes_of(store)
    assert 4101 <= tapes.batch.actions.shape[-1] < 1.25 * 4101
