"""The algorithm of Fine, Singer and Tishby (1998): inference over all spans of a sequence, in ``O(N T^3)``.

It never flattens the tree. With actions, and with trials that may be cut off in the middle of the tree's
activity: at the last step everything counts as ended. Plain NumPy, float64, one trial at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxpomdp.structure.spec import Channel, safe_log
from jaxpomdp.structure.tree import TreeSpec

Trial = tuple[np.ndarray, np.ndarray]
"""``T`` symbols and ``T - 1`` actions."""


class Counts(NamedTuple):
    """Expected uses of each entry: ``vertical[V, I, M]``, ``horizontal[A, M, M+1]``, ``seen[N, O]``."""

    vertical: np.ndarray
    horizontal: np.ndarray
    seen: np.ndarray


class _Tables:
    """Probabilities by step: ``down[T, I, M]`` on entering, ``across[T-1, M, M]``, ``ends[T, M]`` after.

    ``seen[T, N]`` is relative to its mean over leaves, whose logarithms add up to ``scale``: products of
    hundreds of probabilities would be too small for numbers.
    """

    def __init__(self, spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> None:
        vertical, horizontal = np.exp(spec.log_vertical), np.exp(spec.log_horizontal)
        later = vertical[:-1] if len(vertical) > 1 else np.repeat(vertical, len(horizontal), 0)
        seen = np.exp(spec.emissions[0].values["log_prob"])[:, symbols].T
        self.scale = float(np.log(seen.mean(1)).sum())
        self.seen = seen / seen.mean(1, keepdims=True)
        self.down = np.concatenate([vertical[-1:], later[actions]])
        self.across = horizontal[actions][:, :, :-1]
        self.ends = np.concatenate([horizontal[actions][:, :, -1], np.ones((1, spec.num_nodes))])


class _Node(NamedTuple):
    """The spans of one internal state that is entered at t, with its C children.

    ``begin[t, v, c]``: child c is activated at v. ``reach[t, w, c]``: it has ended at w. ``inside[t, u]``:
    the state itself has ended at u. All are joint with what was shown since t.
    """

    children: np.ndarray
    begin: np.ndarray
    reach: np.ndarray
    inside: np.ndarray


def span_evidence(spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> float:
    """Return the log-probability of one trial of ``T`` symbols and ``T - 1`` actions."""
    tables = _Tables(spec, symbols, actions)
    return float(np.log(_inside(spec, tables)[spec.root].inside[0, -1])) + tables.scale


def _inside(spec: TreeSpec, tables: _Tables) -> dict[int, _Node]:
    """Return every internal state's spans, from the bottom up."""
    nodes: dict[int, _Node] = {}
    for node in sorted(range(spec.root, spec.num_nodes), key=lambda m: -spec.depth[m]):
        children = spec.children(node)
        begin, reach = _reach(spec, tables, node, nodes)
        inside = np.einsum("tuc,uc->tu", reach, tables.ends[:, children])
        nodes[node] = _Node(children, begin, reach, inside)
    return nodes


def _reach(
    spec: TreeSpec, tables: _Tables, node: int, nodes: dict[int, _Node]
) -> tuple[np.ndarray, np.ndarray]:
    children, steps = spec.children(node), len(tables.seen)
    begin, reach = np.zeros((2, steps, steps, len(children)))
    first = tables.down[:, node - spec.root][:, children]
    for u in range(steps):
        if u:
            begin[:, u] = reach[:, u - 1] @ tables.across[u - 1][children[:, None], children]
        begin[u, u] = first[u]
        for c, child in enumerate(children):
            if child < spec.num_states:
                reach[:, u, c] = begin[:, u, c] * tables.seen[u, child]
            else:
                reach[:, u, c] = begin[:, : u + 1, c] @ nodes[child].inside[: u + 1, u]
    return begin, reach


