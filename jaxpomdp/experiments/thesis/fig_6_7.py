"""Figure 6.7: how many of 21 runs solve the T-maze with a hierarchy and without, against its length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxpomdp.agents.tree_kind import HMO
from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Measured, Row
from jaxpomdp.experiments.thesis import fig_3_7
from jaxpomdp.experiments.thesis.worlds import plot_held

LENGTHS = (4, 10, 20, 30, 50)
BEST, THESIS, FLAT = "HMO-HUDHMM at its best", "HMO-HUDHMM", "UDHMM"
AS_THE_THESIS: dict[str, Any] = {
    "states": 20,
    "levels": 3,
    "node_cap": 60,
    "operators": HMO,
    "edits_per_phase": 2,
    "every": 3,
}
"""Section 6.4.1: a random tree of 20 production states in up to three levels, growing to 60."""


def run(length: int, agent: str, **settings: Any) -> RunConfig:
    """Return a run of 1,500 trials, judged every 50, as Figure 3.7's."""
    flat = fig_3_7.run(length)
    return replace(flat, agent=agent, settings=(*flat.settings, *settings.items()))


def _runs(length: int) -> dict[str, RunConfig]:
    return {
        BEST: run(length, "hudhmm-tmaze", order="given"),
        THESIS: run(length, "hudhmm-tmaze", **AS_THE_THESIS),
        FLAT: run(length, "udhmm-tmaze"),
    }


def plot(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw the runs that held, the hierarchical agents beside the flat one, with Wilson intervals."""
    count = len(LENGTHS)
    variants = {name: measured[i * count :][:count] for i, name in enumerate((BEST, THESIS, FLAT))}
    places = [str(n) for n in LENGTHS]
    return plot_held(experiment, variants, places, path, xlabel="length of the corridor, N")


EXPERIMENT = Experiment(
    name="fig-6.7",
    title="Figure 6.7: the T-maze, a hierarchy beside a flat model",
    source="thesis, Figure 6.7 and section 6.4.1 (the bars' heights are in no public text)",
    rows=tuple(Row(f"{name}, N = {n}", _runs(n)[name]) for name in (BEST, THESIS, FLAT) for n in LENGTHS),
    columns={
        "successes_held": "runs that held",
        "successes_ever": "runs that ever succeeded",
        "trials_to_hold": "trials until held, median",
        "goal_percent": "right arm in the end, %, median run",
    },
    plot=plot,
    criterion=fig_3_7.CRITERION,
    notes=(
        "The thesis says that its hierarchical agent does better than its flat one. HMO-HUDHMM is as there: "
        "from 20 production states in up to three levels, with four operators in turn. At its best it starts "
        "from one level of 8 states and first splits leaves as the flat agent does, so little hierarchy is "
        "left. Both have one rehearsal in five trials and a probation of 15 trials (without these, up to two "
        "runs of a row were lost); UDHMM needs neither. A run holds when its last two greedy tests take the "
        "right arm in at least 95 % of trials."
    ),
)
