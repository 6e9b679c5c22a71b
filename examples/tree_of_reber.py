"""A grammar within a grammar: the embedded Reber grammar, learned from strings, without actions.

A string is ``B``, an outer letter (``T`` or ``P``), a whole string of the inner grammar, the outer letter
once more, ``E``. The inner string says nothing of the outer letter, so a model must remember it for about
eight steps while something else goes on (Hochreiter and Schmidhuber 1997 made it a test of recurrent
networks). Inner strings are alike after either letter: a tree can hold the inner grammar as a branch.

A string is worth 1 or -1 by its outer letter. That value is the return of every step, and learning sees it
(theta = .2); the models are then judged on new strings without it: bits a symbol, and how often the right
outer letter at the end is likelier than the wrong one (a guess is right in half of the strings).

Compared, from a number of random starts each: a flat model of 30 states, a tree of 30 leaves of random shape,
a tree of 30 told the grammar's shape, and a tree of 14 leaves (a branch for the inner grammar, once) that
grows by the thesis's operators to 30 at most. Measured with 600 strings (200 give the same picture; all
numbers in ``benchmarks/results/hierarchy/reber.json``), 12 starts each; the grammar itself needs .584 bits::

    flat                   .755 bits (.670 to  .836)   0 of 12 remember the letter
    tree, random          1.125 bits (.810 to 1.404)   5
    tree, told the shape   .815 bits (.750 to  .987)   8
    tree, grown            .928 bits (.834 to 1.085)   3

So trees keep the outer letter where the flat model never does, and pay for it: fitted from random numbers
they predict the next letter worse. Told the shape, they lose least.

Run ``python examples/tree_of_reber.py`` (some minutes); ``--out FILE`` keeps the numbers.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxpomdp import (
    FLAT,
    HIERARCHICAL,
    EMConfig,
    TreeSplitConfig,
    e_step,
    fit,
    flatten_tree,
    gather_tree_evidence,
    pack,
    random_tree,
    trial_batch,
)
from jaxpomdp.agents.tree_evidence import evidence_of_model
from jaxpomdp.experiments.record import versions
from jaxpomdp.models.em import as_models
from jaxpomdp.packing import unpack_all
from jaxpomdp.structure.operators import BROTHER_SPLIT, OBSERVATION_SPLIT, UNCLE_SPLIT
from jaxpomdp.structure.policy import PolicyConfig, revise
from jaxpomdp.structure.tree import TreeSpec

LETTERS = "BTPSXVE"
WAYS = {0: "T1 P2", 1: "S1 X3", 2: "T2 V4", 3: "X2 S5", 4: "P3 V5"}
"""The inner grammar: from each node the letters that may come, with the node each leads to; 5 is the end."""
INNER = list(range(2, 14))
WHOLE = [0, [1, INNER, 14], [15, [n + 14 for n in INNER], 28], 29]
"""The first letter, two branches with the inner grammar within each, the last letter."""
ONE_BRANCH = [0, 1, 2, 3, list(range(4, 14))]
STATES, STARTS, HELD, PHASES = 30, 12, 500, 18
THETA, ITERATIONS, BINS = 0.2, 150, 12
OPERATORS = [
    (operator, TreeSplitConfig(significance=0.01))
    for operator in (UNCLE_SPLIT, BROTHER_SPLIT, OBSERVATION_SPLIT)
]


def inner(rng: np.random.Generator) -> str:
    """Draw a string of the inner grammar; every choice is of two, evenly."""
    node, letters = 0, "B"
    while node != 5:
        letter, node = WAYS[node].split()[rng.integers(2)]
        letters, node = letters + letter, int(node)
    return letters + "E"


def strings(seed: int, count: int) -> list[str]:
    """Draw strings of the embedded grammar."""
    rng = np.random.default_rng(seed)
    outer = ["TP"[k] for k in rng.integers(2, size=count)]
    return [f"B{letter}{inner(rng)}{letter}E" for letter in outer]


def source_bits(drawn: list[str]) -> float:
    """Return what the grammar itself needs: a bit a letter, but for both B, both E and the repeated one."""
    return sum(len(x) - 5 for x in drawn) / sum(map(len, drawn))


def batch_of(drawn: list[str]) -> Any:
    """Return strings as trials, whose return is 1 or -1 by the outer letter."""
    letters = [np.array([LETTERS.index(c) for c in x]) for x in drawn]
    rewards = [np.append(np.zeros(len(x) - 2), 1.0 if x[1] == "T" else -1.0) for x in drawn]
    return trial_batch(letters, None, rewards, gamma=1.0)


def swapped(drawn: str) -> str:
    """Return the string with the wrong outer letter at its end."""
    return drawn[:-2] + {"T": "P", "P": "T"}[drawn[-2]] + drawn[-1]


def starts(states: int, **options: Any) -> list[TreeSpec]:
    """Return a random tree for each start."""
    return [random_tree(seed, states, 1, len(LETTERS), **options) for seed in range(STARTS)]


def fitted(family: Any, specs: list[Any], data: Any, iterations: int = ITERATIONS) -> Any:
    """Return the models after EM, side by side."""
    return fit(family, pack(specs, STATES), data, EMConfig(iterations=iterations, theta=THETA))[0]


def grown(specs: list[TreeSpec], data: Any) -> Any:
    """Return the models after phases of EM, evidence, and at most one edit each."""
    policy = PolicyConfig(node_cap=STATES)
    for phase in range(PHASES):
        models, batch, _ = as_models(fitted(HIERARCHICAL, specs, data, iterations=20), data)
        symbols, config = batch.observations[0], EMConfig(theta=THETA)
        seen = gather_tree_evidence(HIERARCHICAL, models, batch, symbols, config, len(LETTERS), BINS)
        seen, specs = jax.device_get(seen), unpack_all(models)
        for s, spec in enumerate(specs):
            found = evidence_of_model(seen, s, spec.num_states)
            specs[s] = revise(spec, found, phase=phase, policy=policy, operators=OPERATORS).spec
    return fitted(HIERARCHICAL, specs, data)


def contestants(data: Any) -> Iterator[tuple[str, Any, Any]]:
    """Give name, family and fitted models of each."""
    yield "flat", FLAT, fitted(FLAT, [flatten_tree(spec) for spec in starts(STATES, levels=1)], data)
    yield "tree, random", HIERARCHICAL, fitted(HIERARCHICAL, starts(STATES), data)
    yield "tree, told the shape", HIERARCHICAL, fitted(HIERARCHICAL, starts(STATES, shape=WHOLE), data)
    yield "tree, grown", HIERARCHICAL, grown(starts(14, shape=ONE_BRANCH), data)


def evidence(family: Any, models: Any, drawn: list[str]) -> np.ndarray:
    """Return the log-probability of each string under each model, ``[S, strings]``."""
    params, data, _ = as_models(models, batch_of(drawn))
    return np.asarray(e_step(family, params, data, EMConfig()).log_evidence)


def score(family: Any, models: Any, drawn: list[str]) -> dict[str, list[float]]:
    """Return states, bits a symbol, and per cent of strings likelier than with the wrong letter, of each."""
    right = evidence(family, models, drawn)
    wrong = evidence(family, models, [swapped(x) for x in drawn])
    bits = -right.sum(1) / np.log(2) / sum(map(len, drawn))
    columns = {"states": models.alive.sum(-1), "bits": bits.round(3)}
    columns["foretold"] = (100 * (right > wrong).mean(1)).round(1)
    return {name: np.asarray(x, float).round(3).tolist() for name, x in columns.items()}


def described(row: dict[str, Any]) -> str:
    """Say how the starts of a contestant did."""
    bits, told = row["bits"], np.array(row["foretold"])
    return (
        f"{np.median(bits):.3f} bits ({min(bits):.3f} to {max(bits):.3f}), "
        f"{int((told >= 95).sum())} of {len(told)} remember (median {np.median(told):.0f} % foretold)"
    )


def main() -> None:
    """Fit all contestants, and print how they do on new strings."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[200, 600])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    new, rows = strings(1, HELD), []
    print(f"the grammar itself: {source_bits(new):.3f} bits a symbol")
    for size in options.sizes:
        for name, family, models in contestants(batch_of(strings(0, size))):
            row = {"strings": size, "model": name} | score(family, models, new)
            print(f"{size:4d} strings, {name:21s} {described(row)}", flush=True)
            rows.append(row)
    if options.out:
        command = " ".join(["python", "examples/tree_of_reber.py", *sys.argv[1:]])
        head = {"command": command, "versions": versions(), "source_bits": source_bits(new)}
        options.out.write_text(json.dumps(head | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
