"""W1 to W4: one E-step, ours beside its peers; accuracy; and how time grows with each size."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from contestants import CONTESTANTS, MISSING
from timing import medians, seconds
from workloads import LOADS, Load, draw


def prepared(load: Load, names: list[str]) -> tuple[dict[str, Any], dict[str, float], dict[str, str]]:
    """Return the calls that run here, the seconds of each first call, and why others do not."""
    data, calls, first, refused = draw(load), {}, {}, {}
    for name in names:
        try:
            call = CONTESTANTS[name](load, data)
            first[name] = seconds(call)
            calls[name] = call
        except (MemoryError, ImportError, ValueError) as reason:
            refused[name] = f"{type(reason).__name__}: {reason}"
    return calls, first, refused


def compare(name: str, rounds: int, budget: float, limit: Mapping[str, float]) -> dict[str, Any]:
    """Return a workload's times, ratios to ours, and the share of the machine's limit."""
    load = LOADS[name]
    calls, first, refused = prepared(load, list(CONTESTANTS))
    taken = medians(calls, rounds, budget)
    rows = {}
    for who, value in taken.items():
        rows[who] = {
            "milliseconds": 1e3 * value,
            "times_ours": value / taken["ours"],
            "compile_seconds": max(first[who] - value, 0.0),
            "share_of_gemm_peak": load.flop / value / 1e9 / limit["gflops"],
            "note": MISSING.get(who, ""),
        }
    return {"what": str(load), "contestants": rows, "left_out": refused}


def outcome(name: str, plan: str) -> dict[str, np.ndarray]:
    """Return the log-evidence and expected transitions of a workload under a plan, in JAX's precision now."""
    from contestants import ours

    load, wide = LOADS[name], jax.config.read("jax_enable_x64")
    data = draw(load)
    if wide:
        data = type(data)(*(x.astype(np.float64) if x.dtype == np.float32 else x for x in data))
    found = ours(plan)(load, data)()
    return {"evidence": np.asarray(found.log_evidence), "xi": np.asarray(found.xi)}  # pyright: ignore


BASE = Load(models=4, trials=16, steps=64, states=16, actions=4, symbols=16)
GROWTH = {
    "T": ("steps", (32, 100, 320, 1000, 3200)),
    "N": ("states", (4, 12, 40, 120, 400)),
    "A": ("actions", (1, 3, 10, 30, 100)),
    "B": ("trials", (4, 12, 40, 120, 400)),
    "S": ("models", (1, 3, 10, 30, 100)),
}
"""One size at a time, over two orders of magnitude, the others as in ``BASE``."""


def growth(rounds: int) -> dict[str, Any]:
    """Return milliseconds of our E-step against each size."""
    curves = {}
    for letter, (field, sizes) in GROWTH.items():
        times = []
        for size in sizes:
            calls, _, _ = prepared(BASE._replace(**{field: size}), ["ours", "ours, XLA only"])
            times.append(medians(calls, rounds, 20))
        curves[letter] = {
            "sizes": list(sizes),
            "milliseconds": {who: [1e3 * t[who] for t in times] for who in times[0]},
        }
    return curves
