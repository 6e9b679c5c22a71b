"""Where things lie on a picture, and the picture itself as an array of pixels (NumPy only)."""

from __future__ import annotations

import math

import numpy as np

from jaxpomdp.envs import grid as grids
from jaxpomdp.envs.world import Layout, World

WALL, FREE, START, GOAL, COSTLY = (
    (52, 58, 64),
    (248, 249, 250),
    (208, 235, 255),
    (105, 219, 124),
    (255, 168, 168),
)
AGENT, SENSED, HEAT = (25, 113, 194), (224, 49, 49), (255, 146, 43)
"""Colours, red, green and blue from 0 to 255."""

TILES = dict.fromkeys("*.", FREE) | dict.fromkeys("+G", GOAL) | {"S": START, "-": COSTLY}
"""The colour of each character of a map; any other is a wall."""


def layout_of(world: World) -> Layout:
    """Return the layout of a world; states of a world without a map are laid out row by row in a square."""
    if world.layout is not None:
        return world.layout
    width = math.ceil(math.sqrt(world.num_states))
    cells = tuple(divmod(state, width) for state in range(world.num_states))
    terminal = np.asarray(world.terminal)
    marks = "".join("+" if terminal[state] else "*" for state in range(world.num_states))
    rows = tuple(marks[at : at + width].ljust(width) for at in range(0, world.num_states, width))
    return Layout(rows, cells, (-1,) * world.num_states)


def heat_map(world: World, weights: np.ndarray) -> np.ndarray:
    """Sum weights of the states, ``[N]`` (a belief, say), over the cells of the map, ``[rows, columns]``.

    Raises:
        ValueError: ``weights`` has another shape than ``[N]``.

    Example:
        >>> from jaxpomdp.envs.registry import make
        >>> world = make("tmaze-2")
        >>> heat_map(world, np.asarray(world.start_prob))[1].tolist()
        [1.0, 0.0, 0.0]
    """
    weights = np.asarray(weights, np.float64)
    if weights.shape != (world.num_states,):
        raise ValueError(f"weights must have shape ({world.num_states},), got {weights.shape}")
    layout = layout_of(world)
    heat = np.zeros((len(layout.rows), len(layout.rows[0])))
    rows, columns = zip(*layout.cells, strict=True)
    np.add.at(heat, (np.array(rows), np.array(columns)), weights)
    return heat


def sensed_walls(world: World, state: int, observation: int) -> tuple[int, ...]:
    """Return the directions (0 north to 3 west) of sensed walls, if the observation is made of wall bits."""
    count = len(world.senses)
    if observation >= 1 << count:
        return ()
    heading = max(layout_of(world).headings[state], 0)
    sensed = [side for side in range(count) if observation >> (count - 1 - side) & 1]
    return tuple((heading + side) % 4 for side in sensed)


def frame(
    world: World,
    state: int | None = None,
    *,
    observation: int | None = None,
    heat: np.ndarray | None = None,
    cell_pixels: int = 32,
) -> np.ndarray:
    """Paint the map with the agent and what it sees.

    The agent is a triangle pointing where it faces, or a disc; walls that it senses are red bars around it.
    Worlds whose observations are not made of wall bits show them as lit squares in a strip below the map.

    Args:
        world: with or without a map.
        state: where the agent is, if it is shown.
        observation: what it sees, if that is shown; needs ``state``.
        heat: weights of the states ``[N]``, shown as orange, relative to the greatest cell.
        cell_pixels: edge of a cell, at least 8.

    Returns:
        uint8 ``[height, width, 3]``, the same size for every frame of one world.

    Raises:
        ValueError: ``cell_pixels`` is below 8 or ``heat`` has the wrong shape.
    """
    if cell_pixels < 8:
        raise ValueError(f"cell_pixels must be at least 8, got {cell_pixels}")
    layout = layout_of(world)
    tiles = coloured_cells(layout)
    if heat is not None:
        tiles = _heated(tiles, heat_map(world, heat))
    tiles = np.pad(tiles, [(1, 1), (1, 1), (0, 0)])
    tiles[[0, -1]], tiles[:, [0, -1]] = WALL, WALL
    image = _with_lines(
        np.repeat(np.repeat(tiles, cell_pixels, 0), cell_pixels, 1).astype(np.uint8), cell_pixels
    )
    if state is not None:
        row, column = layout.cells[state]
        walls = () if observation is None else sensed_walls(world, state, observation)
        top, left = (row + 1) * cell_pixels, (column + 1) * cell_pixels
        _paint_agent(image[top : top + cell_pixels, left : left + cell_pixels], layout.headings[state], walls)
    return image if world.senses else np.concatenate([image, _strip(world, observation, image.shape[1])])


def coloured_cells(layout: Layout) -> np.ndarray:
    """Return the colour of every cell of a map, float64 ``[rows, columns, 3]``."""
    return np.array([[TILES.get(mark, WALL) for mark in row] for row in layout.rows], np.float64)


def _heated(tiles: np.ndarray, heat: np.ndarray) -> np.ndarray:
    share = (heat / max(float(heat.max()), 1e-12))[..., None]
    return (1 - share) * tiles + share * np.array(HEAT)


def _with_lines(image: np.ndarray, cell_pixels: int) -> np.ndarray:
    image[::cell_pixels] = image[::cell_pixels] // 8 * 7
    image[:, ::cell_pixels] = image[:, ::cell_pixels] // 8 * 7
    return image


def _paint_agent(cell: np.ndarray, heading: int, walls: tuple[int, ...]) -> None:
    """Paint into one cell, in place: a bar at each sensed wall and the agent itself."""
    middle = (np.arange(cell.shape[0]) + 0.5) / cell.shape[0] - 0.5
    down, right = middle[:, None], middle[None, :]
    for direction in walls:
        rows, columns = grids.MOVES[direction]
        cell[rows * down + columns * right > 0.38] = SENSED
    if heading < 0:
        cell[down**2 + right**2 < 0.09] = AGENT
        return
    rows, columns = grids.MOVES[heading]
    ahead, aside = rows * down + columns * right, columns * down - rows * right
    cell[(ahead > -0.28) & (np.abs(aside) < 0.5 * (0.3 - ahead))] = AGENT


def _strip(world: World, observation: int | None, width: int) -> np.ndarray:
    """Paint one square an observation, the one that is seen lit."""
    strip = np.full((16, width, 3), WALL, np.uint8)
    edges = np.linspace(0, width, world.num_observations + 1).astype(int)
    for symbol in range(world.num_observations):
        lit = SENSED if symbol == observation else tuple(part // 2 for part in FREE)
        strip[3:-3, edges[symbol] + 1 : max(edges[symbol + 1] - 1, edges[symbol] + 2)] = lit
    return strip
