"""An independent, slow reading of a .POMDP text into dense arrays: every statement painted in order."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np


class Dense(NamedTuple):
    names: dict
    start: np.ndarray
    trans: np.ndarray
    obs: np.ndarray
    reward: np.ndarray


def read_dense(text: str) -> Dense:
    text = re.sub(r"#.*", "", text)
    keywords = r"discount|values|states|actions|observations|start\s*\w*|E|T|O|R"
    chunks = re.split(rf"(?:^|\n)\s*({keywords})\s*:", text)
    pairs = list(zip(chunks[1::2], chunks[2::2], strict=True))
    lists = ("states", "actions", "observations")
    names = {kind: _names(body.split()) for kind, body in pairs if kind in lists}
    states, actions, observations = (len(names[k]) for k in lists)
    start = np.full(states, 1 / states)
    for kind, body in pairs:
        if kind.startswith("start"):
            start = _start(kind.split()[1:], body.split(), names["states"])
    tables = {
        "T": np.zeros((actions, states, states)),
        "O": np.zeros((actions, states, observations)),
        "R": np.zeros((actions, states, states, observations)),
    }
    kinds = {"T": ["actions", "states", "states"], "O": ["actions", "states", "observations"]}
    kinds["R"] = ["actions", "states", "states", "observations"]
    for kind, body in pairs:
        if kind in tables:
            _paint(tables[kind], [names[k] for k in kinds[kind]], body, start)
    ends = [word for kind, body in pairs if kind == "E" for word in body.split()]
    for state in map(names["states"].index, ends):
        missing = tables["T"][:, state].sum(axis=-1) == 0
        tables["T"][missing, state, state] = 1
    for letter in "TO":
        tables[letter] /= tables[letter].sum(axis=-1, keepdims=True)
    return Dense(names, start, tables["T"], tables["O"], tables["R"])


def _names(words):
    return [str(i) for i in range(int(words[0]))] if len(words) == 1 and words[0].isdigit() else words


def _start(mode, words, states):
    chosen = np.array([name in words for name in states])
    if mode == ["exclude"]:
        chosen = ~chosen
    elif not mode and words == ["uniform"]:
        chosen[:] = True
    elif not mode and len(words) == len(states):
        vector = np.array(words, float)
        return vector / vector.sum()
    return chosen / chosen.sum()


def _paint(table, names, body, start):
    parts = [part.split() for part in body.split(":")]
    words = [part[0] for part in parts]
    values = parts[-1][1:]
    where = tuple(
        slice(None) if word == "*" else _number(word, known)
        for word, known in zip(words, names, strict=False)
    )
    where += (slice(None),) * (table.ndim - len(where))
    shape = table.shape[len(words) :]
    if values == ["uniform"]:
        table[where] = 1 / table.shape[-1]
    elif values == ["identity"]:
        table[where] = np.eye(table.shape[-1])
    elif values == ["reset"]:
        table[where] = start
    else:
        table[where] = np.array(values, float).reshape(shape)


def _number(word, known):
    return known.index(word) if word in known else int(word)
