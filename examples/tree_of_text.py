"""Fit a tree to text, letter by letter, without actions: the Zen that Python ships (``import this``).

Random trees of 20 leaves learn beside flat models of 20 states, from ten starts each; all are judged on lines
that they have not seen, every fourth in turn (four folds). Beside them stands the plain frequency of letters.
Measured (bits a letter on new lines, mean over folds; the start chosen by the lines learned from)::

    frequency of letters      4.13
    tree                      3.66 (median start 3.76)
    flat, the tree's numbers  3.49 (median start 3.55)
    flat, even rows           3.45 (median start 3.46)

Of so short a text a tree learns less than the flat model that it comes to, from the same numbers: what a tree
is for, see ``examples/tree_of_reber.py``.

Run ``python examples/tree_of_text.py``.
"""

from __future__ import annotations

import codecs
import contextlib
import io
from typing import Any

import jax
import numpy as np

from jaxpomdp import (
    FLAT,
    HIERARCHICAL,
    EMConfig,
    Prior,
    TrialBatch,
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
STATES, STARTS, FOLDS = 20, 10, 4
CONFIG = EMConfig(iterations=100, prior=Prior(transition=0.1, initial=0.1, observation=0.1))
"""So little text (some 800 letters) is learned by heart without pseudo-counts."""


def lines() -> list[str]:
    """Return the lines of the text, in lower case, letters and blanks only."""
    with contextlib.redirect_stdout(io.StringIO()):
        import this
    text = codecs.decode(this.s, "rot13").lower().splitlines()
    kept = ["".join(c if c in LETTERS else " " for c in line).strip() for line in text]
    return [" ".join(line.split()) for line in kept if line]


def bits(family: Any, models: Any, batch: TrialBatch) -> np.ndarray:
    """Return bits a letter under each model, ``[S]``."""
    params, data, _ = as_models(models, batch)
    evidence = np.asarray(e_step(family, params, data, CONFIG).log_evidence).sum(1)
    return -evidence / np.log(2) / int(batch.valid.sum())


def frequency_bits(seen: list[np.ndarray], new: list[np.ndarray]) -> float:
    """Return bits a letter where letters have nothing to do with one another."""
    count = np.bincount(np.concatenate(seen), minlength=len(LETTERS)) + 0.5
    return float(-np.log2(count / count.sum())[np.concatenate(new)].mean())


def starts() -> dict[str, tuple[Any, Any]]:
    """Return the family and the random starts of each contestant."""
    specs = [random_tree(seed, STATES, 1, len(LETTERS), levels=3) for seed in range(STARTS)]
    flats = [random_tree(seed, STATES, 1, len(LETTERS), levels=1) for seed in range(STARTS)]
    return {
        "tree": (HIERARCHICAL, pack(specs, STATES)),
        "flat, the tree's numbers": (FLAT, pack([flatten_tree(spec) for spec in specs], STATES)),
        "flat, even rows": (FLAT, pack([flatten_tree(spec) for spec in flats], STATES)),
    }


def compare(numbers: list[np.ndarray]) -> None:
    """Print how all do on the lines of each fold, which they have not seen."""
    found: dict[str, list[tuple[float, float]]] = {}
    for fold in range(FOLDS):
        seen = [x for i, x in enumerate(numbers) if i % FOLDS != fold]
        new = numbers[fold::FOLDS]
        plain = frequency_bits(seen, new)
        found.setdefault("frequency of letters", []).append((plain, plain))
        for name, (family, params) in starts().items():
            models, _ = fit(family, params, trial_batch(seen), CONFIG)
            chosen = bits(family, models, trial_batch(seen)).argmin()
            each = bits(family, models, trial_batch(new))
            found.setdefault(name, []).append((float(each[chosen]), float(np.median(each))))
    for name, rows in found.items():
        chosen, median = np.mean(rows, axis=0)
        print(f"    {name:26s}{chosen:.2f} (median start {median:.2f})")


def main() -> None:
    """Compare, and show the path through a tree of one line."""
    text = lines()
    numbers = [np.array([LETTERS.index(c) for c in line]) for line in text]
    compare(numbers)
    family, params = starts()["tree"]
    seen = trial_batch(numbers)
    models, _ = fit(family, params, seen, CONFIG)
    best = int(bits(family, models, seen).argmin())
    one = jax.tree.map(lambda x: x[best], models)
    chain, log_obs = HIERARCHICAL.learning(one, seen, 0.0)
    print("where the branches below the root change:")
    for b, line in enumerate(text[:5]):
        likely = viterbi(chain, log_obs[b], seen.actions[b], seen.start[b], seen.valid[b])
        way = path_of_nodes(one, likely.states, seen.start[b], seen.valid[b])
        print("".join(("|" if top else "") + c for top, c in zip(way.entered[:, 1], line, strict=False)))
    print(unpack(models, best))


if __name__ == "__main__":
    main()
