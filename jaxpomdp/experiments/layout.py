"""Where the states of a learned model go on a picture.

Of a graph, likely transitions are short (stress majorization); a tree hangs from its root.
"""

from __future__ import annotations

import numpy as np


def hang(parent: np.ndarray, leaves: int) -> np.ndarray:
    """Place the nodes of a tree: a level lower for each step from the root, parents above their children.

    Args:
        parent: ``[M]``, -1 above the root, leaves first.
        leaves: N; they get whole numbers along the first axis, in the order of the tree.

    Returns:
        ``[M, 2]``.

    >>> hang(np.array([3, 4, 4, -1, 3]), 3).tolist()
    [[0.0, -1.0], [1.0, -2.0], [2.0, -2.0], [0.75, 0.0], [1.5, -1.0]]
    """
    place = np.zeros((len(parent), 2))
    placed = 0

    def below(node: int, depth: int) -> float:
        nonlocal placed
        if node < leaves:
            across, placed = float(placed), placed + 1
        else:
            ends = [below(int(child), depth + 1) for child in np.flatnonzero(parent == node)]
            across = (ends[0] + ends[-1]) / 2
        place[node] = across, -depth
        return across

    below(int(np.flatnonzero(parent < 0)[0]), 0)
    return place


def spread(weight: np.ndarray, iterations: int = 300, apart: float = 0.0) -> np.ndarray:
    """Place the nodes of a graph in the plane so that distances follow the graph's.

    Minimises ``sum_ij d_ij^-2 (|x_i - x_j| - d_ij)^2`` by majorization (Gansner, Koren and North 2004), where
    ``d`` are shortest-path lengths of edges ``1 - log weight``, symmetrised; starts from classical scaling.

    Args:
        weight: ``[N, N]`` in [0, 1], how strongly two nodes are joined.
        iterations: of the majorization.
        apart: least distance that two nodes are pushed to in the end, in units of the picture's half width.

    Returns:
        ``[N, 2]``, the longer direction along the first axis, from -1 to 1.

    Example:
        >>> chain = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
        >>> np.abs(spread(chain)[:, 0]).round(2).tolist()
        [1.0, 0.0, 1.0]
    """
    if len(weight) < 2:
        return np.zeros((len(weight), 2))
    distance = _distances(weight)
    place = _classical(distance)
    pull = 1 / np.maximum(distance, 1e-9) ** 2
    np.fill_diagonal(pull, 0)
    solve = np.linalg.pinv(np.diag(pull.sum(axis=1)) - pull)
    for _ in range(iterations):
        place = solve @ _majorized(place, pull * distance)
    return _apart(_turned(place), apart)


def _distances(weight: np.ndarray) -> np.ndarray:
    """Return shortest-path lengths; what nothing joins is a step farther than the farthest others."""
    from scipy.sparse.csgraph import shortest_path

    joined = np.maximum(weight, weight.T)
    length = np.where(joined > 1e-3, 1 - np.log(np.clip(joined, 1e-3, 1)), np.inf)
    distance = shortest_path(length, directed=False)
    finite = distance[np.isfinite(distance)]
    return np.where(np.isfinite(distance), distance, finite.max() + 1)


def _classical(distance: np.ndarray) -> np.ndarray:
    count = len(distance)
    centre = np.eye(count) - 1 / count
    values, vectors = np.linalg.eigh(-0.5 * centre @ distance**2 @ centre)
    start = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 1e-9))
    return start + 1e-3 * np.random.default_rng(0).normal(size=start.shape)


def _majorized(place: np.ndarray, strength: np.ndarray) -> np.ndarray:
    gap = np.linalg.norm(place[:, None] - place[None, :], axis=-1)
    ratio = np.where(gap > 1e-9, strength / np.maximum(gap, 1e-9), 0)
    return (np.diag(ratio.sum(axis=1)) - ratio) @ place


def _turned(place: np.ndarray) -> np.ndarray:
    """Turn the long direction to the horizontal, centre the bounding box, and scale."""
    place = place - place.mean(axis=0)
    _, _, axes = np.linalg.svd(place, full_matrices=False)
    place = place @ axes.T
    low, high = place.min(axis=0), place.max(axis=0)
    return (place - (low + high) / 2) * 2 / max((high - low).max(), 1e-9)


def _apart(place: np.ndarray, least: float, rounds: int = 60) -> np.ndarray:
    """Push nodes that lie on each other apart, a half of the missing distance each."""
    for _ in range(rounds if least > 0 else 0):
        away = place[:, None] - place[None, :]
        gap = np.linalg.norm(away, axis=-1) + np.eye(len(place))
        push = np.clip(least - gap, 0, None)[..., None] * away / np.maximum(gap, 1e-9)[..., None]
        place = place + 0.5 * push.sum(axis=1)
    return place
