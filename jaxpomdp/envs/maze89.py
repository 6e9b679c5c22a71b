"""The mazes of Littman, Cassandra and Kaelbling (1995): hallway2 (89 states), hallway (57), tiger-grid.

The agent has a position and a heading; ``state = 4 * cell + heading``, headings north, east, south, west. The
goal keeps its four headings, as in the public files: "89 states" are 22 cells with a heading and one goal, 92
numbers. All noise is generated here by rule; the tests compare every entry with the files.
"""

from __future__ import annotations

import numpy as np

from jaxpomdp.envs import grid as grids
from jaxpomdp.envs.build import Outcomes, assemble, merge, tabulate
from jaxpomdp.envs.grid import Grid
from jaxpomdp.envs.world import Layout, World

ACTIONS = ("no-op", "forward", "turn right", "turn about", "turn left")
SENSES = ("ahead", "right", "behind", "left")
TURNS = {
    0: (1.0, 0.0, 0.0, 0.0),
    2: (0.1, 0.7, 0.1, 0.1),
    3: (0.1, 0.15, 0.6, 0.15),
    4: (0.1, 0.1, 0.1, 0.7),
}
"""For each action but forward, the probability of turning by 0, 1, 2, 3 quarters to the right."""

FORWARD = ((0.8, 0, 0), (0.05, 1, 1), (0.05, 3, 3), (0.025, 2, 0), (0.025, 2, 2))
"""Going forward: probability, direction moved, change of heading (relative to the heading); else nothing."""

SEES_WALL, SEES_WALL_WRONGLY = 0.9, 0.05
"""``P(bit = 1 | wall)`` and ``P(bit = 1 | open)``, independent for the four directions."""

MAZE89_MAP = """
 *****
** * **
 * * *
** * *+
 *****
"""
MAZE57_MAP = """
***********
  * * * +
"""
TIGER_GRID_MAP = """
-*+*-
** **
"""


def maze89(step_limit: int = 251) -> World:
    """Return the 89-state maze (hallway2), thesis section 3.5.3: +1 on entering the goal, any other start.

    The observation is ``8 ahead + 4 right + 2 behind + 1 left`` (a wall seems to be there); the goal is 16.

    Example:
        >>> world = maze89()
        >>> world.num_states, world.num_actions, world.num_observations
        (92, 5, 17)
    """
    return heading_maze(MAZE89_MAP, name="maze89", step_limit=step_limit)


def maze57(step_limit: int = 251) -> World:
    """Return the 57-state maze (hallway): as :func:`maze89` with four landmarks, and the goal as 20.

    A landmark, 16 to 19, shows surely when the agent faces south in the top row above one of the four rooms.

    Example:
        >>> maze57().num_states, maze57().num_observations
        (60, 21)
    """
    above_rooms = [4 * cell + grids.SOUTH for cell in (2, 4, 6, 8)]
    return heading_maze(MAZE57_MAP, name="maze57", landmarks=above_rooms, step_limit=step_limit)


def tiger_grid(step_limit: int = 251) -> World:
    """Return tiger-grid: two starts that look alike, the goal between two cells that cost 1 at every arrival.

    Example:
        >>> tiger_grid().num_states, tiger_grid().num_observations
        (36, 17)
    """
    return heading_maze(TIGER_GRID_MAP, name="tiger-grid", starts=[24, 28], step_limit=step_limit)


def heading_maze(
    ascii_map: str,
    *,
    name: str = "maze",
    starts: list[int] | None = None,
    landmarks: list[int] | None = None,
    discount: float = 0.95,
    step_limit: int = 251,
) -> World:
    """Return a maze with position and heading from any map, with the noise of the three mazes above.

    Args:
        ascii_map: in the characters of :mod:`jaxpomdp.envs.grid`.
        name: of the world.
        starts: states drawn uniformly at a reset; by default every state that is not a goal.
        landmarks: states that show an observation of their own surely, numbered from 16 on.
        discount: gamma.
        step_limit: actions in a trial at most.

    Raises:
        ValueError: the map is bad, or a start is a goal.
    """
    grid = grids.parse(ascii_map)
    landmarks = landmarks or []
    terminal = np.repeat(np.isin(np.arange(len(grid.cells)), grid.goals), 4)
    starts = [s for s in range(terminal.size) if not terminal[s]] if starts is None else starts
    if any(terminal[s] for s in starts):
        raise ValueError(f"starts must not be goals, got {[s for s in starts if terminal[s]]}")
    marks = tuple(f"landmark {i + 1}" for i in range(len(landmarks)))
    return assemble(
        tabulate([[outcomes(grid, s, action) for s in range(terminal.size)] for action in range(5)]),
        observation_table(grid, landmarks)[None],
        np.isin(np.arange(terminal.size), starts) / len(starts),
        terminal,
        name=name,
        discount=discount,
        step_limit=step_limit,
        success_above=0.5,
        action_names=ACTIONS,
        observation_names=(*grids.wall_names(SENSES), *marks, "goal"),
        senses=SENSES,
        layout=_layout(grid),
    )


def _layout(grid: Grid) -> Layout:
    return Layout(grid.rows, tuple(c for c in grid.cells for _ in range(4)), (0, 1, 2, 3) * len(grid.cells))


def outcomes(grid: Grid, state: int, action: int) -> Outcomes:
    """Return what an action brings: +1 on entering the goal, -1 in a costly cell; a goal is for ever."""
    cell, heading = divmod(state, 4)
    if cell in grid.goals:
        return {(state, 0.0): 1.0}
    moved = _turned(cell, heading, action) if action in TURNS else _forward(grid, cell, heading)
    return merge([(prob, {(state, _reward(grid, state // 4)): 1.0}) for prob, state in moved])


def _turned(cell: int, heading: int, action: int) -> list[tuple[float, int]]:
    return [(prob, 4 * cell + (heading + change) % 4) for change, prob in enumerate(TURNS[action])]


def _forward(grid: Grid, cell: int, heading: int) -> list[tuple[float, int]]:
    here = 4 * cell + heading
    moved = [(1 - sum(prob for prob, _, _ in FORWARD), here)]
    for prob, direction, change in FORWARD:
        there = grid.neighbour(cell, (heading + direction) % 4)
        moved.append((prob, here if there is None else 4 * there + (heading + change) % 4))
    return moved


def _reward(grid: Grid, cell: int) -> float:
    return 1.0 if cell in grid.goals else -1.0 if cell in grid.costly else 0.0


def observation_table(grid: Grid, landmarks: list[int]) -> np.ndarray:
    """Return ``P(o | s)``, float64 ``[N, 16 + landmarks + 1]``: noisy walls, sure landmarks, sure goal."""
    num_states = 4 * len(grid.cells)
    table = np.zeros((num_states, 17 + len(landmarks)))
    for state in range(num_states):
        cell, heading = divmod(state, 4)
        if cell in grid.goals:
            table[state, -1] = 1
        elif state in landmarks:
            table[state, 16 + landmarks.index(state)] = 1
        else:
            walls = [grid.wall(cell, (heading + side) % 4) for side in range(4)]
            table[state, :16] = _noisy_bits(walls)
    return table


def _noisy_bits(walls: list[bool]) -> np.ndarray:
    prob = np.ones(1)
    for wall in walls:
        one = SEES_WALL if wall else SEES_WALL_WRONGLY
        prob = np.kron(prob, [1 - one, one])
    return prob
