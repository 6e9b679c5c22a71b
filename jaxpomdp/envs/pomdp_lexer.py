"""Words of a .POMDP file, each with its line and column, and a cursor that reads them."""

from __future__ import annotations

import bisect
import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

ANY = -1
"""Stands for every action, state or observation."""

_WORD = re.compile(r":|[^\s:]+")


class PomdpError(ValueError):
    """A model file that cannot be read: where, and why.

    Attributes:
        line, column: where it was seen, counted from 1.
        message: the reason.

    Example:
        >>> print(PomdpError(3, 7, "no state is called 'cellar'"))
        line 3, column 7: no state is called 'cellar'
    """

    def __init__(self, line: int, column: int, message: str) -> None:
        super().__init__(f"line {line}, column {column}: {message}")
        self.line, self.column, self.message = line, column, message


class Note(NamedTuple):
    """Something mended or assumed while reading, seen at ``line`` and ``column``."""

    line: int
    column: int
    message: str


class Words:
    """The words of a text; ``#`` starts a comment, ``:`` is a word by itself, line ends mean nothing.

    Only the number of each line's first word is kept; a column is found when it is asked for.
    """

    def __init__(self, text: str) -> None:
        self._lines = [line.split("#", 1)[0] for line in text.split("\n")]
        self._first: list[int] = []
        self.words: list[str] = []
        for line in self._lines:
            self._first.append(len(self.words))
            self.words += line.replace(":", " : ").split()

    def __len__(self) -> int:
        return len(self.words)

    def __getitem__(self, index: int) -> str:
        """Return the word, or the empty text after the end."""
        return self.words[index] if index < len(self.words) else ""

    def line(self, index: int) -> int:
        """Return the line of a word, counted from 1; the last line after the end."""
        return bisect.bisect_right(self._first, min(index, len(self.words) - 1)) if self.words else 1

    def place(self, index: int) -> tuple[int, int]:
        """Return a word's line and column, counted from 1; after the end, just behind the last word."""
        line = self.line(index)
        words = list(_WORD.finditer(self._lines[line - 1]))
        if index < len(self.words):
            return line, words[index - self._first[line - 1]].start() + 1
        return line, words[-1].end() + 1 if words else 1

    def error(self, index: int, message: str) -> PomdpError:
        """Return the error to raise about a word."""
        return PomdpError(*self.place(index), message)


def text_of(source: str | Path) -> str:
    """Return the text of a file, or ``source`` itself if it holds a line end.

    Raises:
        FileNotFoundError: there is no such file.
    """
    if isinstance(source, str) and "\n" in source:
        return source
    data = Path(source).read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


class Cursor:
    """Reads a text word by word, and knows the names given so far; ``at`` is the word to read next."""

    def __init__(self, text: str) -> None:
        self.words, self.at = Words(text), 0
        self.names: dict[str, tuple[str, ...]] = {}
        self._places: dict[str, dict[str, int]] = {}

    def found(self) -> str:
        """Return the next word as a message shows it."""
        return repr(self.words[self.at]) if self.at < len(self.words) else "the end of the file"

    def colon(self) -> None:
        """Read a colon."""
        if self.words[self.at] != ":":
            before = self.words[self.at - 1]
            raise self.words.error(self.at, f"expected ':' after {before!r}, got {self.found()}")
        self.at += 1

    def number(self, what: str) -> float:
        """Read one finite number."""
        value = number_of(self.words[self.at])
        if value is None:
            raise self.words.error(self.at, f"expected {what}, a number, got {self.found()}")
        self.at += 1
        return value

    def numbers(self, count: int, what: str) -> np.ndarray:
        """Read ``count`` finite numbers, fast when they are all there."""
        words = self.words.words[self.at : self.at + count]
        try:
            values = np.array(list(map(float, words)))
        except ValueError:
            values = np.zeros(0)
        if len(values) < count or not np.isfinite(values).all():
            good = next((i for i, word in enumerate(words) if number_of(word) is None), len(words))
            self.at += good
            message = f"expected {count} numbers for {what}, got {good} and then {self.found()}"
            raise self.words.error(self.at, message)
        self.at += count
        return values

    def name_all(self, kind: str, names: tuple[str, ...]) -> None:
        """Give the names of the states, actions or observations."""
        self.names[kind] = names
        self._places[kind] = {name: i for i, name in enumerate(names)}

    def is_name(self, kind: str, word: str) -> bool:
        """Say whether a word is a name of this kind."""
        return word in self._places[kind]

    def size(self, kind: str) -> int:
        """Return how many there are of a kind."""
        if kind not in self.names:
            raise self.words.error(self.at, f"{kind} must be given before they are used")
        return len(self.names[kind])

    def index(self, kind: str) -> int:
        """Read one name or number; ``*`` gives ``ANY``."""
        size, word = self.size(kind), self.words[self.at]
        index = ANY if word == "*" else self._places[kind].get(word, int(word) if word.isdecimal() else size)
        if index >= size:
            known = ", ".join(self.names[kind][:8]) + (", ..." if size > 8 else "")
            message = f"expected one of the {size} {kind} ({known}), got {self.found()}"
            raise self.words.error(self.at, message)
        self.at += 1
        return index

    def indices(self, kind: str) -> range:
        """Read one name, number or ``*`` as the range of what it stands for."""
        index = self.index(kind)
        return range(self.size(kind)) if index == ANY else range(index, index + 1)


def number_of(word: str) -> float | None:
    """Return the finite number that a word spells, or None."""
    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
