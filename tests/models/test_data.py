from __future__ import annotations

import numpy as np
import pytest

from jaxpomdp.models.data import trial_batch


def test_the_time_line() -> None:
    batch = trial_batch([[3, 1, 2], [0, 1]], [[1, 0], [1]], [[1.0, 2.0], [4.0]], gamma=0.5)
    np.testing.assert_array_equal(batch.observations[0], [[3, 1, 2], [0, 1, 0]])
    np.testing.assert_array_equal(batch.actions, [[1, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(batch.rewards, [[1, 2, 0], [4, 0, 0]])
    np.testing.assert_array_equal(batch.returns, [[2, 2, 0], [4, 0, 0]])
    np.testing.assert_array_equal(batch.valid, [[1, 1, 1], [1, 1, 0]])
    np.testing.assert_array_equal(batch.start, [[1, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(batch.terminated, [[0, 0, 1], [0, 1, 0]])
    np.testing.assert_array_equal(batch.observed, batch.valid)
    np.testing.assert_array_equal(batch.has_return, [[1, 1, 0], [1, 0, 0]])


def test_a_trial_that_was_cut_off_needs_a_tail() -> None:
    trials = {"observations": [[0, 1], [1, 0]], "actions": [[0], [0]], "rewards": [[1.0], [1.0]]}
    trials["gamma"] = 0.5
    cut = trial_batch(**trials, terminated=[True, False])
    np.testing.assert_array_equal(cut.has_return, [[1, 0], [0, 0]])
    np.testing.assert_array_equal(cut.terminated, [[0, 1], [0, 0]])
    guessed = trial_batch(**trials, terminated=[True, False], tails=[9.0, 8.0])
    np.testing.assert_array_equal(guessed.returns, [[1, 0], [5, 8]])
    np.testing.assert_array_equal(guessed.has_return, [[1, 0], [1, 0]])
    assert not trial_batch([[0, 1]], [[0]]).has_return.any()


def test_missing_steps() -> None:
    vectors = [[[1.0, 2.0], [np.nan, 0.0], None], [[3.0, 4.0]]]
    batch = trial_batch(([[0, None, 1], [None]], vectors))
    np.testing.assert_array_equal(batch.observed, [[1, 0, 0], [0, 0, 0]])
    np.testing.assert_array_equal(batch.observations[1][0], [[1, 2], [0, 0], [0, 0]])
    assert batch.observations[1].shape == (2, 3, 2)
    assert np.isfinite(batch.observations[1]).all()


def test_numbers_are_vectors_of_one() -> None:
    assert trial_batch([np.array([0.5, 1.5]), [1, 2, 3]]).observations[0].shape == (2, 3, 1)


def test_packing_lays_trials_end_to_end() -> None:
    lengths = (2, 6, 3, 1, 4)
    trials = [[i] * n for i, n in enumerate(lengths)]
    batch = trial_batch(trials, pack=True)
    assert batch.valid.shape == (3, 6)
    assert int(batch.valid.sum()) == sum(lengths)
    assert int(batch.start.sum()) == len(lengths)
    for i, n in enumerate(lengths):
        assert int((batch.valid & (batch.observations[0] == i)).sum()) == n
    assert trial_batch(trials, pack=True, length=16).valid.shape == (1, 16)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"observations": []}, "observations must hold at least one trial"),
        ({"observations": [[]]}, r"observations\[0\] must hold at least one step"),
        ({"observations": [[None]]}, "at least one observation"),
        ({"observations": [["a"]]}, r"observations\[0\] must be integers"),
        ({"observations": [[np.inf]]}, "must be finite"),
        ({"observations": [[[1.0], [1.0, 2.0]]]}, "steps of one size"),
        ({"observations": [[[1.0]], [[1.0, 2.0]]]}, r"one dimension throughout, got \[1, 2\]"),
        ({"observations": [[[1, 2]]]}, "one integer per step"),
        ({"observations": ([[0, 1]], [[0]])}, r"observations\[1\] must have .* lengths \[2\], got \[1\]"),
        ({"actions": [[0, 1, 1]]}, r"actions\[0\] must have shape \(2,\).*got \(3,\)"),
        ({"actions": [[0, 1], [0]]}, "actions must have 1 trials, as observations, got 2"),
        ({"actions": [[0, -1]]}, r"actions\[0\] must be integers from 0"),
        ({"actions": [[0.5, 1.0]]}, r"actions\[0\] must be integers from 0"),
        ({"rewards": [[0.0, np.nan]]}, r"rewards\[0\] must be finite"),
        ({"gamma": 1.5}, r"gamma must be in 0\.\.1, got 1.5"),
        ({"terminated": [True, False]}, "terminated must have one entry per trial"),
        ({"length": 2}, "length must be at least 3"),
    ],
)
def test_errors_name_what_is_wrong(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trial_batch(**{"observations": [[0, 1, 2]], **arguments})
