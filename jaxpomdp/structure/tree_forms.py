"""Other forms of a tree: the flat model it comes to, one level of tree, and self-referential internal states.

With minimal self-reference the shortest way between two leaves is the only one, so a transition of the flat
model is a product along it (thesis 5.3). For leaves k, l whose lowest common ancestor has the children u
above k and v above l::

    T*(k, l) = [product of T(n, end) from k up to below u] T(u, v) [product of pi from v down to l]
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxpomdp.structure.spec import FlatSpec, safe_log
from jaxpomdp.structure.topology import paths_of
from jaxpomdp.structure.tree import TreeSpec


def flatten_tree(spec: TreeSpec) -> FlatSpec:
    """Return the flat model of the same leaves: ``T*`` and the first leaf's distribution.

    Self-referential internal states are first removed (``minimal``), which leaves ``T*`` as it is.
    """
    spec = minimal(spec)
    n = spec.num_states
    path = paths_of(spec.parent, n)
    leave, enter_start, enter = _ways(spec, path)
    horizontal = np.exp(spec.log_horizontal.astype(float))
    common = (path[:, None] == path[None]) & (path >= 0)[:, None]
    level = common.sum(-1) - np.eye(n, dtype=int)
    rows, columns = np.arange(n)[:, None], np.arange(n)[None]
    across = horizontal[:, path[rows, level], path[columns, level]]
    trans = leave[:, rows, level] * across * enter[:, columns, level]
    dtype = spec.log_horizontal.dtype
    return FlatSpec(
        safe_log(enter_start[:, 0]).astype(dtype),
        safe_log(trans).astype(dtype),
        spec.emissions,
        spec.return_mean,
        spec.return_var,
    )


def _ways(spec: TreeSpec, path: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return products over the depths below d: ends ``[A, N, L+1]``, and entries at starts and later."""
    node, here = np.maximum(path, 0), path >= 0
    ends = np.where(here, np.exp(spec.log_horizontal.astype(float))[:, node, -1], 1.0)
    vertical = np.exp(spec.log_vertical.astype(float))
    step = vertical[:, np.maximum(path[:, :-1] - spec.root, 0), node[:, 1:]]
    step = np.where(here[:, 1:], step, 1.0)
    into = np.concatenate([np.ones_like(step[..., :1]), step], axis=-1)
    leave, enter = _product_beyond(ends), _product_beyond(into)
    later = enter[:-1] if len(enter) > 1 else np.repeat(enter, spec.num_actions, 0)
    return leave, enter[-1], later


def _product_beyond(x: np.ndarray) -> np.ndarray:
    """Return the product of the entries after each one, along the last axis."""
    shifted = np.concatenate([x[..., 1:], np.ones_like(x[..., :1])], axis=-1)
    return np.cumprod(shifted[..., ::-1], axis=-1)[..., ::-1]


def one_level(spec: FlatSpec) -> TreeSpec:
    """Return a flat model as a tree: all states below the root.

    >>> flat = FlatSpec.from_probabilities([1, 0], [[[0.5, 0.5], [0, 1]]], emissions=(np.eye(2),))
    >>> flatten_tree(one_level(flat)) == flat
    True
    """
    n, absent = spec.num_states, safe_log(np.zeros((), spec.log_trans.dtype))
    vertical = np.full((1, 1, n + 1), absent)
    horizontal = np.full((spec.num_actions, n + 1, n + 2), absent)
    vertical[0, 0, :n], horizontal[:, :n, :n] = spec.log_init, spec.log_trans
    parents = np.zeros(n, int), np.array([-1])
    return TreeSpec(*parents, vertical, horizontal, spec.emissions, spec.return_mean, spec.return_var)


