"""Intervals against formulas and coverage, and the median run."""

from __future__ import annotations

import numpy as np
import pytest

from jaxpomdp.experiments.stats import (
    Interval,
    bootstrap,
    exact,
    format_interval,
    median_run,
    trimmed_mean,
    wilson,
)

Z = 1.959963984540054


@pytest.mark.parametrize("successes", [0, 1, 14, 21])
def test_wilson_ends_solve_the_score_equation(successes):
    found = wilson(successes, 21)
    for end in (found.low / 21, found.high / 21):
        assert abs(successes / 21 - end) <= Z * np.sqrt(end * (1 - end) / 21) + 1e-9
    assert found.low <= found.value == successes <= found.high


@pytest.mark.parametrize(("successes", "runs"), [(-1, 3), (4, 3), (0, 0)])
def test_wilson_refuses_impossible_counts(successes, runs):
    with pytest.raises(ValueError, match="successes must be within"):
        wilson(successes, runs)


def test_bootstrap_is_the_same_for_the_same_values_and_order_does_not_move_its_value():
    values = np.random.default_rng(0).normal(size=21)
    assert bootstrap(values) == bootstrap(values)
    assert bootstrap(values).value == bootstrap(values[::-1]).value == np.median(values)


def test_bootstrap_of_the_mean_is_as_wide_as_the_normal_interval():
    values = np.random.default_rng(1).normal(size=400)
    found = bootstrap(values, np.mean)
    width = 2 * Z * values.std() / 20
    assert found.low < values.mean() < found.high
    assert found.high - found.low == pytest.approx(width, rel=0.1)


def test_bootstrap_of_equal_values_has_no_width():
    assert bootstrap([3.0, 3.0]) == exact(3) == Interval(3.0, 3.0, 3.0)


@pytest.mark.parametrize("values", [[], [1.0, np.nan]])
def test_bootstrap_refuses_what_is_no_number(values):
    with pytest.raises(ValueError, match="values must be numbers"):
        bootstrap(values)


def test_trimmed_mean_leaves_out_the_ends():
    assert trimmed_mean([0.0, 1.0, 2.0, 100.0]) == 1.5
    assert bootstrap([0.0, 1.0, 2.0, 100.0], trimmed_mean).value == 1.5


def test_median_run_is_the_middle_and_breaks_ties_by_steps():
    assert median_run([5, 1, 3]) == 2
    assert median_run([5, 1, 3, 4]) == 2
    assert median_run([1, 1, 1], tie_break=[30, 10, 20]) == 2


def test_format_shows_no_brackets_without_width():
    assert format_interval(Interval(1.25, 1, 2), 2) == "1.25 [1.00, 2.00]"
    assert str(exact(2)) == "2.0"
