"""Settings from the command line: ``name=value`` pairs, and grids of them for sweeps."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace

from jaxpomdp.experiments.config import RunConfig, Scalar

WORDS: dict[str, Scalar] = {"true": True, "false": False, "none": None}


def parse_value(text: str) -> Scalar:
    """Return a number, truth value, None or, failing these, the text.

    >>> parse_value("3"), parse_value("1e-2"), parse_value("true"), parse_value("linear")
    (3, 0.01, True, 'linear')
    """
    if text.lower() in WORDS:
        return WORDS[text.lower()]
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def parse_settings(texts: Iterable[str]) -> tuple[tuple[str, Scalar], ...]:
    """Return ``("theta=0.1", ...)`` as (name, value) pairs.

    Raises:
        ValueError: a text is not of the form name=value, or a name comes twice.
    """
    pairs = [(name, parse_value(value)) for name, value in map(_split, texts)]
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        raise ValueError(f"set must name each setting once, got {', '.join(names)}")
    return tuple(pairs)


def _split(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not (name and equals and value):
        raise ValueError(f"set must be of the form name=value, got {text!r}")
    return name, value


def grid(base: RunConfig, envs: Sequence[str], agents: Sequence[str], vary: Sequence[str]) -> list[RunConfig]:
    """Return every combination of environments, agents and varied settings (``"theta=0,0.2,0.4"``).

    >>> [c.settings for c in grid(RunConfig(), ["maze89"], ["udhmm"], ["theta=0,0.2"])]
    [(('theta', 0),), (('theta', 0.2),)]

    Raises:
        ValueError: a text of ``vary`` is not of the form name=value,value.
    """
    axes = [[f"{name}={value}" for value in values.split(",")] for name, values in map(_split, vary)]
    return [
        replace(base, env=env, agent=agent, settings=base.settings + parse_settings(varied))
        for env, agent, *varied in itertools.product(envs, agents, *axes)
    ]
