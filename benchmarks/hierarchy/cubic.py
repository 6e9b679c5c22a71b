"""Chapter 5's claim measured: linear in T, where the algorithm of Fine, Singer and Tishby (1998) is cubic.

An E-step, which is what EM spends its time on, by their spans (``spans.py``) and through the flat chain, both
in plain NumPy on one trial and one core; against the steps T and the leaves N. Run ``python -m
benchmarks.hierarchy.cubic`` with ``OPENBLAS_NUM_THREADS=1``.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.hierarchy.spans import Counts, span_counts
from jaxpomdp.experiments.plots import COLOURS, new_figure, save
from jaxpomdp.experiments.record import versions
from jaxpomdp.structure.tree import TreeSpec, allowed_horizontal, allowed_vertical
from jaxpomdp.structure.tree_forms import flatten_tree
from jaxpomdp.structure.tree_init import random_tree

RESULT = Path(__file__).parents[1] / "results" / "hierarchy" / "cubic.json"
LENGTHS, LONG = (32, 64, 128, 256, 512, 768), (1536, 3072, 6144)
SIZES, MANY = (4, 9, 16, 36, 64, 144), (256,)
BASE_N, BASE_T = 9, 128


def flat_evidence(spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> float:
    """Return the log-probability of one trial through the flat chain, in ``O(N^2 T)``."""
    flat = flatten_tree(spec)
    init, trans = np.exp(flat.log_init), np.exp(flat.log_trans)
    seen = np.exp(flat.emissions[0].values["log_prob"])
    belief, total = init * seen[:, symbols[0]], 0.0
    for action, symbol in zip(actions, symbols[1:], strict=True):
        total += np.log(belief.sum())
        belief = (belief / belief.sum()) @ trans[action] * seen[:, symbol]
    return float(total + np.log(belief.sum()))


def flat_counts(spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> Counts:
    """Return how often each entry of the tree is expected to be used, through the flat chain (thesis 5.3)."""
    flat, steps = flatten_tree(spec), len(symbols)
    trans, seen = np.exp(flat.log_trans), np.exp(flat.emissions[0].values["log_prob"])[:, symbols].T
    ahead, behind = np.zeros((2, steps, spec.num_states))
    ahead[0] = np.exp(flat.log_init) * seen[0]
    for t in range(steps):
        if t:
            ahead[t] = ahead[t - 1] @ trans[actions[t - 1]] * seen[t]
        ahead[t] /= ahead[t].sum()
    behind[-1], xi = 1, np.zeros_like(trans)
    for t in reversed(range(steps - 1)):
        later = seen[t + 1] * behind[t + 1]
        behind[t] = trans[actions[t]] @ later
        pair = ahead[t][:, None] * trans[actions[t]] * later
        xi[actions[t]] += pair / pair.sum()
        behind[t] /= behind[t].sum()
    gamma = ahead * behind
    gamma /= gamma.sum(-1, keepdims=True)
    shown = np.zeros_like(spec.emissions[0].values["log_prob"])
    np.add.at(shown.T, symbols, gamma)
    return Counts(*_credited(spec, gamma[0], xi), shown)


def _credited(spec: TreeSpec, initial: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add up flat transitions over the leaves below each node: ``D xi D^T`` and its complements."""
    under = spec.below.astype(float)
    inner = 1 - under[spec.num_states :]
    beyond = 1 - under[np.maximum(spec.parent, 0)]
    ends = ((under @ xi) * beyond).sum(-1, keepdims=True)
    horizontal = np.concatenate([under @ xi @ under.T, ends], -1) * allowed_horizontal(spec)
    later = inner @ xi @ under.T * allowed_vertical(spec)
    starts = (under @ initial * allowed_vertical(spec))[None]
    by_action = len(spec.log_vertical) > 1
    vertical = np.concatenate([later, starts]) if by_action else later.sum(0, keepdims=True) + starts
    return vertical, horizontal


def seconds(run: Callable[..., object], *arguments: object) -> float:
    """Return the least time of a few runs, in CPU seconds."""
    times = []
    while len(times) < 3 or (sum(times) < 0.1 and len(times) < 50):
        begin = time.process_time()
        run(*arguments)
        times.append(time.process_time() - begin)
    return min(times)


def compare(leaves: int, steps: int, *, spans: bool) -> dict[str, float]:
    """Time an E-step of both on a tree of two levels, about as many branches as leaves in each."""
    rng = np.random.default_rng(0)
    spec = random_tree(0, leaves, 2, 4, levels=2, form="sober")
    data = rng.integers(4, size=steps), rng.integers(2, size=steps - 1)
    row: dict[str, float] = {"N": leaves, "T": steps, "flat_s": seconds(flat_counts, spec, *data)}
    if spans:
        row["spans_s"] = seconds(span_counts, spec, *data)
    print(row, flush=True)
    return row


def exponent(rows: Sequence[dict[str, float]], size: str, time_of: str) -> float:
    """Return the slope of log time over log size, of the upper half of the sizes: the power that rules."""
    there = [row for row in rows if time_of in row]
    there = there[len(there) // 2 - 1 :] if len(there) > 3 else there
    x, y = (np.log([row[name] for row in there]) for name in (size, time_of))
    return round(float(np.polyfit(x, y, 1)[0]), 2)


def draw(by_steps: Sequence[dict[str, float]], by_leaves: Sequence[dict[str, float]], path: Path) -> Path:
    """Draw both times against both sizes, on logarithmic axes."""
    figure, axes = new_figure(9.2, 3.8, 1, 2)
    named = {"spans_s": "spans (Fine, Singer, Tishby)", "flat_s": "flat chain (thesis 5.3)"}
    panels = ((by_steps, "T", f"steps T (N = {BASE_N})"), (by_leaves, "N", f"leaves N (T = {BASE_T})"))
    for ax, (rows, size, title) in zip(axes, panels, strict=True):
        for colour, (time_of, name) in zip(COLOURS[1::-1], named.items(), strict=True):
            there = [row for row in rows if time_of in row]
            label = f"{name}: {size}$^{{{exponent(rows, size, time_of)}}}$"
            x, y = ([row[key] for row in there] for key in (size, time_of))
            ax.loglog(x, y, "o-", color=colour, markersize=4, label=label)
        ax.set(xlabel=title, ylabel="seconds for an E-step")
        ax.legend(fontsize=8)
    figure.suptitle("Re-estimating a hierarchical HMM, plain NumPy", x=0.01, ha="left", fontweight="bold")
    return save(figure, path)


def main() -> None:
    by_steps = [compare(BASE_N, steps, spans=steps in LENGTHS) for steps in LENGTHS + LONG]
    by_leaves = [compare(leaves, BASE_T, spans=leaves in SIZES) for leaves in SIZES + MANY]
    sizes = {"T": by_steps, "N": by_leaves}
    powers = {
        f"{name} in {size}": exponent(rows, size, f"{name}_s")
        for size, rows in sizes.items()
        for name in ("flat", "spans")
    }
    command = " ".join(["OPENBLAS_NUM_THREADS=1 python -m benchmarks.hierarchy.cubic", *sys.argv[1:]])
    result = {"command": command, "versions": versions(), "exponents": powers}
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(result | {"by_steps": by_steps, "by_leaves": by_leaves}, indent=1) + "\n")
    print(powers, draw(by_steps, by_leaves, RESULT.with_suffix(".png")))


if __name__ == "__main__":
    main()
