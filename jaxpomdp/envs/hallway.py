"""McCallum's hallway navigation (1995), thesis section 3.5.1: absolute moves, four wall sensors."""

from __future__ import annotations

import numpy as np

from jaxpomdp.envs import grid as grids
from jaxpomdp.envs.build import Outcomes, assemble, tabulate
from jaxpomdp.envs.grid import Grid
from jaxpomdp.envs.world import Layout, World

ACTIONS = ("north", "east", "south", "west")
SENSES = ("north", "east", "south", "west")
GOAL_OBSERVATION = 16

NAVIGATION_MAP = """
S*****S
*  *  *
*  +  *
*  *  *
S*****S
"""
"""A RECONSTRUCTION of Figure 3.3: the map of 1995 is in no public text that was found. It keeps what is
known: starts in four corners, the goal in the centre, many cells that look alike. The best path is 5 steps
from each corner; an average of exactly 7 means that two corners take the long way."""


def hallway_navigation(step_limit: int = 251) -> World:
    """Return hallway navigation on the reconstructed map (see ``NAVIGATION_MAP``).

    Example:
        >>> world = hallway_navigation()
        >>> world.num_states, world.num_actions, world.num_observations
        (23, 4, 17)
    """
    return hallway(NAVIGATION_MAP, step_limit=step_limit)


def hallway(
    ascii_map: str,
    *,
    name: str = "hallway",
    goal: float = 5.0,
    bump: float = -1.0,
    move: float = -0.1,
    discount: float = 0.9,
    step_limit: int = 251,
) -> World:
    """Return a hallway from any map in the characters of :mod:`jaxpomdp.envs.grid`; a state is a cell.

    The observation is ``8 north + 4 east + 2 south + 1 west`` (a wall lies there), and 16 at the goal, where
    the trial is over. Trials start in a cell marked ``S``, or, without any, in any cell that is not a goal.

    Args:
        ascii_map: rows of characters.
        name: of the world.
        goal: reward of entering the goal.
        bump: reward of running into a wall.
        move: reward of any other move.
        discount: gamma.
        step_limit: actions in a trial at most.

    Raises:
        ValueError: the map has an unknown character, no goal, or nowhere to start.
    """
    grid = grids.parse(ascii_map)
    num_states = len(grid.cells)
    terminal = np.isin(np.arange(num_states), grid.goals)
    start = _start(grid, terminal)
    pay = (goal, bump, move)
    return assemble(
        tabulate([[_outcomes(grid, pay, cell, action) for cell in range(num_states)] for action in range(4)]),
        np.eye(17)[[_shown(grid, cell) for cell in range(num_states)]][None],
        start,
        terminal,
        name=name,
        discount=discount,
        step_limit=step_limit,
        success_above=(goal + max(bump, move)) / 2,
        action_names=ACTIONS,
        observation_names=(*grids.wall_names(SENSES), "goal"),
        senses=SENSES,
        layout=Layout(grid.rows, grid.cells, (-1,) * num_states),
    )


def _start(grid: Grid, terminal: np.ndarray) -> np.ndarray:
    starts = grid.starts or [int(cell) for cell in np.flatnonzero(~terminal)]
    if not starts:
        raise ValueError(f"ascii_map must have a cell that is not a goal to start in, got {grid.rows}")
    start = np.zeros(terminal.size)
    start[starts] = 1 / len(starts)
    return start


def _outcomes(grid: Grid, pay: tuple[float, float, float], cell: int, action: int) -> Outcomes:
    goal, bump, move = pay
    if cell in grid.goals:
        return {(cell, 0.0): 1.0}
    there = grid.neighbour(cell, action)
    if there is None:
        return {(cell, bump): 1.0}
    return {(there, goal if there in grid.goals else move): 1.0}


def _shown(grid: Grid, cell: int) -> int:
    if cell in grid.goals:
        return GOAL_OBSERVATION
    return grids.bits([grid.wall(cell, direction) for direction in range(4)])
