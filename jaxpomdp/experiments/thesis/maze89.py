"""What the experiments in the 89-state maze share: the runs, and how their curves are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Measured
from jaxpomdp.experiments.plots import Curve, Line, learning_curves
from jaxpomdp.experiments.results import Criterion
from jaxpomdp.experiments.stats import median_run

SOURCE = "thesis, Table 3.1 and section 3.5.3"
TRIALS = 6000
CRITERION = Criterion("goal_percent", 92.0, last=2)
"""As good as the thesis's UDHMM, at the last two evaluations."""


def run(agent: str, trials: int = TRIALS, **settings: float) -> RunConfig:
    """Return a run in the maze, judged every 250 trials and on 251 trials at the end."""
    return RunConfig("maze89", agent, trials=trials, evaluate_every=250, settings=tuple(settings.items()))


THETA_02 = run("udhmm-thesis", theta=0.2)
THETA_0 = run("udhmm-thesis", theta=0.0)
BEST = run("udhmm")


def draw_curves(
    measured: Sequence[Measured], path: Path, metric: str, ylabel: str, lines: Sequence[Line]
) -> Path:
    """Draw a score of the greedy tests against trials, the run of median goal % thick."""
    curves = [curve(m, metric) for m in measured if m.run is not None]
    title = "89-state maze: greedy tests while learning; median run, middle half of the runs"
    return learning_curves([(ylabel, curves, lines)], path, title=title, xlabel="training trials")


def curve(measured: Measured, metric: str) -> Curve:
    """Return one row's course; the median run is the one of median final goal %."""
    table = measured.run.evaluations if measured.run is not None else {}
    median = median_run(measured.per_seed["goal_percent"], measured.per_seed["median_steps"])
    return Curve(measured.row.name, table["trial"][0], table[metric], median)


def plot_goal(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw Figure 3.9."""
    lines = [Line("thesis 92", 92)]
    return draw_curves(measured, path, "goal_percent", "tests that reach the goal, %", lines)


def plot_steps(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw Figure 3.10."""
    return draw_curves(measured, path, "median_steps", "median steps", [Line("thesis 62", 62)])
