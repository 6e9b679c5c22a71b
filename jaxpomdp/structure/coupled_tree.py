"""A coupled hierarchy as a value: a tree, and beside it a flat chain that remembers one of its leaves."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxpomdp.structure.spec import NEG, expect_rows, expect_shape, frozen, safe_log
from jaxpomdp.structure.tree import TreeSpec, validate_tree
from jaxpomdp.structure.tree_forms import flatten_tree


@dataclass(frozen=True, eq=False)
class CoupledTreeSpec:
    """A tree of ``N`` leaves coupled with a flat chain of as many nodes, unpadded, in log space.

    The flat chain is a memory (see ``models.coupled_tree``): in each step it notes the active leaf or keeps
    the one it holds, and then activity moves by the tree, or heeds the memory. Two specs are equal when every
    number is. The constructor checks shapes; ``validate_coupled_tree`` checks the numbers.

    Attributes:
        tree: the hierarchy.
        log_lead: ``[A, N, N]``, where activity goes that heeds a node of the memory.
        log_heed: ``[N, 2]``, by the node: activity moves by the tree, or by the memory.
        log_note: ``[N, 2]``, by the node: it is let go for the active leaf, or kept.
        log_alone: ``[A, N, N]``, transitions of the leaves by themselves, for acting.

    Raises:
        ValueError: shapes disagree.
    """

    tree: TreeSpec
    log_lead: np.ndarray
    log_heed: np.ndarray
    log_note: np.ndarray
    log_alone: np.ndarray

    def __post_init__(self) -> None:
        for name in TABLES:
            object.__setattr__(self, name, frozen(name, getattr(self, name)))
        n, a = self.num_states, self.num_actions
        for name in TABLES:
            shape = (n, 2) if name in ("log_heed", "log_note") else (a, n, n)
            expect_shape(name, getattr(self, name), shape)

    @property
    def num_states(self) -> int:
        """Number of leaves, N, which act; and of nodes of the memory."""
        return self.tree.num_states

    @property
    def num_actions(self) -> int:
        """Number of actions, A."""
        return self.tree.num_actions

    @property
    def heeded(self) -> np.ndarray:
        """Bool ``[N]``: something was written for the node of the memory."""
        return self.log_heed[:, 1] > NEG / 2

    def tables(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield every table of log rows beside the tree, with its name."""
        yield from ((name, getattr(self, name)) for name in TABLES)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CoupledTreeSpec):
            return NotImplemented
        theirs = dict(other.tables())
        return self.tree == other.tree and all(np.array_equal(x, theirs[name]) for name, x in self.tables())

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        nodes = np.flatnonzero(self.heeded)
        written = f"{len(nodes)} of {self.num_states} nodes of the memory heeded"
        return "\n".join([f"{self.tree}", f"coupled, {written}", *(_line(self, int(n)) for n in nodes)])


TABLES = ("log_lead", "log_heed", "log_note", "log_alone")
"""The tables beside the tree."""


def coupled_tree(tree: TreeSpec) -> CoupledTreeSpec:
    """Return a tree with a memory that always notes the active leaf and is never heeded: the tree alone.

    >>> from jaxpomdp.structure.tree_init import random_tree
    >>> print(str(coupled_tree(random_tree(0, 3))).splitlines()[-1])
    coupled, 0 of 3 nodes of the memory heeded
    """
    flat = flatten_tree(tree)
    n, dtype = tree.num_states, flat.log_trans.dtype
    even = np.full((tree.num_actions, n, n), -np.log(n), dtype)
    sure = np.tile(safe_log(np.array([1, 0], dtype)), (n, 1))
    return CoupledTreeSpec(tree, even, sure, sure, flat.log_trans)


def validate_coupled_tree(spec: CoupledTreeSpec) -> None:
    """Stop unless the numbers make sense: a valid tree, finite tables, rows that sum to one.

    Raises:
        ValueError: naming the table and the row, what was expected and what came.
    """
    validate_tree(spec.tree)
    for name, table in spec.tables():
        if not np.isfinite(table).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(table))[0])
            raise ValueError(f"{name} must be finite, got NaN or infinity at {where}")
        expect_rows(name, table)


def _line(spec: CoupledTreeSpec, node: int) -> str:
    """Describe a node that is heeded: how much, how long it is kept, and where it leads."""
    heed, keep = np.exp(spec.log_heed[node, 1]), np.exp(spec.log_note[node, 1])
    parts = [f"  s{node} remembered: heeded {heed:.2f}, kept {keep:.2f}"]
    for action, row in enumerate(np.exp(spec.log_lead[:, node])):
        likely = [int(k) for k in np.argsort(-row, kind="stable")[:3] if row[k] >= 0.005]
        parts.append(f"a{action} -> " + " ".join(f"s{k} ({row[k]:.2f})" for k in sorted(likely)))
    return "; ".join(parts)
