"""An experiment is data: rows of settings and published figures, how to analyse runs, how to draw results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.results import Criterion, RunData, outcome, score
from jaxpomdp.experiments.stats import Interval, bootstrap, exact, median_run, wilson

FAR = 1e18
Published = Mapping[str, float | str]


@dataclass(frozen=True)
class Row:
    """One row of a table or one curve of a figure."""

    name: str
    """As it is printed."""
    run: RunConfig | None = None
    """What is run (its seeds are replaced by those asked for); None: a published row, nothing to run."""
    published: Published = field(default_factory=dict)
    """Published figures by metric; a text where it is no number, such as ``">251"``."""
    criterion: Criterion | None = None
    """When a run of this row counts as a success, where rows differ; None: as the experiment says."""


class Measured(NamedTuple):
    """A row with what came of it; ``run`` is None for a row that is published only."""

    row: Row
    run: RunData | None
    per_seed: dict[str, np.ndarray]
    metrics: dict[str, Interval]


@dataclass(frozen=True)
class Experiment:
    """A table or a figure of the thesis."""

    name: str
    """As on the command line, ``table-3.1``."""
    title: str
    """Over the picture and the table."""
    source: str
    """Where the published figures stand."""
    rows: tuple[Row, ...]
    """What is compared."""
    columns: Mapping[str, str]
    """The metrics that are printed, and their headings."""
    plot: Callable[[Experiment, Sequence[Measured], Path], object]
    """Draws the picture."""
    criterion: Criterion | None = None
    """When a run counts as a success, if the experiment counts successes."""
    notes: str = ""
    """What a reader has to know, in Markdown."""


def analyse(row: Row, run: RunData, criterion: Criterion | None) -> Measured:
    """Return what each seed scored in its final greedy trials, and the summary over seeds."""
    per_seed, criterion = score(run.final), row.criterion or criterion
    if criterion is not None:
        found = outcome(criterion, run)
        per_seed |= {
            "success_held": found.held,
            "success_ever": found.ever,
            "trials_to_hold": found.trials_to_hold,
        }
    return Measured(row, run, per_seed, summarise(per_seed))


def summarise(per_seed: Mapping[str, np.ndarray]) -> dict[str, Interval]:
    """Return the metrics of a row from the scores of its seeds.

    ``goal_percent`` and ``median_steps`` are medians over seeds (so those of the median run), with bootstrap
    intervals; ``median_run_steps`` are the steps of that very run; means carry bootstrap intervals and counts
    Wilson intervals. Runs that never hold count as infinitely late in ``trials_to_hold``.
    """
    goal, steps = per_seed["goal_percent"], per_seed["median_steps"]
    metrics = {
        "goal_percent": bootstrap(goal),
        "median_steps": bootstrap(steps),
        "mean_goal_percent": bootstrap(goal, np.mean),
        "worst_goal_percent": exact(goal.min()),
        "median_run_steps": exact(steps[median_run(goal, steps)]),
    }
    for name in ("mean_steps", "mean_reward", "mean_discounted"):
        metrics[name] = bootstrap(per_seed[name], np.mean)
    return metrics | _successes(per_seed)


def _successes(per_seed: Mapping[str, np.ndarray]) -> dict[str, Interval]:
    if "success_held" not in per_seed:
        return {}
    held, ever, late = (per_seed[name] for name in ("success_held", "success_ever", "trials_to_hold"))
    return {
        "successes_held": wilson(int(held.sum()), held.size),
        "successes_ever": wilson(int(ever.sum()), ever.size),
        "trials_to_hold": _with_infinities(late),
    }


def _with_infinities(values: np.ndarray) -> Interval:
    """Return the median of values some of which may be infinite, which is then far beyond all others."""
    found = bootstrap(np.where(np.isinf(values), FAR, values))
    return Interval(*(np.inf if x > FAR / 1e6 else x for x in found))
