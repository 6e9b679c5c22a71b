"""Chapter 5's claim measured: linear in T, where the algorithm of Fine, Singer and Tishby (1998) is cubic.

``span_evidence`` is theirs, the inside pass over all spans of a sequence, with actions and with trials that
may be cut off in the middle of the tree's activity; slow and plain. Run
``python benchmarks/hierarchy/cubic.py``.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_forms import flatten_tree
from jaxpomdp.structure.tree_init import random_tree

RESULT = Path(__file__).parents[1] / "results" / "hierarchy" / "cubic.json"


def span_evidence(spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> float:
    """Return the log-probability of one trial of ``T`` symbols and ``T - 1`` actions, in ``O(T^3)``.

    ``inside[s][t, u]`` is the chance that an internal state entered at t shows ``o_t .. o_u`` and ends then.
    ``reach[t, u, c]``: as far as that its child c has ended at u. At the trial's last step everything may be
    cut off, so it counts as ended.
    """
    tables, reach = _Tables(spec, symbols, actions), np.zeros((1, 1, 1))
    inside: dict[int, np.ndarray] = {}
    for node in sorted(range(spec.root, spec.num_nodes), key=lambda m: (-spec.depth[m], m)):
        children = spec.children(node)
        reach = _reach(tables, node, children, inside)
        inside[node] = np.einsum("tuc,uc->tu", reach, tables.ends[:, children])
    return float(np.log(reach[0, -1].sum()))


class _Tables:
    """Probabilities by step: ``down[T, I, M]`` on entering, ``across[T-1, M, M]``, ``ends[T, M]`` after."""

    def __init__(self, spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> None:
        vertical, horizontal = np.exp(spec.log_vertical), np.exp(spec.log_horizontal)
        later = vertical[:-1] if len(vertical) > 1 else np.repeat(vertical, len(horizontal), 0)
        self.spec = spec
        self.seen = np.exp(spec.emissions[0].values["log_prob"])[:, symbols].T
        self.down = np.concatenate([vertical[-1:], later[actions]])
        self.across = horizontal[actions][:, :, :-1]
        self.ends = np.concatenate([horizontal[actions][:, :, -1], np.ones((1, spec.num_nodes))])


def _reach(tables: _Tables, node: int, children: np.ndarray, inside: dict[int, np.ndarray]) -> np.ndarray:
    steps, spec = len(tables.seen), tables.spec
    reach = np.zeros((steps, steps, len(children)))
    for t in range(steps):
        first = tables.down[t, node - spec.root, children]
        for u in range(t, steps):
            for c, child in enumerate(children):
                if child < spec.num_states:
                    came = first[c] if u == t else reach[t, u - 1] @ tables.across[u - 1, children, child]
                    reach[t, u, c] = came * tables.seen[u, child]
                    continue
                reach[t, u, c] = first[c] * inside[child][t, u]
                for v in range(t + 1, u + 1):
                    came = reach[t, v - 1] @ tables.across[v - 1, children, child]
                    reach[t, u, c] += came * inside[child][v, u]
    return reach


def flat_evidence(spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> float:
    """Return the same through the flat chain in ``O(N^2 T)``, in the same plain NumPy."""
    flat = flatten_tree(spec)
    init, trans = np.exp(flat.log_init), np.exp(flat.log_trans)
    seen = np.exp(flat.emissions[0].values["log_prob"])
    belief, total = init * seen[:, symbols[0]], 0.0
    for action, symbol in zip(actions, symbols[1:], strict=True):
        total += np.log(belief.sum())
        belief = (belief / belief.sum()) @ trans[action] * seen[:, symbol]
    return float(total + np.log(belief.sum()))


def seconds(run: Callable[..., float], *arguments: object) -> float:
    """Return the least time of a few runs, in CPU seconds."""
    times = []
    for _ in range(3):
        begin = time.process_time()
        run(*arguments)
        times.append(time.process_time() - begin)
    return min(times)


def main() -> None:
    rows, rng = [], np.random.default_rng(0)
    spec = random_tree(0, 8, 2, 4, levels=2, form="sober")
    for steps in (16, 32, 64, 128, 1000, 2000, 4000):
        data = rng.integers(4, size=steps), rng.integers(2, size=steps - 1)
        row: dict[str, float] = {"T": steps, "flat_s": seconds(flat_evidence, spec, *data)}
        if steps <= 128:
            row["span_s"] = seconds(span_evidence, spec, *data)
        rows.append(row)
        print(row, flush=True)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps({"N": 8, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
