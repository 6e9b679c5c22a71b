"""Table 3.1: what each algorithm reaches in the 89-state maze."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Measured, Published, Row
from jaxpomdp.experiments.plots import Point, comparison
from jaxpomdp.experiments.thesis import maze89

TARGETS: dict[str, Published] = {
    "random walk": {"goal_percent": 26, "median_steps": ">251"},
    "human": {"goal_percent": 100, "median_steps": 29},
    "linear Q (seeded)": {"goal_percent": 84, "median_steps": 33},
    "SARSA(λ), memoryless": {"goal_percent": 77, "median_steps": 73},
    "RL-LSTM": {"goal_percent": 94, "median_steps": 61},
    "UDHMM, θ = 0.2": {"goal_percent": 92, "median_steps": 62},
}
"""Thesis, Table 3.1; its UDHMM has theta 0.2 (section 3.5.3)."""

SETTINGS: dict[str, RunConfig | None] = {
    "random walk": maze89.run("random", 0),
    "human": None,
    "linear Q (seeded)": maze89.run("seeded-q"),
    "SARSA(λ), memoryless": maze89.run("memoryless"),
    "RL-LSTM": None,
    "UDHMM, θ = 0.2": maze89.THETA_02,
    "UDHMM, θ = 0": maze89.THETA_0,
    "UDHMM at its best": maze89.BEST,
    "SARSA(λ), true belief": maze89.run("belief-sarsa"),
    "Perseus, true model": maze89.run("perseus", 0),
    "QMDP, true model": maze89.run("qmdp", 0),
    "most likely state, true model": maze89.run("most-likely", 0),
}


def plot(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw goal % and median steps of every row, with intervals, beside what was published."""
    goal = [_point(m, "goal_percent") for m in measured]
    steps = [_point(m, "median_steps") for m in measured]
    panels = [("goal % within 251 steps (median run)", goal, 102.0), ("median steps", steps, 256.0)]
    return comparison(panels, path, title=experiment.title)


def _point(measured: Measured, metric: str) -> Point:
    published = measured.row.published.get(metric)
    number = 251.0 if isinstance(published, str) else published
    return Point(measured.row.name, measured.metrics.get(metric), number)


EXPERIMENT = Experiment(
    name="table-3.1",
    title="Table 3.1: the 89-state maze",
    source="thesis, Table 3.1",
    rows=tuple(Row(name, run, TARGETS.get(name, {})) for name, run in SETTINGS.items()),
    columns={
        "goal_percent": "goal %",
        "median_steps": "median steps",
        "mean_goal_percent": "goal %, mean of seeds",
        "worst_goal_percent": "goal %, worst seed",
        "mean_discounted": "discounted reward",
    },
    plot=plot,
    notes=(
        "`jaxpomdp play` is how the human row is made. RL-LSTM is Bakker's (2004), as published; it is not "
        "run here. The last rows know the true model and bound what can be reached."
    ),
)
