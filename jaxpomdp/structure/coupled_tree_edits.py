"""Operators on coupled hierarchies (thesis 6.3.5): every edit of the tree is made in the flat chain as well.

A tree's edit copies leaves, and shares what led to a leaf between it and its copy. Whatever shares it gave
can be read off the tree that it made, for any operator: the transition ``T*`` from a leaf to a copy, over
that to all copies. The flat chain gets the same copies, and its rows are shared in the same way (``follow``).

The cousin split is the one edit that also writes in the flat chain. No table of a tree can send activity from
one cousin to a branch and from another, with the same parent, to the branch's copy. So both are remembered
from then on: activity that heeds them goes as it went, but one leads to the branch, the other to the copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.structure import operators
from jaxpomdp.structure.coupled_tree import CoupledTreeSpec
from jaxpomdp.structure.edits import UNLIMITED, Allowance, Edit, Operator
from jaxpomdp.structure.operators import TREE_OPERATORS, TreeSplit
from jaxpomdp.structure.spec import safe_log
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_evidence import TreeEvidence
from jaxpomdp.structure.tree_forms import flatten_tree
from jaxpomdp.structure.tree_tests import TreeSplitConfig

KIND = "cousin"


@dataclass(frozen=True)
class CousinSplitConfig:
    """When cousins are told apart, and how well they are remembered.

    Raises:
        ValueError: a setting is out of its range.
    """

    tests: TreeSplitConfig = field(default_factory=TreeSplitConfig)
    """when it fires, and how it shares probability; the memory is heeded with probability ``strong``"""
    keep: float = 0.1
    """probability at the start that a cousin is still remembered a step later; 0: never, and for good"""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if not 0 <= self.keep <= 1:
            raise ValueError(f"keep must be between 0 and 1, got {self.keep}")


class CousinSplit(NamedTuple):
    """What a cousin split needs: that of the tree, and for how long the cousins are remembered."""

    split: TreeSplit
    keep: float

    def row(self) -> dict[str, Any]:
        """Return the JSON-friendly part of the log row."""
        return self.split.row()


def copy_shares(tree: TreeSpec, origin: np.ndarray) -> np.ndarray:
    """Return ``[A, N', N']``: of what goes from a leaf to a leaf or its copies, the share that goes to each.

    Args:
        tree: as it is after an edit.
        origin: ``[N']``, the old leaf that each leaf comes from.
    """
    trans = np.exp(flatten_tree(tree).log_trans.astype(float))
    together = (origin[:, None] == origin[None]).astype(float)
    total = trans @ together
    return np.where(total > 0, trans / np.where(total > 0, total, 1), 1 / together.sum(0))


def follow(spec: CoupledTreeSpec, tree: TreeSpec, origin: np.ndarray) -> CoupledTreeSpec:
    """Put an edited tree in, and give the flat chain the copies that the tree has, shared as the tree's.

    A copy is remembered as its original is, and leads and acts as it; so the evidence is what it was, if the
    tree's edit left its own.

    Args:
        spec: the model before.
        tree: its tree, edited; old leaves keep their numbers.
        origin: ``[N']``, the old leaf that each new one comes from.
    """
    shares = copy_shares(tree, origin)
    lead, alone = (
        _logs(np.exp(table.astype(float))[:, origin][:, :, origin] * shares, table)
        for table in (spec.log_lead, spec.log_alone)
    )
    return CoupledTreeSpec(tree, lead, spec.log_heed[origin], spec.log_note[origin], alone)


def write_memory(
    spec: CoupledTreeSpec,
    nodes: np.ndarray,
    pairs: tuple[np.ndarray, np.ndarray],
    share: float,
    heed: float,
    keep: float,
) -> CoupledTreeSpec:
    """Let the nodes be remembered, and lead to the copies of some leaves with this share of what led to both.

    A node that was not heeded leads as its leaf does in acting; one that leads already only shares anew.

    Args:
        spec: the model.
        nodes: leaves to be remembered.
        pairs: leaves, and the copy of each.
        share: of the copies.
        heed: probability that activity heeds a node.
        keep: probability that a node is still remembered a step later.
    """
    lead, alone = (np.exp(x.astype(float)) for x in (spec.log_lead, spec.log_alone))
    rows = np.where(spec.heeded[:, None], lead, alone)[:, nodes]
    lead[:, nodes] = _shared(rows, pairs, share)
    alone[:, nodes] = _shared(alone[:, nodes], pairs, share)
    new = nodes[~spec.heeded[nodes]]
    choices = {"log_heed": (1 - heed, heed), "log_note": (1 - keep, keep)}
    tables = {name: getattr(spec, name).copy() for name in choices}
    for name, choice in choices.items():
        tables[name][new] = safe_log(np.array(choice))
    return replace(
        spec, log_lead=_logs(lead, spec.log_lead), log_alone=_logs(alone, spec.log_alone), **tables
    )


def propose_cousin(
    spec: CoupledTreeSpec,
    evidence: TreeEvidence,
    config: CousinSplitConfig = CousinSplitConfig(),
    allowance: Allowance = UNLIMITED,
) -> list[Edit]:
    """Return the cousin splits that the evidence calls for, best first, at most one a leaf.

    Raises:
        ValueError: the evidence is of another number of leaves or actions.
    """
    edits = operators.propose(KIND, spec.tree, evidence, config.tests, allowance)
    return [replace(edit, details=CousinSplit(edit.details, config.keep)) for edit in edits]


def apply_cousin(spec: CoupledTreeSpec, edit: Edit) -> CoupledTreeSpec:
    """Copy the branch in both chains, and write the cousins in the memory.

    Raises:
        ValueError: the edit is for another number of leaves, or its branch was changed by another edit.
    """
    split: TreeSplit = edit.details.split
    tree = operators.apply(spec.tree, replace(edit, details=split))
    grown = follow(spec, tree, edit.origin)
    pairs = np.array(edit.copied), np.arange(edit.num_states, grown.num_states)
    for name, share in zip(split.conditions, (1 - split.strong, split.strong), strict=True):
        nodes = np.flatnonzero(tree.below[_named(tree, name)])
        grown = write_memory(grown, nodes, pairs, share, split.strong, edit.details.keep)
    return grown


def lifted(operator: Operator) -> Operator:
    """Return a tree's operator as one of coupled hierarchies: proposed by the tree, made in both chains."""

    def propose(spec: CoupledTreeSpec, *arguments: Any) -> list[Edit]:
        return operator.propose(spec.tree, *arguments)

    def apply(spec: CoupledTreeSpec, edit: Edit) -> CoupledTreeSpec:
        return follow(spec, operator.apply(spec.tree, edit), edit.origin)

    return Operator(operator.kind, propose, operator.shrink, apply)


def _shared(rows: np.ndarray, pairs: Sequence[np.ndarray], share: float) -> np.ndarray:
    """Share what goes to leaves and their copies anew; rows are ``[A, K, N]``."""
    rows, (old, copies) = rows.copy(), pairs
    both = rows[..., old] + rows[..., copies]
    rows[..., old], rows[..., copies] = both * (1 - share), both * share
    return rows


def _named(tree: TreeSpec, name: str) -> int:
    """Return the node of a printed name, the inverse of ``name_of``; old nodes keep theirs through edits."""
    return int(name[1:]) + (tree.root if name[0] == "i" else 0)


def _logs(rows: np.ndarray, like: np.ndarray) -> np.ndarray:
    return safe_log(rows).astype(like.dtype)


COUSIN_SPLIT = Operator(KIND, propose_cousin, operators.shrink, apply_cousin)
"""The branch of a leaf whose return depends on which cousin was active before is copied, and the cousins are
remembered (6.3.5)."""

COUPLED_TREE_OPERATORS = {kind: lifted(operator) for kind, operator in TREE_OPERATORS.items()} | {
    KIND: COUSIN_SPLIT
}
"""The operators of coupled hierarchies by name, the cousin split last."""
