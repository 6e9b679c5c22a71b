"""Results as text for a terminal, and as learning curves, straight from run directories."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxpomdp.experiments.config import differences, digest
from jaxpomdp.experiments.experiment import summarise
from jaxpomdp.experiments.plots import Curve, Line, learning_curves, moving_average
from jaxpomdp.experiments.record import RunDirectoryError, read_json
from jaxpomdp.experiments.restore import find_runs
from jaxpomdp.experiments.results import RunData, load_run, merge_runs, score
from jaxpomdp.experiments.stats import format_interval, median_run
from jaxpomdp.experiments.stopwatch import in_words

SHOWN = {"goal_percent": "goal %", "median_steps": "median steps", "mean_discounted": "discounted reward"}
DIGITS = {"mean_discounted": 3}
WINDOW = 100


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows in aligned columns, the first one to the left and the others to the right.

    >>> print(text_table([("", "goal %"), ("seed 3", "92")]))
            goal %
    seed 3      92
    """
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        lines.append("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())
    return "\n".join(lines)


def score_report(seeds: Sequence[int], trials: Mapping[str, np.ndarray]) -> str:
    """Return what each seed scored over its trials ``[S, trials]``, and medians and means over the seeds."""
    per_seed = score(trials)
    rows = [("", *SHOWN.values())]
    for s, seed in enumerate(seeds):
        rows.append((f"seed {seed}", *(f"{per_seed[name][s]:.{DIGITS.get(name, 1)}f}" for name in SHOWN)))
    if len(seeds) > 1:
        metrics = summarise(per_seed)
        cells = [format_interval(metrics[name], DIGITS.get(name, 1)) for name in SHOWN]
        rows.append(("all (medians, mean)", *cells))
    return text_table(rows)


def run_report(path: Path) -> str:
    """Return the final scores of a complete run."""
    run = load_run(path)
    count = run.final["steps"].shape[1]
    spent = in_words(read_json(path / "summary.json")["seconds"])
    return f"{count} greedy trials per seed, as it ended:\n{score_report(run.seeds, run.final)}\n{spent}"


def sweep_report(paths: Iterable[Path]) -> str:
    """Return a line per configuration: medians and mean over its seeds at the end."""
    runs = merge_by_configuration(paths)
    rows = [("", "seeds", *SHOWN.values())]
    for label, run in zip(labels(runs), runs, strict=True):
        metrics = summarise(score(run.final))
        cells = [format_interval(metrics[name], DIGITS.get(name, 1)) for name in SHOWN]
        rows.append((label, str(len(run.seeds)), *cells))
    return text_table(rows)


def merge_by_configuration(paths: Iterable[Path]) -> list[RunData]:
    """Read run directories and put together those that differ in nothing but their seeds."""
    groups: dict[str, list[RunData]] = {}
    for path in find_runs(paths):
        run = load_run(path)
        groups.setdefault(digest(_without_seeds(run)), []).append(run)
    return [merge_runs(runs) for runs in groups.values()]


def _without_seeds(run: RunData) -> dict:
    return {**run.config, "run": {**run.config["run"], "seeds": None}}


def labels(runs: Sequence[RunData]) -> list[str]:
    """Return a name for each run: what it does not share with the first, or else environment and agent."""
    base = [f"{run.config['run']['env']}, {run.config['run']['agent']}" for run in runs]
    if len(set(base)) == len(base):
        return base
    changes = [differences(_without_seeds(runs[0]), _without_seeds(run)) for run in runs]
    names = sorted({change.split(":")[0] for lines in changes for change in lines} - {"run.settings"})
    return [", ".join(f"{name.split('.')[-1]} {_at(run.config, name)}" for name in names) for run in runs]


def _at(config: Mapping, dotted: str) -> object:
    value: object = config
    for name in dotted.split("."):
        value = value.get(name) if isinstance(value, Mapping) else None
    return value


def plot_runs(
    paths: Iterable[Path], out: Path, title: str = "", lines: Mapping[str, Line] | None = None
) -> Path:
    """Draw goal % and median steps against trials, one curve for each configuration.

    Args:
        paths: run directories, or directories that hold some.
        out: the PNG.
        title: by default how many seeds.
        lines: levels to compare with, by metric.

    Raises:
        RunDirectoryError: there is no run, or none has learned anything yet.
    """
    runs = [run for run in merge_by_configuration(paths) if run.trials]
    if not runs:
        raise RunDirectoryError("there is nothing to plot: no run has training trials on disk yet")
    greedy = all(run.evaluations for run in runs)
    kind = "greedy tests" if greedy else f"mean of {WINDOW} training trials"
    named = list(zip(labels(runs), runs, strict=True))
    panels = []
    for metric, ylabel in (
        ("goal_percent", "goal %"),
        ("median_steps" if greedy else "mean_steps", "median steps" if greedy else "steps"),
    ):
        curves = [course(name, run, metric, greedy) for name, run in named]
        panels.append((f"{ylabel}, {kind}", curves, [lines[metric]] if lines and metric in lines else []))
    return learning_curves(panels, out, title=title or _title(runs), xlabel="training trials")


def _title(runs: Sequence[RunData]) -> str:
    count = min(len(run.seeds) for run in runs)
    return f"Median run and middle half of {count} runs" if count > 1 else "One run"


def course(label: str, run: RunData, metric: str, greedy: bool = True) -> Curve:
    """Return a run's course in one metric; its median run is that of median goal % at the end."""
    if greedy:
        trial, values, goal = (
            run.evaluations["trial"][0],
            run.evaluations[metric],
            run.evaluations["goal_percent"],
        )
    else:
        goal = moving_average(100 * run.trials["success"], WINDOW)
        values = goal if metric == "goal_percent" else moving_average(run.trials["steps"], WINDOW)
        trial = run.trials["trial"][0]
    end = score(run.final)["goal_percent"] if run.final else goal[:, -1]
    return Curve(label, trial, values, median_run(end, values[:, -1]))
