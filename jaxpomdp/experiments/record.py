"""A run directory: it can be killed at any moment, and the same command resumes it to the same result.

::

    config.json       everything that fixes the results (``config.describe``)
    versions.json     what the run was computed with, and on what
    trials.csv        a row per seed and training trial
    phases.csv        a row per seed and phase of the agent
    edits.jsonl       an object per structure edit
    edits-judged.jsonl  the same with the reward of the trials before and after, once the run is complete
    evaluations.csv   a row per seed and greedy evaluation
    final.csv         a row per seed and greedy trial of the agent as it ended
    checkpoint.npz    the agent's whole state, and how much of each table belongs to it
    model.npz         the agent as it ended
    summary.json      what each seed scored in the end; it is there when the run is complete
    figures/          pictures

A commit first appends rows, then replaces the checkpoint in one rename. The checkpoint holds the length and
checksum of every table, so rows that were appended after it are cut off on resuming. Nothing is unpickled.
"""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxpomdp.experiments.arrays import flatten, load_arrays, save_arrays, unflatten
from jaxpomdp.experiments.config import differences

SCORES = ("goal_percent", "median_steps", "mean_steps", "mean_reward", "mean_discounted")
TABLES = {
    "trials": ("seed", "trial", "steps", "reward", "discounted", "success"),
    "phases": ("seed", "trial", "states", "log_evidence", "epsilon"),
    "evaluations": ("seed", "trial", *SCORES),
}
LOGS = ("edits",)
"""Tables of objects, one JSON value a line."""
FINAL_COLUMNS = TABLES["trials"]
OURS = (".lock", "versions.json")
PACKAGES = ("jaxpomdp", "jax", "jaxlib", "numpy", "scipy", "optax")

Rows = Sequence[Any]


class RunDirectoryError(ValueError):
    """A run directory that cannot be used; the message says which file, why, and what to do."""


def versions() -> dict[str, str]:
    """Return what computes here: Python, packages, device and platform."""
    found = {"python": platform.python_version(), "platform": f"{platform.system()} {platform.machine()}"}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            found[package] = metadata.version(package)
    return found | {"device": jax.devices()[0].device_kind, "backend": jax.default_backend()}


class RunDirectory:
    """An open run directory; use ``open_run``.

    Attributes:
        path: the directory.
        resumed: whether it already held a run.
    """

    def __init__(self, path: Path, *, resumed: bool) -> None:
        self.path = path
        self.resumed = resumed
        self._marks: dict[str, list[int]] = {}

    def restore(self, template: Any) -> tuple[Any, dict[str, Any]] | None:
        """Return the state and the progress at the last commit, and cut off rows that came after it.

        Args:
            template: a fresh state of the agent; only its structure is used.

        Raises:
            RunDirectoryError: a file is damaged, or belongs to another kind of agent.
        """
        file = self.path / "checkpoint.npz"
        if not file.exists():
            self._cut({})
            return None
        arrays, meta = load_arrays(file)
        state = unflatten(template, arrays, file)
        self._cut(meta["tables"])
        return state, meta["progress"]

    def commit(self, state: Any, progress: Mapping[str, Any], tables: Mapping[str, Rows]) -> None:
        """Append rows to the tables, then make state and progress the ones to resume from."""
        for name, rows in tables.items():
            self._append(name, rows)
        meta = {"progress": dict(progress), "tables": self._marks}
        save_arrays(self.path / "checkpoint.npz", flatten(state), meta)

    def finish(self, state: Any, rows: Rows, summary: Mapping[str, Any], edits: Rows = ()) -> None:
        """Write the agent as it ended, its last trials, its judged edits, and the summary, which says so."""
        if edits:
            write_atomically(self.path / "edits-judged.jsonl", lines_text(edits).encode())
        save_arrays(self.path / "model.npz", flatten(state), {})
        write_atomically(self.path / "final.csv", table_text([FINAL_COLUMNS, *rows]).encode())
        write_json(self.path / "summary.json", dict(summary))

    def _file(self, name: str) -> Path:
        return self.path / (f"{name}.csv" if name in TABLES else f"{name}.jsonl")

    def _append(self, name: str, rows: Rows) -> None:
        if not rows:
            return
        header = [] if name in self._marks or name not in TABLES else [TABLES[name]]
        text = table_text([*header, *rows]) if name in TABLES else lines_text(rows)
        data = text.encode()
        size, checksum = self._marks.get(name, [0, 0])
        with open(self._file(name), "ab") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._marks[name] = [size + len(data), zlib.crc32(data, checksum)]

    def _cut(self, marks: Mapping[str, Sequence[int]]) -> None:
        """Cut every table back to what the checkpoint knows of it."""
        for name in (*TABLES, *LOGS):
            file = self._file(name)
            if name not in marks:
                file.unlink(missing_ok=True)
            else:
                _cut_file(file, *marks[name])
        self._marks = {name: list(mark) for name, mark in marks.items()}


