"""How fast this is, beside what a user would pick instead and beside the machine's limit: `make bench`.

    python benchmarks/speed/bench.py [--only W1 W5 ...] [--rounds 7] [--out benchmarks/results]

Writes speed.json and speed.png. Peers that are not installed are left out, and said so.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import acting
import inference
import training
from timing import limits
from workloads import LOADS

PARTS = (*LOADS, "W5", "W6", "growth")
PEERS = ("dynamax", "hmmlearn", "pomegranate", "torch", "gymnax", "gymnasium")


def versions() -> dict[str, str]:
    """Return the versions that matter, of what is installed."""
    found = {"python": platform.python_version()}
    for name in ("jaxpomdp", "jax", "jaxlib", "numpy", *PEERS):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def machine() -> str:
    """Describe the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f"{model}, {len(os.sched_getaffinity(0))} cores"


def child(task: str, *, wide: bool = False) -> dict[str, Any]:
    """Do one task in a process of its own, and return what it prints."""
    environment = os.environ | {"JAX_ENABLE_X64": "1" if wide else "0"}
    arguments = [sys.executable, __file__, "--task", task]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[-1] if done.stderr else str(done.returncode)}
    return json.loads(done.stdout.splitlines()[-1])


def peak_memory(name: str, who: str) -> dict[str, float]:
    """Return the mebibytes that one contestant needed beyond what was there before it ran."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    inference.prepared(LOADS[name], [who])
    return {"mebibytes": (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024}


def totals(name: str, plan: str) -> dict[str, Any]:
    """Return what tells float32 from float64: the log-evidence of every trial, and all counts."""
    found = inference.outcome(name, plan)
    return {"evidence": found["evidence"].ravel().tolist(), "xi": found["xi"].ravel().tolist()}


def accuracy(name: str) -> dict[str, float]:
    """Return the largest relative errors of float32 against float64."""
    import numpy as np

    single, double = child(f"totals {name} auto"), child(f"totals {name} grouped", wide=True)
    evidence, exact = np.array(single["evidence"]), np.array(double["evidence"])
    counts, true = np.array(single["xi"]), np.array(double["xi"])
    return {
        "log_evidence": float(np.max(np.abs(evidence - exact) / np.abs(exact))),
        "counts": float(np.max(np.abs(counts - true)) / np.max(true)),
    }


def measure(parts: list[str], rounds: int, budget: float) -> Iterator[dict[str, Any]]:
    """Yield each part that was asked for once it is measured, so that a run cut short keeps the rest."""
    limit = limits()
    yield {"limits": limit}
    for part in parts:
        print(f"{part} ...", file=sys.stderr, flush=True)
        if part in LOADS:
            found = inference.compare(part, rounds, budget, limit)
            for who, row in found["contestants"].items():
                row["peak_mebibytes"] = child(f"memory {part} {who}").get("mebibytes")
            found["float32_error"] = accuracy(part)
        elif part == "W5":
            found = acting.compare(rounds)
        elif part == "W6":
            found = training.compare()
        else:
            found = inference.growth(max(rounds // 2, 1))
        yield {part: found}


def show(result: dict[str, Any]) -> None:
    """Print the tables."""
    for part in (p for p in LOADS if p in result):
        print(f"\n{part}: {result[part]['what']}")
        for who, row in result[part]["contestants"].items():
            times, share = row["times_ours"], 100 * row["share_of_gemm_peak"]
            print(f"  {who:22}{row['milliseconds']:12.1f} ms{times:9.1f} x ours{share:7.1f} % of GEMM")
    for count, row in result.get("W5", {}).items():
        print(f"\nW5: {count} agents, steps per second")
        for who, value in row.items():
            print(f"  {who:34}{value:14,.0f}")
    for kind, row in result.get("W6", {}).items():
        print(f"\nW6, cache {kind}: " + ", ".join(f"{name} {value:.1f} s" for name, value in row.items()))


def main() -> None:
    """Parse, measure, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--budget", type=float, default=60.0, help="seconds a contestant may use up")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--task", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.task:
        kind, name, who = options.task.split(" ", 2)
        print(json.dumps(peak_memory(name, who) if kind == "memory" else totals(name, who)))
        return
    path = options.out / "speed.json"
    result = json.loads(path.read_text()) if path.exists() else {}
    result |= {
        "name": "speed",
        "command": "python benchmarks/speed/bench.py",
        "machine": machine(),
        "versions": versions(),
    }
    options.out.mkdir(parents=True, exist_ok=True)
    for found in measure(options.only, options.rounds, options.budget):
        result |= found
        path.write_text(json.dumps(result, indent=1) + "\n")
        show(found)
    from figures import draw

    draw(result, options.out / "speed.png")
    print(f"\nwritten: {path} and speed.png")


if __name__ == "__main__":
    main()
