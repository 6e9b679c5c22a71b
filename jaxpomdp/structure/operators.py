"""The Hierarchical Model Operators on trees (thesis 6.3): observation, brother, uncle and parent split.

Each is an ``Operator`` as the flat model's state split; ``Edit.origin`` says which leaf each comes from. What
the cousin split does to the tree is here too; its memory comes with ``coupled_tree_edits``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.structure.edits import UNLIMITED, Allowance, Edit, Operator
from jaxpomdp.structure.significance import two_sample
from jaxpomdp.structure.spec import Channel, safe_log
from jaxpomdp.structure.tree import TreeSpec, name_of
from jaxpomdp.structure.tree_edits import branch_leaves, clone_branch, new_level, with_returns
from jaxpomdp.structure.tree_evidence import TreeEvidence, conditioned, effective, mean_and_var
from jaxpomdp.structure.tree_tests import Conditions, Finding, TreeSplitConfig, conditions_of, findings


class TreeSplit(NamedTuple):
    """What an edit of a tree needs. Nodes are kept as (is a leaf, number), which edits before it leave valid.

    Attributes:
        conditions: the two nodes whose activity before made the difference, as printed.
        action: whose return differed; -1 for observations.
        top: the branch that is copied, or the node whose children are.
        leaf_shares: ``[N]``, share of the transition from each leaf that goes to the copy.
        node_shares: ``[I]``, of that from each internal state.
        entry_share: of the entry from the parent.
        symbols: ``[2, O]``, observations of the leaf and its copy, channels jointly; None: copied.
        returns: ``[2, 2]``, mean and variance of the return of the leaf and its copy; None: copied.
        strong: share of the new level.
        stay: share of a leaf's transition to itself that each of the two keeps; None: shared like the rest.
    """

    conditions: tuple[str, str]
    action: int
    top: tuple[bool, int]
    leaf_shares: np.ndarray
    node_shares: np.ndarray
    entry_share: float
    symbols: np.ndarray | None
    returns: np.ndarray | None
    strong: float
    stay: float | None

    def row(self) -> dict[str, Any]:
        """Return the JSON-friendly part of the log row."""
        kind, number = ("s", "i")[not self.top[0]], self.top[1]
        return {"conditions": list(self.conditions), "action": self.action, "top": f"{kind}{number}"}


DEFAULTS = TreeSplitConfig()
"""The operators' settings where none are given."""


def propose(
    kind: str,
    spec: TreeSpec,
    evidence: TreeEvidence,
    config: TreeSplitConfig = DEFAULTS,
    allowance: Allowance = UNLIMITED,
) -> list[Edit]:
    """Return the edits of one kind that the evidence calls for, best first, at most one a leaf.

    Raises:
        ValueError: the evidence is of another number of leaves or actions.
    """
    evidence.check(spec.num_states, spec.num_actions)
    if allowance.room < 1 or allowance.edits < 1:
        return []
    conditions = conditions_of(kind, spec, evidence, allowance.free(spec.num_states))
    found: dict[int, Finding] = {}
    for finding in findings(evidence, conditions, config, seen=kind == "observation"):
        found.setdefault(finding.leaf, finding)
    edits = [_edit(kind, spec, evidence, f, conditions[f.leaf], config) for f in found.values()]
    fitting = [edit for edit in edits if edit is not None and len(edit.copied) <= allowance.room]
    return _one_per_top(fitting)[: allowance.edits]


def shrink(edit: Edit, room: int) -> Edit | None:
    """Return the edit where it fits: a branch is copied whole or not at all."""
    return edit if len(edit.copied) <= room else None


def apply(spec: TreeSpec, edit: Edit) -> TreeSpec:
    """Make the edit.

    Raises:
        ValueError: the edit is for another number of leaves, or its branch was changed by another edit.
    """
    if edit.num_states != spec.num_states:
        raise ValueError(f"edit must be for {spec.num_states} leaves, got {edit.num_states} (see Edit.moved)")
    split: TreeSplit = edit.details
    is_leaf, number = split.top
    top = number if is_leaf else spec.root + number
    leaves = branch_leaves(spec, top).tolist()
    if sorted(edit.copied) != leaves:
        raise ValueError(
            f"edit must be of the leaves below {name_of(spec, top)}, {leaves}, got {edit.copied}"
        )
    if edit.kind == "parent":
        return new_level(spec, top, split.strong)
    grown = clone_branch(spec, top, _shares(spec, split), split.stay)
    twin = spec.num_states + int(np.flatnonzero(branch_leaves(spec, top) == edit.node)[0])
    return _told_apart(grown, split, (edit.node, twin))


