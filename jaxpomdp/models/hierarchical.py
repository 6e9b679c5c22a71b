"""The hierarchical hidden Markov model (thesis chapter 5): ``HIERARCHICAL`` and its parameters.

Inference runs on the flat chain over leaves that the tree comes to, so it costs what the flat model costs,
``O(N^2 T)``; the counts of the flat chain are then credited to the tree's own connections. Every distribution
is normalised by the sum of its own counts, so the M-step is exact and the objective never falls.
"""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxpomdp._types import Array, Chain, TrialBatch, last_steps, pytree
from jaxpomdp.kernels.filtering import trial_starts
from jaxpomdp.kernels.hierarchy import NodePath, flatten, node_belief, node_path, tree_counts
from jaxpomdp.models.checks import check_data, check_leaves
from jaxpomdp.models.emission import ReturnModel
from jaxpomdp.models.estimates import check_rows
from jaxpomdp.models.family import Family
from jaxpomdp.models.flat import FlatStatistics, Tables, chain_family


@pytree
class TreeParams:
    """Parameters of a tree of ``N`` leaves, ``I`` internal states, ``M = N + I`` nodes, capacity included.

    Leaves are nodes ``0 .. N-1``, internal states ``N .. M-1``, the root first. ``NEG`` stands wherever the
    tree has no connection. ``Prior.initial`` and the part "init" are of ``log_vertical``;
    ``Prior.transition`` and "transitions" of ``log_horizontal``.

    Attributes:
        log_vertical: ``[V, I, M]``, log probability that an internal state activates each child; V = 1, or
            A + 1 where it depends on the action that led there (the last is for starts of trials).
        log_horizontal: ``[A, M, M+1]``, log probability that a node is followed by each sibling, or (last
            column) by its parent's end.
        path: int ``[N, L+1]``, the node at each depth from the root to each leaf, -1 beyond.
        emissions: tuple of channels, rows are leaves.
        returns: ``ReturnModel``, the return from each leaf on.
        alive: bool ``[N]``, the leaf exists.
    """

    log_vertical: Array
    log_horizontal: Array
    path: Array
    emissions: tuple[Any, ...]
    returns: ReturnModel
    alive: Array


def _chain(params: TreeParams) -> Chain:
    return flatten(params.log_vertical, params.log_horizontal, params.path)


def _rows(params: TreeParams) -> tuple[Array, Array]:
    return params.log_vertical, params.log_horizontal


def _counts(params: TreeParams, statistics: FlatStatistics) -> tuple[Array, Array]:
    tables, internal = params.log_vertical.shape[:2]
    return tree_counts(statistics.initial, statistics.transitions, params.path, internal, tables)


def beliefs_of_nodes(params: TreeParams, belief: Array) -> Array:
    """Return how much every node is believed to be active, ``[..., M]``, of one model's belief ``[..., N]``.

    Works on the online belief, and on the rows of a posterior's ``gamma``.
    """
    return node_belief(belief, params.path, params.log_vertical.shape[-2])


def path_of_nodes(params: TreeParams, states: Array, start: Array, valid: Array) -> NodePath:
    """Return a path of leaves as the path of nodes through one tree, with where each is entered and left.

    Args:
        params: one model.
        states: int ``[T]``, such as the best path (``viterbi``) or a sampled one; -1 at padding.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.
    """
    return node_path(states, params.path, trial_starts(start, valid), last_steps(valid, start))


def check_tree(params: Any, batch: TrialBatch) -> None:
    """Refuse trees (any leading axes) or a batch that inference cannot use, before anything is compiled.

    Raises:
        ValueError: naming the argument, what was expected, and what came.
    """
    check_tree_params(params)
    check_data(params, batch, params.log_horizontal.shape[-3])


