"""Pictures of results: curves with the median run and a band, bars, measured beside published.

Matplotlib is loaded when a picture is made, and no window is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxpomdp.experiments.stats import Interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#1864ab", "#e8590c", "#2b8a3e", "#862e9c", "#c92a2a", "#0b7285", "#846358", "#5f6b76")
BAR_COLOURS = (
    "#4c7fb0",
    "#c3d3e3",
    "#e3b98f",
    "#efe0cf",
    "#8fae8b",
    "#d5e3cf",
    "#b09ac0",
    "#e2d8ea",
    "#7b7f87",
)
INK, PALE, GRID = "#212529", "#868e96", "#e9ecef"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": INK,
    "axes.edgecolor": PALE,
    "axes.labelcolor": INK,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "xtick.color": PALE,
    "ytick.color": PALE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "savefig.dpi": 150,
}


class Curve(NamedTuple):
    """One agent's course over trials: ``trial[T]``, ``values[S, T]``, and which seed is the median run."""

    label: str
    trial: np.ndarray
    values: np.ndarray
    median_run: int


class Line(NamedTuple):
    """A level to compare with: a published figure, a criterion."""

    label: str
    value: float


class Point(NamedTuple):
    """One row of a comparison: what was measured, and what was published, if anything was."""

    label: str
    measured: Interval | None
    published: float | None


class Bars(NamedTuple):
    """One group of bars: a count with its interval at each place on the axis."""

    label: str
    counts: Sequence[Interval]


class Panel(NamedTuple):
    """Part of an animation: ``draw(axes)`` gives a function of the step, which brings it up to date.

    ``width`` is in inches.
    """

    draw: Callable[[Axes], Callable[[int], None]]
    width: float


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG, in this module's style, and return the path."""
    import matplotlib

    path.parent.mkdir(parents=True, exist_ok=True)
    with matplotlib.rc_context(STYLE):
        figure.savefig(path)
    return path


def new_figure(
    width: float, height: float, rows: int = 1, columns: int = 1, **settings: Any
) -> tuple[Figure, Any]:
    """Return a figure that no window shows, in inches, with a grid of axes."""
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        return figure, figure.subplots(rows, columns, **settings)