def minimal(spec: TreeSpec) -> TreeSpec:
    """Return the model in which no internal state follows itself; ``T*`` is unchanged (thesis 5.3).

    Where u follows itself with probability s, a child c that ends may start over: ``T'(c, c') = T(c, c') +
    T(c, end) s pi(c')``, ``T'(c, end) = T(c, end) (1 - s)`` and ``T'(u, v) = T(u, v) / (1 - s)``. Done from
    the root down, since children that are internal come to follow themselves by it.
    """
    internal = np.arange(spec.root + 1, spec.num_nodes)
    if not (np.exp(spec.log_horizontal[:, internal, internal]) > 0).any():
        return spec
    horizontal = np.exp(spec.log_horizontal.astype(float))
    for node in sorted(internal, key=lambda m: (spec.depth[m], m)):
        _remove_self(spec, horizontal, int(node))
    return _with_horizontal(spec, horizontal)


def maximal(spec: TreeSpec) -> TreeSpec:
    """Return the model in which internal states follow themselves as much as possible; ``T*`` is unchanged.

    The inverse of ``minimal``, done from the leaves up. With ``r = s / (1 - s)`` the children of u become
    ``T(c, c') = T'(c, c') - r T'(c, end) pi(c')``; r is the largest for which none is negative, apart for
    each action. A state whose children never end under an action is left alone there.
    """
    spec = minimal(spec)
    horizontal = np.exp(spec.log_horizontal.astype(float))
    internal = np.arange(spec.root + 1, spec.num_nodes)
    for node in sorted(internal, key=lambda m: (-spec.depth[m], m)):
        _add_self(spec, horizontal, int(node))
    return _with_horizontal(spec, horizontal)


def opened(spec: TreeSpec) -> TreeSpec:
    """Return the maximal form in which the root, too, starts over as often as it can.

    The root is entered when a trial starts, and never ends. A transition between two of its children may
    still be a starting over, by the distribution of starts: child c becomes one that ends with ``e(c) =
    min_c' T(c, c') / pi(c')`` and goes on by ``T(c, c') - e(c) pi(c')``. These ends are in the last column,
    where trees have none; ``closed`` gives the tree back.
    """
    most = maximal(spec)
    horizontal = np.exp(most.log_horizontal.astype(float))
    children = most.children(most.root)
    again = vertical_under_actions(most, most.root)[:, None, children]
    across = horizontal[:, children[:, None], children[None]]
    ends = np.where(again > 0, across / np.where(again > 0, again, 1), np.inf).min(-1)
    horizontal[:, children[:, None], children[None]] = _less(across, ends[..., None] * again)
    horizontal[:, children, -1] = ends
    return _with_horizontal(most, horizontal)


def closed(spec: TreeSpec) -> TreeSpec:
    """Return the minimal form of a tree whose root starts over when a child of it ends (``opened``)."""
    horizontal = np.exp(spec.log_horizontal.astype(float))
    _start_over(spec, horizontal, spec.root, np.ones(spec.num_actions))
    return minimal(_with_horizontal(spec, horizontal))


def starting_over(spec: TreeSpec) -> np.ndarray:
    """Return ``[A, N, N]``: what share of ``T*(k, l)`` the starting over of l's parent has (maximal form).

    For k below l's parent p it is ``[product of T(n, end) from k up to below p] T(p, p) pi(l) / T*(k, l)``;
    the rest are ways that turn below p, or above it. For other k it is zero.
    """
    most, flat = opened(spec), np.exp(flatten_tree(spec).log_trans.astype(float))
    share = np.zeros_like(flat)
    for node in range(most.root, most.num_nodes):
        leaves = most.children(node)
        leaves = leaves[leaves < most.num_states]
        again = self_share(most, node)[:, None] * vertical_under_actions(most, node)[:, leaves]
        way = _ends_up_to(most, node)[:, :, None] * again[:, None]
        whole = flat[:, :, leaves]
        share[:, :, leaves] = np.where(whole > 0, way / np.where(whole > 0, whole, 1), 0).clip(0, 1)
    return share


