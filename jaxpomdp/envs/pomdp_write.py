"""Writing the .POMDP format: a file that reads back equal to the last bit."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator

import numpy as np

from jaxpomdp.envs.pomdp_tables import ParsedPOMDP, RewardRules

_WIDTH = 110


def write_pomdp(parsed: ParsedPOMDP) -> str:
    """Return the text of a .POMDP file that ``read_pomdp`` reads back equal, every number to the last bit.

    A table that is the same for all actions is written once. Notes are not written.

    Raises:
        ValueError: a name cannot be written (it holds a space, ``:`` or ``#``, or is ``*``).
    """
    _check_names(parsed)
    lines = [] if parsed.discount is None else [f"discount: {parsed.discount!r}"]
    lines += [f"values: {parsed.values}"]
    for kind in ("states", "actions", "observations"):
        lines += _named_list(kind, getattr(parsed, kind))
    lines += ["", "start:", *_wrapped(_number(p) for p in parsed.start)]
    if parsed.end_states:
        lines += ["", "E:", *_wrapped(parsed.states[s] for s in parsed.end_states)]
    lines += _table("T", parsed.transitions, parsed, parsed.states)
    lines += _table("O", parsed.observation_probs, parsed, parsed.observations)
    lines += ["", *_rules(parsed.rewards, parsed)]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    """Return the shortest text that reads back as the same float64."""
    return repr(float(value))


def _check_names(parsed: ParsedPOMDP) -> None:
    for kind in ("states", "actions", "observations"):
        for name in getattr(parsed, kind):
            if not name or name == "*" or any(c.isspace() or c in ":#" for c in name):
                raise ValueError(f"{kind} must be names without space, ':' and '#', not '*', got {name!r}")


def _named_list(kind: str, names: tuple[str, ...]) -> list[str]:
    if names == tuple(map(str, range(len(names)))):
        return [f"{kind}: {len(names)}"]
    return [f"{kind}:", *_wrapped(names)]


def _wrapped(words: Iterable[str]) -> list[str]:
    return textwrap.wrap(" ".join(words), _WIDTH, break_long_words=False, break_on_hyphens=False)


def _table(letter: str, matrices, parsed: ParsedPOMDP, columns: tuple[str, ...]) -> Iterator[str]:
    one_for_all = len(matrices) > 1 and all(matrix is matrices[0] for matrix in matrices)
    for action, matrix in zip(["*"] if one_for_all else parsed.actions, matrices, strict=False):
        yield ""
        for state, name in enumerate(parsed.states):
            row = slice(*matrix.indptr[state : state + 2])
            yield from _row(f"{letter}: {action} : {name}", matrix.indices[row], matrix.data[row], columns)


def _row(head: str, indices: np.ndarray, values: np.ndarray, columns: tuple[str, ...]) -> Iterator[str]:
    """Write a sparse row entry by entry, a full one as a vector."""
    if len(indices) <= max(4, len(columns) // 4):
        for index, value in zip(indices.tolist(), values.tolist(), strict=True):
            yield f"{head} : {columns[index]} {value!r}"
        return
    dense = np.zeros(len(columns))
    dense[indices] = values
    yield f"{head} {' '.join(map(repr, dense.tolist()))}"


def _rules(rules: RewardRules, parsed: ParsedPOMDP) -> Iterator[str]:
    # ANY is -1, so it picks the star at the end of the names
    names = [
        np.array([*kind, "*"], object)[rules.index[:, axis]]
        for axis, kind in enumerate((parsed.actions, parsed.states, parsed.states, parsed.observations))
    ]
    for a, s, t, o, value in zip(*names, rules.value.tolist(), strict=True):
        yield f"R: {a} : {s} : {t} : {o} {_number(value)}"
