"""Do the operators find what is there, and nothing else? Synthetic data with an inconsistency of one kind.

Paths are drawn from a random tree, with observations and returns of the leaves. Planted: in one leaf the
observation or the return depends on what was active one step before, in the way that one operator looks for.
Power is how often that operator fires on the planted leaf; size how often it fires at all on data without it,
which should be no more than the significance level.

Evidence comes from known states, or as in an agent from smoothed posteriors (of the model that made the data,
or of that model after EM on them). Symbols are ``vague`` (drawn from a Dirichlet distribution, as all else)
or ``clear`` (a symbol for each leaf, seen in eight of ten steps). Run ``python -m
benchmarks.hierarchy.planted``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import TrialBatch
from jaxpomdp.agents.tree_evidence import evidence_of_model, gather_tree_evidence
from jaxpomdp.experiments.record import versions
from jaxpomdp.models.em import EMConfig, em_step
from jaxpomdp.models.hierarchical import HIERARCHICAL
from jaxpomdp.packing import pack
from jaxpomdp.structure.evidence import bin_of, even_edges
from jaxpomdp.structure.operators import propose
from jaxpomdp.structure.significance import two_sample
from jaxpomdp.structure.spec import Channel
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_evidence import TreeEvidence, tree_evidence
from jaxpomdp.structure.tree_forms import flatten_tree, starting_over
from jaxpomdp.structure.tree_init import random_tree
from jaxpomdp.structure.tree_tests import (
    Conditions,
    TreeSplitConfig,
    activations,
    brothers,
    conditions_of,
    cousins,
    uncles,
)

KINDS = ("observation", "brother", "uncle", "parent")
SYMBOLS, ACTIONS, BINS = 4, 2, 12
RESULT = Path(__file__).parents[1] / "results" / "hierarchy" / "operators.json"


class Case(NamedTuple):
    """Where evidence comes from, how clear symbols are, theta, how far apart the returns of leaves are."""

    evidence: str = "smoothed"
    symbols: str = "clear"
    theta: float = 0.0
    apart: float = 0.1
    roots: bool = False


CASES = {
    "known states, vague symbols": Case("known", "vague", roots=True),
    "smoothed by the true model, clear symbols": Case(roots=True),
    "smoothed by the true model, vague symbols": Case(symbols="vague"),
    "smoothed after EM, clear symbols": Case("fitted"),
    "smoothed, leaves one deviation apart": Case(apart=1.0),
    "smoothed with theta .2, one deviation apart": Case(theta=0.2, apart=1.0),
    "smoothed with theta 1, one deviation apart": Case(theta=1.0, apart=1.0),
}


class Tape(NamedTuple):
    """Trials of one length, ``[B, L]``, with the leaves that made them and where the plant is."""

    states: np.ndarray
    actions: np.ndarray
    symbols: np.ndarray
    returns: np.ndarray
    marked: np.ndarray


def world(seed: int, symbols: str = "vague", apart: float = 0.1, *, levels: int = 2) -> TreeSpec:
    """Draw a tree of three branches of three leaves each, or (one level) of five leaves.

    Mean returns of leaves are ``apart``, in standard deviations of the return in one leaf.
    """
    spec = _tree(seed, levels)
    spec = replace(spec, return_mean=spec.return_mean * apart / 0.1)
    if symbols == "vague":
        return spec
    n = spec.num_states
    table = np.full((n, n), 0.2 / (n - 1)) + (0.8 - 0.2 / (n - 1)) * np.eye(n)
    return replace(spec, emissions=(Channel("Categorical", {"log_prob": np.log(table)}),))


def _tree(seed: int, levels: int) -> TreeSpec:
    if levels == 1:
        return random_tree(seed, 5, ACTIONS, SYMBOLS, levels=1, concentration=2.0)
    while True:
        spec = random_tree(seed, 9, ACTIONS, SYMBOLS, levels=2, form="sober", concentration=2.0)
        if spec.num_internal == 4:
            return spec
        seed += 1


def conditions_for(kind: str, spec: TreeSpec, leaf: int) -> Conditions:
    """Return what the operator tells apart; the parent's activations weigh transitions evenly."""
    if kind == "parent":
        even = np.exp(flatten_tree(spec).log_trans)
        return activations(spec, starting_over(spec), leaf, even)
    return {"uncle": uncles, "cousin": cousins}.get(kind, brothers)(spec, leaf)


