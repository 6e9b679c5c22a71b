"""Figure 3.7: how many of 21 runs solve the T-maze, against the length of its corridor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Measured, Published, Row
from jaxpomdp.experiments.plots import Bars, bars
from jaxpomdp.experiments.results import Criterion

CRITERION = Criterion("goal_percent", 95.0, last=2)
LENGTHS = (4, 10, 20, 50, 100, 200)
TARGETS: dict[int, Published] = {n: {"successes_held": "poor"} for n in LENGTHS if n > 10}
"""Section 3.5.2, in words: above N = 10 the algorithm performs poorly; RL-LSTM handles N up to 50."""


def run(length: int, theta: float = 0.2) -> RunConfig:
    """Return a run of 1,500 trials, judged every 50."""
    settings = (("theta", theta),)
    return RunConfig(f"tmaze-{length}", "udhmm-tmaze", trials=1500, evaluate_every=50, settings=settings)


def plot(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw the runs that held and those that ever succeeded, with Wilson intervals."""
    ran = [m for m in measured if m.run is not None]
    held = Bars("held to the end", [m.metrics["successes_held"] for m in ran])
    ever = Bars("at some evaluation", [m.metrics["successes_ever"] for m in ran])
    places = [m.row.name.removeprefix("N = ") for m in ran]
    labels = {"xlabel": "length of the corridor, N", "ylabel": "successful runs"}
    top = ran[0].per_seed["success_held"].size
    return bars([held, ever], places, path, title=experiment.title, top=top, **labels)


EXPERIMENT = Experiment(
    name="fig-3.7",
    title="Figure 3.7: the T-maze, successful runs against the length of the corridor",
    source="thesis, Figure 3.7 and section 3.5.2 (the bars' heights are in no public text)",
    rows=tuple(Row(f"N = {n}", run(n), TARGETS.get(n, {})) for n in LENGTHS),
    columns={
        "successes_held": "runs that held",
        "successes_ever": "runs that ever succeeded",
        "trials_to_hold": "trials until held, median",
        "goal_percent": "right arm in the end, %, median run",
    },
    plot=plot,
    criterion=CRITERION,
    notes="A run holds when its last two greedy evaluations take the right arm in at least 95 % of trials.",
)