def check_tree_params(params: Any) -> None:
    """Refuse parameters that disagree in shape, whose paths are no tree, or that are no probabilities.

    Raises:
        ValueError: naming the field.
    """
    check_leaves(params)
    alive, path = np.asarray(params.alive), np.asarray(params.path)
    lead, leaves = alive.shape[:-1], alive.shape[-1]
    tables, internal = params.log_vertical.shape[-3:-1]
    actions, nodes = params.log_horizontal.shape[-3], leaves + internal
    _shape("params.log_vertical", params.log_vertical, (*lead, tables, internal, nodes))
    _shape("params.log_horizontal", params.log_horizontal, (*lead, actions, nodes, nodes + 1))
    _shape("params.path", path, (*lead, leaves, path.shape[-1]))
    if tables not in (1, actions + 1):
        raise ValueError(f"params.log_vertical must have 1 or {actions + 1} tables, got {tables}")
    _check_path(path.reshape(-1, *path.shape[-2:]), alive.reshape(-1, leaves), nodes)
    parent = _parents(path, nodes)
    horizontal = np.broadcast_to((parent >= 0)[..., None, :], (*lead, actions, nodes))
    check_rows("params.log_horizontal", params.log_horizontal, horizontal)
    root = np.arange(internal) == 0
    used = (parent[..., None, :] == np.arange(leaves, nodes)[:, None]).any(-1)
    vertical = np.broadcast_to(used[..., None, :], (*lead, tables, internal)).copy()
    vertical[..., :-1, root] = False
    check_rows("params.log_vertical", params.log_vertical, vertical)
    _check_zeros(params, parent)


def _shape(name: str, array: Any, expected: tuple[int, ...]) -> None:
    if tuple(array.shape) != expected:
        raise ValueError(f"{name} must have shape {expected}, got {tuple(array.shape)}")


def _check_path(path: np.ndarray, alive: np.ndarray, nodes: int) -> None:
    """Refuse paths that do not lead from the root to their leaf, or that give a node two parents."""
    leaves = path.shape[1]
    here = path >= 0
    ends = np.take_along_axis(path, np.maximum(here.sum(-1, keepdims=True) - 1, 0), -1)[..., 0]
    whole = (np.diff(here.astype(int), axis=-1) <= 0).all(-1) & (path < nodes).all(-1)
    good = np.where(alive, whole & (path[..., 0] == leaves) & (ends == np.arange(leaves)), ~here.any(-1))
    if not good.all():
        model, leaf = np.argwhere(~good)[0]
        raise ValueError(
            f"params.path must lead from the root ({leaves}) to each leaf that is alive, "
            f"got {path[model, leaf].tolist()} for leaf {leaf}"
        )
    parent = _parents(path, nodes)
    child, above = np.maximum(path[..., 1:], 0), path[..., :-1]
    same = np.take_along_axis(parent, child.reshape(len(path), -1), -1).reshape(child.shape) == above
    if not (same | (path[..., 1:] < 0)).all():
        raise ValueError("params.path must give every node one parent, got two for some node")


def _parents(path: np.ndarray, nodes: int) -> np.ndarray:
    """Return ``[..., M]``: the parent of every node, -1 where there is none."""
    rows = path.reshape(-1, *path.shape[-2:])
    parent = np.full((len(rows), nodes + 1), -1)
    for row, model in zip(parent, rows, strict=True):
        row[model[:, 1:]] = np.where(model[:, 1:] >= 0, model[:, :-1], -1)
    parent[:, nodes] = -1
    return parent[:, :-1].reshape(*path.shape[:-2], nodes)


def _check_zeros(params: Any, parent: np.ndarray) -> None:
    """Refuse probability where the tree has no connection."""
    nodes, leaves = parent.shape[-1], np.asarray(params.alive).shape[-1]
    internal = np.arange(leaves, nodes)
    children = parent[..., None, :] == internal[:, None]
    siblings = (parent[..., :, None] == parent[..., None, :]) & (parent >= 0)[..., None]
    siblings[..., internal, internal] = False
    ends = (parent >= 0) & (parent != leaves)
    places = np.concatenate([siblings, ends[..., None]], axis=-1)
    for name, allowed in {"log_vertical": children, "log_horizontal": places}.items():
        table = np.exp(np.asarray(getattr(params, name)))
        if ((table > 0) & ~allowed[..., None, :, :]).any():
            what = (
                "a node that is no child" if name == "log_vertical" else "one that is no sibling, or itself"
            )
            raise ValueError(f"params.{name} must be zero where the tree has no connection, got {what}")


HIERARCHICAL: Family = chain_family(
    "hierarchical", Tables(("log_vertical", "log_horizontal"), _chain, _rows, _counts), check_tree
)
"""The hierarchical model as a family."""

flatten_trees = jax.jit(jax.vmap(_chain))
"""``params -> Chain`` for many trees at once: leading axis ``S`` on everything."""