def draw(
    spec: TreeSpec,
    seed: int,
    steps: int,
    plant: str | None = None,
    leaf: int = 0,
    shift: float = 1.0,
    *,
    length: int = 50,
    group: int = 0,
) -> Tape:
    """Draw trials of ``length``, about ``steps`` in all, the plant in ``leaf`` after one of its conditions.

    After it a return is larger by ``shift`` standard deviations (of one action), or the leaf's least likely
    symbol is seen in half of the steps.
    """
    rng = np.random.default_rng(seed)
    flat = flatten_tree(spec)
    actions = rng.integers(ACTIONS, size=(max(steps // length, 1), length))
    states = _paths(rng, np.exp(flat.log_init), np.exp(flat.log_trans), actions)
    table = np.exp(spec.emissions[0].values["log_prob"])
    symbols = (table[states].cumsum(-1) > rng.uniform(size=(*states.shape, 1))).argmax(-1)
    returns = spec.return_mean[states, 0] + rng.normal(size=states.shape)
    marked = np.zeros(states.shape, bool)
    if plant is not None:
        chance = conditions_for(plant, spec, leaf).groups[group].astype(float)[_before(states, spec)]
        marked = (rng.uniform(size=states.shape) < chance) & (states == leaf)
        moved = marked & (rng.uniform(size=states.shape) < 0.5 * shift) & (plant == "observation")
        symbols[moved] = table[leaf].argmin()
        returns[marked & (actions == 0) & (plant != "observation")] += shift
    return Tape(states, actions, symbols, returns, marked)


def _paths(rng: np.random.Generator, init: np.ndarray, trans: np.ndarray, actions: np.ndarray) -> np.ndarray:
    states = np.zeros(actions.shape, int)
    begin, ways, last = init.cumsum(), trans.cumsum(-1), len(init) - 1
    chance = rng.uniform(size=actions.shape)
    states[:, 0] = np.minimum(np.searchsorted(begin, chance[:, 0]), last)
    for t in range(1, actions.shape[1]):
        rows = ways[actions[:, t - 1], states[:, t - 1]]
        states[:, t] = np.minimum((rows < chance[:, t, None]).sum(-1), last)
    return states


def _before(states: np.ndarray, spec: TreeSpec) -> np.ndarray:
    """Return the leaf one step before, N at starts."""
    return np.concatenate([np.full((len(states), 1), spec.num_states), states[:, :-1]], axis=1)


def known(spec: TreeSpec, tape: Tape, symbols: int | None = None) -> TreeEvidence:
    """Gather the evidence with the states known, of so many symbols (by default the first channel's)."""
    n = spec.num_states
    states, before = tape.states.ravel(), _before(tape.states, spec).ravel()
    pairs = np.zeros((len(states), n + 1, n))
    pairs[np.arange(len(states)), before, states] = 1
    edges = even_edges(tape.returns.min(), tape.returns.max(), BINS)
    columns = tape.actions.ravel(), tape.symbols.ravel(), tape.returns.ravel()
    count = spec.emissions[0].values["log_prob"].shape[1] if symbols is None else symbols
    return tree_evidence(pairs, *columns, edges, num_actions=ACTIONS, num_symbols=count)


def simulate(spec: TreeSpec, seed: int, steps: int, *plant: object, **options: object) -> TreeEvidence:
    """Draw as ``draw`` does, and gather the evidence with the states known."""
    return known(spec, draw(spec, seed, steps, *plant, **options))


def smoothed(
    specs: Sequence[TreeSpec], tapes: Sequence[Tape], theta: float = 0.0, iterations: int = 0
) -> list[TreeEvidence]:
    """Gather the evidence of each tape from the posteriors of its tree, after EM where asked for."""
    batch, config = _batch(tapes), EMConfig(theta=theta)
    params = pack(specs, specs[0].num_states)
    for _ in range(iterations):
        params, _ = em_step(HIERARCHICAL, params, batch, config)
    count = specs[0].emissions[0].values["log_prob"].shape[1]
    found = gather_tree_evidence(HIERARCHICAL, params, batch, batch.observations[0], config, count, BINS)
    found = jax.device_get(found)
    return [evidence_of_model(found, s, spec.num_states) for s, spec in enumerate(specs)]


def _batch(tapes: Sequence[Tape]) -> TrialBatch:
    _, actions, symbols, returns, _ = (np.stack(x) for x in zip(*tapes, strict=True))
    there, first = np.ones(actions.shape, bool), np.zeros(actions.shape, bool)
    first[..., 0] = True
    returns = jnp.asarray(returns, jnp.float32)
    return TrialBatch(
        (jnp.asarray(symbols, jnp.int32),),
        jnp.asarray(actions, jnp.int32),
        jnp.zeros_like(returns),
        returns,
        there,
        first,
        ~there,
        there,
        there,
    )


def gathered(evidence: str, specs: list[TreeSpec], tapes: list[Tape], theta: float) -> list[TreeEvidence]:
    """Return the evidence of each tape, ``known``, ``smoothed`` or ``fitted``."""
    if evidence == "known":
        return [known(spec, tape) for spec, tape in zip(specs, tapes, strict=True)]
    return smoothed(specs, tapes, theta, iterations=20 if evidence == "fitted" else 0)


def measure(name: str, case: Case, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Return power and size of every operator in one case; the parent split also below the root."""
    rows: dict[str, dict[str, float]] = {}
    for kind, found, fired in _fires(case, options, KINDS, levels=2, length=50):
        rows[kind] = {"power": found, "size": fired}
    for group, where in enumerate(("", ", at the start") if case.roots else ()):
        for kind, found, fired in _fires(case, options, ("parent",), levels=1, length=10, group=group):
            rows[f"{kind}, one level{where}"] = {"power": found, "size": fired}
    print(name, json.dumps(rows, indent=1), flush=True)
    return rows


def _fires(
    case: Case,
    options: argparse.Namespace,
    kinds: Sequence[str],
    *,
    levels: int,
    length: int,
    group: int = 0,
) -> Iterator[tuple[str, float, float]]:
    """Give for each operator how often it finds the plant, and how often it fires without one."""
    runs, config = range(options.runs), TreeSplitConfig(significance=options.level)
    specs = [world(seed, case.symbols, case.apart, levels=levels) for seed in runs]
    leaves = [int(np.random.default_rng(seed).integers(specs[0].num_states)) for seed in runs]
    data = {"steps": options.steps, "length": length}
    none = [draw(spec, seed + options.runs, **data) for seed, spec in enumerate(specs)]
    quiet = gathered(case.evidence, specs, none, case.theta)
    for kind in kinds:
        tapes = [
            draw(spec, seed, plant=kind, leaf=leaf, group=group, **data)
            for seed, (spec, leaf) in enumerate(zip(specs, leaves, strict=True))
        ]
        planted = gathered(case.evidence, specs, tapes, case.theta)
        found = [
            any(edit.node == leaf for edit in propose(kind, spec, seen, config))
            for spec, leaf, seen in zip(specs, leaves, planted, strict=True)
        ]
        fired = [bool(propose(kind, *pair, config)) for pair in zip(specs, quiet, strict=True)]
        yield kind, float(np.mean(found)), float(np.mean(fired))


def told(spec: TreeSpec, tape: Tape, leaf: int, level: float) -> bool:
    """Say whether the parent split's test would fire if it were seen when the parent started over.

    It is the most that can be asked of it: its evidence is the share of each transition that is a starting
    over, and the test is then diluted by the rest.
    """
    entered = ~spec.below[spec.parent[leaf]]
    entry = (tape.states == leaf) & np.append(entered, True)[_before(tape.states, spec)]
    edges = even_edges(tape.returns.min(), tape.returns.max(), BINS)
    groups = [tape.returns[group & (tape.actions == 0)] for group in (tape.marked, entry)]
    own, other = (np.bincount(bin_of(x, edges), minlength=BINS).astype(float) for x in groups)
    tests = spec.num_states * ACTIONS
    weight = min(own.sum(), other.sum())
    return bool(weight >= 30 and two_sample(own, other).p_value * tests < level)


def by_share(options: argparse.Namespace) -> list[dict[str, float]]:
    """Return the parent split's power with known states by how much of what it weighs is a starting over."""
    config, rows = TreeSplitConfig(significance=options.level), []
    for seed in range(options.runs):
        spec = world(seed)
        leaf = int(np.random.default_rng(seed).integers(spec.num_states))
        tape = draw(spec, seed, options.steps, "parent", leaf)
        evidence = known(spec, tape)
        groups = conditions_of("parent", spec, evidence, np.arange(spec.num_states) == leaf)[leaf].groups
        weight = evidence.returns[:, leaf].sum((-1, -2))
        own = groups[0] @ weight
        share = (groups[0] ** 2 @ weight) / own if own > 0 else 0.0
        fired = any(edit.node == leaf for edit in propose("parent", spec, evidence, config))
        rows.append((share, fired, told(spec, tape, leaf, options.level)))
    found, limits = np.array(rows, float), (0, 0.1, 0.3, 0.5, 1.01)
    parts = [found[(found[:, 0] >= low) & (found[:, 0] < high)] for low, high in pairwise(limits)]
    return [
        {"share": f"{low} to {min(high, 1)}", "runs": len(part)}
        | {name: float(part[:, k].mean()) if len(part) else 0.0 for k, name in ((1, "power"), (2, "told"))}
        for part, (low, high) in zip(parts, pairwise(limits), strict=True)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--steps", type=int, default=12000)
    parser.add_argument("--level", type=float, default=0.05)
    options = parser.parse_args()
    cases = {name: measure(name, case, options) for name, case in CASES.items()}
    command = " ".join(["python -m benchmarks.hierarchy.planted", *sys.argv[1:]])
    result = {"command": command, "versions": versions()} | vars(options) | {"cases": cases}
    result["parent split by the share that is a starting over"] = by_share(options)
    RESULT.parent.mkdir(parents=True, exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
