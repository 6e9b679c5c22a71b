"""Fit a tree to text, letter by letter, without actions: the Zen that Python ships (``import this``).

A random tree of 20 leaves learns beside a flat model of 20 states, from several starts each; both are judged
on lines they have not seen. Run ``python examples/tree_of_text.py``.
"""

from __future__ import annotations

import codecs
import contextlib
import io

import jax
import numpy as np

from jaxpomdp import (
    FLAT,
    HIERARCHICAL,
    EMConfig,
    e_step,
    fit,
    pack,
    path_of_nodes,
    random_tree,
    trial_batch,
    unpack,
    viterbi,
)
from jaxpomdp.models.em import as_models
from jaxpomdp.structure.tree_forms import flatten_tree

LETTERS = " abcdefghijklmnopqrstuvwxyz"
STARTS = 5


def lines() -> list[str]:
    """Return the lines of the text, in lower case, letters and blanks only."""
    with contextlib.redirect_stdout(io.StringIO()):
        import this
    text = codecs.decode(this.s, "rot13").lower().splitlines()
    kept = ["".join(c if c in LETTERS else " " for c in line).strip() for line in text]
    return [" ".join(line.split()) for line in kept if line]


def main() -> None:
    """Fit, compare, and show the path through the tree of one line."""
    text = lines()
    numbers = [np.array([LETTERS.index(c) for c in line]) for line in text]
    held = [i for i in range(len(text)) if i % 4 == 3]
    seen = trial_batch([x for i, x in enumerate(numbers) if i not in held])
    new = trial_batch([numbers[i] for i in held])
    config = EMConfig(iterations=100)
    specs = [random_tree(seed, 20, 1, len(LETTERS), levels=3) for seed in range(STARTS)]
    contestants = {
        "tree": (HIERARCHICAL, pack(specs, 20)),
        "flat": (FLAT, pack([flatten_tree(spec) for spec in specs], 20)),
    }
    fitted = {}
    for name, (family, params) in contestants.items():
        fitted[name], report = fit(family, params, seen, config)
        models, data, _ = as_models(fitted[name], new)
        bits = -e_step(family, models, data, config).log_evidence.sum(1) / np.log(2) / int(new.valid.sum())
        print(
            f"{name}: {np.median(bits):.3f} bits a letter on new lines (best {bits.min():.3f})", report.fell
        )
    one = jax.tree.map(lambda x: x[0], fitted["tree"])
    chain, log_obs = HIERARCHICAL.learning(one, new, 0.0)
    best = viterbi(chain, log_obs[0], new.actions[0], new.start[0], new.valid[0])
    way = path_of_nodes(one, best.states, new.start[0], new.valid[0])
    top = np.asarray(way.entered)[:, 1]
    line = text[held[0]]
    print("where the branches below the root change:")
    print("".join(("|" if top[t] else "") + c for t, c in enumerate(line)))
    print(unpack(fitted["tree"], 0))


if __name__ == "__main__":
    main()
