"""What run directories say: scores per seed, curves over trials, and whether success was reached and held."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxpomdp.experiments.record import RunDirectoryError, read_json, read_lines, read_table

PER_PHASE = ("states", "log_evidence", "epsilon")
PER_TRIAL = ("steps", "reward", "discounted", "success")
Columns = Mapping[str, np.ndarray]


def score(trials: Columns) -> dict[str, np.ndarray]:
    """Return what each seed scored over its trials, from columns ``[S, trials]`` to ``[S]``.

    A trial that fails counts with the steps it took: ``median_steps`` is the step limit where most fail.
    """
    return {
        "goal_percent": 100 * np.mean(trials["success"], axis=1),
        "median_steps": np.median(trials["steps"], axis=1),
        "mean_steps": np.mean(trials["steps"], axis=1),
        "mean_reward": np.mean(trials["reward"], axis=1),
        "mean_discounted": np.mean(trials["discounted"], axis=1),
    }


def trial_rows(seeds: Sequence[int], before: int, trials: Columns) -> list[tuple]:
    """Return a row per trial and seed for a table of trials; trials count from ``before + 1``."""
    columns = [np.asarray(trials[name]) for name in PER_TRIAL]
    return [
        (seed, before + t + 1, *(column[s, t] for column in columns))
        for t in range(columns[0].shape[1])
        for s, seed in enumerate(seeds)
    ]


def evaluation_rows(seeds: Sequence[int], trial: int, trials: Columns) -> list[tuple]:
    """Return a row per seed for the table of evaluations."""
    columns = list(score(trials).values())
    return [(seed, trial, *(float(column[s]) for column in columns)) for s, seed in enumerate(seeds)]


def phase_rows(seeds: Sequence[int], trial: int, phase: Columns) -> list[tuple]:
    """Return a row per seed for the table of phases; what an agent does not report is NaN."""
    nothing = [float("nan")] * len(seeds)
    columns = [phase.get(name, nothing) for name in PER_PHASE]
    return [(seed, trial, *(column[s] for column in columns)) for s, seed in enumerate(seeds)]


def edit_row(seeds: Sequence[int], trial: int, edit: Mapping[str, Any]) -> dict[str, Any]:
    """Return a structure edit with the seed of its run and the trial after which it was made.

    What the edit itself calls its seed, the one that its parameters were drawn with, is ``draw_seed``.
    """
    rest = {"draw_seed" if name == "seed" else name: x for name, x in edit.items() if name != "seed_index"}
    return {"seed": seeds[edit["seed_index"]], "trial": trial} | rest


def judged_edits(run: RunData) -> list[dict[str, Any]]:
    """Return the structure edits of a run with how the agent did in the phase before each, and in that after.

    ``discounted_before`` and ``discounted_after`` are means over a phase's trials of the discounted reward
    that the seed collected, exploring; None after the last phase.
    """
    if not run.phases:
        return []
    width = int(run.phases["trial"][0, 0])

    def reward(edit: Mapping[str, Any], begin: int) -> float | None:
        trials = run.trials["discounted"][run.seeds.index(edit["seed"]), begin : begin + width]
        return float(trials.mean()) if trials.size else None

    return [
        row
        | {
            "discounted_before": reward(row, row["trial"] - width),
            "discounted_after": reward(row, row["trial"]),
        }
        for row in read_lines(run.path / "edits.jsonl")
    ]


class RunData(NamedTuple):
    """A finished or unfinished run as arrays; columns are ``[S, rows]``, in the order of ``seeds``."""

    path: Path
    config: dict[str, Any]
    seeds: list[int]
    trials: dict[str, np.ndarray]
    evaluations: dict[str, np.ndarray]
    phases: dict[str, np.ndarray]
    final: dict[str, np.ndarray]
    seconds: float


def load_run(path: Path) -> RunData:
    """Read a run directory; a table that is not there yet is empty.

    Raises:
        RunDirectoryError: it is no run directory, or a file is damaged.
    """
    if not (path / "config.json").exists():
        raise RunDirectoryError(f"{path} is no run directory (jaxpomdp train makes one): no config.json")
    config = read_json(path / "config.json")
    tables = {name: _by_seed(path / f"{name}.csv") for name in ("trials", "evaluations", "phases", "final")}
    done = read_json(path / "summary.json") if (path / "summary.json").exists() else {"seconds": {"all": 0.0}}
    return RunData(path, config, config["run"]["seeds"], **tables, seconds=done["seconds"]["all"])


def _by_seed(file: Path) -> dict[str, np.ndarray]:
    """Return the columns of a table as ``[S, rows per seed]``; a cut-off last block of rows is left out."""
    if not file.exists():
        return {}
    table = read_table(file)
    seeds = table.pop("seed")
    count = len(dict.fromkeys(seeds))
    whole = len(seeds) - len(seeds) % max(count, 1)
    return {name: column[:whole].reshape(-1, max(count, 1)).T for name, column in table.items()}


def merge_runs(runs: Sequence[RunData]) -> RunData:
    """Put the seeds of runs of one configuration together, ``[S1 + S2 + ..., rows]``, cut to the shortest."""
    first = runs[0]
    if len(runs) == 1:
        return first
    tables = {name: _joined([getattr(run, name) for run in runs]) for name in first._fields[3:7]}
    seeds = [seed for run in runs for seed in run.seeds]
    return RunData(first.path, first.config, seeds, **tables, seconds=sum(run.seconds for run in runs))


def _joined(tables: Sequence[Columns]) -> dict[str, np.ndarray]:
    if not all(tables):
        return {}
    rows = {name: min(table[name].shape[1] for table in tables) for name in tables[0]}
    return {name: np.concatenate([table[name][:, :n] for table in tables]) for name, n in rows.items()}


@dataclass(frozen=True)
class Criterion:
    """When an agent counts as successful: a score of its greedy evaluations on the good side of a bound."""

    metric: str = "goal_percent"
    """Column of the evaluations."""
    bound: float = 95.0
    """What must be reached."""
    side: Literal["at least", "below"] = "at least"
    """On which side of the bound success lies."""
    last: int = 2
    """How many evaluations at the end must all succeed for success to be held."""

    def met(self, values: np.ndarray) -> np.ndarray:
        """Return where ``values`` succeed."""
        return values < self.bound if self.side == "below" else values >= self.bound


class Outcome(NamedTuple):
    """Per seed, ``[S]``: success at some evaluation, at the last ones, and from which trial on it stayed."""

    ever: np.ndarray
    held: np.ndarray
    trials_to_hold: np.ndarray


def outcome(criterion: Criterion, run: RunData) -> Outcome:
    """Judge a run; the final evaluation counts as the last one.

    ``trials_to_hold`` is the first trial from which every later evaluation succeeds; infinite where not held.
    """
    final = score(run.final)[criterion.metric][:, None]
    values = np.concatenate([run.evaluations[criterion.metric], final], axis=1) if run.evaluations else final
    last = run.trials["trial"][:, -1:] if run.trials else np.zeros_like(final)
    trial = np.concatenate([run.evaluations["trial"], last], axis=1) if run.evaluations else last
    met = criterion.met(values)
    held = met[:, -criterion.last :].all(axis=1)
    onwards = np.flip(np.logical_and.accumulate(np.flip(met, 1), axis=1), 1)
    first = np.take_along_axis(trial, np.argmax(onwards, axis=1)[:, None], axis=1)[:, 0]
    return Outcome(np.asarray(met.any(axis=1)), np.asarray(held), np.where(held, first, np.inf))
