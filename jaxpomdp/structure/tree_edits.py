"""Copying parts of a tree: a branch beside itself, or the children of a node into a level of their own.

Copies leave and emit as their originals and share what leads there, so the evidence of observations stays as
it was for any shares. Old leaves and internal states keep their numbers; copies are appended.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxpomdp.structure.spec import safe_log
from jaxpomdp.structure.tree import TreeSpec, allowed_horizontal, allowed_vertical
from jaxpomdp.structure.tree_forms import closed, opened
from jaxpomdp.structure.tree_growth import Growth, Shape, branch_copied, level_added


def shape_of(spec: TreeSpec) -> Shape:
    """Return the shape of a tree, without its numbers."""
    return Shape(spec.leaf_parent, spec.node_parent)


def branch_leaves(spec: TreeSpec, node: int) -> np.ndarray:
    """Return the leaves of a branch, ascending: what a copy of it appends."""
    return np.flatnonzero(spec.below[node])


def clone_branch(spec: TreeSpec, node: int, shares: np.ndarray, stay: float | None = None) -> TreeSpec:
    """Copy a branch (or a leaf) as a sibling of itself; the two share what leads there.

    Args:
        spec: the model, in minimal form.
        node: the top of the branch, not the root.
        shares: ``[M+1]``: what share of the transition from each sibling to the node goes to the copy, at the
            end of its entry from the parent; at the node itself, of a leaf's transition to itself.
        stay: how much of a leaf's transition to itself each of the two keeps, instead of sharing it.

    Raises:
        ValueError: the node is the root, or shares are not between 0 and 1.
    """
    if not 0 <= node < spec.num_nodes or node == spec.root:
        raise ValueError(f"node must be 0 .. {spec.num_nodes - 1} and not the root, got {node}")
    if shares.shape != (spec.num_nodes + 1,) or (shares < 0).any() or (shares > 1).any():
        raise ValueError(f"shares must be [{spec.num_nodes + 1}] between 0 and 1, got {shares.shape}")
    copied = branch_copied(shape_of(spec), node)
    top, twin = _twins(spec, copied, node)
    vertical, horizontal, origin = _read(spec, copied)
    from_rows = shares[origin][None].copy()
    if stay is not None and node < spec.num_states:
        from_rows[:, [top, twin]] = 1 - stay, stay
    horizontal[:, :, twin] *= from_rows
    horizontal[:, :, top] *= 1 - from_rows
    vertical[:, :, twin] *= shares[-1]
    vertical[:, :, top] *= 1 - shares[-1]
    return _grown(spec, copied, vertical, horizontal)


def new_level(spec: TreeSpec, node: int, strong: float) -> TreeSpec:
    """Bundle copies of a node's children into a new internal state, one more child of the node.

    The new child is activated with probability ``strong``, the others share the rest (thesis 6.3.4). Done in
    maximal self-referential form, where the new state ends whenever a child of it does and the node starts
    over, so the model is the same. The root, which never ends, starts over with certainty (``opened``).

    Raises:
        ValueError: the node is no internal state.
    """
    if not spec.root <= node < spec.num_nodes:
        raise ValueError(f"node must be an internal state, got {node}")
    most = opened(spec)
    number = node - spec.root
    copied = level_added(shape_of(most), node)
    vertical, horizontal, _ = _read(most, copied)
    new = len(copied.leaf_origin) + spec.num_internal
    horizontal[:, new] = 0
    horizontal[:, new, -1] = 1
    if node == spec.root:
        vertical[:, spec.num_internal] = vertical[-1, spec.num_internal]
    vertical[:, number] *= 1 - strong
    vertical[-1 if node == spec.root else slice(None), number, new] = strong
    return closed(_grown(most, copied, vertical, horizontal))


def _twins(spec: TreeSpec, copied: Growth, node: int) -> tuple[int, int]:
    """Return the numbers in the grown tree of a branch's top and of its copy."""
    n, i, grown = spec.num_states, spec.num_internal, len(copied.leaf_origin)
    if node < n:
        return node, n
    copy = i + int(np.flatnonzero(copied.node_origin[i:] == node - n)[0])
    return grown + node - n, grown + copy


def _read(spec: TreeSpec, copied: Growth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the grown tables, each entry that of the originals where the grown tree has one; and origins."""
    origin = np.concatenate([copied.leaf_origin, copied.node_origin + spec.num_states])
    columns = np.append(origin, spec.num_nodes)
    vertical = np.exp(spec.log_vertical.astype(float))[:, copied.node_origin][:, :, origin]
    horizontal = np.exp(spec.log_horizontal.astype(float))[:, origin][:, :, columns]
    shape = _grown(spec, copied, vertical, horizontal)
    places = allowed_horizontal(shape, self_referential=True)
    places[:, -1] |= shape.parent == shape.root
    return vertical * allowed_vertical(shape), horizontal * places, origin


def _grown(spec: TreeSpec, copied: Growth, vertical: np.ndarray, horizontal: np.ndarray) -> TreeSpec:
    dtype = spec.log_vertical.dtype
    leaves = copied.leaf_origin
    return TreeSpec(
        *copied.shape,
        safe_log(vertical).astype(dtype),
        safe_log(horizontal).astype(dtype),
        tuple(channel.take(leaves) for channel in spec.emissions),
        spec.return_mean[leaves],
        spec.return_var[leaves],
    )


def with_returns(
    spec: TreeSpec, leaf: int, column: int, mean: float, var: float, known: bool = True
) -> TreeSpec:
    """Return the spec with another return of one leaf (as it is where nothing is ``known``)."""
    if not known:
        return spec
    means, variances = spec.return_mean.copy(), spec.return_var.copy()
    means[leaf, column], variances[leaf, column] = mean, max(var, 1e-9)
    return replace(spec, return_mean=means, return_var=variances)
