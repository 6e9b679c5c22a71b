"""Do the operators find what is there, and nothing else? Synthetic data with an inconsistency of one kind.

A path is drawn from a random tree, with observations and returns of the leaves. Planted: in one leaf the
observation or the return depends on what was active one step before, in the way that one operator looks for.
Power is how often that operator fires on the planted leaf; size how often it fires at all on data without it,
which should be no more than the significance level. Run ``python benchmarks/hierarchy/planted.py``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from jaxpomdp.structure.evidence import even_edges
from jaxpomdp.structure.operators import TREE_SPLITS, propose
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_evidence import TreeEvidence, tree_evidence
from jaxpomdp.structure.tree_forms import flatten_tree, maximal
from jaxpomdp.structure.tree_init import random_tree
from jaxpomdp.structure.tree_tests import Conditions, TreeSplitConfig, activations, brothers, uncles

KINDS = ("observation", "brother", "uncle", "parent")
SYMBOLS, ACTIONS = 4, 2
RESULT = Path(__file__).parents[1] / "results" / "hierarchy" / "operators.json"


def world(seed: int) -> TreeSpec:
    """Draw a tree of three branches of three leaves each."""
    while True:
        spec = random_tree(seed, 9, ACTIONS, SYMBOLS, levels=2, form="sober", concentration=2.0)
        if spec.num_internal == 4:
            return spec
        seed += 1


def conditions_for(kind: str, spec: TreeSpec, leaf: int) -> Conditions:
    """Return what the operator tells apart; the parent's activations weigh transitions evenly."""
    if kind == "parent":
        even = np.exp(flatten_tree(spec).log_trans)
        return activations(spec, maximal(spec), leaf, even)
    return uncles(spec, leaf) if kind == "uncle" else brothers(spec, leaf)


def simulate(
    spec: TreeSpec, seed: int, steps: int, plant: str | None = None, leaf: int = 0, shift: float = 1.0
) -> TreeEvidence:
    """Draw a path of ``steps`` and gather the evidence with the states known, the plant in ``leaf``."""
    rng = np.random.default_rng(seed)
    flat = flatten_tree(spec)
    actions = rng.integers(ACTIONS, size=steps)
    states = _path(rng, np.exp(flat.log_init), np.exp(flat.log_trans), actions)
    table = np.exp(spec.emissions[0].values["log_prob"])
    symbols = (table[states].cumsum(1) > rng.uniform(size=(steps, 1))).argmax(1)
    returns = spec.return_mean[states, 0] + rng.normal(size=steps)
    if plant is not None:
        groups = conditions_for(plant, spec, leaf).groups.astype(float)
        chance = groups[0][np.roll(states, 1)] * (states == leaf)
        marked = rng.uniform(size=steps) < chance
        symbols[marked & (rng.uniform(size=steps) < 0.5 * shift) & (plant == "observation")] = 0
        returns[marked & (actions == 0) & (plant != "observation")] += shift
    pairs = np.zeros((steps, spec.num_states, spec.num_states))
    pairs[np.arange(1, steps), states[:-1], states[1:]] = 1
    edges = even_edges(returns.min(), returns.max(), 12)
    return tree_evidence(pairs, actions, symbols, returns, edges, num_actions=ACTIONS, num_symbols=SYMBOLS)


def _path(rng: np.random.Generator, init: np.ndarray, trans: np.ndarray, actions: np.ndarray) -> np.ndarray:
    states = np.zeros(len(actions), int)
    state = int(rng.choice(len(init), p=init / init.sum()))
    ways = trans.cumsum(-1)
    for t in range(len(actions)):
        states[t] = state
        state = min(int(np.searchsorted(ways[actions[t], state], rng.uniform())), len(init) - 1)
    return states


def power_and_size(kind: str, runs: int, steps: int, level: float) -> dict[str, float]:
    """Return how often the operator fires on the planted leaf, and how often with nothing planted."""
    config = TreeSplitConfig(significance=level)
    found = fired = 0
    for seed in range(runs):
        spec = world(seed)
        leaf = int(np.random.default_rng(seed).integers(spec.num_states))
        planted = propose(kind, spec, simulate(spec, seed, steps, kind, leaf), config)
        found += any(edit.node == leaf for edit in planted)
        fired += bool(propose(kind, spec, simulate(spec, seed + runs, steps), config))
    return {"runs": runs, "steps": steps, "level": level, "power": found / runs, "size": fired / runs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--level", type=float, default=0.05)
    arguments = parser.parse_args()
    rows = {}
    for operator, _ in TREE_SPLITS:
        rows[operator.kind] = power_and_size(operator.kind, arguments.runs, arguments.steps, arguments.level)
        print(operator.kind, rows[operator.kind], flush=True)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
