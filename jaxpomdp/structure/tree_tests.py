"""Is what follows a leaf the same whatever was active before? Chi-square tests by pairs of conditions.

All pairs of one operator on one model are one family of tests, corrected together.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.structure.significance import Correction, adjust, homogeneity, two_sample
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_evidence import TreeEvidence, effective
from jaxpomdp.structure.tree_forms import starting_over


@dataclass(frozen=True)
class TreeSplitConfig:
    """When an operator fires, and how it shares probability (thesis 6.3 leaves most of it open).

    Raises:
        ValueError: a setting is out of its range.
    """

    significance: float = 0.01
    """an inconsistency counts where its corrected p-value is below this"""
    correction: Correction = "holm"
    """correction for testing many pairs of conditions: none, bonferroni, holm or benjamini-hochberg"""
    minimum_weight: float = 30.0
    """least number of observations that the evidence under each of the two conditions is worth"""
    minimum_effect: float = 0.0
    """least Cramer's V, whatever the weight"""
    strong: float = 0.95
    """share of the connection that fits; the other copy gets the rest (thesis 6.3.1)"""
    stay: float | None = None
    """share of a leaf's transition to itself that a copy keeps (sticky: 0.9); None: shared like the rest"""
    pseudo: float = 0.5
    """pseudo-count per symbol in the observations of a new copy"""
    most_levels: int = 6
    """the parent split makes no leaf deeper than this"""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        for name in ("significance", "strong"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if self.stay is not None and not 0 <= self.stay <= 1:
            raise ValueError(f"stay must be None or between 0 and 1, got {self.stay}")
        for name in ("minimum_weight", "minimum_effect", "pseudo"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")


class Conditions(NamedTuple):
    """The previous activity that a test of one leaf tells apart: ``nodes[C]`` (-1: the parent's entry).

    ``groups[C, N+1]`` holds the weight in each condition of each previous leaf, and of the start of a trial.
    Where ``kin[C]`` is given, only conditions of equal kin are compared.
    """

    nodes: np.ndarray
    groups: np.ndarray
    kin: np.ndarray | None = None


class Finding(NamedTuple):
    """One tested pair: the leaf, two conditions, the action (-1: observations), and the test's outcome."""

    leaf: int
    left: int
    right: int
    action: int
    statistic: float
    p_value: float
    effect: float
    weight: float


def brothers(spec: TreeSpec, leaf: int) -> Conditions:
    """Return a leaf's siblings, itself among them, and the entry through its parent (as at starts)."""
    siblings = spec.children(int(spec.parent[leaf]))
    outside = ~spec.below[spec.parent[leaf]]
    inside = _without_starts(spec.below[siblings])
    return Conditions(np.append(siblings, -1), np.concatenate([inside, _with_starts(outside)[None]]))


def uncles(spec: TreeSpec, leaf: int) -> Conditions:
    """Return the siblings of a leaf's parent; a leaf below the root has none."""
    parent = int(spec.parent[leaf])
    if parent == spec.root:
        return Conditions(np.zeros(0, int), np.zeros((0, spec.num_states + 1), bool))
    siblings = spec.children(int(spec.parent[parent]))
    siblings = siblings[siblings != parent]
    return Conditions(siblings, _without_starts(spec.below[siblings]))


def cousins(spec: TreeSpec, leaf: int) -> Conditions:
    """Return the children of a leaf's uncles, each the kin of its brothers.

    Cousins of different uncles are not compared: the tree can tell uncles apart.
    """
    above = uncles(spec, leaf).nodes
    children = [spec.children(int(uncle)) for uncle in above]
    nodes = np.concatenate([np.zeros(0, int), *children])
    kin = np.repeat(above, [len(each) for each in children])
    return Conditions(nodes, _without_starts(spec.below[nodes]), kin)


def activations(spec: TreeSpec, over: np.ndarray, leaf: int, transitions: np.ndarray) -> Conditions:
    """Return a leaf's parent as activated by itself and by another node (the root: by a trial's start).

    Which of the two it was is not seen where a brother was active before: it weighs what share of the
    transition is a starting over (``over``, from ``starting_over``), averaged over actions by their
    ``transitions``.
    """
    parent = int(spec.parent[leaf])
    weight = transitions[:, :, leaf]
    total = weight.sum(0)
    own = (over[:, :, leaf] * weight).sum(0) / np.where(total > 0, total, 1)
    outside = _with_starts(~spec.below[parent])
    return Conditions(np.array([parent, -1]), np.stack([_without_starts(own), outside]))


def _with_starts(leaves: np.ndarray) -> np.ndarray:
    return np.append(leaves, 1).astype(leaves.dtype)


def _without_starts(leaves: np.ndarray) -> np.ndarray:
    return np.concatenate([leaves, np.zeros_like(leaves[..., :1])], -1)


def conditions_of(
    kind: str, spec: TreeSpec, evidence: TreeEvidence, free: np.ndarray
) -> dict[int, Conditions]:
    """Return the conditions that an operator tells apart, of every leaf that may be edited."""
    leaves = [int(leaf) for leaf in np.flatnonzero(free)]
    if kind == "parent":
        over = starting_over(spec)
        return {leaf: activations(spec, over, leaf, evidence.transitions) for leaf in leaves}
    find = {"uncle": uncles, "cousin": cousins}.get(kind, brothers)
    return {leaf: find(spec, leaf) for leaf in leaves}


def findings(
    evidence: TreeEvidence, conditions: dict[int, Conditions], config: TreeSplitConfig, *, seen: bool
) -> list[Finding]:
    """Test all pairs of conditions of all leaves; return the significant ones, p-values corrected.

    Args:
        evidence: the tables.
        conditions: of each leaf to test.
        config: the settings.
        seen: test observations (else returns, by action).
    """
    tests = [f for leaf, c in conditions.items() for f in _tests(evidence, leaf, c, config, seen)]
    if not tests:
        return []
    adjusted = adjust(np.array([f.p_value for f in tests]), config.correction)
    corrected = [f._replace(p_value=float(p)) for f, p in zip(tests, adjusted, strict=True)]
    good = [f for f in corrected if f.p_value < config.significance and f.effect >= config.minimum_effect]
    return sorted(good, key=lambda f: -f.statistic)


def _tests(
    evidence: TreeEvidence, leaf: int, conditions: Conditions, config: TreeSplitConfig, seen: bool
) -> Iterator[Finding]:
    table = evidence.symbols[:, :, None] if seen else evidence.returns
    kin = np.zeros(len(conditions.nodes)) if conditions.kin is None else conditions.kin
    pairs = [(i, j) for i, j in combinations(range(len(kin)), 2) if kin[i] == kin[j]]
    if not pairs:
        return
    left, right = np.array(pairs).T
    hist = effective(table, leaf, conditions.groups)
    weight = hist.sum(-1)
    lighter = np.minimum(weight[left], weight[right])
    test: Any = _observations if seen else two_sample
    result = test(hist[left], hist[right])
    for p, k in np.argwhere((lighter >= config.minimum_weight) & (result.dof >= 1)):
        ends = int(conditions.nodes[left[p]]), int(conditions.nodes[right[p]])
        numbers = (result.statistic, result.p_value, result.effect, lighter)
        yield Finding(leaf, *ends, -1 if seen else int(k), *(float(x[p, k]) for x in numbers))


def _observations(left: np.ndarray, right: np.ndarray) -> Any:
    return homogeneity(np.stack([left, right], axis=-2))
