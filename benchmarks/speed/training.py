"""W6: a whole training run in a process of its own, with an empty cache and a full one.

It is ``jaxpomdp train`` without its command line, so that it runs where that is not installed, and with the
environment that the command line makes for itself.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxpomdp.cli import environment

SEEDS = 21
PROGRAM = f"""
import sys
from pathlib import Path
from jaxpomdp.experiments.commands import Train
Train(Path(sys.argv[1]), env="maze89", agent="udhmm", seeds={SEEDS}, trials=1000, evaluate_every=0,
      final_trials=1, progress="none").run()
"""


def run(cache: Path, patience: float) -> dict[str, Any]:
    """Return the seconds of one run, in all and by part; one that lasts too long is stopped."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run"
        variables = os.environ | environment() | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
        arguments = [sys.executable, "-c", PROGRAM, str(path)]
        begin = time.perf_counter()
        try:
            subprocess.run(arguments, env=variables, check=True, stdout=subprocess.DEVNULL, timeout=patience)
        except subprocess.TimeoutExpired:
            return {"stopped_after": patience, "trials": _trials(path)}
        wall = time.perf_counter() - begin
        summary = json.loads((path / "summary.json").read_text())
    return {"wall": wall, **summary["seconds"]}


def _trials(path: Path) -> int:
    """Return how many trials of each seed an unfinished run had written down."""
    try:
        rows = (path / "trials.csv").read_text().splitlines()
    except OSError:
        return 0
    return (len(rows) - 1) // SEEDS


def compare(patience: float) -> Iterator[dict[str, Any]]:
    """Yield a run that compiles everything, then one that finds it in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        found = {}
        for kind in ("cold", "warm"):
            found[kind] = run(Path(folder), patience)
            yield {"W6": found}
