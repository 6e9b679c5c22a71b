"""How a tree grows, as its shape alone: a branch is copied, or a level is added; and the log replayed.

Leaves and internal states keep their numbers and what is new is appended, so the log of edits holds all there
is to know of the shape at every moment.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.structure.topology import below, parents_of

BRANCHES = ("observation", "brother", "uncle", "cousin", "leaf")
"""Operators that copy a branch (or a leaf); ``parent`` adds a level."""


class Shape(NamedTuple):
    """The shape of a tree: ``leaf_parent[N]`` and ``node_parent[I]``, as in ``structure.topology``."""

    leaf_parent: np.ndarray
    node_parent: np.ndarray


class Growth(NamedTuple):
    """A shape that has grown, and the old leaf and internal state that each one reads."""

    shape: Shape
    leaf_origin: np.ndarray
    node_origin: np.ndarray


def branch_copied(shape: Shape, node: int) -> Growth:
    """Copy the branch below a node (or a leaf), not the root, as a sibling of it."""
    parent = parents_of(*shape)[node] - len(shape.leaf_parent)
    return _copied(shape, np.array([node]), int(parent))


def level_added(shape: Shape, node: int) -> Growth:
    """Copy all that is below an internal state into a new one, the last, which becomes its child."""
    number, new = node - len(shape.leaf_parent), len(shape.node_parent)
    children = np.flatnonzero(parents_of(*shape) == node)
    grown = _copied(shape, children, new)
    nodes, origin = (np.insert(x, new, number) for x in (grown.shape.node_parent, grown.node_origin))
    return Growth(Shape(grown.shape.leaf_parent, nodes), grown.leaf_origin, origin)


def _copied(shape: Shape, tops: np.ndarray, parent: int) -> Growth:
    """Copy the branches of these nodes below internal state ``parent``.

    Where that is a new state (number I), copied internal states are numbered after it.
    """
    n, i = len(shape.leaf_parent), len(shape.node_parent)
    above = parents_of(*shape)
    leaves = np.flatnonzero(below(above, n)[tops].any(0))
    internal = np.array([m for m in range(n, n + i) if _within(above, m, tops)], int) - n
    number = np.full(i + 1, -1)
    number[internal] = i + (parent == i) + np.arange(len(internal))

    def moved(old: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        return np.where(np.isin(nodes, tops), parent, number[old])

    return Growth(
        Shape(
            np.concatenate([shape.leaf_parent, moved(shape.leaf_parent[leaves], leaves)]),
            np.concatenate([shape.node_parent, moved(shape.node_parent[internal], internal + n)]),
        ),
        np.concatenate([np.arange(n), leaves]),
        np.concatenate([np.arange(i), internal]),
    )


def _within(above: np.ndarray, node: int, tops: np.ndarray) -> bool:
    while node >= 0 and node not in tops:
        node = int(above[node])
    return node >= 0


def replayed(shape: Shape, rows: Iterable[Mapping[str, Any]]) -> list[Shape]:
    """Return the shapes of a tree as it grew: the first, and the one after each logged edit.

    Args:
        shape: of the tree before the first edit.
        rows: of the log (``Edit.row``), in order; read are ``operator``, ``top``, ``states_before`` and
            ``states_after``.

    Raises:
        ValueError: an operator is unknown, or an edit does not fit the tree that those before it make.

    >>> row = {"operator": "brother", "top": "s0", "states_before": 2, "states_after": 3}
    >>> [s.leaf_parent.tolist() for s in replayed(Shape(np.array([0, 0]), np.array([-1])), [row])]
    [[0, 0], [0, 0, 0]]
    """
    shapes = [shape]
    for row in rows:
        shapes.append(_after(shapes[-1], row))
    return shapes


class Step(NamedTuple):
    """A shape on the way from one tree to another, and the logged edit that made it; None for the first."""

    shape: Shape
    row: Mapping[str, Any] | None


def grown_to(first: Shape, last: Shape, rows: Iterable[Mapping[str, Any]]) -> list[Step]:
    """Return how the last tree grew from the first; edits of trees that were given up are left out.

    An agent may go back to an earlier tree and grow that one, which the log does not say. So an edit is taken
    to be of the latest tree that it fits, most often the one before it.

    Raises:
        ValueError: the rows do not lead there, as where an agent began again with another tree.
    """
    steps, before = [Step(first, None)], [-1]
    for row in rows:
        at, shape = _latest_fitting([step.shape for step in steps], row)
        steps.append(Step(shape, row))
        before.append(at)
    ends = [k for k, step in enumerate(steps) if all(map(np.array_equal, step.shape, last))]
    if not ends:
        raise ValueError("the logged edits do not lead from the first tree to the last")
    way = [ends[-1]]
    while before[way[0]] >= 0:
        way.insert(0, before[way[0]])
    return [steps[k] for k in way]


def _latest_fitting(shapes: list[Shape], row: Mapping[str, Any]) -> tuple[int, Shape]:
    for at in reversed(range(len(shapes))):
        with suppress(ValueError):
            return at, _after(shapes[at], row)
    raise ValueError(f"the logged edit of {row['top']} fits no tree before it")


def _after(shape: Shape, row: Mapping[str, Any]) -> Shape:
    leaves, kind = len(shape.leaf_parent), row["operator"]
    if kind not in (*BRANCHES, "parent"):
        raise ValueError(f"operator must be one of {', '.join(BRANCHES)}, parent, got {kind!r}")
    letter, number = row["top"][0], int(row["top"][1:])
    last = leaves if letter == "s" else len(shape.node_parent)
    if row["states_before"] != leaves or number >= last:
        raise ValueError(
            f"the edit of {row['top']} must fit a tree of {leaves} leaves and {len(shape.node_parent)} "
            f"internal states, got one for {row['states_before']} leaves"
        )
    node = number if letter == "s" else leaves + number
    grown = (level_added if kind == "parent" else branch_copied)(shape, node).shape
    if len(grown.leaf_parent) != row["states_after"]:
        raise ValueError(
            f"the edit of {row['top']} must make {row['states_after']} leaves, got {len(grown.leaf_parent)}"
        )
    return grown
