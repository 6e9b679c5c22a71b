"""Reproduce a table or figure: run what is missing, write rows, picture and tables beside the published."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxpomdp.experiments.config import RunConfig, seed_range
from jaxpomdp.experiments.experiment import Experiment, Measured, analyse
from jaxpomdp.experiments.record import table_text, versions, write_atomically, write_json
from jaxpomdp.experiments.results import RunData, load_run, merge_runs
from jaxpomdp.experiments.runner import Build, build
from jaxpomdp.experiments.stats import Interval, format_interval
from jaxpomdp.experiments.sweep import Job, plan, run_jobs

STEP_LIMIT = 251
DIGITS = {"mean_discounted": 3, "trials_to_hold": 0, "successes_held": 0, "successes_ever": 0}


@dataclass(frozen=True)
class Effort:
    """How much of an experiment is run, and where."""

    seeds: int = 21
    """Runs of each row."""
    first_seed: int = 1000
    """Their seeds count up from here; settings were chosen on other seeds."""
    trials: int | None = None
    """Training trials of every row that trains; by default each row's own."""
    quick: bool = False
    """A smoke test: few seeds, few trials, few tests. Its figures mean nothing."""
    workers: int = 1
    """Runs at a time, each in its own process."""
    chunk: int = 0
    """Seeds in a batch (0: all); other chunks may differ in the last bits and so in the end."""
    work: Path = Path("benchmarks/runs")
    """Where run directories lie; a killed command resumes from them."""
    out: Path = Path("benchmarks/results")
    """Where results are written."""
    progress: str = "auto"
    """``auto``, ``lines`` or ``none``."""


def reproduce(
    experiment: Experiment, effort: Effort, *, command: str = "", make: Build = build
) -> dict[str, Any]:
    """Run an experiment and write ``NAME.json``, ``.csv``, ``.png`` and ``.md`` under ``effort.out``.

    Returns:
        What stands in the JSON file.
    """
    wanted = [_sized(row.run, effort) for row in experiment.rows if row.run is not None]
    jobs = plan(wanted, effort.work, chunk=effort.chunk, make=make)
    flat = [job for row in jobs for job in row]
    run_jobs(flat, workers=effort.workers, progress=effort.progress, make=make)
    measured = collect(experiment, jobs)
    result = to_json(experiment, measured, wanted, command or f"jaxpomdp reproduce {experiment.name}")
    write_results(experiment, measured, result, effort.out)
    return result


