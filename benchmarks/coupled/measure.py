"""Inference of two coupled chains: approximate against exact, cost against sizes, and a flat chain beside it.

    python benchmarks/coupled/measure.py errors cost flat

Each part writes ``benchmarks/results/coupled-NAME.json``, and the first two a picture. All models are random;
seeds are fixed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxpomdp._types import Chain
from jaxpomdp.experiments.record import versions, write_json
from jaxpomdp.kernels.coupled import CoupledChain
from jaxpomdp.kernels.coupled_plans import coupled_posterior, marginal_posterior
from jaxpomdp.kernels.posterior import posterior

OUT = Path("benchmarks/results")
STRENGTHS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
SIZES = ((8, 4), (16, 4), (25, 4), (40, 4), (25, 2), (25, 8), (25, 12))


def rows_of(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return np.log(np.maximum(rng.dirichlet(np.ones(shape[-1]), shape[:-1]), 1e-9))


def softmax(logits: np.ndarray) -> np.ndarray:
    peak = logits.max(-1, keepdims=True)
    return logits - peak - np.log(np.exp(logits - peak).sum(-1, keepdims=True))


def tapes(rng: np.random.Generator, models: int, trials: int, steps: int, sizes: tuple[int, ...]) -> tuple:
    """Draw log densities of emissions (standard normal times 2), actions, one trial a tape."""
    shape = (models, trials, steps)
    rows = tuple(jnp.asarray(2 * rng.normal(size=(*shape, n)), jnp.float32) for n in sizes)
    actions = jnp.asarray(rng.integers(0, 4, shape), jnp.int32)
    start = jnp.zeros(shape, bool).at[..., 0].set(True)
    return rows, actions, start, jnp.ones(shape, bool)


def chains(rng: np.random.Generator, models: int, one: int, two: int, strength: float) -> CoupledChain:
    """Draw chains whose next state follows ``softmax(own + strength * other)``, logits standard normal."""

    def table(own: int, new: int) -> jax.Array:
        first = rng.normal(size=(models, 4, one, 1, new)), rng.normal(size=(models, 4, 1, two, new))
        logits = 2 * first[own] + strength * first[1 - own]
        return jnp.asarray(softmax(np.broadcast_to(logits, (models, 4, one, two, new))), jnp.float32)

    init = tuple(jnp.asarray(rows_of(rng, models, n), jnp.float32) for n in (one, two))
    return CoupledChain(init, (table(0, one), table(1, two)))


def error_rows(models: int = 20, steps: int = 40, sizes: tuple[int, int] = (8, 4)) -> list[dict[str, Any]]:
    """Compare both on one tape of each of many models, by strength of the coupling."""
    found = []
    for strength in STRENGTHS:
        rng = np.random.default_rng(7)
        chain, tape = chains(rng, models, *sizes, strength), tapes(rng, models, 1, steps, sizes)
        exact, rough = coupled_posterior(chain, *tape), marginal_posterior(chain, *tape)
        off = np.abs(np.asarray(exact.log_evidence - rough.log_evidence)).ravel() / steps
        away = [np.abs(np.asarray(x - y)).sum(-1) / 2 for x, y in zip(exact.gamma, rough.gamma, strict=True)]
        row = {"strength": strength, "log_evidence_per_step": float(off.mean()), "worst": float(off.max())}
        for c, distance in enumerate(away):
            row |= {f"total_variation_{c}": float(distance.mean()), f"worst_{c}": float(distance.max())}
        found.append(row)
    return found


def milliseconds(calls: dict[str, Callable[[], Any]], rounds: int = 7) -> dict[str, float]:
    """Time calls in turns; medians."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        jax.block_until_ready(call())
    for _ in range(rounds):
        for name, call in calls.items():
            begin = time.perf_counter()
            jax.block_until_ready(call())
            taken[name].append(1e3 * (time.perf_counter() - begin))
    return {name: statistics.median(times) for name, times in taken.items()}


def cost_rows(models: int = 4, trials: int = 8, steps: int = 64) -> list[dict[str, Any]]:
    """Time every plan of exact inference, and of the sweep over marginals, against sizes."""
    found = []
    for sizes in SIZES:
        rng = np.random.default_rng(3)
        given = (chains(rng, models, *sizes, 1.0), *tapes(rng, models, trials, steps, sizes))
        calls = {p: partial(coupled_posterior, *given, plan=p) for p in ("scan", "native")}
        calls["marginals_scan"] = partial(marginal_posterior, *given, plan="scan")
        calls["marginals"] = partial(marginal_posterior, *given)
        found.append({"states": list(sizes)} | milliseconds(calls, 15))
    return found


