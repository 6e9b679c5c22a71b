"""The cousin split: does it find what is there and nothing else, and what is the memory worth that it writes?

Power and size are measured as ``planted.py`` does for the other operators: in one leaf the return depends on
which of two cousins, children of one uncle, was active one step before. Run
``python benchmarks/hierarchy/cousin.py``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.hierarchy.planted import simulate, world
from jaxpomdp.structure.coupled_tree import coupled_tree
from jaxpomdp.structure.coupled_tree_edits import CousinSplitConfig, propose_cousin
from jaxpomdp.structure.operators import propose
from jaxpomdp.structure.tree_tests import TreeSplitConfig

RESULT = Path(__file__).parents[1] / "results" / "hierarchy" / "cousin.json"


def found(seed: int, steps: int, config: TreeSplitConfig) -> dict[str, bool]:
    """Say who fires: the split on a planted leaf, other splits there, and the split where nothing is."""
    spec = world(seed)
    leaf = int(np.random.default_rng(seed).integers(spec.num_states))
    planted = simulate(spec, seed, steps, "cousin", leaf)
    coupled, cousin = coupled_tree(spec), CousinSplitConfig(config)
    others = {kind: propose(kind, spec, planted, config) for kind in ("brother", "uncle", "parent")}
    fired = {kind: any(edit.node == leaf for edit in edits) for kind, edits in others.items()}
    ours = any(edit.node == leaf for edit in propose_cousin(coupled, planted, cousin))
    nothing = propose_cousin(coupled, simulate(spec, seed + 100_000, steps), cousin)
    return {"power": ours, "size": bool(nothing)} | {f"{kind} fires there": x for kind, x in fired.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--steps", type=int, nargs="+", default=[12_000, 50_000])
    parser.add_argument("--level", type=float, default=0.05)
    arguments = parser.parse_args()
    config, rows = TreeSplitConfig(significance=arguments.level), []
    for steps in arguments.steps:
        runs = [found(seed, steps, config) for seed in range(arguments.runs)]
        shares = {name: float(np.mean([run[name] for run in runs])) for name in runs[0]}
        rows.append({"runs": arguments.runs, "steps": steps, "level": arguments.level} | shares)
        print(rows[-1], flush=True)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
