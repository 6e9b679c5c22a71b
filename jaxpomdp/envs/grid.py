"""Maps in ASCII: ``*`` or ``.`` free, ``+`` or ``G`` goal, ``S`` a start, ``-`` costly, blank or ``#`` wall.

Cells are numbered row by row; directions are 0 north, 1 east, 2 south, 3 west.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

NORTH, EAST, SOUTH, WEST = range(4)
MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""Row and column steps of the four directions."""

_FREE, _GOAL, _START, _COSTLY, _WALL = "*.", "+G", "S", "-", " #"


@dataclass(frozen=True)
class Grid:
    """A parsed map.

    Attributes:
        rows: the map, every row padded to one width.
        cells: ``(row, column)`` of every cell that is not a wall, row by row.
    """

    rows: tuple[str, ...]
    cells: tuple[tuple[int, int], ...]

    def neighbour(self, cell: int, direction: int) -> int | None:
        """Return the cell that lies next in a direction, or None where a wall is."""
        row, column = self.cells[cell]
        return self._number.get((row + MOVES[direction][0], column + MOVES[direction][1]))

    @cached_property
    def _number(self) -> dict[tuple[int, int], int]:
        return {place: cell for cell, place in enumerate(self.cells)}

    def wall(self, cell: int, direction: int) -> bool:
        """Say whether a wall lies next to a cell in a direction."""
        return self.neighbour(cell, direction) is None

    def marked(self, marks: str) -> list[int]:
        """Return the cells whose character is one of ``marks``."""
        return [i for i, (row, column) in enumerate(self.cells) if self.rows[row][column] in marks]

    @property
    def goals(self) -> list[int]:
        """The goal cells."""
        return self.marked(_GOAL)

    @property
    def starts(self) -> list[int]:
        """The cells marked as starts."""
        return self.marked(_START)

    @property
    def costly(self) -> list[int]:
        """The cells that cost the agent something to arrive in."""
        return self.marked(_COSTLY)


def parse(ascii_map: str) -> Grid:
    """Read a map.

    Raises:
        ValueError: an unknown character (row and column named), no cell at all, or no goal.

    Example:
        >>> parse("S*+").cells
        ((0, 0), (0, 1), (0, 2))
    """
    lines = ascii_map.strip("\n").split("\n")
    width = max(len(line) for line in lines)
    rows = tuple(line.ljust(width) for line in lines)
    known = _FREE + _GOAL + _START + _COSTLY + _WALL
    for r, row in enumerate(rows):
        for c, mark in enumerate(row):
            if mark not in known:
                raise ValueError(f"ascii_map must be made of {known!r}, got {mark!r} in row {r}, column {c}")
    cells = tuple((r, c) for r, row in enumerate(rows) for c, mark in enumerate(row) if mark not in _WALL)
    grid = Grid(rows, cells)
    if not grid.goals:
        raise ValueError(f"ascii_map must have a goal, one of {_GOAL!r}, got none in {rows}")
    return grid


def bits(flags: list[bool]) -> int:
    """Read flags as a binary number, the first the highest: walls (north, east, south, west) to 0..15."""
    return sum(1 << (len(flags) - 1 - i) for i, flag in enumerate(flags) if flag)


def wall_names(senses: tuple[str, ...]) -> tuple[str, ...]:
    """Name every pattern of walls, e.g. ``walls: north, south``; none is ``open``."""
    names = []
    for pattern in range(1 << len(senses)):
        present = [sense for i, sense in enumerate(senses) if pattern >> (len(senses) - 1 - i) & 1]
        names.append("walls: " + ", ".join(present) if present else "open")
    return tuple(names)
