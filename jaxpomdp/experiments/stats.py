"""What 21 runs say: a value and how far it could be off.

Counts carry Wilson intervals, medians and means seeded bootstrap intervals, and the median run is a run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

CONFIDENCE = 0.95
RESAMPLES = 4000


class Interval(NamedTuple):
    """A value with the ends of its confidence interval, in the value's own unit."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """Return ``value [low, high]``."""
        return format_interval(self)


def format_interval(interval: Interval, digits: int = 1) -> str:
    """Return ``value [low, high]``; without the brackets where the interval has no width.

    >>> format_interval(Interval(92.04, 88.0, 95.5))
    '92.0 [88.0, 95.5]'
    >>> format_interval(Interval(3.0, 3.0, 3.0), digits=0)
    '3'
    """
    value, low, high = (f"{x:.{digits}f}" for x in interval)
    return value if interval.low == interval.high else f"{value} [{low}, {high}]"


def wilson(successes: int, runs: int, confidence: float = CONFIDENCE) -> Interval:
    """Return ``successes`` out of ``runs`` with the Wilson score interval, both in runs.

    The interval holds the proportions ``p`` with ``|k/n - p| <= z sqrt(p (1 - p) / n)`` (Wilson 1927).

    Raises:
        ValueError: ``successes`` is not within ``0..runs``, or there are no runs.

    >>> wilson(21, 21)
    Interval(value=21.0, low=17.7..., high=21.0)
    """
    if not 0 <= successes <= runs or runs < 1:
        raise ValueError(f"successes must be within 0..runs and runs at least 1, got {successes} of {runs}")
    from scipy.stats import binomtest

    ends = binomtest(int(successes), int(runs)).proportion_ci(confidence, method="wilson")
    return Interval(float(successes), float(ends.low) * runs, float(ends.high) * runs)


def bootstrap(
    values: ArrayLike, statistic: Callable = np.median, *, confidence: float = CONFIDENCE, seed: int = 0
) -> Interval:
    """Return ``statistic(values)`` with its percentile bootstrap interval, the same for the same values.

    Args:
        values: one number per run, ``[S]``.
        statistic: ``np.median``, ``np.mean`` or another function of an array and its ``axis``.
        confidence: the share of resampled statistics that the interval holds.
        seed: of the resampling.

    Raises:
        ValueError: there are no values, or one is NaN.
    """
    sample = _numbers(values)
    value = float(statistic(sample, axis=-1))
    if np.all(sample == sample[0]):
        return Interval(value, value, value)
    from scipy import stats

    draw = np.random.default_rng(seed)
    settings: dict[str, Any] = {"n_resamples": RESAMPLES, "confidence_level": confidence}
    found = stats.bootstrap((sample,), statistic, method="percentile", rng=draw, **settings)
    ends = found.confidence_interval
    return Interval(value, float(ends.low), float(ends.high))


def trimmed_mean(values: ArrayLike, axis: int = -1, cut: float = 0.25) -> np.ndarray:
    """Return the mean without the lowest and highest ``cut`` of the values (.25: the interquartile mean)."""
    from scipy.stats import trim_mean

    return trim_mean(np.asarray(values, dtype=float), cut, axis=axis)


def exact(value: float) -> Interval:
    """Return a value that has no spread of its own, such as the worst of the runs."""
    return Interval(float(value), float(value), float(value))


def median_run(scores: ArrayLike, tie_break: ArrayLike | None = None) -> int:
    """Return the index of the run of median score; of an even number of runs the lower of the middle two.

    The thesis plots this run: "median in the sense of median percentage success" (section 3.5.3).

    Args:
        scores: ``[S]``, higher is better.
        tie_break: ``[S]``, lower is better, orders runs of equal score.

    >>> median_run([90.0, 70.0, 80.0])
    2
    """
    score = _numbers(scores)
    ties = np.zeros(score.size) if tie_break is None else _numbers(tie_break)
    order = np.lexsort((-ties, score))
    return int(order[(score.size - 1) // 2])


def _numbers(values: ArrayLike) -> np.ndarray:
    """Return ``values`` as a checked float vector."""
    array = np.asarray(values, dtype=float).reshape(-1)
    if array.size == 0 or np.isnan(array).any():
        bad = int(np.isnan(array).sum())
        raise ValueError(f"values must be numbers, at least one, got {array.size} of which {bad} NaN")
    return array
