"""What a run is: an environment, an agent, its seeds, how long, and how it is judged. Data only."""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

Scalar = bool | int | float | str | None
EVALUATION_SEED = 20_061_997
"""Evaluation draws come from this seed and the trial number, never from the training seeds."""


@dataclass(frozen=True)
class RunConfig:
    """A fixed chunk of seeds, trained and judged together; with the versions it fixes every result."""

    env: str = "maze89"
    """Name of the environment, or a .POMDP file."""
    agent: str = "udhmm"
    """Name of the agent."""
    seeds: tuple[int, ...] = (0,)
    """Training seeds; they run together as one batch, the chunk."""
    trials: int = 300
    """Training trials per seed, rounded up to whole phases of the agent (0: nothing to learn)."""
    evaluate_every: int = 100
    """Trials between greedy evaluations (0: only at the end)."""
    evaluation_trials: int = 100
    """Greedy trials per seed in each evaluation on the way."""
    final_trials: int = 251
    """Greedy trials per seed of the agent as it ends."""
    settings: tuple[tuple[str, Scalar], ...] = field(default=())
    """Settings of the agent that differ from its preset: (name, value) pairs."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: naming the field, what was expected and what came.
        """
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds must be distinct and at least one, got {self.seeds}")
        for name in ("trials", "evaluate_every"):
            _at_least(name, getattr(self, name), 0)
        for name in ("evaluation_trials", "final_trials"):
            _at_least(name, getattr(self, name), 1)


def _at_least(name: str, value: int, least: int) -> None:
    if value < least:
        raise ValueError(f"{name} must be at least {least}, got {value}")


def seed_range(first: int, count: int) -> tuple[int, ...]:
    """Return ``count`` seeds from ``first`` on.

    Raises:
        ValueError: ``count`` is not positive or ``first`` is negative.

    >>> seed_range(1000, 3)
    (1000, 1001, 1002)
    """
    _at_least("seeds", count, 1)
    _at_least("first seed", first, 0)
    return tuple(range(first, first + count))


def describe(config: RunConfig, agent: Any) -> dict[str, Any]:
    """Return what fixes the results of a run, as JSON: the run and the agent's whole configuration."""
    resolved = dataclasses.asdict(agent.config)
    description = {"format": 1, "run": dataclasses.asdict(config), "agent": resolved}
    return json.loads(json.dumps(description, default=str))


def digest(description: dict[str, Any]) -> str:
    """Return eight hex digits that tell one description from another."""
    text = json.dumps(description, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "") -> list[str]:
    """Return a line ``name: old -> new`` for every field that differs between two nested descriptions.

    >>> differences({"run": {"trials": 300}}, {"run": {"trials": 500}})
    ['run.trials: 300 -> 500']
    """
    lines = []
    for name in sorted(old.keys() | new.keys()):
        a, b, path = old.get(name), new.get(name), f"{prefix}{name}"
        if isinstance(a, dict) and isinstance(b, dict):
            lines += differences(a, b, f"{path}.")
        elif a != b:
            lines.append(f"{path}: {a} -> {b}")
    return lines


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a hint at the nearest known name, or nothing.

    >>> did_you_mean("maze98", ["hallway", "maze89"])
    "; did you mean 'maze89'?"
    """
    close = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {close[0]!r}?" if close else ""
