"""Trees on the device: from a tree's tables to the flat chain, and from flat counts back to the tables.

The shape of a tree is data, ``path[N, L+1]``: the node at each depth on the way from the root to each leaf,
-1 beyond the leaf and in spare slots. Leaves are nodes ``0 .. N-1`` and internal states ``N .. M-1``,
capacity included, so different trees fit one shape. All functions are for one model. Source: chapter 5.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from jaxpomdp._types import Array, Chain
from jaxpomdp.kernels.filtering import EXACT
from jaxpomdp.numerics import NEG


class TreeCounts(NamedTuple):
    """How often each entry of a tree's tables was used: ``vertical[V, I, M]``, ``horizontal[A, M, M+1]``.

    Only the tables' own entries mean anything: children in ``vertical``, siblings and the end (last) in
    ``horizontal``.
    """

    vertical: Array
    horizontal: Array


def branching(path: Array) -> Array:
    """Return int ``[N, N]``: the depth at which the ways to leaves k and l part, a leaf from itself its own.

    It is the depth of u and v in ``flatten``; 0 for spare slots.
    """
    common = jnp.sum((path[:, None] == path[None]) & (path >= 0)[:, None], axis=-1)
    return jnp.maximum(common - jnp.eye(path.shape[0], dtype=common.dtype), 0)


def beyond(x: Array) -> Array:
    """Return the sum of the entries after each one along the last axis, at least ``NEG``."""
    shifted = jnp.concatenate([x[..., 1:], jnp.zeros_like(x[..., :1])], axis=-1)
    return jnp.maximum(jnp.cumsum(shifted[..., ::-1], axis=-1)[..., ::-1], NEG)


def flatten(log_vertical: Array, log_horizontal: Array, path: Array) -> Chain:
    """Return the chain over leaves: ``T*_a(k, l) = exits_a(k, below u) T_a(u, v) entries_a(v, down to l)``.

    With u, v the children above k and l of their lowest common ancestor (a leaf and itself: the leaf), exits
    are the ends of the nodes from k up to below u, and entries the vertical transitions from v down to l;
    both are sums of logarithms over depth, taken once and read at the depth of u.

    Args:
        log_vertical: ``[V, I, M]``, V = 1, or A + 1 (one an action, the last for starts).
        log_horizontal: ``[A, M, M+1]``, the last column is the end.
        path: int ``[N, L+1]``.

    Returns:
        Chain: ``log_init[N]`` and ``log_trans[A, N, N]``; ``NEG`` for spare slots.
    """
    actions, leaves = log_horizontal.shape[0], path.shape[0]
    node, here = jnp.maximum(path, 0), path >= 0
    exits = beyond(jnp.where(here, log_horizontal[:, node, -1], 0))
    above = jnp.maximum(path[:, :-1] - leaves, 0)
    step = jnp.where(here[:, 1:], log_vertical[:, above, node[:, 1:]], 0)
    entries = beyond(jnp.concatenate([jnp.zeros_like(step[..., :1]), step], axis=-1))
    later = entries[:-1] if len(entries) > 1 else jnp.broadcast_to(entries, (actions, *entries.shape[1:]))
    log_trans = _joined(exits, log_horizontal, later, node, branching(path))
    exists = here[:, 0]
    both = (exists[:, None] & exists[None])[None]
    return Chain(jnp.where(exists, entries[-1, :, 0], NEG), jnp.where(both, jnp.maximum(log_trans, NEG), NEG))


def _joined(exits: Array, log_horizontal: Array, entries: Array, node: Array, level: Array) -> Array:
    """Add up the three parts of every way ``[A, N, N]``, one depth at which ways part after the other."""
    total = jnp.full((log_horizontal.shape[0], *level.shape), NEG, log_horizontal.dtype)
    for depth in range(1, node.shape[1]):
        across = log_horizontal[:, node[:, depth]][:, :, node[:, depth]]
        way = exits[:, :, None, depth] + across + entries[:, None, :, depth]
        total = jnp.where((level == depth)[None], way, total)
    return total


def descendants(path: Array, nodes: int) -> Array:
    """Return bool ``D[M, N]``: leaf n is node m or below it."""
    return jnp.any(path[None] == jnp.arange(nodes)[:, None, None], axis=-1)


def parents(path: Array, nodes: int) -> Array:
    """Return int ``[M]``: the parent of every node, -1 for the root and spare slots."""
    child = jnp.where(path[:, 1:] >= 0, path[:, 1:], nodes)
    return jnp.full(nodes, -1, path.dtype).at[child].max(path[:, :-1], mode="drop")


def tree_counts(initial: Array, xi: Array, path: Array, internal: int, tables: int) -> TreeCounts:
    """Add up the ways that use each connection: ``D xi D^T`` and its complements.

    A sibling follows a node: ``sum xi(k, l)`` over k below the one and l below the other. A node ends: k
    below it, l not below its parent. A child is activated: k not below the parent, l below the
    child; and at starts.

    Args:
        initial: ``[N]``, expected counts of first leaves.
        xi: ``[A, N, N]``, expected transitions under each action.
        path: int ``[N, L+1]``.
        internal: I, slots for internal states.
        tables: V, of the vertical tables.
    """
    leaves = path.shape[0]
    nodes = leaves + internal
    under = descendants(path, nodes)
    inside, outside = under.astype(xi.dtype), (~under).astype(xi.dtype)
    leaving = jnp.einsum("mk,akl->aml", inside, xi, precision=EXACT)
    across = jnp.einsum("aml,nl->amn", leaving, inside, precision=EXACT)
    beyond_parent = outside[jnp.maximum(parents(path, nodes), 0)]
    ends = jnp.sum(leaving * beyond_parent[None], axis=-1, keepdims=True)
    entering = jnp.einsum("akl,nl->akn", xi, inside, precision=EXACT)
    down = jnp.einsum("ik,akn->ain", outside[leaves:], entering, precision=EXACT)
    starts = jnp.broadcast_to(jnp.matmul(inside, initial, precision=EXACT), (1, internal, nodes))
    vertical = jnp.concatenate([down, starts]) if tables > 1 else jnp.sum(down, 0, keepdims=True) + starts
    return TreeCounts(vertical, jnp.concatenate([across, ends], axis=-1))


def node_belief(belief: Array, path: Array, internal: int) -> Array:
    """Return how much each node is believed to be active, ``[..., M]``, of beliefs over leaves ``[..., N]``.

    A node is active while a leaf below it is; the nodes of one depth and the leaves above it sum to one.
    """
    inside = descendants(path, path.shape[0] + internal).astype(belief.dtype)
    return jnp.matmul(belief, inside.T, precision=EXACT)


class NodePath(NamedTuple):
    """A path of leaves as a path of nodes, per step and depth ``[T, L+1]``.

    ``nodes``: the active node at each depth, -1 below the leaf and at padding. ``entered``: it was activated
    to make this step. ``left``: activity passes from it to another node (or to the leaf once more) after this
    step. At the ends of a trial everything is entered and left.
    """

    nodes: Array
    entered: Array
    left: Array


def node_path(states: Array, path: Array, first: Array, last: Array) -> NodePath:
    """Return a path of leaves ``[T]`` (-1 at padding), such as Viterbi's, as a path through the tree.

    A step from leaf k to l leaves the nodes above k, and enters those above l, from the depth at which the
    ways to them part.

    Args:
        states: int ``[T]``.
        path: int ``[N, L+1]``.
        first: bool ``[T]``, first steps of trials.
        last: bool ``[T]``, last steps of trials.
    """
    there = states >= 0
    leaf = jnp.maximum(states, 0)
    nodes = jnp.where(there[:, None], path[leaf], -1)
    level = branching(path)[leaf, jnp.roll(leaf, -1)]
    depth = jnp.arange(path.shape[1])[None]
    gone = jnp.where(last, 0, level)[:, None]
    come = jnp.where(first, 0, jnp.roll(level, 1))[:, None]
    return NodePath(nodes, (depth >= come) & (nodes >= 0), (depth >= gone) & (nodes >= 0))
