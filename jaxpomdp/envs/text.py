"""Worlds in a terminal: maps in ANSI colours, observations in words."""

from __future__ import annotations

import numpy as np

from jaxpomdp.envs.picture import heat_map, layout_of
from jaxpomdp.envs.world import World

_SHOWN = dict.fromkeys("*.S", "·") | dict.fromkeys("+G", "G") | dict.fromkeys(" #", "█") | {"-": "-"}
_AGENT = {-1: "@", 0: "^", 1: ">", 2: "v", 3: "<"}
_COLOUR = {"G": "32", "-": "31", "█": "90"} | dict.fromkeys(_AGENT.values(), "1;34")
_SHADES = (None, 230, 222, 220, 214, 208)
"""Backgrounds of the 256-colour palette, from no belief to the most."""


def ansi(
    world: World,
    state: int | None = None,
    *,
    observation: int | None = None,
    heat: np.ndarray | None = None,
    colour: bool = True,
) -> str:
    """Write the map: ``█`` wall, ``·`` free, ``G`` goal, ``-`` costly, the agent ``^ > v <`` or ``@``.

    Args:
        world: with or without a map.
        state: where the agent is, if it is shown.
        observation: described in a last line, if given.
        heat: weights of the states ``[N]``, shown as a background relative to the greatest (in colour only).
        colour: with ANSI escape sequences.

    Example:
        >>> from jaxpomdp.envs.registry import make
        >>> print(ansi(make("tmaze-3"), 2, observation=2, colour=False))
        ███G
        ·@··
        ███G
        corridor
    """
    layout = layout_of(world)
    marks = [[_SHOWN[mark] for mark in row] for row in layout.rows]
    if state is not None:
        row, column = layout.cells[state]
        marks[row][column] = _AGENT[layout.headings[state]]
    if colour:
        shades = _shades(world, heat, (len(marks), len(marks[0])))
        marks = [
            [_painted(*pair) for pair in zip(*rows, strict=True)] for rows in zip(marks, shades, strict=True)
        ]
    lines = ["".join(row) for row in marks]
    if observation is not None:
        lines.append(describe_observation(world, observation))
    return "\n".join(lines)


def _shades(world: World, heat: np.ndarray | None, shape: tuple[int, int]) -> np.ndarray:
    if heat is None:
        return np.zeros(shape, int)
    cells = heat_map(world, heat)
    return np.ceil(cells / max(float(cells.max()), 1e-12) * (len(_SHADES) - 1) - 1e-3).astype(int)


def _painted(mark: str, shade: int) -> str:
    codes = [code for code in (_COLOUR.get(mark), _background(shade)) if code]
    return f"\x1b[{';'.join(codes)}m{mark}\x1b[0m" if codes else mark


def _background(shade: int) -> str | None:
    return None if _SHADES[shade] is None else f"48;5;{_SHADES[shade]}"


def describe_observation(world: World, observation: int) -> str:
    """Say in words what the agent sees.

    Raises:
        ValueError: the world has no such observation.

    Example:
        >>> from jaxpomdp.envs.registry import make
        >>> describe_observation(make("maze89"), 9)
        'wall ahead, open right, open behind, wall left'
        >>> describe_observation(make("tmaze-5"), 1)
        'signal down'
    """
    if not 0 <= observation < world.num_observations:
        raise ValueError(f"observation must be in 0..{world.num_observations - 1}, got {observation}")
    count = len(world.senses)
    if not count or observation >= 1 << count:
        return world.observation_names[observation]
    bits = [observation >> (count - 1 - side) & 1 for side in range(count)]
    return ", ".join(
        f"{'wall' if bit else 'open'} {sense}" for bit, sense in zip(bits, world.senses, strict=True)
    )
