"""How fast this is, beside what a user would pick instead and beside the machine's limit: `make bench`.

    python benchmarks/speed/bench.py [--only W2 W5 ...] [--name speed] [--rounds 7] [--minutes 30]

Writes NAME.json, NAME.md and NAME.png after every part. Peers that are not installed are left out, and said
so. `--only` without a part writes the page and the picture again. On a machine with a GPU, as it is:

    PYTHONPATH=. python3 benchmarks/speed/bench.py --name speed-gpu --rounds 5 --budget 3 --minutes 6.5
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
import traceback
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

from processes import Settings, last_result

LOADS = ("W2", "W1", "W3", "W4")
PARTS = (*LOADS, "seeds", "W5", "long", "memory", "W6", "growth")
"""In order of importance, for when time runs out."""

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


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def machine() -> str:
    """Describe the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        model = platform.processor() or platform.machine()
    return f"{model}, {cores()} cores"


def memory(result: Mapping[str, Any], until: float) -> dict[str, Any]:
    """Return the parts of a result with the memory that each contestant takes, measured side by side."""
    pairs = [(part, who) for part in LOADS if part in result for who in result[part].get("contestants", {})]

    def peak(pair: tuple[str, str]) -> float | None:
        return last_result(f"memory {' '.join(pair)}", Settings(), until).get("mebibytes")

    with ThreadPoolExecutor(max(cores() // 2, 1)) as pool:
        peaks = list(pool.map(peak, pairs))
    for (part, who), value in zip(pairs, peaks, strict=True):
        result[part]["contestants"][who]["peak_mebibytes"] = value
    return {part: result[part] for part, _ in pairs}


def shares(result: dict[str, Any]) -> None:
    """Put down what each contestant makes of the machine's arithmetic."""
    from workloads import LOADS as loads

    limit = result.get("limits", {}).get("gflops")
    for part in (p for p in LOADS if limit and p in result):
        for row in result[part]["contestants"].values():
            row["share_of_gemm_peak"] = loads[part].flop / row["milliseconds"] / 1e6 / limit


def measure(parts: list[str], settings: Settings, until: float, result: dict[str, Any]) -> Iterator[str]:
    """Put each part into a result and yield its name, so that a run cut short keeps the rest."""
    known = "limits" in result and set(parts) != set(PARTS)
    for part in parts if known or not parts else ["limits", *parts]:
        left = until - time.monotonic()
        if left <= 0:
            return
        begin = time.monotonic()
        if part == "memory":
            found = memory(result, until)
        else:
            patient = Settings(settings.rounds, settings.budget, min(settings.patience, left / 2))
            found = last_result(part, patient, until)
        problem = {part: found.pop("error", "")}
        result |= found
        shares(result)
        result["problems"] = result.get("problems", {}) | problem
        result["seconds"] = result.get("seconds", {}) | {part: round(time.monotonic() - begin, 1)}
        yield part


def write(result: dict[str, Any], out: Path) -> None:
    """Write the result, its page and its picture."""
    from figures import draw
    from page import page

    name = result["name"]
    (out / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
    (out / f"{name}.md").write_text(page(result))
    draw(result, out / f"{name}.png")


def task(name: str, settings: Settings) -> None:
    """Do what the parent process asked for: print a line for each result, and what went wrong."""
    from tasks import results

    found: dict[str, Any] = {}
    try:
        for found in results(name, settings):
            print(json.dumps(found), flush=True)
    except Exception as error:
        traceback.print_exc()
        told = next(iter(str(error).splitlines()), "")[:300]
        print(json.dumps(found | {"error": f"{type(error).__name__}: {told}"}), flush=True)


def main() -> None:
    """Parse, measure, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--name", default="speed", help="of the files that are written")
    parser.add_argument("--rounds", type=int, default=Settings.rounds)
    parser.add_argument("--budget", type=float, default=Settings.budget, help="seconds for each contestant")
    parser.add_argument("--patience", type=float, default=Settings.patience, help="seconds for a run of W6")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so many")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results"))
    parser.add_argument("--task", help=argparse.SUPPRESS)
    options = parser.parse_args()
    settings = Settings(options.rounds, options.budget, options.patience)
    if options.task:
        return task(options.task, settings)
    until = time.monotonic() + 60 * options.minutes
    path = options.out / f"{options.name}.json"
    result = json.loads(path.read_text()) if path.exists() else {"name": options.name}
    if options.only:
        named = "" if options.name == "speed" else f" --name {options.name}"
        command = f"python benchmarks/speed/bench.py{named}"
        result |= {"command": command, "machine": machine(), "versions": versions()}
    options.out.mkdir(parents=True, exist_ok=True)
    write(result, options.out)
    for part in measure([p for p in PARTS if p in options.only], settings, until, result):
        write(result, options.out)
        print(f"{part}: {result['seconds'][part]} s. {result['problems'][part]}", flush=True)
    print(f"written: {path}, {options.name}.md and {options.name}.png")


if __name__ == "__main__":
    main()
