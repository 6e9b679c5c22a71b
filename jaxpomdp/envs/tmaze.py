"""The T-maze of Bakker (2002), thesis section 3.5.2: one early signal decides a late choice."""

from __future__ import annotations

import numpy as np

from jaxpomdp.envs import grid as grids
from jaxpomdp.envs.build import Outcomes, assemble, tabulate
from jaxpomdp.envs.world import Layout, World

UP, DOWN, CORRIDOR, JUNCTION, UPPER_END, LOWER_END = range(6)
OBSERVATIONS = ("signal up", "signal down", "corridor", "junction", "upper end", "lower end")
ACTIONS = ("north", "east", "south", "west")


def tmaze(
    length: int = 10,
    *,
    right: float = 4.0,
    wrong: float = -0.1,
    bump: float = -0.1,
    discount: float = 0.98,
    step_limit: int | None = None,
) -> World:
    """Return the T-maze with a corridor of ``length`` moves from the start to the junction (Figure 3.6).

    The signal, up or down with even odds, shows at the start only (also on coming back to it); every corridor
    cell looks the same; at the junction north leads to the upper end and south to the lower one, and the
    trial is over. The best path takes ``length + 1`` actions. State ``2 * position + signal``, then two ends.

    Args:
        length: ``N``, at least 1.
        right: reward of the arm that the signal named.
        wrong: reward of the other arm.
        bump: reward of a move against a wall; any other move pays 0.
        discount: gamma.
        step_limit: actions in a trial; by default ``20 (length + 5)``, within which a random walk reaches an
            end in 72 % of trials for length 10, 37 % for 20, 6 % for 50 (longer corridors want exploration
            that repeats its moves).

    Raises:
        ValueError: ``length`` is below 1.

    Example:
        >>> tmaze(5).num_states, tmaze(5).num_observations
        (14, 6)
    """
    if length < 1:
        raise ValueError(f"length must be at least 1, got {length}")
    num_states = 2 * (length + 1) + 2
    pay = (right, wrong, bump)
    rows = [[_outcomes(length, pay, state, action) for state in range(num_states)] for action in range(4)]
    start = np.zeros(num_states)
    start[:2] = 0.5
    return assemble(
        tabulate(rows),
        _observation_table(length)[None],
        start,
        np.arange(num_states) >= num_states - 2,
        name=f"tmaze-{length}",
        discount=discount,
        step_limit=20 * (length + 5) if step_limit is None else step_limit,
        success_above=(right + wrong) / 2,
        action_names=ACTIONS,
        observation_names=OBSERVATIONS,
        layout=_layout(length),
    )


def _outcomes(length: int, pay: tuple[float, float, float], state: int, action: int) -> Outcomes:
    position, signal = divmod(state, 2)
    right, wrong, bump = pay
    if position > length:
        return {(state, 0.0): 1.0}
    if position == length and action in (grids.NORTH, grids.SOUTH):
        arm = 0 if action == grids.NORTH else 1
        return {(2 * (length + 1) + arm, right if arm == signal else wrong): 1.0}
    there = position + {grids.EAST: 1, grids.WEST: -1}.get(action, 0)
    if there == position or not 0 <= there <= length:
        return {(state, bump): 1.0}
    return {(2 * there + signal, 0.0): 1.0}


def _observation_table(length: int) -> np.ndarray:
    shown = [UP, DOWN] + [CORRIDOR] * (2 * length - 2) + [JUNCTION] * 2 + [UPPER_END, LOWER_END]
    return np.eye(len(OBSERVATIONS))[shown]


def _layout(length: int) -> Layout:
    rows = (" " * length + "+", "S" + "*" * length, " " * length + "+")
    path = [(1, position) for position in range(length + 1) for _ in range(2)]
    cells = (*path, (0, length), (2, length))
    return Layout(rows, cells, (-1,) * len(cells))
