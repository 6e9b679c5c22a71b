"""What Figures 3.4 and 3.5 share: runs in the hallway, the criterion of success, and the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Measured
from jaxpomdp.experiments.plots import Curve, Line, learning_curves, moving_average
from jaxpomdp.experiments.results import Criterion
from jaxpomdp.experiments.stats import median_run

CRITERION = Criterion("mean_steps", 7.0, "below", last=2)
"""Consistently under 7.0 steps on average (section 3.5.1)."""
WINDOW = 10
COLUMNS = {
    "successes_held": "runs held under 7.0",
    "successes_ever": "runs ever under 7.0",
    "trials_to_hold": "trials until held, median",
    "mean_steps": "steps in the end, mean of seeds",
}
NOTES = (
    "The exact map of McCallum (1995) is in no public text; this is a documented reconstruction with optimum "
    "5.0, so trials and steps compare in kind, not in number. A run holds when its last two greedy "
    "evaluations are under 7.0 steps on average."
)


def run(theta: float) -> RunConfig:
    """Return a run of 400 trials, judged every 10."""
    config = RunConfig("hallway", "udhmm-hallway", trials=400, evaluate_every=10, evaluation_trials=50)
    return replace(config, settings=(("theta", theta),))


def noisy_run(theta: float) -> RunConfig:
    """Return a run of 1,500 trials with noise, judged every 50 on many trials, since these vary."""
    config = RunConfig("hallway-noise", "udhmm-hallway-noise", trials=1500, evaluate_every=50)
    return replace(config, evaluation_trials=251, settings=(("theta", theta),))


def plot(experiment: Experiment, measured: Sequence[Measured], path: Path) -> Path:
    """Draw steps per trial, while learning and in greedy tests, of the run of median trials to hold."""
    ran = [m for m in measured if m.run is not None]
    panels = [
        (f"steps per training trial, mean of {WINDOW}", [_training(m) for m in ran], [Line("7.0", 7.0)]),
        ("steps per greedy trial", [_greedy(m) for m in ran], [Line("7.0", 7.0)]),
    ]
    return learning_curves(panels, path, title=experiment.title, xlabel="training trials")


def _median(measured: Measured) -> int:
    late = -measured.per_seed["trials_to_hold"]
    return median_run(late, measured.per_seed["mean_steps"])


def _training(measured: Measured) -> Curve:
    table = measured.run.trials if measured.run is not None else {}
    return Curve(
        measured.row.name, table["trial"][0], moving_average(table["steps"], WINDOW), _median(measured)
    )


def _greedy(measured: Measured) -> Curve:
    table = measured.run.evaluations if measured.run is not None else {}
    return Curve(measured.row.name, table["trial"][0], table["mean_steps"], _median(measured))
