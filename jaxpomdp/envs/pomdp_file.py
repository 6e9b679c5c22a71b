"""Reading the .POMDP format of Cassandra, with the liberties that real files take.

A file is a list of statements, ``keyword : ...``; line ends mean nothing; ``#`` starts a comment; later
statements override earlier ones::

    discount: 0.95          values: reward | rewards | cost | costs
    states: 4  (or names)   actions: ...       observations: ...
    start: P(s) for every s | uniform | one or several states
    start include: states   start exclude: states
    E: states                                          after which nothing happens
    T: a : s : s' p         T: a : s  row|uniform|reset       T: a  matrix|uniform|identity|reset
    O: a : s' : o p         O: a : s'  row|uniform            O: a  matrix|uniform|identity
    R: a : s : s' : o r     R: a : s : s'  one r for every o  R: a : s  one row of them for every s'

``*`` stands for every action, state or observation; a number stands for one too, counted from 0.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxpomdp.envs.pomdp_lexer import Cursor, Note, PomdpError, number_of, text_of
from jaxpomdp.envs.pomdp_rows import EXACT, TOLERANCE, ProbabilityRows, Row, row_of, settle
from jaxpomdp.envs.pomdp_tables import ParsedPOMDP, RewardRules
from jaxpomdp.envs.pomdp_write import write_pomdp

__all__ = ["Note", "ParsedPOMDP", "PomdpError", "read_pomdp", "write_pomdp"]

_VALUES = {"reward": "reward", "rewards": "reward", "cost": "cost", "costs": "cost"}
_KEYWORDS = ("discount", "values", "states", "actions", "observations", "start", "E", "T", "O", "R")


def read_pomdp(source: str | Path, *, mend: bool = False) -> ParsedPOMDP:
    r"""Read a .POMDP file.

    Rows of probabilities off by at most 1e-4 are taken as rounded and scaled to sum to one; ``notes`` tells.

    Args:
        source: a path, or the text itself (any string that holds a line end).
        mend: scale rows that are further off as well, with a note for each; an empty row becomes uniform.

    Raises:
        PomdpError: the file is not well formed, or (without ``mend``) a row does not sum to one.
        FileNotFoundError: there is no such file.

    Example:
        >>> model = read_pomdp('''discount: 0.9
        ... states: left right
        ... actions: 1
        ... observations: 1
        ... T: 0 identity
        ... O: * uniform
        ... R: 0 : left : * : * 2''')
        >>> model.states, model.expected_rewards().tolist()
        (('left', 'right'), [[2.0, 0.0]])
        >>> read_pomdp("states: 2\nactions: 1\nT: 0 : 2 : 0 1.0")
        Traceback (most recent call last):
            ...
        jaxpomdp.envs.pomdp_lexer.PomdpError: line 3, column 8: expected one of the 2 states (0, 1), got '2'
    """
    return _Reader(text_of(source), mend).read()


class _Reader(Cursor):
    """One pass over the statements."""

    def __init__(self, text: str, mend: bool) -> None:
        super().__init__(text)
        self.mend = mend
        self.discount: float | None = None
        self.values = "reward"
        self.start: np.ndarray | None = None
        self.reset_used = False
        self.end_states: list[int] = []
        self.tables: dict[str, ProbabilityRows] = {}
        self.rule_blocks: list[tuple[np.ndarray, np.ndarray]] = []
        self.rules: list[list[int]] = []
        self.rule_values: list[float] = []
        self.notes: list[Note] = []

    def read(self) -> ParsedPOMDP:
        handlers: dict[str, Callable[[], None]] = {
            "discount": self._read_discount,
            "values": self._read_values,
            "start": self._read_start,
            "E": self._read_end_states,
            "R": self._read_reward,
        }
        handlers |= {kind: self._names_reader(kind) for kind in ("states", "actions", "observations")}
        handlers |= {letter: self._table_reader(letter) for letter in "TO"}
        while self.at < len(self.words):
            word = self.words[self.at]
            if word not in handlers:
                raise self._unexpected(word)
            self.at += 1
            handlers[word]()
        return self._finish()

    def _unexpected(self, word: str) -> PomdpError:
        hint = "" if number_of(word) is None else "; are there too many numbers before it?"
        return self.words.error(self.at, f"expected one of {', '.join(_KEYWORDS)}, got {word!r}{hint}")

    def _list(self) -> range:
        """Return the words up to the next statement."""
        begin = self.at
        while self.at < len(self.words) and not self._statement_begins():
            self.at += 1
        return range(begin, self.at)

    def _statement_begins(self) -> bool:
        following = self.words[self.at + 1]
        include = self.words[self.at] == "start" and following in ("include", "exclude")
        return following == ":" or (include and self.words[self.at + 2] == ":")

    # --- the statements before the tables

    def _read_discount(self) -> None:
        self.colon()
        self.discount = self.number("the discount")
        if not 0 <= self.discount <= 1:
            raise self.words.error(self.at - 1, f"discount must lie in [0, 1], got {self.discount}")

    def _read_values(self) -> None:
        self.colon()
        if self.words[self.at] not in _VALUES:
            raise self.words.error(self.at, f"values must be reward or cost, got {self.found()}")
        self.values = _VALUES[self.words[self.at]]
        self.at += 1

    def _names_reader(self, kind: str) -> Callable[[], None]:
        def read() -> None:
            if kind in self.names:
                raise self.words.error(self.at - 1, f"{kind} are given twice")
            self.colon()
            listed = self._list()
            given = [self.words[i] for i in listed]
            if len(given) == 1 and given[0].isdecimal() and int(given[0]) > 0:
                given = [str(i) for i in range(int(given[0]))]
            self.name_all(kind, tuple(given))
            self._check_names(kind, listed)

        return read

    def _check_names(self, kind: str, listed: range) -> None:
        if not listed or (self.names[kind] == ("0",) and self.words[listed[0]] == "0"):
            raise self.words.error(self.at, f"{kind} must be names or a number above 0")
        seen: set[str] = set()
        for i in listed:
            if self.words[i] in seen or self.words[i] == "*":
                message = f"{kind} must be different names other than '*', got {self.words[i]!r}"
                raise self.words.error(i, message)
            seen.add(self.words[i])

    def _read_end_states(self) -> None:
        self.colon()
        listed = self._list()
        self.at = listed.start
        self.end_states += [state for _ in listed for state in self.indices("states")]

    # --- start

    def _read_start(self) -> None:
        size, begin = self.size("states"), self.at
        if self.reset_used:
            raise self.words.error(begin - 1, "start must come before the first 'reset'")
        mode = self.words[self.at] if self.words[self.at] in ("include", "exclude") else ""
        self.at += bool(mode)
        self.colon()
        listed = self._list()
        self.at = listed.start
        if not mode and len(listed) == 1 and self.words[self.at] == "uniform":
            self.at += 1
            self.start = np.full(size, 1 / size)
        elif not mode and self._is_vector(listed, size):
            self.start = self._scaled_start(self.numbers(size, "start"))
        else:
            self.start = self._start_states(listed, exclude=mode == "exclude")

    def _is_vector(self, listed: range, size: int) -> bool:
        """Say whether a list is one number for every state rather than states."""
        words = [self.words[i] for i in listed]
        if len(words) == 1 and words[0].isdecimal():
            return size == 1 and words[0] == "1"
        return all(number_of(word) is not None for word in words)

    def _scaled_start(self, start: np.ndarray) -> np.ndarray:
        total, last = start.sum(), self.at - 1
        hopeless = bool(np.any(start < 0)) or total <= 0
        if hopeless or (abs(total - 1) > TOLERANCE and not self.mend):
            raise self.words.error(last, f"start must be probabilities that sum to 1, got sum {total:.6g}")
        if abs(total - 1) <= EXACT:
            return start
        message = f"start was off by {abs(total - 1):.2g}; scaled to sum to one"
        self.notes.append(Note(*self.words.place(last), message))
        return start / total

    def _start_states(self, listed: range, *, exclude: bool) -> np.ndarray:
        chosen = np.zeros(self.size("states"), bool)
        for _ in listed:
            chosen[list(self.indices("states"))] = True
        chosen ^= exclude
        if not chosen.any():
            raise self.words.error(self.at - 1, "start must leave at least one state")
        return chosen / chosen.sum()

    # --- tables

    def _table(self, letter: str) -> ProbabilityRows:
        if letter not in self.tables:
            width = self.size("states" if letter == "T" else "observations")
            self.tables[letter] = ProbabilityRows(self.size("actions"), self.size("states"), width)
        return self.tables[letter]

    def _table_reader(self, letter: str) -> Callable[[], None]:
        columns = "states" if letter == "T" else "observations"

        def read() -> None:
            word = self.at - 1
            table = self._table(letter)
            self.colon()
            actions = self.indices("actions")
            if self.words[self.at] != ":":
                return self._put_matrix(table, letter, actions, word)
            self.at += 1
            states = self.indices("states")
            if self.words[self.at] != ":":
                return table.put_row(actions, states, self._row(table.width, letter), word)
            self.at += 1
            where = self.indices(columns)
            return table.put_entry(actions, states, where, self._probability(letter), word)

        return read

    def _probability(self, letter: str) -> float:
        value = self.number(f"a probability of {letter}")
        if not 0 <= value <= 1 + TOLERANCE:
            raise self.words.error(self.at - 1, f"a probability of {letter} must lie in [0, 1], got {value}")
        return value

    def _probabilities(self, count: int, letter: str) -> np.ndarray:
        begin = self.at
        values = self.numbers(count, letter)
        wrong = np.flatnonzero((values < 0) | (values > 1 + TOLERANCE))
        if wrong.size:
            message = f"a probability of {letter} must lie in [0, 1], got {values[wrong[0]]}"
            raise self.words.error(begin + int(wrong[0]), message)
        return values

    def _row(self, width: int, letter: str) -> Row:
        word = self.words[self.at]
        if word == "uniform":
            self.at += 1
            return row_of(np.full(width, 1 / width))
        if word == "reset" and letter == "T":
            return self._reset()
        return row_of(self._probabilities(width, letter))

    def _reset(self) -> Row:
        self.at, self.reset_used = self.at + 1, True
        size = self.size("states")
        return row_of(np.full(size, 1 / size) if self.start is None else self.start)

    def _put_matrix(self, table: ProbabilityRows, letter: str, actions: range, word: int) -> None:
        states, kind = range(self.size("states")), self.words[self.at]
        if kind == "uniform" or (kind == "reset" and letter == "T"):
            return table.put_row(actions, states, self._row(table.width, letter), word)
        if kind == "identity" and table.width == len(states):
            self.at += 1
            rows = [Row(np.array([s]), np.ones(1)) for s in states]
        else:
            first = self.at
            values = self._probabilities(len(states) * table.width, letter).reshape(len(states), table.width)
            rows, word = [row_of(row) for row in values], first
        for state, row in enumerate(rows):
            table.put_row(actions, [state], row, word + state * table.width * (kind != "identity"))

    # --- rewards

    def _read_reward(self) -> None:
        names: list[int] = []
        for kind in ("actions", "states", "states", "observations"):
            if len(names) >= 2 and self.words[self.at] != ":":
                break
            self.colon()
            names.append(self.index(kind))
        if len(names) == 4:
            self.rules.append(names)
            self.rule_values.append(self.number("a reward"))
            return
        width, height = self.size("observations"), self.size("states") if len(names) == 2 else 1
        values = self.numbers(width * height, "R")
        index = np.empty((height, width, 4), np.int64)
        index[..., 0], index[..., 1] = names[:2]
        index[..., 2] = np.arange(height)[:, None] if len(names) == 2 else names[2]
        index[..., 3] = np.arange(width)
        self._flush_rules()
        self.rule_blocks.append((index.reshape(-1, 4), values))

    def _flush_rules(self) -> None:
        index = np.array(self.rules, np.int64).reshape(-1, 4)
        self.rule_blocks.append((index, np.array(self.rule_values, np.float64)))
        self.rules, self.rule_values = [], []

    # --- the end

    def _finish(self) -> ParsedPOMDP:
        for kind in ("states", "actions", "observations"):
            self.size(kind)
        names = self.names["actions"], self.names["states"]
        settled = {}
        for letter in "TO":
            table = self._table(letter)
            self._complete_end_states(table, letter)
            settled[letter], notes = settle(table, self.words, what=letter, names=names, mend=self.mend)
            self.notes += notes
        self._flush_rules()
        if self.discount is None:
            self.notes.append(Note(*self.words.place(len(self.words)), "there is no discount line"))
        size = self.size("states")
        index, value = zip(*self.rule_blocks, strict=True)
        return ParsedPOMDP(
            states=self.names["states"],
            actions=self.names["actions"],
            observations=self.names["observations"],
            discount=self.discount,
            values=self.values,
            start=np.full(size, 1 / size) if self.start is None else self.start,
            transitions=settled["T"],
            observation_probs=settled["O"],
            rewards=RewardRules(np.concatenate(index), np.concatenate(value)),
            end_states=tuple(sorted(set(self.end_states))),
            notes=tuple(self.notes),
        )

    def _complete_end_states(self, table: ProbabilityRows, letter: str) -> None:
        """Let an end state whose row is never given keep its agent; observations must be given."""
        if letter == "O":
            return
        for state in self.end_states:
            never = np.flatnonzero(table.written[:, state] < 0)
            table.put_row(never.tolist(), [state], Row(np.array([state]), np.ones(1)), -1)