def _sized(config: RunConfig, effort: Effort) -> RunConfig:
    """Return the configuration with the seeds and the size that are asked for."""
    seeds = seed_range(effort.first_seed, 2 if effort.quick else effort.seeds)
    config = replace(config, seeds=seeds)
    if effort.trials is not None and config.trials:
        every = min(config.evaluate_every, max(effort.trials // 2, 1))
        config = replace(config, trials=effort.trials, evaluate_every=every)
    if not effort.quick:
        return config
    trials = min(config.trials, effort.trials or 20)
    return replace(
        config, trials=trials, evaluate_every=max(trials // 2, 1), evaluation_trials=5, final_trials=10
    )


def collect(experiment: Experiment, jobs: Sequence[Sequence[Job]]) -> list[Measured]:
    """Read the runs back and analyse them, row by row."""
    ran = iter(jobs)
    rows = []
    for row in experiment.rows:
        if row.run is None:
            rows.append(Measured(row, None, {}, {}))
        else:
            data = merge_runs([load_run(job.path) for job in next(ran)])
            rows.append(analyse(row, data, experiment.criterion))
    return rows


def to_json(
    experiment: Experiment, measured: Sequence[Measured], configs: Sequence[RunConfig], command: str
) -> dict[str, Any]:
    """Return the result in the form that is committed."""
    ran = [(m.row.name, m.run) for m in measured if m.run is not None]
    return {
        "name": experiment.name,
        "command": command,
        "versions": versions(),
        "settings": {name: _settings(run) for name, run in ran},
        "seeds": list(configs[0].seeds) if configs else [],
        "seconds": round(sum(run.seconds for _, run in ran), 1),
        "rows": [_row_json(m) for m in measured],
    }


def _settings(run: RunData) -> dict[str, Any]:
    config = run.config["run"]
    plain = {name: x for name, x in config.items() if name not in ("seeds", "settings")}
    return plain | {"chunk": len(config["seeds"]), "settings": run.config["agent"]}


def _row_json(measured: Measured) -> dict[str, Any]:
    return {
        "row": measured.row.name,
        "published": dict(measured.row.published),
        "measured": {
            name: {end: _number(x) for end, x in interval._asdict().items()}
            for name, interval in measured.metrics.items()
        },
        "per_seed": {name: [_number(x) for x in values] for name, values in measured.per_seed.items()},
    }


def _number(x: Any) -> float | bool | None:
    """Return a JSON number of at most six significant digits; None where it is infinite."""
    if isinstance(x, bool | np.bool_):
        return bool(x)
    return float(f"{float(x):.6g}") if math.isfinite(x) else None


def write_results(
    experiment: Experiment, measured: Sequence[Measured], result: Mapping[str, Any], out: Path
) -> None:
    """Write the four files of a result."""
    out.mkdir(parents=True, exist_ok=True)
    stem = out / experiment.name
    write_json(stem.with_name(experiment.name + ".json"), result)
    write_atomically(stem.with_name(experiment.name + ".csv"), csv_text(result).encode())
    write_atomically(stem.with_name(experiment.name + ".md"), markdown(experiment, result).encode())
    experiment.plot(experiment, measured, stem.with_name(experiment.name + ".png"))


def csv_text(result: Mapping[str, Any]) -> str:
    """Return the result as CSV: row, metric, published, value, low, high."""
    lines: list[Sequence[Any]] = [("row", "metric", "published", "value", "low", "high")]
    for row in result["rows"]:
        names = [*row["measured"], *(name for name in row["published"] if name not in row["measured"])]
        for name in names:
            found = row["measured"].get(name, {})
            ends = [found.get(end, "") for end in ("value", "low", "high")]
            lines.append((row["row"], name, row["published"].get(name, ""), *ends))
    return table_text(lines)


def markdown(experiment: Experiment, result: Mapping[str, Any]) -> str:
    """Return the whole report: the table, notes, settings and versions."""
    seeds = result["seeds"]
    said = f"{len(seeds)} seeds ({seeds[0]} to {seeds[-1]})" if seeds else "no runs"
    parts = [
        f"# {experiment.title}",
        f"Published: {experiment.source}. Measured: `{result['command']}`, {said}, "
        f"{result['seconds']:.0f} s of running; each agent as it ends, greedy; value [95 % interval].",
        markdown_table(experiment, result),
        f"![{experiment.title}]({experiment.name}.png)",
        *([experiment.notes] if experiment.notes else []),
        "## Settings",
        _settings_table(result["settings"]),
        "## Versions",
        ", ".join(f"{name} {version}" for name, version in result["versions"].items()),
    ]
    return "\n\n".join(parts) + "\n"


def markdown_table(experiment: Experiment, result: Mapping[str, Any]) -> str:
    """Return published and measured side by side, a line per row; what nobody published has one column."""
    published = {name for row in result["rows"] for name in row["published"]}
    heads = [""]
    for name, heading in experiment.columns.items():
        heads += [f"{heading}, published", f"{heading}, measured"] if name in published else [heading]
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)]]
    for row in result["rows"]:
        lines.append([row["row"], *_cells(experiment, row, published)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cells(experiment: Experiment, row: Mapping[str, Any], published: set[str]) -> list[str]:
    cells = []
    for name in experiment.columns:
        if name in published:
            cells.append(str(row["published"].get(name, "")))
        cells.append(_cell(name, row["measured"].get(name)))
    return cells


def _cell(name: str, found: Mapping[str, float | None] | None) -> str:
    """Return one measured metric; steps at the limit mean that most trials failed."""
    if found is None:
        return ""
    ends = [math.inf if found[end] is None else float(found[end] or 0) for end in ("value", "low", "high")]
    if name.endswith("steps") and ends[0] >= STEP_LIMIT:
        return f">{STEP_LIMIT}"
    if math.isinf(ends[0]):
        return "never"
    return format_interval(Interval(*ends), DIGITS.get(name, 1))


def _settings_table(settings: Mapping[str, Any]) -> str:
    lines = ["| | environment | agent | trials | settings |", "|---|---|---|---:|---|"]
    for name, run in settings.items():
        flat = ", ".join(f"{key}={value}" for key, value in flatten_settings(run["settings"]).items())
        lines.append(f"| {name} | {run['env']} | {run['agent']} | {run['trials']} | {flat} |")
    return "\n".join(lines)


def flatten_settings(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return nested settings under dotted names.

    >>> flatten_settings({"control": {"alpha": 0.01}, "theta": 0.2})
    {'control.alpha': 0.01, 'theta': 0.2}
    """
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        path = f"{prefix}{name}"
        flat |= flatten_settings(value, f"{path}.") if isinstance(value, dict) else {path: value}
    return flat
