"""What is the memory of a coupled hierarchy worth, where cousins matter?

The truth is a tree with a branch and its copy, which emit differently; two cousins of the branch, children of
one uncle, lead one to the branch and the other to the copy. From the same blurred start four models are
fitted to its data, without returns: the tree, which cannot say so; the coupled hierarchy as the cousin split
writes it; the same with memory that is never kept; and the flat model, which has every transition to learn.
Shown is the log-evidence of data not seen, below that of the truth, in nats per step.
Run ``python benchmarks/hierarchy/remembered.py``.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import TrialBatch
from jaxpomdp.coupled_packing import pack_coupled_trees
from jaxpomdp.kernels.memory import pair_chain
from jaxpomdp.kernels.sampling import sample_path
from jaxpomdp.models.coupled_tree import COUPLED_TREE, memory_chain
from jaxpomdp.models.em import EMConfig, fit
from jaxpomdp.models.flat import FLAT
from jaxpomdp.models.hierarchical import HIERARCHICAL
from jaxpomdp.models.selection import held_out
from jaxpomdp.packing import pack
from jaxpomdp.structure.coupled_tree import CoupledTreeSpec, coupled_tree
from jaxpomdp.structure.coupled_tree_edits import follow, write_memory
from jaxpomdp.structure.spec import Channel, safe_log
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_edits import branch_leaves, clone_branch
from jaxpomdp.structure.tree_forms import flatten_tree
from jaxpomdp.structure.tree_init import random_tree
from jaxpomdp.structure.tree_tests import cousins

ACTIONS, SYMBOLS, ROW = 2, 6, 500
RESULT = Path(__file__).parents[1] / "results" / "hierarchy" / "remembered.json"


def emitting(tree: TreeSpec, table: np.ndarray) -> TreeSpec:
    """Return the tree with other observations."""
    return replace(tree, emissions=(Channel("Categorical", {"log_prob": np.log(table)}),))


def led(tree: TreeSpec, uncle: int, top: int, share: float = 0.8) -> TreeSpec:
    """Let the children of the uncle end, and the uncle lead to the branch, with this probability at least."""
    rows = np.exp(tree.log_horizontal)
    goals = [(child, tree.num_nodes) for child in tree.children(uncle)] + [(uncle, top)]
    for node, goal in goals:
        rows[:, node] *= 1 - share
        rows[:, node, goal] += share
    return replace(tree, log_horizontal=safe_log(rows))


def grown(seed: int) -> tuple[CoupledTreeSpec, np.ndarray, tuple[int, int]]:
    """Copy the branch of leaf 0; return the model, the branch's leaves, and two cousins of them."""
    tree = random_tree(seed, 9, ACTIONS, SYMBOLS, levels=2, form="sober", concentration=0.3)
    top, found = int(tree.parent[0]), cousins(tree, 0)
    one, other = (int(node) for node in found.nodes[:2])
    assert found.kin is not None
    tree = led(tree, int(found.kin[0]), top)
    leaves = branch_leaves(tree, top)
    copy = clone_branch(tree, top, np.full(tree.num_nodes + 1, 0.5))
    table = np.exp(copy.emissions[0].values["log_prob"])
    table[tree.num_states :] = np.roll(table[leaves], 1, axis=-1)
    origin = np.concatenate([np.arange(tree.num_states), leaves])
    return follow(coupled_tree(tree), emitting(copy, table), origin), leaves, (one, other)


def written(
    spec: CoupledTreeSpec, leaves: np.ndarray, pair: tuple[int, int], strong: float, keep: float
) -> CoupledTreeSpec:
    """Let one cousin lead to the branch and the other to its copy."""
    places = leaves, np.arange(spec.num_states - len(leaves), spec.num_states)
    for node, share in zip(pair, (1 - strong, strong), strict=True):
        spec = write_memory(spec, np.array([node]), places, share, strong, keep)
    return spec


def drawn(key: Any, spec: CoupledTreeSpec, steps: int) -> TrialBatch:
    """Draw data of the coupled model, in rows of ``ROW`` steps."""
    params = jax.tree.map(lambda x: x[0], pack_coupled_trees([spec], spec.num_states))
    keys, rows = jax.random.split(key, 3), steps // ROW
    shape = (rows, ROW)
    actions = jax.random.randint(keys[0], shape, 0, ACTIONS)
    true = jnp.ones(shape, bool)
    start = ~true.at[:, 0].set(False)
    paths = jax.vmap(lambda k, *tape: sample_path(k, pair_chain(memory_chain(params)), *tape))
    states = paths(jax.random.split(keys[1], rows), actions, start, true) // params.alive.shape[0]
    seen = jax.random.categorical(keys[2], params.tree.emissions[0].log_prob[states])
    zero = jnp.zeros(shape)
    return TrialBatch((seen,), actions, zero, zero, true, start, ~true, true, ~true)


def contestants(spec: CoupledTreeSpec, leaves: np.ndarray, pair: tuple[int, int]) -> dict[str, Any]:
    """Return each model's family and where it starts: observations blurred, cousins told apart if it can."""
    table = np.exp(spec.tree.emissions[0].values["log_prob"])
    blurred = replace(spec, tree=emitting(spec.tree, 0.9 * table + 0.1 / SYMBOLS))
    kept, noted = (written(blurred, leaves, pair, 0.95, keep) for keep in (0.1, 0.0))
    flat = replace(flatten_tree(blurred.tree), log_trans=kept.log_alone)
    room = spec.num_states
    return {
        "tree": (HIERARCHICAL, pack([blurred.tree], room)),
        "coupled": (COUPLED_TREE, pack_coupled_trees([kept], room)),
        "coupled, never kept": (COUPLED_TREE, pack_coupled_trees([noted], room)),
        "flat": (FLAT, pack([flat], room)),
    }


def below_truth(seed: int, steps: int, keep: float, config: EMConfig) -> dict[str, float]:
    """Fit every model to ``steps`` of data, and score it on data that it has not seen."""
    spec, leaves, pair = grown(seed)
    truth = written(spec, leaves, pair, 0.98, keep)
    keys = jax.random.split(jax.random.key(seed))
    data, unseen = drawn(keys[0], truth, steps), drawn(keys[1], truth, 16 * ROW)
    best = held_out(COUPLED_TREE, pack_coupled_trees([truth], spec.num_states), unseen)
    deaf = held_out(HIERARCHICAL, pack([truth.tree], spec.num_states), unseen)
    scores = {"truth without memory": float((best - deaf)[0])}
    for name, (family, params) in contestants(spec, leaves, pair).items():
        fitted, _ = fit(family, params, data, config)
        scores[name] = float((best - held_out(family, fitted, unseen))[0])
    return scores


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=12)
    parser.add_argument("--steps", type=int, nargs="+", default=[8000])
    parser.add_argument("--keep", type=float, nargs="+", default=[0.0, 0.8])
    arguments = parser.parse_args()
    config, rows = EMConfig(iterations=60), []
    for keep in arguments.keep:
        for steps in arguments.steps:
            runs = [below_truth(seed, steps, keep, config) for seed in range(arguments.runs)]
            medians = {name: round(float(np.median([run[name] for run in runs])), 5) for name in runs[0]}
            wins = {
                f"coupled over {name}": sum(run["coupled"] < run[name] for run in runs)
                for name in ("tree", "flat")
            }
            rows.append({"runs": len(runs), "kept in truth": keep, "steps": steps} | medians | wins)
            print(rows[-1], flush=True)
    RESULT.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
