"""Section 6.3.5: the hierarchical agent with a flat chain coupled to its tree, and with the cousin split."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from jaxpomdp.experiments.experiment import Experiment, Row
from jaxpomdp.experiments.thesis import fig_3_7, fig_6_7, maze89
from jaxpomdp.experiments.thesis.worlds import COLUMNS, picture_of

WORLDS = {
    "T-maze, N = 10": (fig_6_7.run(10, "hudhmm-tmaze"), "hudhmm-coupled-tmaze", fig_3_7.CRITERION),
    "89-state maze": (maze89.run("hudhmm", 1000, theta=0.0), "hudhmm-coupled", maze89.CRITERION),
}
"""A run of the hierarchical agent, its coupled kind, and what a success is."""

VARIANTS: Mapping[str, Mapping[str, Any] | None] = {
    "tree alone": None,
    "tree and memory": {"cousin": False},
    "tree, memory, cousin split": {"cousin": True},
}
"""Settings of the coupled agent; None: the hierarchical agent."""


def _rows(world: str) -> list[Row]:
    alone, agent, criterion = WORLDS[world]
    runs = {
        name: alone
        if more is None
        else replace(alone, agent=agent, settings=(*alone.settings, *more.items()))
        for name, more in VARIANTS.items()
    }
    return [Row(f"{world}, {name}", run, criterion=criterion) for name, run in runs.items()]


EXPERIMENT = Experiment(
    name="coupled-hierarchy",
    title="A hierarchy with a flat chain coupled to it",
    source="thesis, section 6.3.5, in words",
    rows=tuple(row for world in WORLDS for row in _rows(world)),
    columns=COLUMNS,
    plot=picture_of(tuple(VARIANTS), tuple(WORLDS)),
    notes=(
        "The thesis saw no effect of the coupling or the cousin split. A run holds when its last two tests "
        "reach the right arm in 95 % of trials (T-maze), or the goal in 92 % (maze, after 1,000 "
        "trials)."
    ),
)
