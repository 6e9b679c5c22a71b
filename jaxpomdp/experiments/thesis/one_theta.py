"""One theta and one return model for all worlds: the weight of utility, world by world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Measured, Row
from jaxpomdp.experiments.thesis import fig_3_7, hallway, maze89
from jaxpomdp.experiments.thesis.worlds import plot_held

THETAS = (0.0, 0.02, 0.2)


def _by_action(config: RunConfig) -> RunConfig:
    return replace(config, settings=(*config.settings, ("return_by_action", True)))


def _rows(theta: float) -> list[Row]:
    maze = maze89.run("udhmm", 2000, theta=theta)
    found = {
        "hallway": (hallway.run(theta), hallway.CRITERION),
        "hallway with noise": (hallway.noisy_run(theta), hallway.CRITERION),
        "T-maze, N = 10": (fig_3_7.run(10, theta), fig_3_7.CRITERION),
        "89-state maze": (maze, maze89.CRITERION),
    }
    return [
        Row(f"{world}, θ = {theta:g}", _by_action(run), criterion=criterion)
        for world, (run, criterion) in found.items()
    ]


def plot(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw the runs that held in every world, a group of bars for each theta."""
    worlds = [m.row.name.split(", θ")[0] for m in measured[: len(measured) // len(THETAS)]]
    rows = [measured[i * len(worlds) :][: len(worlds)] for i in range(len(THETAS))]
    variants = {f"θ = {theta:g}": row for theta, row in zip(THETAS, rows, strict=True)}
    return plot_held(experiment, variants, worlds, path)


EXPERIMENT = Experiment(
    name="one-theta",
    title="One θ and one return model for all worlds",
    source="none: the thesis uses θ = 0.2 everywhere, and finds θ = 0 no worse in the maze",
    rows=tuple(row for theta in THETAS for row in _rows(theta)),
    columns={
        "successes_held": "runs that held",
        "successes_ever": "runs that ever succeeded",
        "goal_percent": "goal %",
        "mean_goal_percent": "goal %, mean of seeds",
        "median_steps": "median steps",
    },
    plot=plot,
    notes=(
        "Returns are modelled per state and action in every world. A run holds when its last two greedy "
        "evaluations are under 7.0 steps on average (hallway), reach the right arm in 95 % of trials "
        "(T-maze), or the goal in 92 % (maze, after 2,000 trials)."
    ),
)
