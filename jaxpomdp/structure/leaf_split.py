"""The flat model's state split on the leaves of a tree: a leaf whose return is not Gaussian becomes two.

It is no operator of the thesis's chapter 6, which compares what was active before; it lets a hierarchical
agent also do what the flat one does (section 3.3), and a tree of one level is then the flat agent.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.structure.edits import UNLIMITED, Allowance, Edit, Operator
from jaxpomdp.structure.evidence import ReturnEvidence
from jaxpomdp.structure.splits import SplitConfig, StateSplit, propose_splits, shrink_split
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_edits import clone_branch, with_returns
from jaxpomdp.structure.tree_evidence import TreeEvidence, mean_and_var

KIND = "leaf"
DEFAULTS = SplitConfig()
"""The settings where none are given."""


class LeafSplit(NamedTuple):
    """What a leaf split needs: the leaf, and the state split with a mixture of two components."""

    leaf: int
    split: StateSplit

    def row(self) -> dict[str, Any]:
        """Return the JSON-friendly part of the log row."""
        return self.split.row() | {"top": f"s{self.leaf}"}


def returns_of_leaves(evidence: TreeEvidence, columns: int) -> ReturnEvidence:
    """Return the returns of every leaf, whatever was active before.

    Args:
        evidence: of a tree.
        columns: 1 for a return per leaf, A for one per leaf and action.
    """
    hist, sums = evidence.returns.sum(0), evidence.sums.sum(0)
    weight = hist.sum(-1)
    middle = (evidence.edges[1:] + evidence.edges[:-1]) / 2
    found = ReturnEvidence(evidence.edges, middle, hist, *mean_and_var(weight, sums), weight)
    return found if columns > 1 else found.per_state()


def propose(
    spec: TreeSpec,
    evidence: TreeEvidence,
    config: SplitConfig = DEFAULTS,
    allowance: Allowance = UNLIMITED,
) -> list[Edit]:
    """Return the splits of leaves that the evidence calls for, best first, each in two.

    Raises:
        ValueError: the evidence is of another number of leaves or actions.
    """
    evidence.check(spec.num_states, spec.num_actions)
    returns = returns_of_leaves(evidence, spec.return_mean.shape[1])
    return [_in_two(edit) for edit in propose_splits(spec, returns, config, allowance)]


def apply(spec: TreeSpec, edit: Edit) -> TreeSpec:
    """Split the leaf: it and its copy share what leads there, and each takes the return of a component.

    Raises:
        ValueError: the edit is for another number of leaves, or of another kind.
    """
    edit.stop_unless(KIND, spec.num_states)
    split: StateSplit = edit.details.split
    means = split.mixture.mean - split.mixture.weight @ split.mixture.mean
    old = spec.return_mean[edit.node]
    grown = clone_branch(spec, edit.node, _shares(spec, split), split.stay)
    for leaf, component in ((edit.node, 0), (spec.num_states, 1)):
        for column in range(len(old)):
            mean, var = old[column] + means[component], spec.return_var[edit.node, column]
            if column == split.action:
                mean, var = split.mixture.mean[component], split.mixture.var[component]
            if column == split.action or split.shift:
                grown = with_returns(grown, leaf, column, float(mean), float(var))
    return grown


def _in_two(edit: Edit) -> Edit:
    halved = shrink_split(edit, 1)
    return replace(halved, kind=KIND, details=LeafSplit(edit.node, halved.details))


def _shares(spec: TreeSpec, split: StateSplit) -> np.ndarray:
    """Return the copy's share of what leads there ``[M+1]``, a little different for each node."""
    share = split.shares[1]
    noise = np.random.default_rng(split.seed).standard_normal(spec.num_nodes + 1) * split.jitter
    odds = share / (1 - share) * np.exp(np.sqrt(2) * noise)
    return odds / (1 + odds)


LEAF_SPLIT = Operator(KIND, propose, lambda edit, room: edit, apply)
"""The flat model's state split as an operator on trees."""