def camera(figure: Figure) -> Callable[[], np.ndarray]:
    """Return what gives a figure as a frame, uint8 ``[height, width, 3]``; it is laid out once."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure.set_dpi(72)
    canvas = FigureCanvasAgg(figure)

    def grab() -> np.ndarray:
        canvas.draw()
        figure.set_layout_engine("none")
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()

    return grab


def moving_average(values: np.ndarray, window: int) -> np.ndarray:
    """Average each value with up to ``window - 1`` before it, along the last axis.

    >>> moving_average(np.array([1.0, 3.0, 5.0]), 2)
    array([1., 2., 4.])
    """
    total = np.cumsum(values, axis=-1, dtype=float)
    before = np.concatenate([np.zeros_like(total[..., :window]), total[..., :-window]], axis=-1)
    return (total - before[..., : total.shape[-1]]) / np.minimum(np.arange(total.shape[-1]) + 1, window)


def learning_curves(
    panels: Sequence[tuple[str, Sequence[Curve], Sequence[Line]]],
    path: Path,
    *,
    title: str,
    xlabel: str = "trials",
) -> Path:
    """Draw a panel per quantity: each curve's median run, and a band that holds the middle half of the runs.

    Args:
        panels: for each the label of its vertical axis, its curves, and levels to compare with.
        path: of the PNG.
        title: above all panels.
        xlabel: of the common axis.
    """
    figure, grid = new_figure(max(4.6 * len(panels) + 0.4, 8.6), 3.9, 1, len(panels), squeeze=False)
    for ax, (ylabel, curves, lines) in zip(grid[0], panels, strict=True):
        for curve, colour in zip(curves, _colours(len(curves)), strict=True):
            _draw_curve(ax, curve, colour)
        for line in lines:
            _draw_line(ax, line)
        ax.set(xlabel=xlabel, ylabel=ylabel)
        ax.margins(x=0.01)
        ax.set_ylim(bottom=0)
    _legend_below(figure, grid[0][0])
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return save(figure, path)


def _colours(count: int) -> list[str]:
    return [COLOURS[i % len(COLOURS)] for i in range(count)]


def _draw_curve(ax: Axes, curve: Curve, colour: str) -> None:
    low, high = np.percentile(curve.values, [25, 75], axis=0)
    if len(curve.values) > 1:
        ax.fill_between(curve.trial, low, high, color=colour, alpha=0.16, linewidth=0)
    ax.plot(curve.trial, curve.values[curve.median_run], color=colour, linewidth=1.8, label=curve.label)


def _draw_line(ax: Axes, line: Line) -> None:
    ax.axhline(line.value, color=PALE, linewidth=1, linestyle=(0, (5, 3)))
    at = ax.get_yaxis_transform()
    ax.text(1.01, line.value, line.label, transform=at, ha="left", va="center", color=PALE, fontsize=8.5)


def _legend_below(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    if labels:
        room = int(figure.get_figwidth() / (0.6 + 0.085 * max(map(len, labels))))
        columns = max(min(len(labels), 4, room), 1)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)


def comparison(
    panels: Sequence[tuple[str, Sequence[Point], float | None]], path: Path, *, title: str, note: str = ""
) -> Path:
    """Draw a row per agent and a panel per quantity: a dot with its interval, a diamond if published.

    Args:
        panels: for each the label of its axis, its points from the top down, and where it ends (None: free).
        path: of the PNG.
        title: above all panels.
        note: below them.
    """
    rows = len(panels[0][1])
    width, height = 3.4 * len(panels) + 2.6, 0.34 * rows + 1.6
    figure, grid = new_figure(width, height, 1, len(panels), squeeze=False, sharey=True)
    for ax, (xlabel, points, end) in zip(grid[0], panels, strict=True):
        for y, point in enumerate(points):
            _draw_point(ax, y, point)
        ax.set(xlabel=xlabel, xlim=(0, end), ylim=(rows - 0.4, -0.6))
        ax.grid(visible=True, axis="x", color=GRID)
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0)
    grid[0][0].set_yticks(range(rows), [point.label for point in panels[0][1]])
    _comparison_legend(figure)
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    if note:
        figure.supxlabel(note, fontsize=8.5, color=PALE)
    return save(figure, path)


def _draw_point(ax: Axes, y: int, point: Point) -> None:
    if point.measured is not None:
        value, low, high = point.measured
        ax.plot([low, high], [y, y], color=COLOURS[0], linewidth=4, alpha=0.28, solid_capstyle="round")
        ax.plot([value], [y], "o", color=COLOURS[0], markersize=6)
    if point.published is not None:
        ax.plot([point.published], [y], "D", markerfacecolor="none", markeredgecolor=COLOURS[1], markersize=7)


def _comparison_legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D

    dot = Line2D(
        [], [], marker="o", color=COLOURS[0], linewidth=4, alpha=0.8, label="measured, 95 % interval"
    )
    diamond = Line2D([], [], marker="D", color="none", markerfacecolor="none", markeredgecolor=COLOURS[1])
    diamond.set_label("published")
    figure.legend(handles=[dot, diamond], loc="outside upper right", ncols=2, frameon=False, fontsize=9)


def bars(
    groups: Sequence[Bars],
    places: Sequence[str],
    path: Path,
    *,
    title: str,
    xlabel: str,
    ylabel: str,
    top: int,
) -> Path:
    """Draw counts out of ``top`` as bars with their intervals, one group of bars at each place."""
    figure, ax = new_figure(max((0.5 + 0.3 * len(groups)) * len(places) + 1.6, 6.5), 3.8)
    width = 0.8 / len(groups)
    for i, (group, colour) in enumerate(zip(groups, cycle(BAR_COLOURS), strict=False)):
        x = np.arange(len(places)) + (i - (len(groups) - 1) / 2) * width
        value, low, high = np.array(group.counts, dtype=float).T
        ax.bar(x, value, width * 0.92, color=colour, label=group.label)
        ax.errorbar(x, value, [value - low, high - value], fmt="none", ecolor=INK, elinewidth=1, capsize=2.5)
    ax.set(xlabel=xlabel, ylabel=ylabel, ylim=(0, top * 1.05))
    ax.set_xticks(range(len(places)), list(places))
    ax.set_yticks([*range(0, top, max(top // 4, 1))])
    ax.grid(visible=False, axis="x")
    _draw_line(ax, Line(f"all {top}", top))
    _legend_below(figure, ax)
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return save(figure, path)
