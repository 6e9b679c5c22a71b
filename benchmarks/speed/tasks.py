"""What a process of its own does for ``bench.py``: one part, one contestant's memory, or float64's answer.

It prints a line of JSON for every result that it has; the last one holds the others.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import acting
import inference
import jax
import numpy as np
import scaling
import training
from processes import Settings, newest, start
from timing import limits, on_cpu
from workloads import LOADS


def results(task: str, settings: Settings) -> Iterator[dict[str, Any]]:
    """Yield what a task finds; a task is a kind and its words."""
    kind, *words = task.split(" ", 2)
    if kind == "memory":
        yield {"mebibytes": peak_memory(*words)}
    elif kind == "totals":
        yield totals(*words)
    elif kind == "limits":
        yield {"limits": limits(), "device": jax.devices()[0].device_kind, "backend": jax.default_backend()}
    else:
        yield from part(kind, settings)


def part(name: str, settings: Settings) -> Iterator[dict[str, Any]]:
    """Yield a part of the benchmark as it grows."""
    rounds = settings.rounds
    if name in LOADS:
        found = inference.compare(name, rounds, settings.budget)
        yield {name: found}
        yield {name: found | {"float32_error": accuracy(name)}}
    elif name == "W6":
        yield from training.compare(settings.patience)
    else:
        others = {
            "W5": acting.compare,
            "seeds": scaling.seeds,
            "long": inference.long,
            "growth": inference.growth,
        }
        yield from others[name](max(rounds // 2, 1) if name == "growth" else rounds)


def peak_memory(name: str, who: str) -> float:
    """Return the mebibytes that one contestant took of the device's memory, data included.

    On a CPU: how much more of this process's memory than before it ran.
    """
    if on_cpu():
        with contextlib.suppress(OSError):  # forget the peak of the imports
            Path("/proc/self/clear_refs").write_text("5")
        before = _high_water()
        inference.prepared(LOADS[name], [who])
        return _high_water() - before
    inference.prepared(LOADS[name], [who])
    return jax.devices()[0].memory_stats()["peak_bytes_in_use"] / 2**20


def _high_water() -> float:
    """Return the most that this process has held, in MiB.

    Not ``ru_maxrss``: a child starts with its parent's there.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def totals(name: str, plan: str) -> dict[str, Any]:
    """Return what tells float32 from float64: the log-evidence of every trial, and all counts."""
    found = inference.outcome(name, plan)
    return {key: value.ravel().tolist() for key, value in found.items()}


def accuracy(name: str) -> dict[str, Any]:
    """Return the largest relative errors of float32 against float64."""
    exact = newest(start(f"totals {name} grouped", Settings(), wide=True).communicate()[0])
    if "error" in exact:
        return exact
    single = {key: value.ravel() for key, value in inference.outcome(name, "auto").items()}
    evidence, counts = (np.array(exact[key]) for key in ("evidence", "xi"))
    return {
        "log_evidence": float(np.max(np.abs(single["evidence"] - evidence) / np.abs(evidence))),
        "counts": float(np.max(np.abs(single["xi"] - counts)) / np.max(counts)),
    }
