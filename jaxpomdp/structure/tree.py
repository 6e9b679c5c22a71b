"""A hierarchical model as a value: a ragged, immutable, printable tree of production and internal states.

Activity enters at the root and flows down vertical transitions to a leaf, which emits. Then it moves to a
sibling (or the leaf itself), or to its parent's end state, and the parent moves in the same way (thesis 5.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxpomdp.structure import topology
from jaxpomdp.structure.spec import (
    ROW_TOLERANCE,
    Channel,
    channel_arrays,
    channel_of,
    equal_maps,
    expect_rows,
    expect_shape,
    frozen,
    safe_log,
)


@dataclass(frozen=True, eq=False)
class TreeSpec:
    """A hierarchical HMM of ``N`` leaves, ``I`` internal states, ``M = N + I`` nodes, unpadded, in log space.

    Nodes are numbered as in ``structure.topology``: leaves first, then internal states, the root first among
    them. Two specs are equal when every number is. The constructor checks shapes and that the parents make a
    tree; ``validate`` checks the numbers.

    Attributes:
        leaf_parent: int ``[N]``, the internal state (0 the root) above each leaf.
        node_parent: int ``[I]``, the internal state above each, -1 above the root.
        log_vertical: ``[V, I, M]``, log probability that an internal state activates each of its children;
            V = 1, or A + 1 where it depends on the action that led there (the last is for a trial's start).
        log_horizontal: ``[A, M, M+1]``, log probability that a node is followed by each sibling, or (last
            column) by its parent's end. A leaf may follow itself. The root has no row.
        emissions: a ``Channel`` per observation channel, rows are leaves.
        return_mean: ``[N, K]``, mean return, K = 1 (per leaf) or A (per leaf and action).
        return_var: ``[N, K]``, its variance.

    Raises:
        ValueError: shapes disagree, or the parents are no tree.
    """

    leaf_parent: np.ndarray
    node_parent: np.ndarray
    log_vertical: np.ndarray
    log_horizontal: np.ndarray
    emissions: tuple[Channel, ...]
    return_mean: np.ndarray
    return_var: np.ndarray

    def __post_init__(self) -> None:
        for name in ("leaf_parent", "node_parent"):
            object.__setattr__(self, name, _parents(name, getattr(self, name)))
        for name in ("log_vertical", "log_horizontal", "return_mean", "return_var"):
            object.__setattr__(self, name, frozen(name, getattr(self, name)))
        object.__setattr__(self, "emissions", tuple(self.emissions))
        topology.check_topology(self.leaf_parent, self.node_parent)
        _check_shapes(self)

    @property
    def num_states(self) -> int:
        """Number of leaves (production states), N."""
        return len(self.leaf_parent)

    @property
    def num_internal(self) -> int:
        """Number of internal states, I, the root among them."""
        return len(self.node_parent)

    @property
    def num_nodes(self) -> int:
        """Number of nodes, M = N + I (end states are columns, not nodes)."""
        return self.num_states + self.num_internal

    @property
    def num_actions(self) -> int:
        """Number of actions, A."""
        return self.log_horizontal.shape[0]

    @property
    def root(self) -> int:
        """The root as a node."""
        return self.num_states

    @cached_property
    def parent(self) -> np.ndarray:
        """``[M]``: the parent of every node as a node, -1 above the root."""
        return topology.parents_of(self.leaf_parent, self.node_parent)

    @cached_property
    def below(self) -> np.ndarray:
        """Bool ``D[M, N]``: leaf n is node m or below it."""
        return topology.below(self.parent, self.num_states)

    @cached_property
    def depth(self) -> np.ndarray:
        """``[M]``: how many steps below the root each node is."""
        return topology.depths_of(self.parent)

    def children(self, node: int) -> np.ndarray:
        """Return the children of a node, ascending."""
        return np.flatnonzero(self.parent == node)

    @staticmethod
    def from_probabilities(
        shape: Sequence[object],
        vertical: object,
        horizontal: object,
        emissions: Sequence[object] = (),
        return_mean: object | None = None,
        return_var: object | None = None,
    ) -> TreeSpec:
        """Build a spec from nested lists of leaves and tables of probabilities.

        Args:
            shape: as ``[[0, 1], [2, 3], 4]``: nested lists of the leaves 0 .. N-1.
            vertical: ``[V, I, M]``; internal states are numbered as their brackets open.
            horizontal: ``[A, M, M+1]``, the last column is the end.
            emissions: tables ``[N, O]`` or channels.
            return_mean: ``[N, K]``; zeros if None.
            return_var: ``[N, K]``; ones if None.

        Raises:
            ValueError: shapes disagree, or the numbers are no probabilities of this tree.
        """
        leaf_parent, node_parent = topology.nested(shape)
        none = np.zeros((len(leaf_parent), 1))
        mean = frozen("return_mean", none if return_mean is None else return_mean)
        var = frozen("return_var", np.ones_like(mean) if return_var is None else return_var)
        down, across = safe_log(frozen("vertical", vertical)), safe_log(frozen("horizontal", horizontal))
        channels = tuple(channel_of(c) for c in emissions)
        spec = TreeSpec(leaf_parent, node_parent, down, across, channels, mean, var)
        validate_tree(spec)
        return spec

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TreeSpec):
            return NotImplemented
        return self.emissions == other.emissions and equal_maps(_arrays(self), _arrays(other))

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        head = f"TreeSpec of {self.num_states} leaves and {self.num_internal} internal states"
        lines = [f"{head}, {self.depth.max()} levels, {self.num_actions} actions"]
        return "\n".join(lines + _lines(self, self.root, "  "))


def name_of(spec: TreeSpec, node: int) -> str:
    """Return how a node is printed: leaves ``s0, s1, ..``, internal states ``i0, ..`` (the root)."""
    return f"s{node}" if node < spec.num_states else f"i{node - spec.num_states}"


def allowed_vertical(spec: TreeSpec) -> np.ndarray:
    """Return bool ``[I, M]``: the node is a child of the internal state."""
    return spec.parent[None, :] == np.arange(spec.num_states, spec.num_nodes)[:, None]


def allowed_horizontal(spec: TreeSpec, *, self_referential: bool = False) -> np.ndarray:
    """Return bool ``[M, M+1]``: siblings, a leaf itself, and the end of every parent but the root."""
    m, root = spec.num_nodes, spec.root
    siblings = (spec.parent[:, None] == spec.parent[None, :]) & (spec.parent >= 0)[:, None]
    if not self_referential:
        internal = np.arange(spec.num_states, m)
        siblings[internal, internal] = False
    ends = (spec.parent >= 0) & (spec.parent != root)
    return np.concatenate([siblings, ends[:, None]], axis=1)


def validate_tree(spec: TreeSpec, *, self_referential: bool = False) -> None:
    """Stop unless the numbers make sense: finite, rows of this tree that sum to one, positive variances.

    Args:
        spec: the model.
        self_referential: internal states may follow themselves (else the minimal form is asked for).

    Raises:
        ValueError: naming the table and the node, what was expected and what came.
    """
    for name, array in (_arrays(spec) | channel_arrays(spec)).items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite, got NaN or infinity")
    for name, array in channel_arrays(spec).items():
        if name.endswith("log_prob"):
            expect_rows(name, array)
    if not (spec.return_var > 0).all():
        raise ValueError(f"return_var must be positive, got {spec.return_var.min()}")
    _check_places(spec, self_referential)
    _check_sums(spec)


def _parents(name: str, value: object) -> np.ndarray:
    array = np.asarray(value)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise ValueError(f"{name} must be a row of integers, got {array.dtype}{list(array.shape)}")
    array = array.astype(np.int64)
    array.flags.writeable = False
    return array


def _check_shapes(spec: TreeSpec) -> None:
    n, m = spec.num_states, spec.num_nodes
    expect_shape("log_horizontal", spec.log_horizontal, (None, m, m + 1))
    expect_shape("log_vertical", spec.log_vertical, (None, spec.num_internal, m))
    actions, tables = spec.num_actions, spec.log_vertical.shape[0]
    if tables not in (1, actions + 1):
        raise ValueError(
            f"log_vertical must have 1 table, or {actions + 1} (per action, and for starts), got {tables}"
        )
    expect_shape("return_mean", spec.return_mean, (n, None))
    expect_shape("return_var", spec.return_var, spec.return_mean.shape)
    if spec.return_mean.shape[1] not in (1, actions):
        raise ValueError(f"return_mean must have 1 or {actions} columns, got {spec.return_mean.shape[1]}")
    for name, array in channel_arrays(spec).items():
        expect_shape(name, array, (n, *array.shape[1:]))


def _check_places(spec: TreeSpec, self_referential: bool) -> None:
    """Refuse probability where the tree has no connection."""
    for _, i, m in np.argwhere((np.exp(spec.log_vertical) > 0) & ~allowed_vertical(spec)):
        raise ValueError(f"log_vertical: {name_of(spec, m)} is no child of {name_of(spec, spec.root + i)}")
    places = allowed_horizontal(spec, self_referential=self_referential)
    for _, m, to in np.argwhere((np.exp(spec.log_horizontal) > 0) & ~places):
        if m == to:
            raise ValueError(
                f"log_horizontal: internal state {name_of(spec, m)} must not follow itself in minimal form "
                "(see minimal)"
            )
        what = "an end" if to == spec.num_nodes else name_of(spec, to)
        why = "has none" if to == spec.num_nodes else "is no sibling"
        raise ValueError(f"log_horizontal: {name_of(spec, m)} leads to {what}, but {why}")


def _check_sums(spec: TreeSpec) -> None:
    parts = (("log_vertical", spec.log_vertical, spec.root), ("log_horizontal", spec.log_horizontal, 0))
    for name, table, first in parts:
        totals = np.exp(table).sum(-1)
        rows = np.ones_like(totals, bool)
        if name == "log_horizontal":
            rows[:, spec.root] = False
        elif len(table) > 1:
            rows[:-1, 0] = False
        wrong = np.argwhere(rows & (np.abs(totals - 1) > ROW_TOLERANCE))
        for k, row in wrong:
            node = name_of(spec, first + int(row))
            raise ValueError(
                f"{name}: probabilities must sum to 1, got {totals[k, row]:.6g} at {node} in table {k}"
            )


def _arrays(spec: TreeSpec) -> dict[str, np.ndarray]:
    names = ("leaf_parent", "node_parent", "log_vertical", "log_horizontal", "return_mean", "return_var")
    return {name: getattr(spec, name) for name in names}


def _lines(spec: TreeSpec, node: int, indent: str) -> list[str]:
    """Describe a node, then its children one step to the right."""
    text = f"{indent}{name_of(spec, node)}"
    if node != spec.root:
        entered = np.exp(spec.log_vertical[-1, spec.parent[node] - spec.root, node])
        text += f" (entered {entered:.2f})" + _moves(spec, node)
    if node < spec.num_states:
        pairs = zip(spec.return_mean[node], np.sqrt(spec.return_var[node]), strict=True)
        return [text + ", return " + ", ".join(f"{mean:.3g} +- {width:.2g}" for mean, width in pairs)]
    rows = [_lines(spec, int(child), indent + "  ") for child in spec.children(node)]
    return [text, *(line for row in rows for line in row)]


def _moves(spec: TreeSpec, node: int, shown: int = 3) -> str:
    """Describe where a node leads under each action: its likeliest siblings, and the end."""
    parts = []
    for action, row in enumerate(np.exp(spec.log_horizontal[:, node])):
        likely = [int(k) for k in np.argsort(-row, kind="stable")[:shown] if row[k] >= 0.005]
        names = ["end" if k == spec.num_nodes else name_of(spec, k) for k in sorted(likely)]
        chances = [f"{row[k]:.2f}" for k in sorted(likely)]
        parts.append(f" a{action} -> " + " ".join(f"{n} ({c})" for n, c in zip(names, chances, strict=True)))
    return ";".join(parts)