def _tails(
    spec: TreeSpec, tables: _Tables, node: _Node, nodes: dict[int, _Node]
) -> tuple[np.ndarray, np.ndarray]:
    """Return what is left to show: ``tail[w, u, c]`` after c has ended at w until the state ends at u.

    And ``post[v, u, c]``: since c was activated at v.
    """
    children, steps = node.children, len(tables.seen)
    tail, post = np.zeros((2, steps, steps, len(children)))
    for v in reversed(range(steps)):
        if v + 1 < steps:
            tail[v] = post[v + 1] @ tables.across[v][children[:, None], children].T
        tail[v, v] = tables.ends[v, children]
        for c, child in enumerate(children):
            if child < spec.num_states:
                post[v, :, c] = tables.seen[v, child] * tail[v, :, c]
            else:
                post[v, :, c] = nodes[child].inside[v, v:] @ tail[v:, :, c]
    return tail, post


def span_counts(spec: TreeSpec, symbols: np.ndarray, actions: np.ndarray) -> Counts:
    """Return how often each entry of the tree is expected to be used in one trial (their E-step)."""
    tables = _Tables(spec, symbols, actions)
    nodes, steps = _inside(spec, tables), len(symbols)
    seen = spec.emissions[0].values["log_prob"]
    counts = Counts(np.zeros_like(spec.log_vertical), np.zeros_like(spec.log_horizontal), np.zeros_like(seen))
    outside = {spec.root: np.zeros((steps, steps))}
    outside[spec.root][0, -1] = 1 / nodes[spec.root].inside[0, -1]
    for node in sorted(nodes, key=lambda m: spec.depth[m]):
        tail, post = _tails(spec, tables, nodes[node], nodes)
        used = _uses(tables, node - spec.root, nodes[node], outside[node], post)
        _credit(counts, used, node - spec.root, nodes[node].children, actions)
        for c, child in enumerate(nodes[node].children):
            before = nodes[node].begin[:, :, c].T @ outside[node]
            if child >= spec.num_states:
                outside[child] = np.triu(before @ tail[:, :, c].T)
                continue
            shown = np.einsum("vu,vu->v", before, tail[:, :, c]) * tables.seen[:, child]
            np.add.at(counts.seen[child], symbols, shown)
    return counts


class _Uses(NamedTuple):
    """Expected uses by step: ``down[T, C]``, ``across[T-1, C, C]``, ``ends[T-1, C]``."""

    down: np.ndarray
    across: np.ndarray
    ends: np.ndarray


def _uses(tables: _Tables, number: int, node: _Node, outside: np.ndarray, post: np.ndarray) -> _Uses:
    children = node.children
    first = tables.down[:, number][:, children]
    down = first * np.einsum("tu,tuc->tc", outside, post)
    rest = np.stack([outside @ post[:, :, c].T for c in range(len(children))], -1)
    ways = tables.across[:, children[:, None], children]
    across = np.einsum("tvc,tvd->vcd", node.reach[:, :-1], rest[:, 1:]) * ways
    ended = np.einsum("tvc,tv->vc", node.reach[:, :-1], outside[:, :-1]) * tables.ends[:-1, children]
    return _Uses(down, across, ended)


def _credit(counts: Counts, used: _Uses, number: int, children: np.ndarray, actions: np.ndarray) -> None:
    by_action = len(counts.vertical) > 1
    counts.vertical[-1, number, children] += used.down[0]
    for t, action in enumerate(actions):
        counts.vertical[action if by_action else 0, number, children] += used.down[t + 1]
        counts.horizontal[action][children[:, None], children] += used.across[t]
        counts.horizontal[action, children, -1] += used.ends[t]


def reestimated(spec: TreeSpec, counts: Sequence[Counts]) -> TreeSpec:
    """Return the tree after the M-step: rows in proportion to their counts, or as they were without any."""
    vertical, horizontal, seen = (sum(x) for x in zip(*counts, strict=True))
    channel = spec.emissions[0].values["log_prob"]
    return replace(
        spec,
        log_vertical=_rows(vertical, spec.log_vertical),
        log_horizontal=_rows(horizontal, spec.log_horizontal),
        emissions=(Channel("Categorical", {"log_prob": _rows(seen, channel)}),),
    )


def _rows(counts: np.ndarray, old: np.ndarray) -> np.ndarray:
    total = counts.sum(-1, keepdims=True)
    return np.where(total > 0, safe_log(counts / np.where(total > 0, total, 1)), old)