def _edit(
    kind: str,
    spec: TreeSpec,
    evidence: TreeEvidence,
    finding: Finding,
    conditions: Conditions,
    config: TreeSplitConfig,
) -> Edit | None:
    leaf = finding.leaf
    top = leaf if kind in ("observation", "brother") else int(spec.parent[leaf])
    if kind == "parent" and _deepest(spec, top) + 1 > config.most_levels:
        return None
    split = _split(kind, spec, evidence, finding, conditions, config)
    copied = tuple(int(n) for n in branch_leaves(spec, top))
    score = finding.statistic
    test = (score, finding.statistic, finding.p_value, finding.effect, finding.weight)
    return Edit(kind, leaf, spec.num_states, copied, *test, split._replace(top=_stable(spec, top)))


def _deepest(spec: TreeSpec, node: int) -> int:
    return int(spec.depth[: spec.num_states][spec.below[node]].max())


def _stable(spec: TreeSpec, node: int) -> tuple[bool, int]:
    return (True, node) if node < spec.num_states else (False, node - spec.root)


def _split(
    kind: str,
    spec: TreeSpec,
    evidence: TreeEvidence,
    finding: Finding,
    conditions: Conditions,
    config: TreeSplitConfig,
) -> TreeSplit:
    n = spec.num_states
    shares = np.full(spec.num_nodes + 1, 0.5)
    if kind != "parent":
        given = _given_shares(evidence, finding, conditions, config)
        shares[conditions.nodes] = given
        if conditions.kin is not None:
            into = evidence.transitions.sum(0)[:, spec.below[spec.parent[finding.leaf]]].sum(-1)
            shares[conditions.kin] = _of_kin(conditions.kin, given, conditions.groups[:, :-1] @ into)
    names = [name_of(spec, node) if node >= 0 else "entry" for node in (finding.left, finding.right)]
    symbols = _symbols(evidence, finding, conditions, config) if kind == "observation" else None
    returns = (
        _returns(spec, evidence, finding, conditions) if finding.action >= 0 and kind != "parent" else None
    )
    return TreeSplit(
        (names[0], names[1]),
        finding.action,
        (True, finding.leaf),
        shares[:n],
        shares[n:-1],
        float(shares[-1]),
        symbols,
        returns,
        config.strong,
        config.stay,
    )


def _given_shares(
    evidence: TreeEvidence, finding: Finding, conditions: Conditions, config: TreeSplitConfig
) -> np.ndarray:
    """Return ``[C]``: what share of each condition goes to the copy, which is what follows ``right``.

    The two conditions give ``strong`` to the copy that fits. For returns the others are shared by likeness,
    the p-values of the chi-square tests against either; for observations evenly (thesis 6.3.1, 6.3.2).
    """
    shares = np.full(len(conditions.nodes), 0.5)
    if finding.action >= 0:
        hist = effective(evidence.returns[:, :, finding.action], finding.leaf, conditions.groups)
        left, right = (hist[conditions.nodes == node] for node in (finding.left, finding.right))
        like = [two_sample(hist, np.broadcast_to(h, hist.shape)).p_value for h in (left, right)]
        total = like[0] + like[1]
        some = (total > 0) & (hist.sum(-1) >= config.minimum_weight)
        shares = np.where(some, like[1] / np.where(total > 0, total, 1), shares)
        shares = shares.clip(1 - config.strong, config.strong)
    shares[conditions.nodes == finding.left] = 1 - config.strong
    shares[conditions.nodes == finding.right] = config.strong
    return shares


