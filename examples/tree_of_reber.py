"""A grammar within a grammar: the embedded Reber grammar, learned from strings, without actions.

A string is ``B``, an outer letter (``T`` or ``P``), a whole string of the inner grammar, the outer letter
once more, ``E``. The inner string says nothing of the outer letter, so a model must remember it for about
eight steps while something else goes on (Hochreiter and Schmidhuber 1997 made it a test of recurrent
networks). Inner strings are alike after either letter: a tree can hold the inner grammar as a branch.

Compared on new strings: a flat model, trees of random shapes, a tree told the grammar's shape, and a tree
that first learns the shape without the memory (one branch); its best fit's branch is then copied whole, as
the uncle split does. All have 30 states in the end, and as many starts, of which the best on the strings
learned from is chosen. Scored are bits a symbol, and how often the letter's return is foretold.

Run ``python examples/tree_of_reber.py`` (some minutes); ``--out FILE`` keeps the numbers.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxpomdp import (
    FLAT,
    HIERARCHICAL,
    EMConfig,
    e_step,
    fit,
    flatten_tree,
    pack,
    random_tree,
    trial_batch,
)
from jaxpomdp.experiments.record import versions
from jaxpomdp.models.em import as_models
from jaxpomdp.packing import unpack_all
from jaxpomdp.structure.spec import Channel
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_edits import clone_branch

LETTERS = "BTPSXVE"
WAYS = {0: "T1 P2", 1: "S1 X3", 2: "T2 V4", 3: "X2 S5", 4: "P3 V5"}
"""The inner grammar: from each node the letters that may come, with the node each leads to; 5 is the end."""
INNER = list(range(2, 14))
ONE_BRANCH = [0, [1, INNER, 14], 15]
WHOLE = [0, [1, INNER, 14], [15, [n + 14 for n in INNER], 28], 29]
STATES, STARTS, ITERATIONS, HELD = 30, 20, 150, 500


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
    """Return strings as trials."""
    return trial_batch([np.array([LETTERS.index(c) for c in x]) for x in drawn])


def swapped(drawn: str) -> str:
    """Return the string with the wrong outer letter at its end."""
    return drawn[:-2] + {"T": "P", "P": "T"}[drawn[-2]] + drawn[-1]


def copied(spec: TreeSpec, rng: np.random.Generator) -> TreeSpec:
    """Copy the branch of a tree of one branch, the two a little apart, so that each may take a letter."""
    grown = clone_branch(spec, spec.root + 1, np.full(spec.num_nodes + 1, 0.5))
    table = grown.emissions[0].values["log_prob"] + 0.3 * rng.normal(size=(STATES, len(LETTERS)))
    table -= np.log(np.exp(table).sum(-1, keepdims=True))
    channel = Channel("Categorical", {"log_prob": table.astype(spec.log_horizontal.dtype)})
    return replace(grown, emissions=(channel,))


def start(name: str) -> list[TreeSpec]:
    """Return where a contestant starts, a tree for each seed."""
    options: dict[str, dict[str, Any]] = {
        "flat": {"levels": 1},
        "tree, diverse": {"levels": 3},
        "tree, sober": {"form": "sober"},
        "tree, told the shape": {"shape": WHOLE},
        "tree, a branch copied": {"shape": ONE_BRANCH},
    }
    states = 16 if "copied" in name else STATES
    return [random_tree(seed, states, 1, len(LETTERS), **options[name]) for seed in range(STARTS)]


def learned(name: str, drawn: list[str]) -> tuple[Any, Any, np.ndarray]:
    """Return the family, a contestant's fitted models, and their evidence of what they learned from."""
    specs, data, config = start(name), batch_of(drawn), EMConfig(iterations=ITERATIONS)
    family = FLAT if name == "flat" else HIERARCHICAL
    trees = [flatten_tree(spec) for spec in specs] if name == "flat" else specs
    models, _ = fit(family, pack(trees, specs[0].num_states), data, config)
    if "copied" in name:
        best = unpack_all(models)[int(evidence(family, models, drawn).sum(1).argmax())]
        grown = [copied(best, np.random.default_rng(seed)) for seed in range(STARTS)]
        models, _ = fit(family, pack(grown, STATES), data, config)
    return family, models, evidence(family, models, drawn).sum(1)


def evidence(family: Any, models: Any, drawn: list[str]) -> np.ndarray:
    """Return the log-probability of each string under each model, ``[S, strings]``."""
    params, data, _ = as_models(models, batch_of(drawn))
    return np.asarray(e_step(family, params, data, EMConfig()).log_evidence)


def score(family: Any, models: Any, drawn: list[str]) -> dict[str, list[float]]:
    """Return bits a symbol, and per cent of strings likelier than with the wrong letter, of each model."""
    right = evidence(family, models, drawn)
    wrong = evidence(family, models, [swapped(x) for x in drawn])
    bits = -right.sum(1) / np.log(2) / sum(map(len, drawn))
    return {"bits": bits.round(3).tolist(), "foretold": (100 * (right > wrong).mean(1)).round(1).tolist()}


def described(row: dict[str, Any]) -> str:
    """Say how the chosen model does, and the median and the range of all."""
    parts = []
    for name, unit, digits in (("bits", "bits", 3), ("foretold", "% foretold", 1)):
        low, middle, high = (f"{f(row[name]):.{digits}f}" for f in (min, np.median, max))
        parts.append(f"{row[name][row['chosen']]:.{digits}f} {unit} (median {middle}, {low} to {high})")
    return ", ".join(parts)


def main() -> None:
    """Fit all contestants on ever more strings, and print how they do on new ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", type=int, nargs="+", default=[30, 100, 300, 1000])
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    new, rows = strings(1, HELD), []
    print(f"the grammar itself: {source_bits(new):.3f} bits a symbol; the best of {STARTS} starts each")
    for size in options.sizes:
        drawn = strings(0, size)
        for name in ("flat", "tree, diverse", "tree, sober", "tree, told the shape", "tree, a branch copied"):
            family, models, fitted = learned(name, drawn)
            row = {"strings": size, "model": name, "chosen": int(fitted.argmax())}
            row |= score(family, models, new)
            print(f"{size:5d} strings, {name:22s} {described(row)}", flush=True)
            rows.append(row)
    if options.out:
        command = " ".join(["python", "examples/tree_of_reber.py", *sys.argv[1:]])
        head = {"command": command, "versions": versions(), "source_bits": source_bits(new)}
        options.out.write_text(json.dumps(head | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
