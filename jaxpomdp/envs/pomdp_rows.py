"""Conditional probabilities being written down, later lines over earlier ones; then sparse and checked."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxpomdp.envs.pomdp_lexer import Note, PomdpError, Words

if TYPE_CHECKING:
    from scipy.sparse import csr_array

EXACT = 1e-12
"""A row off by no more than this is kept to the last bit, so that a written file reads back unchanged."""

TOLERANCE = 1e-4
"""A row off by no more than this was rounded by its author and is scaled to sum to one."""


class Row(NamedTuple):
    """The positive part of one distribution: where (ascending) and how much; shared, so never changed."""

    columns: np.ndarray
    values: np.ndarray


def row_of(values: np.ndarray) -> Row:
    """Return the positive part of a dense distribution."""
    columns = np.flatnonzero(values)
    return Row(columns, np.asarray(values)[columns])


def _row_of_entries(entries: dict[int, float]) -> Row:
    kept = sorted((column, value) for column, value in entries.items() if value > 0)
    return Row(np.array([c for c, _ in kept], np.int64), np.array([v for _, v in kept], np.float64))


EMPTY = row_of(np.zeros(0))


class ProbabilityRows:
    """``P(column | action, state)`` row by row, each with the word that last wrote to it (-1: none did)."""

    def __init__(self, num_actions: int, num_states: int, width: int) -> None:
        self._rows: list[list[Row | dict[int, float]]] = [[EMPTY] * num_states for _ in range(num_actions)]
        self.written = np.full((num_actions, num_states), -1, np.int64)
        self.width = width

    def put_row(self, actions: Iterable[int], states: Iterable[int], row: Row, word: int) -> None:
        """Write whole rows."""
        states = list(states)
        for action in actions:
            for state in states:
                self._rows[action][state] = row
                self.written[action, state] = word

    def put_entry(
        self, actions: Iterable[int], states: Iterable[int], columns: Iterable[int], value: float, word: int
    ) -> None:
        """Write single entries; the rest of their rows stays."""
        states, columns = list(states), list(columns)
        for action in actions:
            rows, written = self._rows[action], self.written[action]
            for state in states:
                row = rows[state]
                if isinstance(row, Row):
                    row = rows[state] = dict(zip(row.columns.tolist(), row.values.tolist(), strict=True))
                for column in columns:
                    row[column] = value
                written[state] = word

    def matrix(self, action: int) -> csr_array:
        """Return one action's rows as a sparse float64 ``[N, width]``."""
        from scipy.sparse import csr_array

        rows = [row if isinstance(row, Row) else _row_of_entries(row) for row in self._rows[action]]
        pointers = np.cumsum([0] + [len(row.columns) for row in rows])
        values = np.concatenate([row.values for row in rows])
        columns = np.concatenate([row.columns for row in rows])
        return csr_array((values, columns.astype(np.int64), pointers), shape=(len(rows), self.width))


def settle(
    rows: ProbabilityRows, words: Words, *, what: str, names: tuple[tuple[str, ...], ...], mend: bool
) -> tuple[tuple[csr_array, ...], list[Note]]:
    """Check that rows sum to one, scale those that nearly do, and share what actions have in common.

    Args:
        rows: the table.
        words: the text, for the place of an error.
        what: the table's letter, for messages.
        names: of the actions and of the states.
        mend: scale rows that are far off as well; an empty row becomes uniform. Each with a note.

    Raises:
        PomdpError: a row is off by more than ``TOLERANCE`` and ``mend`` is false.
    """
    matrices: list[csr_array] = []
    notes: list[Note] = []
    for action, name in enumerate(names[0]):
        matrix = rows.matrix(action)
        total = np.asarray(matrix.sum(axis=1)).ravel()
        for state in np.flatnonzero(np.abs(total - 1) > TOLERANCE):
            last = int(rows.written[action, state])
            place = words.place(last if last >= 0 else len(words))
            row = f"the probabilities of {what} : {name} : {names[1][state]}"
            reason = f"{row} sum to {total[state]:.6g}, expected 1" if last >= 0 else f"{row} are never given"
            if not mend:
                raise PomdpError(*place, reason)
            notes.append(Note(*place, f"{reason}; {'scaled' if total[state] > 0 else 'made uniform'}"))
        notes += _rounding_notes(np.abs(total - 1), rows.written[action], words, f"{what}: {name}")
        matrices.append(_shared(scaled(matrix), matrices))
    return tuple(matrices), notes


def _rounding_notes(off: np.ndarray, written: np.ndarray, words: Words, table: str) -> list[Note]:
    rounded = (off > EXACT) & (off <= TOLERANCE)
    if not rounded.any():
        return []
    worst = int(np.argmax(np.where(rounded, off, 0)))
    message = f"{rounded.sum()} rows of {table} were off by at most {off[worst]:.2g}; scaled to sum to one"
    return [Note(*words.place(int(written[worst])), message)]


def scaled(matrix: csr_array) -> csr_array:
    """Scale the rows that are off by more than ``EXACT`` to sum to one; an empty row becomes uniform."""
    from scipy.sparse import csr_array

    total = np.asarray(matrix.sum(axis=1)).ravel()
    if np.any(total <= 0):
        dense = matrix.toarray()
        dense[total <= 0] = 1 / dense.shape[1]
        matrix, total = csr_array(dense), np.where(total <= 0, 1.0, total)
    factor = np.where(np.abs(total - 1) > EXACT, total, 1.0)
    data = matrix.data / np.repeat(factor, np.diff(matrix.indptr))
    return csr_array((data, matrix.indices, matrix.indptr), shape=matrix.shape)


def _shared(matrix: csr_array, earlier: list[csr_array]) -> csr_array:
    """Return the first action's matrix instead of an equal copy."""
    if not earlier:
        return matrix
    first = earlier[0]
    pairs = ((first.indptr, matrix.indptr), (first.indices, matrix.indices), (first.data, matrix.data))
    return first if all(np.array_equal(x, y) for x, y in pairs) else matrix