def _ends_up_to(spec: TreeSpec, node: int) -> np.ndarray:
    """Return ``[A, N]``: the product of ends from each leaf up to below an internal state; 0 elsewhere."""
    ends = np.exp(spec.log_horizontal[:, :, -1].astype(float))
    under, at = spec.below[node], np.arange(spec.num_states)
    total = np.broadcast_to(under.astype(float), (spec.num_actions, len(at)))
    for _ in range(int(spec.depth.max())):
        climbing = under & (at != node)
        total = total * np.where(climbing, ends[:, at], 1)
        at = np.where(climbing, spec.parent[at], at)
    return total


def self_share(spec: TreeSpec, node: int) -> np.ndarray:
    """Return ``[A]``: with what probability an internal state follows itself; the root does nothing else."""
    if node == spec.root:
        return np.ones(spec.num_actions)
    return np.exp(spec.log_horizontal[:, node, node].astype(float))


def vertical_under_actions(spec: TreeSpec, node: int) -> np.ndarray:
    """Return ``[A, M]``: what an internal state activates when it is entered under each action.

    The root is entered at starts alone, whatever the action.
    """
    row = np.exp(spec.log_vertical[:, node - spec.root].astype(float))
    by_action = len(row) > 1 and node != spec.root
    return row[:-1] if by_action else np.repeat(row[-1:], spec.num_actions, 0)


def _start_over(spec: TreeSpec, horizontal: np.ndarray, node: int, share: np.ndarray) -> None:
    """Let a share ``[A]`` of the ends of a node's children lead to the node's children again."""
    children = spec.children(node)
    again = vertical_under_actions(spec, node)[:, children]
    ends = horizontal[:, children, -1].copy()
    back = (ends * share[:, None])[..., None] * again[:, None]
    horizontal[:, children[:, None], children[None]] += back
    horizontal[:, children, -1] = ends * (1 - share)[:, None]


def _remove_self(spec: TreeSpec, horizontal: np.ndarray, node: int) -> None:
    share = horizontal[:, node, node].copy()
    _start_over(spec, horizontal, node, share)
    horizontal[:, node, node] = 0
    left = 1 - share
    away = horizontal[:, node] / np.where(left > 0, left, 1)[:, None]
    horizontal[:, node] = np.where((left > 0)[:, None], away, _evenly_away(spec, node))


def _evenly_away(spec: TreeSpec, node: int) -> np.ndarray:
    """Return the row of a state that never comes to leave: any will do, so an even one over its siblings."""
    siblings = (spec.parent == spec.parent[node]) & (np.arange(spec.num_nodes) != node)
    return np.append(siblings, False) / siblings.sum()


def _add_self(spec: TreeSpec, horizontal: np.ndarray, node: int) -> None:
    children = spec.children(node)
    again = vertical_under_actions(spec, node)[:, children]
    ends = horizontal[:, children, -1].copy()
    back = ends[..., None] * again[:, None]
    across = horizontal[:, children[:, None], children[None]]
    ratio = np.where(back > 0, across / np.where(back > 0, back, 1), np.inf).min((1, 2))
    ratio = np.where(np.isfinite(ratio), ratio, 0.0)[:, None]
    horizontal[:, children[:, None], children[None]] = _less(across, ratio[..., None] * back)
    horizontal[:, children, -1] = ends * (1 + ratio)
    horizontal[:, node] /= 1 + ratio
    horizontal[:, node, node] = (ratio / (1 + ratio))[:, 0]


def _less(whole: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return ``whole - part``, exactly zero where no more than rounding is left."""
    rest = whole - part
    return np.where(rest > 1e-12 * np.maximum(whole, 1e-300), rest, 0.0)


def _with_horizontal(spec: TreeSpec, horizontal: np.ndarray) -> TreeSpec:
    return replace(spec, log_horizontal=safe_log(horizontal).astype(spec.log_horizontal.dtype))
