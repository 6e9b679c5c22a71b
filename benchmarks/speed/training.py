"""W6: a whole training run, as a user starts it, in its own process, with an empty cache and a full one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

COMMAND = (
    "train --env maze89 --agent udhmm --seeds 21 --trials 1000"
    " --evaluate-every 0 --final-trials 1 --progress none"
)


def run(cache: Path) -> dict[str, Any]:
    """Return the seconds of one run, in all and by part."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache)}
        arguments = [sys.executable, "-m", "jaxpomdp.cli", *COMMAND.split(), "--out", f"{folder}/run"]
        begin = time.perf_counter()
        subprocess.run(arguments, env=environment, check=True, stdout=subprocess.DEVNULL)
        wall = time.perf_counter() - begin
        summary = json.loads((Path(folder) / "run" / "summary.json").read_text())
    return {"wall": wall, **summary["seconds"]}


def compare() -> dict[str, Any]:
    """Return a run that compiles everything, and one that finds it in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        return {"cold": run(Path(folder)), "warm": run(Path(folder))}
