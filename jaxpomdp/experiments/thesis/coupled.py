"""Coupled agents: both couplings, exact and approximate inference, in the hallway, T-maze and maze."""

from __future__ import annotations

from dataclasses import replace

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Row
from jaxpomdp.experiments.thesis import fig_3_7, hallway, maze89
from jaxpomdp.experiments.thesis.worlds import picture_of

VARIANTS = (
    ("product", "exact"),
    ("product", "approximate"),
    ("mixture", "exact"),
    ("mixture", "approximate"),
)
TARGETS = {"successes_held": 14}
"""Section 3.5.1: 7 of 21 coupled runs fail in the hallway; the thesis's coupling is the product."""

WORLDS = {
    "hallway": (hallway.run(0.2), "cudhmm", hallway.CRITERION),
    "T-maze, N = 10": (fig_3_7.run(10, 0.2), "cudhmm-tmaze", fig_3_7.CRITERION),
    "89-state maze": (maze89.run("udhmm", 1000, theta=0.2), "cudhmm-maze89", maze89.CRITERION),
}
"""A run of the flat agent, the coupled agent for it, and when a run is a success."""


def coupled_run(flat: RunConfig, agent: str, coupling: str, inference: str = "exact") -> RunConfig:
    """Return a flat agent's run made by a coupled one."""
    added = "state" if coupling == "product" else "components"
    settings = (("coupling", coupling), ("inference", inference), ("added", added))
    return replace(flat, agent=agent, settings=(*flat.settings, *settings))


def _rows(world: str) -> list[Row]:
    flat, agent, criterion = WORLDS[world]
    rows = [Row(f"{world}, flat", flat, criterion=criterion)]
    for coupling, inference in VARIANTS:
        run = coupled_run(flat, agent, coupling, inference)
        published = TARGETS if (world, coupling, inference) == ("hallway", *VARIANTS[0]) else {}
        rows.append(Row(f"{world}, {coupling}, {inference}", run, published, criterion))
    return rows


EXPERIMENT = Experiment(
    name="coupled",
    title="Coupled agents, by coupling and inference",
    source="thesis, section 3.5.1, for the product in the hallway; else none",
    rows=tuple(row for world in WORLDS for row in _rows(world)),
    columns={
        "successes_held": "runs that held",
        "successes_ever": "runs that ever succeeded",
        "goal_percent": "goal %",
        "mean_steps": "steps, mean of seeds",
    },
    plot=picture_of(("flat", *(", ".join(variant) for variant in VARIANTS)), tuple(WORLDS)),
    notes=(
        "With the product a split adds a return state at the statistics of the split state, as in the "
        "thesis; with the mixture, one for each component. A run holds when its last two greedy evaluations "
        "are under 7.0 steps on average (hallway), reach the right arm in 95 % of trials (T-maze), or the "
        "goal in 92 % (maze, after 1,000 trials)."
    ),
)
