"""Pictures of worlds with matplotlib, which is loaded when a picture is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from jaxpomdp.envs.grid import MOVES
from jaxpomdp.envs.picture import AGENT, HEAT, SENSED, coloured_cells, heat_map, layout_of, sensed_walls
from jaxpomdp.envs.world import World

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw(
    world: World,
    ax: Axes | None = None,
    *,
    state: int | None = None,
    observation: int | None = None,
    heat: np.ndarray | None = None,
    numbers: bool = False,
    title: str | None = None,
) -> Axes:
    """Draw the map, the agent, the walls it senses and a heat map of a belief.

    Args:
        world: with or without a map.
        ax: drawn into, and cleared first; by default one of a new figure that no window shows.
        state: where the agent is, if it is shown.
        observation: what it sees, if that is shown; needs ``state``.
        heat: weights of the world's states ``[N]``, or of the cells of the map ``[rows, columns]``.
        numbers: write the share of the heat into each cell.
        title: above the map.

    Returns:
        The axes; save with ``ax.figure.savefig``.

    Raises:
        ValueError: ``heat`` has another shape.
    """
    ax = _new_axes(world) if ax is None else ax
    ax.clear()
    ax.set_axis_off()
    layout = layout_of(world)
    ax.imshow(coloured_cells(layout) / 255, interpolation="nearest")
    if heat is not None:
        _draw_heat(ax, _cells(world, heat), numbers)
    for row, marks in enumerate(layout.rows):
        for column, mark in enumerate(marks):
            if mark in "+G":
                ax.text(column, row, "G", ha="center", va="center", fontweight="bold")
    if state is not None:
        _draw_agent(ax, world, state, observation)
    if title is not None:
        ax.set_title(title)
    return ax


def _new_axes(world: World) -> Axes:
    from matplotlib.figure import Figure

    rows = layout_of(world).rows
    scale = min(0.6, 12 / max(len(rows), len(rows[0])))
    figure = Figure(figsize=(scale * len(rows[0]) + 0.4, scale * len(rows) + 0.6), layout="constrained")
    return figure.add_subplot()


def _cells(world: World, heat: np.ndarray) -> np.ndarray:
    rows = layout_of(world).rows
    heat = np.asarray(heat, np.float64)
    if heat.shape == (len(rows), len(rows[0])):
        return heat
    if heat.shape != (world.num_states,):
        shapes = f"({world.num_states},) or ({len(rows)}, {len(rows[0])})"
        raise ValueError(f"heat must have shape {shapes}, got {heat.shape}")
    return heat_map(world, heat)


def _draw_heat(ax: Axes, cells: np.ndarray, numbers: bool) -> None:
    share = cells / max(float(cells.max()), 1e-12)
    colour = np.broadcast_to(np.array(HEAT) / 255, (*cells.shape, 3))
    ax.imshow(np.concatenate([colour, share[..., None]], axis=-1), interpolation="nearest")
    if not numbers:
        return
    for row, column in np.argwhere(cells >= 0.005):
        ax.text(column, row + 0.35, f"{cells[row, column]:.2f}", ha="center", va="center", fontsize="x-small")


def _draw_agent(ax: Axes, world: World, state: int, observation: int | None) -> None:
    layout = layout_of(world)
    (row, column), heading = layout.cells[state], layout.headings[state]
    # A marker (3, 0, angle) is a triangle; angles turn against the clock from north.
    marker = "o" if heading < 0 else (3, 0, -90 * heading)
    ax.plot([column], [row], marker=marker, markersize=14, color=np.array(AGENT) / 255)
    for direction in () if observation is None else sensed_walls(world, state, observation):
        down, right = MOVES[direction]
        middle, along = np.array([column + 0.44 * right, row + 0.44 * down]), 0.44 * np.array([down, right])
        ends = np.stack([middle - along, middle + along])
        ax.plot(ends[:, 0], ends[:, 1], color=np.array(SENSED) / 255, linewidth=3, solid_capstyle="butt")


def save_gif(
    path: str | PathLike[str], frames: Sequence[np.ndarray], *, frames_per_second: float = 8
) -> None:
    """Write frames as an animation that repeats (with Pillow).

    Args:
        path: of the file.
        frames: uint8 ``[height, width, 3]`` each, of one size; see :func:`jaxpomdp.envs.picture.frame`.
        frames_per_second: at most 50, which is what viewers show.

    Raises:
        ValueError: there is no frame, their sizes differ, or the rate is outside (0, 50].
    """
    from PIL import Image

    sizes = {np.shape(frame) for frame in frames}
    if len(sizes) != 1:
        raise ValueError(f"frames must be at least one and of one size, got sizes {sorted(sizes)}")
    if not 0 < frames_per_second <= 50:
        raise ValueError(f"frames_per_second must be in (0, 50], got {frames_per_second}")
    first, *rest = [Image.fromarray(np.asarray(frame, np.uint8)) for frame in frames]
    first.save(
        path, format="GIF", save_all=True, append_images=rest, duration=1000 / frames_per_second, loop=0
    )
