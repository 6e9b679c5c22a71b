"""Tasks in processes of their own: what one leaves in a device's memory, or breaks, is not the next one's."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

BENCH = Path(__file__).with_name("bench.py")
SECONDS_AT_LEAST = 5.0


@dataclass(frozen=True)
class Settings:
    """How carefully a task measures: rounds, seconds a contestant may use up, seconds of a training run."""

    rounds: int = 7
    budget: float = 60.0
    patience: float = 3600.0

    def flags(self) -> list[str]:
        """Return them as arguments of ``bench.py``."""
        return [f"--{name}={value}" for name, value in vars(self).items()]


def variables(*, wide: bool) -> dict[str, str]:
    """Return the environment of a task: its precision; and it takes a device's memory only as it needs it."""
    chosen = {"JAX_ENABLE_X64": "1" if wide else "0", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    return os.environ | chosen


def start(task: str, settings: Settings, *, wide: bool = False, alone: bool = False) -> subprocess.Popen[str]:
    """Start a task; ``alone`` in a session of its own, so that it can be ended with all that it started."""
    return subprocess.Popen(
        [sys.executable, str(BENCH), "--task", task, *settings.flags()],
        env=variables(wide=wide),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=alone,
    )


def last_result(task: str, settings: Settings, until: float) -> dict[str, Any]:
    """Do a task; return the last result that it printed, and under ``error`` why there is none or no more.

    Args:
        task: for ``tasks.results``.
        settings: passed on.
        until: stop it at this time of ``time.monotonic``.
    """
    process = start(task, settings, alone=True)
    wait = None if math.isinf(until) else max(until - time.monotonic(), SECONDS_AT_LEAST)
    problem = {}
    try:
        out, err = process.communicate(timeout=wait)
        if process.returncode:
            problem = {"error": f"exit status {process.returncode}: {err.strip()[-200:]}"}
    except subprocess.TimeoutExpired:
        _end(process)
        out, _ = process.communicate()
        problem = {"error": "stopped, for want of time"}
    finally:
        _end(process)
    return newest(out) | problem


def newest(out: str) -> dict[str, Any]:
    """Return the last line of an output that is a JSON object, or an empty one; a line cut short is none."""
    return next(_objects(out), {})


def _objects(out: str) -> Iterator[dict[str, Any]]:
    """Yield the JSON objects among printed lines, the last one first; a line cut short is none."""
    for line in reversed(out.splitlines()):
        try:
            found = json.loads(line)
        except ValueError:
            continue
        if isinstance(found, dict):
            yield found


def _end(process: subprocess.Popen[str]) -> None:
    """End a process that still runs, with all that it started itself."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