def _of_kin(kin: np.ndarray, given: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return ``[C]``: the mean share of each condition's kin, by the weight that leads on from them.

    It is all that the tree itself can do for cousins: their uncle's connection is one.
    """
    same = (kin[:, None] == kin[None]) * (weight + 1e-9)
    return same @ given / same.sum(-1)


def _of_pair(conditions: Conditions, finding: Finding) -> np.ndarray:
    """Return ``[2, N+1]``: the groups of the two conditions."""
    return np.concatenate([conditions.groups[conditions.nodes == n] for n in (finding.left, finding.right)])


def _symbols(
    evidence: TreeEvidence, finding: Finding, conditions: Conditions, config: TreeSplitConfig
) -> np.ndarray:
    counts = conditioned(evidence.symbols, finding.leaf, _of_pair(conditions, finding)) + config.pseudo
    return counts / counts.sum(-1, keepdims=True)


def _returns(spec: TreeSpec, evidence: TreeEvidence, finding: Finding, conditions: Conditions) -> np.ndarray:
    """Return mean and variance of the return after either condition: of the action, or of all together."""
    groups, leaf = _of_pair(conditions, finding), finding.leaf
    weight = conditioned(evidence.returns.sum(-1), leaf, groups)
    sums = conditioned(evidence.sums, leaf, groups)
    if spec.return_mean.shape[1] > 1:
        mean, var = mean_and_var(weight[:, finding.action], sums[:, finding.action])
    else:
        mean, var = mean_and_var(weight.sum(-1), sums.sum(1))
    least = 1e-3 * spec.return_var[leaf].min()
    return np.stack([mean, np.maximum(var, least)], -1)


def _shares(spec: TreeSpec, split: TreeSplit) -> np.ndarray:
    """Return the shares ``[M+1]`` for a tree that may have grown; what is new shares evenly."""
    shares = np.full(spec.num_nodes + 1, 0.5)
    shares[: len(split.leaf_shares)] = split.leaf_shares
    shares[spec.root : spec.root + len(split.node_shares)] = split.node_shares
    shares[-1] = split.entry_share
    return shares


def _told_apart(spec: TreeSpec, split: TreeSplit, pair: Sequence[int]) -> TreeSpec:
    """Give the leaf and its copy what was found after the one condition and after the other."""
    if split.symbols is not None:
        spec = replace(spec, emissions=_with_symbols(spec.emissions, split.symbols, list(pair)))
    if split.returns is not None:
        column = split.action if spec.return_mean.shape[1] > 1 else 0
        for leaf, (mean, var) in zip(pair, split.returns, strict=True):
            spec = with_returns(spec, leaf, column, float(mean), float(var))
    return spec


def _with_symbols(channels: tuple[Channel, ...], symbols: np.ndarray, pair: list[int]) -> tuple[Channel, ...]:
    """Give the two leaves of a pair new rows in the channels that the symbols ``[2, O]`` code.

    Symbols number what was seen in one or more channels together, the first the most significant digit
    (``agents.tree_evidence.joint_symbols``). They code the first categorical channels, as many as have O
    combinations, and each gets its marginal distribution. Other channels, and all where none fit (symbols
    that are bins of numbers), keep the copied rows.
    """
    places = [c for c, channel in enumerate(channels) if channel.kind == "Categorical"]
    sizes = [channels[c].values["log_prob"].shape[1] for c in places]
    fits = [k for k in range(1, len(sizes) + 1) if np.prod(sizes[:k]) == symbols.shape[1]]
    if not fits:
        return channels
    coded, told = sizes[: fits[0]], list(channels)
    joint = symbols.reshape(2, *coded)
    for k, place in enumerate(places[: len(coded)]):
        others = tuple(1 + axis for axis in range(len(coded)) if axis != k)
        table = channels[place].values["log_prob"].copy()
        table[pair] = safe_log(joint.sum(others))
        told[place] = Channel("Categorical", {"log_prob": table})
    return tuple(told)


def _one_per_top(edits: list[Edit]) -> list[Edit]:
    """Keep the best of edits whose branches overlap: after one, the other's evidence is of another tree."""
    kept: list[Edit] = []
    taken: set[int] = set()
    for edit in edits:
        touched = {edit.node, *edit.copied}
        if not touched & taken:
            kept.append(edit)
            taken |= touched
    return kept


def _operator(kind: str) -> Operator:
    return Operator(kind, partial(propose, kind), shrink, apply)


OBSERVATION_SPLIT = _operator("observation")
"""A leaf whose observations depend on which brother was active before becomes two (6.3.1)."""
BROTHER_SPLIT = _operator("brother")
"""A leaf whose return depends on which brother was active before becomes two (6.3.2)."""
UNCLE_SPLIT = _operator("uncle")
"""The branch of a leaf whose return depends on which uncle was active before is copied whole (6.3.3)."""
PARENT_SPLIT = _operator("parent")
"""Where a leaf's return depends on who activated its parent, a level is added below the parent (6.3.4).

The root is activated by a trial's start, and by itself where a transition could be a starting over."""

TREE_OPERATORS = {o.kind: o for o in (OBSERVATION_SPLIT, BROTHER_SPLIT, UNCLE_SPLIT, PARENT_SPLIT)}
"""The tree's operators by name, in their order; the cousin split's place is last."""
TREE_SPLITS = tuple((operator, DEFAULTS) for operator in TREE_OPERATORS.values())
"""The tree's operators at their defaults."""
