"""What the experiments that go through several worlds share: rows by world and variant, and one picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from jaxpomdp.experiments.experiment import Experiment, Measured
from jaxpomdp.experiments.plots import Bars, bars

COLUMNS = {
    "successes_held": "runs that held",
    "successes_ever": "runs that ever succeeded",
    "mean_goal_percent": "goal %, mean of seeds",
    "median_steps": "median steps",
}
"""What is told of agents that are better or worse, where not all succeed."""


def plot_held(
    experiment: Experiment,
    variants: Mapping[str, Sequence[Measured]],
    worlds: Sequence[str],
    path: Path,
    xlabel: str = "world",
) -> Path:
    """Draw the runs that held in every world, a group of bars for each variant (its rows world by world)."""
    groups = [Bars(name, [m.metrics["successes_held"] for m in rows]) for name, rows in variants.items()]
    top = next(iter(variants.values()))[0].per_seed["success_held"].size
    labels = {"xlabel": xlabel, "ylabel": "runs that held"}
    return bars(groups, worlds, path, title=experiment.title, top=top, **labels)


def picture_of(variants: Sequence[str], worlds: Sequence[str]) -> Callable[..., Path]:
    """Return the ``plot`` of an experiment whose rows go through all variants, world after world."""

    def plot(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
        groups = {name: measured[i :: len(variants)] for i, name in enumerate(variants)}
        return plot_held(experiment, groups, list(worlds), path)

    return plot
