"""W1 to W4: one E-step, ours beside its peers; accuracy; and how time grows with each size."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from contestants import CONTESTANTS, MISSING, ON_THE_CPU, entrants, ours
from timing import LACKING, medians, on_cpu, reason, seconds
from workloads import LOADS, Load, draw

from jaxpomdp.kernels.posterior import choose_plan


def prepared(load: Load, names: list[str]) -> tuple[dict[str, Any], dict[str, float], dict[str, str]]:
    """Return the calls that run here, the seconds of each first call, and why others do not."""
    data, calls, first, refused = draw(load), {}, {}, {}
    for name in names:
        try:
            call = CONTESTANTS[name](load, data)
            first[name] = seconds(call)
            calls[name] = call
        except LACKING as error:
            refused[name] = reason(error)
    return calls, first, refused


def compare(name: str, rounds: int, budget: float) -> dict[str, Any]:
    """Return a workload's times, their ratios to ours, and who was left out."""
    load = LOADS[name]
    calls, first, refused = prepared(load, entrants(load))
    if not on_cpu():
        refused |= dict.fromkeys(ON_THE_CPU, "computes on the CPU")
    taken = medians(calls, rounds, budget)
    rows = {
        who: {
            "milliseconds": 1e3 * value,
            "times_ours": value / taken["ours"],
            "compile_seconds": max(first[who] - value, 0.0),
            "note": MISSING.get(who, ""),
        }
        for who, value in taken.items()
    }
    sizes = (load.models, load.trials, load.steps, load.states)
    rows["ours"]["note"] = f"plan `{choose_plan('auto', np.dtype(np.float32), sizes)}`"
    return {"what": str(load), "contestants": rows, "left_out": refused}


def outcome(name: str, plan: str) -> dict[str, np.ndarray]:
    """Return the log-evidence and expected transitions of a workload under a plan, in JAX's precision now."""
    load, wide = LOADS[name], jax.config.read("jax_enable_x64")
    data = draw(load)
    if wide:
        data = type(data)(*(x.astype(np.float64) if x.dtype == np.float32 else x for x in data))
    found: Any = ours(plan)(load, data)()
    return {"evidence": np.asarray(found.log_evidence), "xi": np.asarray(found.xi)}


BASE = Load(models=4, trials=16, steps=64, states=16, actions=4, symbols=16)
GROWTH = {
    "T": ("steps", (32, 100, 320, 1000, 3200)),
    "N": ("states", (4, 12, 40, 120, 400)),
    "A": ("actions", (1, 3, 10, 30, 100)),
    "B": ("trials", (4, 12, 40, 120, 400)),
    "S": ("models", (1, 3, 10, 30, 100)),
}
"""One size at a time, over two orders of magnitude, the others as in ``BASE``."""

LENGTHS = (100, 320, 1000, 3200, 10_000, 32_000, 100_000)
PATIENCE = 5.0
"""Seconds: who would take longer for one long tape sits out, and all longer ones."""


def growth(rounds: int) -> Iterator[dict[str, Any]]:
    """Yield milliseconds of our E-step against each size; fewer sizes on an accelerator."""
    curves = {}
    thin, names = (1, ["ours", "ours, XLA only"]) if on_cpu() else (2, ["ours"])
    for letter, (field, sizes) in GROWTH.items():
        times: dict[str, list[float]] = {name: [] for name in names}
        for size in sizes[::thin]:
            calls, _, _ = prepared(BASE._replace(**{field: size}), names)
            for name, value in medians(calls, rounds, 20).items():
                times[name].append(1e3 * value)
        curves[letter] = {"sizes": list(sizes[::thin]), "milliseconds": times}
        yield {"growth": curves}


def long(rounds: int) -> Iterator[dict[str, Any]]:
    """Yield milliseconds of one E-step on a single tape, as W4's, against its length."""
    names = ["ours", "ours, XLA only", "ours, blocked", *([] if on_cpu() else ["ours, mapped"])]
    times: dict[str, dict[int, float]] = {name: {} for name in names}
    last = 0
    for steps in LENGTHS[:: 1 if on_cpu() else 2]:
        names = [n for n in names if not last or times[n].get(last, np.inf) * steps / last < 1e3 * PATIENCE]
        calls, _, _ = prepared(LOADS["W4"]._replace(steps=steps), names)
        for name, value in medians(calls, rounds, PATIENCE).items():
            times[name][steps] = 1e3 * value
        last = steps
        yield {"long": {"states": LOADS["W4"].states, "milliseconds": times}}
