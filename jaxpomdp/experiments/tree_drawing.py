"""A picture of a tree: its connections, and what its leaves stand for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxpomdp.experiments.layout import hang
from jaxpomdp.experiments.plots import COLOURS, INK, PALE, new_figure, save
from jaxpomdp.structure.tree import TreeSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection, PathCollection
    from matplotlib.figure import Figure

LEAST_ACROSS = 0.1
"""A transition to a sibling that is less likely, over all actions, is not drawn."""
NODE = "#a5b8cc"


def tree_picture(
    spec: TreeSpec,
    path: Path,
    *,
    colour: str | np.ndarray = "observation",
    label: str = "",
    names: Sequence[str] | None = None,
    title: str = "",
) -> Path:
    """Draw a tree: internal states are squares, leaves circles with their most likely symbol below.

    A line down is as thick as the child is likely to be activated; an arrow leads to a sibling that follows
    (both are means over actions).

    Args:
        spec: the tree.
        path: of the PNG.
        colour: of the leaves: by their most likely ``"observation"``, their mean ``"return"`` (the best
            action's), or numbers ``[N]``.
        label: of those numbers.
        names: of the symbols; numbers if None.
        title: above.

    Raises:
        ValueError: the colour is none of these, or observations are asked for where there are no symbols.
    """
    numbers, label = _numbers(spec, colour, label)
    place, inches = hang(spec.parent, spec.num_states), width_for(spec.num_states)
    figure, ax = empty_figure(inches, 1.4 + 0.9 * int(spec.depth.max()))
    _draw_across(ax, spec, place)
    draw_lines(ax, spec.parent, place, 0.5 + 5 * activated(spec), PALE)
    _, leaves = draw_nodes(ax, place, spec.num_states, inches)
    if isinstance(colour, str) and colour == "observation":
        from matplotlib import colormaps

        leaves.set_facecolor([colormaps["tab20"](int(k) % 20) for k in numbers])
    else:
        leaves.set(
            array=numbers, cmap="YlGnBu", clim=(numbers.min(), max(numbers.max(), numbers.min() + 1e-9))
        )
        figure.colorbar(leaves, ax=ax, label=label, shrink=0.7, pad=0.01)
    write_names(ax, place, symbol_names(spec, names))
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return save(figure, path)


def _numbers(spec: TreeSpec, colour: str | np.ndarray, label: str) -> tuple[np.ndarray, str]:
    """Return what colours the leaves, ``[N]``, and what it is called."""
    if not isinstance(colour, str):
        numbers = np.asarray(colour, float)
        if numbers.shape != (spec.num_states,):
            raise ValueError(f"colour must have shape ({spec.num_states},), got {numbers.shape}")
        return numbers, label
    if colour == "return":
        return spec.return_mean.max(-1), label or "mean return"
    if colour != "observation":
        raise ValueError(f"colour must be 'observation', 'return' or numbers, got {colour!r}")
    likely = likely_symbols(spec)
    if likely is None:
        raise ValueError("colour must be 'return' or numbers where nothing is a symbol, got 'observation'")
    return likely, label


def likely_symbols(spec: TreeSpec) -> np.ndarray | None:
    """Return ``[N]``, the symbol that each leaf is most likely to show; None where it shows none."""
    tables = [c.values["log_prob"] for c in spec.emissions if c.kind == "Categorical"]
    return tables[0].argmax(-1) if tables else None


def symbol_names(spec: TreeSpec, names: Sequence[str] | None) -> list[str]:
    """Return ``[N]``, the name of the symbol that each leaf is most likely to show; empty for other kinds."""
    likely = likely_symbols(spec)
    if likely is None:
        return [""] * spec.num_states
    return [str(k if names is None else names[k]) for k in likely.tolist()]


def activated(spec: TreeSpec) -> np.ndarray:
    """Return ``[M]``: how likely its parent is to activate each node, a mean over actions; 0 for the root."""
    tables = np.exp(spec.log_vertical.astype(float))
    later = tables[:-1] if len(tables) > 1 else tables
    mean = later.mean(0)
    mean[0] = tables[-1, 0]
    return mean.sum(0)


def width_for(leaves: int) -> float:
    """Return inches for a tree of so many leaves."""
    return float(np.clip(0.32 * leaves + 1.2, 6, 20))


def empty_figure(width: float, height: float) -> tuple[Figure, Axes]:
    """Return a figure with axes that do not show."""
    figure, ax = new_figure(width, height)
    ax.set_axis_off()
    return figure, ax


def draw_lines(ax: Axes, parent: np.ndarray, place: np.ndarray, width: Any, colour: Any) -> LineCollection:
    """Draw the line above every node but the root, in the order of nodes."""
    from matplotlib.collections import LineCollection

    child = np.flatnonzero(parent >= 0)
    width = np.broadcast_to(width, len(parent))[child]
    lines = LineCollection(
        np.stack([place[parent[child]], place[child]], 1), linewidths=width, colors=colour, zorder=2
    )
    lines.set_capstyle("round")
    ax.add_collection(lines)
    return lines


def draw_nodes(
    ax: Axes, place: np.ndarray, leaves: int, inches: float
) -> tuple[PathCollection, PathCollection]:
    """Draw internal states and leaves, as large as there is room for; what is below them has room too."""
    size = float(np.clip(0.7 * 72 * inches / max(leaves, 1), 4, 17)) ** 2
    style = {"s": size, "edgecolors": INK, "linewidths": 0.6, "zorder": 3}
    internal = ax.scatter(*place[leaves:].T, marker="s", color=NODE, **style)
    circles = ax.scatter(*place[:leaves].T, marker="o", color="white", **style)
    low, high = place.min(0), place.max(0)
    ax.set(xlim=(low[0] - 0.8, high[0] + 0.8), ylim=(low[1] - 0.7, high[1] + 0.3))
    return internal, circles


def _draw_across(ax: Axes, spec: TreeSpec, place: np.ndarray) -> None:
    from matplotlib.patches import FancyArrowPatch

    across = np.exp(spec.log_horizontal.astype(float)).mean(0)[:, :-1]
    np.fill_diagonal(across, 0)
    for i, j in np.argwhere(across >= LEAST_ACROSS):
        bend = 0.35 if place[i, 0] < place[j, 0] else -0.35
        arrow = FancyArrowPatch(
            tuple(place[i]),
            tuple(place[j]),
            connectionstyle=f"arc3,rad={bend}",
            arrowstyle="-|>,head_width=1.6,head_length=3",
            shrinkA=6,
            shrinkB=6,
            linewidth=0.3 + 1.8 * float(across[i, j]),
            color=COLOURS[0],
            alpha=0.2 + 0.5 * float(across[i, j]),
        )
        ax.add_patch(arrow)


def write_names(ax: Axes, place: np.ndarray, names: Sequence[str]) -> None:
    """Write a name below each of the first nodes."""
    longest = max(map(len, names), default=0)
    for (x, y), name in zip(place, names, strict=False):
        ax.annotate(
            name,
            (x, y),
            (0, -11),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=7,
            rotation=90 if longest > 3 else 0,
            annotation_clip=False,
        )