def bytes_of(function: Callable[..., Any], *arguments: Any) -> dict[str, int]:
    """Return the bytes of arguments, results and work space of a compiled function."""
    used = jax.jit(function).lower(*arguments).compile().memory_analysis()
    parts = {"arguments": "argument", "results": "output", "work": "temp"}
    sizes = {name: int(getattr(used, f"{field}_size_in_bytes")) for name, field in parts.items()}
    return sizes | {"total": sum(sizes.values())}


def beside_flat() -> dict[str, Any]:
    """Time exact inference at 25 and 12 states beside a flat chain of 300, on 21 times 12 trials of 64."""
    one, two, models, trials, steps = 25, 12, 21, 12, 64
    rng = np.random.default_rng(0)
    given = (chains(rng, models, one, two, 1.0), *tapes(rng, models, trials, steps, (one, two)))
    pairs = one * two
    table = jnp.asarray(rows_of(rng, models, 4, pairs, pairs), jnp.float32)
    chain = Chain(jnp.asarray(rows_of(rng, models, pairs), jnp.float32), table)
    (rows,), *rest = tapes(rng, models, trials, steps, (pairs,))
    calls = {"coupled": partial(coupled_posterior, *given), "flat": partial(posterior, chain, rows, *rest)}
    taken = milliseconds(calls)
    memory = {
        "coupled": bytes_of(partial(coupled_posterior, plan="auto"), *given),
        "flat": bytes_of(posterior, chain, rows, *rest),
    }
    ratios = {
        "times": taken["coupled"] / taken["flat"],
        "bytes": memory["coupled"]["total"] / memory["flat"]["total"],
    }
    return {"milliseconds": taken, "bytes": memory, "coupled_over_flat": ratios}


def draw_errors(found: list[dict[str, Any]], path: Path) -> None:
    """Draw the errors of the sweep over marginals against the strength of the coupling: mean and worst."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
    strengths = [row["strength"] for row in found]
    names = {"log_evidence_per_step": "mean of models", "worst": "worst model"}
    for name, label in names.items():
        axes[0].plot(strengths, [row[name] for row in found], "o-", label=label)
    for c in (0, 1):
        axes[1].plot(
            strengths, [row[f"total_variation_{c}"] for row in found], "o-", label=f"chain {c}, mean"
        )
        axes[1].plot(strengths, [row[f"worst_{c}"] for row in found], "x:", label=f"chain {c}, worst step")
    axes[0].set(ylabel="log-evidence, nats per step", xlabel="strength of the coupling")
    axes[1].set(ylabel="marginals, total variation", xlabel="strength of the coupling")
    _finish(figure, axes, path)


def draw_cost(found: list[dict[str, Any]], path: Path) -> None:
    """Draw the time of each plan against the states of each chain."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), sharey=True)
    labels = {"scan": "exact, XLA", "native": "exact, C++"}
    labels |= {"marginals_scan": "marginals, XLA", "marginals": "marginals, C++"}
    for axis, own, fixed in ((axes[0], 0, 4), (axes[1], 1, 25)):
        rows = sorted((r for r in found if r["states"][1 - own] == fixed), key=lambda r: r["states"][own])
        sizes = [row["states"][own] for row in rows]
        for name, label in labels.items():
            axis.loglog(sizes, [row[name] for row in rows], "o-", label=label)
        axis.set(xlabel=f"states of chain {own}, of {fixed} in the other", xticks=sizes, xticklabels=sizes)
        axis.minorticks_off()
    axes[0].set(ylabel="milliseconds")
    _finish(figure, axes, path)


def _finish(figure: Any, axes: Any, path: Path) -> None:
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


PARTS = {"errors": error_rows, "cost": cost_rows, "flat": beside_flat}
PICTURES = {"errors": draw_errors, "cost": draw_cost}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=f"among {', '.join(PARTS)}")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.parts:
        found = PARTS[name]()
        write_json(options.out / f"coupled-{name}.json", {"versions": versions(), "found": found})
        if name in PICTURES:
            PICTURES[name](found, options.out / f"coupled-{name}.png")
        print(name, found)


if __name__ == "__main__":
    main()
