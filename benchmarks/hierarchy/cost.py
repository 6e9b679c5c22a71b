"""What an EM iteration of a tree costs beside the flat model of as many states; times in turn, medians.

Run ``python benchmarks/hierarchy/cost.py``: both models on the same tapes, for several N and T.
"""

from __future__ import annotations

import json
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxpomdp.models.data import trial_batch
from jaxpomdp.models.em import EMConfig, as_models, em_step
from jaxpomdp.models.flat import FLAT
from jaxpomdp.models.hierarchical import HIERARCHICAL
from jaxpomdp.packing import pack
from jaxpomdp.structure.tree_forms import flatten_tree
from jaxpomdp.structure.tree_init import random_tree

ACTIONS, SYMBOLS, TRIALS = 5, 17, 50
SIZES = ((20, 60), (60, 60), (60, 120), (60, 240), (120, 120))
RESULT = Path(__file__).parents[1] / "results" / "hierarchy" / "cost.json"


def data(steps: int) -> Any:
    """Draw trials of so many steps."""
    rng = np.random.default_rng(0)
    return trial_batch(
        [rng.integers(SYMBOLS, size=steps) for _ in range(TRIALS)],
        [rng.integers(ACTIONS, size=steps - 1) for _ in range(TRIALS)],
        [rng.normal(size=steps - 1) for _ in range(TRIALS)],
    )


def compare(states: int, steps: int, rounds: int = 15) -> dict[str, float]:
    """Return median milliseconds of one iteration of either model, and the median ratio of neighbours."""
    spec = random_tree(0, states, ACTIONS, SYMBOLS)
    config = EMConfig(theta=0.2)
    models = {
        "flat": (FLAT, pack([flatten_tree(spec)], states)),
        "tree": (HIERARCHICAL, pack([spec], states)),
    }
    models = {name: (family, *as_models(p, data(steps))[:2]) for name, (family, p) in models.items()}
    times: dict[str, list[float]] = {"flat": [], "tree": []}
    for turn in range(rounds + 2):
        for name, (family, params, batch) in models.items():
            begin = time.perf_counter()
            jax.block_until_ready(em_step(family, params, batch, config))
            if turn >= 2:
                times[name].append(1e3 * (time.perf_counter() - begin))
    ratios = [t / f for t, f in zip(times["tree"], times["flat"], strict=True)]
    medians = {f"{name}_ms": round(statistics.median(each), 2) for name, each in times.items()}
    least = {f"{name}_least_ms": round(min(each), 2) for name, each in times.items()}
    return {"N": states, "T": TRIALS * steps} | medians | least | {"ratio": statistics.median(ratios)}


def main() -> None:
    rows = []
    for states, steps in SIZES:
        rows.append(compare(states, steps))
        print(rows[-1], flush=True)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps({"actions": ACTIONS, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
