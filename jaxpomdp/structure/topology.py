"""The shape of a tree as arrays of parents: depths, paths, who is below whom, and what makes a tree valid.

Leaves (production states) are nodes ``0 .. N-1``, internal states ``N .. N+I-1``, the root is node ``N``.
New leaves and new internal states are appended, so both keep their numbers through edits; ``leaf_parent[N]``
and ``node_parent[I]`` hold numbers of internal states (0 the root), -1 above the root.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def nested(shape: Sequence[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return ``leaf_parent[N]`` and ``node_parent[I]`` of a tree written as nested lists of leaves.

    Leaves must be the numbers 0 .. N-1 in any order; internal states are numbered as their brackets open.

    Raises:
        ValueError: the leaves are not 0 .. N-1, each once.

    >>> leaf_parent, node_parent = nested([[0, 1], [2, 3], 4])
    >>> leaf_parent.tolist(), node_parent.tolist()
    ([1, 1, 2, 2, 0], [-1, 0, 0])
    """
    above: dict[int, int] = {}
    parents: list[int] = []

    def enter(children: Sequence[Any], parent: int) -> None:
        here = len(parents)
        parents.append(parent)
        for child in children:
            if isinstance(child, (list, tuple)):
                enter(child, here)
            elif child in above:
                raise ValueError(f"shape must hold every leaf once, got {child} twice")
            else:
                above[child] = here

    enter(shape, -1)
    if sorted(above) != list(range(len(above))):
        raise ValueError(f"shape must hold the leaves 0 .. {len(above) - 1}, got {sorted(above)}")
    return np.array([above[leaf] for leaf in range(len(above))], int), np.array(parents, int)


def check_topology(leaf_parent: np.ndarray, node_parent: np.ndarray) -> None:
    """Stop unless the parents make one tree in which activity can always flow.

    Raises:
        ValueError: naming what is wrong: no leaf, an unknown parent, a cycle, an internal state without
            children, or one whose only child is internal (it has no sibling to pass activity to).
    """
    leaves, internal = len(leaf_parent), len(node_parent)
    if leaves < 1 or internal < 1:
        raise ValueError(f"a tree must have a leaf and a root, got {leaves} leaves, {internal} internal")
    if node_parent[0] != -1:
        raise ValueError(
            f"node_parent[0] must be -1, the first internal state is the root, got {node_parent[0]}"
        )
    for name, parents in {"leaf_parent": leaf_parent, "node_parent[1:]": node_parent[1:]}.items():
        unknown = (parents < 0) | (parents >= internal)
        if unknown.any():
            raise ValueError(f"{name} must be internal states 0 .. {internal - 1}, got {parents[unknown][0]}")
    _check_cycles(node_parent)
    _check_children(leaf_parent, node_parent)


def _check_cycles(node_parent: np.ndarray) -> None:
    for node in range(len(node_parent)):
        at = node
        for _ in range(len(node_parent)):
            at = node_parent[at] if at > 0 else 0
        if at != 0:
            raise ValueError(f"node_parent must lead to the root, got a cycle above internal state {node}")


def _check_children(leaf_parent: np.ndarray, node_parent: np.ndarray) -> None:
    internal = len(node_parent)
    nodes = np.bincount(node_parent[1:], minlength=internal)
    children = nodes + np.bincount(leaf_parent, minlength=internal)
    for node in range(internal):
        if children[node] == 0:
            raise ValueError(f"every internal state must have a child, got none below internal state {node}")
        if children[node] == 1 and nodes[node] == 1:
            child = int(np.flatnonzero(node_parent == node)[0])
            raise ValueError(
                f"an internal state below the root must have a sibling, "
                f"got internal state {child} as the only child of {node}"
            )


def parents_of(leaf_parent: np.ndarray, node_parent: np.ndarray) -> np.ndarray:
    """Return ``[M]``: the parent of every node as a node, -1 above the root."""
    leaves = len(leaf_parent)
    return np.concatenate([leaf_parent + leaves, np.where(node_parent < 0, -1, node_parent + leaves)])


def depths_of(parent: np.ndarray) -> np.ndarray:
    """Return ``[M]``: how many steps below the root each node is.

    >>> depths_of(np.array([3, 4, 4, -1, 3])).tolist()
    [1, 2, 2, 0, 1]
    """
    depth, at = np.zeros(len(parent), int), parent.copy()
    while (at >= 0).any():
        depth += at >= 0
        at = np.where(at >= 0, parent[np.maximum(at, 0)], -1)
    return depth


def paths_of(parent: np.ndarray, leaves: int, levels: int | None = None) -> np.ndarray:
    """Return ``[N, L+1]``: the node at each depth on the way from the root to each leaf, then -1.

    Args:
        parent: ``[M]``.
        leaves: N.
        levels: L, the depth there is room for; that of the deepest leaf if None.

    Raises:
        ValueError: a leaf is deeper.

    >>> paths_of(np.array([3, 4, 4, -1, 3]), 3).tolist()
    [[3, 0, -1], [3, 4, 1], [3, 4, 2]]
    """
    depth = depths_of(parent)[:leaves]
    room = int(depth.max()) if levels is None else levels
    if depth.max() > room:
        raise ValueError(f"levels must be at least {depth.max()}, the deepest leaf's depth, got {room}")
    path, at = np.full((leaves, room + 1), -1), np.arange(leaves)
    for up in range(room + 1):
        here = depth - up
        path[here >= 0, here[here >= 0]] = at[here >= 0]
        at = np.where(at >= 0, parent[at], -1)
    return path


def below(parent: np.ndarray, leaves: int) -> np.ndarray:
    """Return bool ``D[M, N]``: leaf n is node m or below it.

    >>> below(np.array([3, 4, 4, -1, 3]), 3).astype(int).tolist()
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [0, 1, 1]]
    """
    return (paths_of(parent, leaves)[None] == np.arange(len(parent))[:, None, None]).any(-1)