def _cut_file(file: Path, size: int, checksum: int) -> None:
    data = file.read_bytes() if file.exists() else b""
    if len(data) < size or zlib.crc32(data[:size]) != checksum:
        raise RunDirectoryError(
            f"{file} is damaged: its first {size} bytes are not those that were committed. "
            f"Restore the file, or delete {file.parent} and run again"
        )
    if len(data) > size:
        os.truncate(file, size)


@contextmanager
def open_run(path: Path, description: Mapping[str, Any]) -> Iterator[RunDirectory]:
    """Open a run directory for writing, new or to resume; one process at a time.

    Args:
        path: the directory; made if absent.
        description: of the run that is wanted (``config.describe``), compared with the one that is there.

    Raises:
        RunDirectoryError: another process works in it, it holds another run, or it holds foreign files.
    """
    _refuse_foreign(path)
    path.mkdir(parents=True, exist_ok=True)
    with _lock(path / ".lock"):
        resumed = (path / "config.json").exists()
        if resumed:
            _check_same(path, description)
        else:
            write_json(path / "versions.json", versions())
            write_json(path / "config.json", description)
        yield RunDirectory(path, resumed=resumed)


def _check_same(path: Path, description: Mapping[str, Any]) -> None:
    changed = differences(read_json(path / "config.json"), dict(description))
    if changed:
        raise RunDirectoryError(
            f"{path} holds a run with other settings (there -> asked for): {'; '.join(changed)}. "
            "Give the same settings to resume it, or another directory"
        )


def _refuse_foreign(path: Path) -> None:
    if not path.exists() or (path / "config.json").exists():
        return
    foreign = sorted(p.name for p in path.iterdir() if p.name not in OURS and p.suffix != ".part")
    if foreign:
        raise RunDirectoryError(f"{path} is no run directory: it holds {foreign[0]!r} and no config.json")


def changed_versions(path: Path) -> list[str]:
    """Return ``name: then -> now`` for each version that differs from when the run began."""
    return differences(read_json(path / "versions.json"), versions())


@contextmanager
def _lock(file: Path) -> Iterator[None]:
    """Hold a lock that the system frees however this process ends (without fcntl: no lock)."""
    with open(file, "w") as handle:
        try:
            import fcntl

            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except ImportError:
            pass
        except OSError:
            raise RunDirectoryError(f"another process is working in {file.parent}, wait for it") from None
        yield


def table_text(rows: Rows) -> str:
    """Return rows as CSV; floats in nine digits, which hold every float32 exactly."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([_cell(x) for x in row] for row in rows)
    return text.getvalue()


def lines_text(rows: Sequence[Any]) -> str:
    """Return objects as JSON, one a line."""
    return "".join(json.dumps(row, default=lambda x: x.tolist()) + "\n" for row in rows)


def _cell(x: Any) -> Any:
    if isinstance(x, bool | np.bool_):
        return int(x)
    return format(float(x), ".9g") if isinstance(x, float | np.floating) else x


def read_table(file: Path) -> dict[str, np.ndarray]:
    """Return the columns of a CSV table as float arrays.

    Raises:
        RunDirectoryError: the file is absent, or a row is not made of numbers.
    """
    try:
        with open(file, newline="") as handle:
            header, *rows = list(csv.reader(handle))
        columns = np.array(rows, dtype=float).reshape(len(rows), len(header)).T
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"{file} is not a readable table: {error}") from None
    return dict(zip(header, columns, strict=True))


def read_lines(file: Path) -> list[Any]:
    """Return the objects of a log, one a line; none where there is no file.

    Raises:
        RunDirectoryError: a line is damaged.
    """
    try:
        return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"{file} is not readable: {error}") from None


def by_seed(table: Mapping[str, np.ndarray], column: str) -> np.ndarray:
    """Return one column as ``[S, rows per seed]``, seeds and rows in the order of the file."""
    seeds = table["seed"]
    names = list(dict.fromkeys(seeds))
    return np.stack([table[column][seeds == seed] for seed in names])


def write_atomically(file: Path, data: bytes) -> None:
    """Write a file whole or not at all."""
    part = file.with_name(file.name + ".part")
    with open(part, "wb") as handle:
        handle.write(data)
        handle.flush()
        os.fsync(handle.fileno())
    os.replace(part, file)


def write_json(file: Path, value: Any) -> None:
    """Write JSON whole or not at all."""
    write_atomically(file, (json.dumps(value, indent=2) + "\n").encode())


def read_json(file: Path) -> Any:
    """Read JSON.

    Raises:
        RunDirectoryError: the file is absent or damaged.
    """
    try:
        return json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise RunDirectoryError(f"{file} is not readable: {error}") from None
