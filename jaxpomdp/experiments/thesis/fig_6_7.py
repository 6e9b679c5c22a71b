"""Figure 6.7: how many of 21 runs solve the T-maze with a hierarchy and without, against its length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Measured, Row
from jaxpomdp.experiments.plots import Bars, bars
from jaxpomdp.experiments.thesis import fig_3_7

LENGTHS = (4, 10, 15, 20, 25, 30, 50, 100)
AGENTS = {"HMO-HUDHMM": "hudhmm-tmaze", "UDHMM": "udhmm-tmaze"}


def run(length: int, agent: str) -> RunConfig:
    """Return a run of 1,500 trials, judged every 50, as Figure 3.7's."""
    return replace(fig_3_7.run(length), agent=agent)


def plot(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw the runs that held, the hierarchical agent beside the flat one, with Wilson intervals."""
    groups = [
        Bars(name, [m.metrics["successes_held"] for m in measured if m.row.name.startswith(f"{name},")])
        for name in AGENTS
    ]
    labels = {"xlabel": "length of the corridor, N", "ylabel": "runs that held"}
    top = measured[0].per_seed["success_held"].size
    return bars(groups, [str(n) for n in LENGTHS], path, title=experiment.title, top=top, **labels)


EXPERIMENT = Experiment(
    name="fig-6.7",
    title="Figure 6.7: the T-maze, a hierarchy beside a flat model",
    source="thesis, Figure 6.7 and section 6.4.1 (the bars' heights are in no public text)",
    rows=tuple(Row(f"{name}, N = {n}", run(n, agent)) for name, agent in AGENTS.items() for n in LENGTHS),
    columns={
        "successes_held": "runs that held",
        "successes_ever": "runs that ever succeeded",
        "trials_to_hold": "trials until held, median",
        "goal_percent": "right arm in the end, %, median run",
    },
    plot=plot,
    criterion=fig_3_7.CRITERION,
    notes=(
        "The thesis says that its hierarchical agent does better than its flat one, from 20 production "
        "states in up to three levels to 60. A run holds when its last two greedy evaluations take the right "
        "arm in at least 95 % of trials."
    ),
)
