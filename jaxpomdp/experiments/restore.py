"""A trained agent out of its run directory."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.experiments.arrays import load_arrays, unflatten
from jaxpomdp.experiments.config import RunConfig, describe, differences
from jaxpomdp.experiments.record import RunDirectoryError, read_json
from jaxpomdp.experiments.runner import Build, build


class Restored(NamedTuple):
    """A run's configuration, world and agent, the agent's state, and whether the run was complete."""

    config: RunConfig
    world: Any
    agent: Any
    state: Any
    complete: bool


def config_of(path: Path) -> RunConfig:
    """Return the configuration of a run directory.

    Raises:
        RunDirectoryError: it is none, or was made by an incompatible version.
    """
    if not (path / "config.json").exists():
        raise RunDirectoryError(f"{path} is no run directory (jaxpomdp train makes one): no config.json")
    fields = dict(read_json(path / "config.json")["run"])
    try:
        settings = tuple((name, value) for name, value in fields.pop("settings"))
        return RunConfig(**{**fields, "seeds": tuple(fields["seeds"]), "settings": settings})
    except (KeyError, TypeError, ValueError) as error:
        raise RunDirectoryError(f"{path / 'config.json'} is damaged or of another version: {error}") from None


def restore(path: Path, make: Build = build) -> Restored:
    """Return the agent as it ended, or as it was at the last commit of a run that is not complete.

    Raises:
        RunDirectoryError: there is nothing to load, or the agent's presets have changed since.
    """
    config = config_of(path)
    world, agent = make(config)
    changed = differences(read_json(path / "config.json"), describe(config, agent))
    if changed:
        raise RunDirectoryError(f"{path} was made with other settings (there -> now): {'; '.join(changed)}")
    complete = (path / "model.npz").exists()
    file = path / ("model.npz" if complete else "checkpoint.npz")
    if not file.exists():
        raise RunDirectoryError(f"{path} holds no model yet: the run has not reached its first commit")
    state = unflatten(agent.init(np.asarray(config.seeds)), load_arrays(file)[0], file)
    return Restored(config, world, agent, state if complete else agent.finish(state), complete)


def find_runs(paths: Iterable[Path]) -> list[Path]:
    """Return the run directories at or below the given paths, in order.

    Raises:
        RunDirectoryError: there is none.
    """
    paths = list(paths)
    found = [file.parent for path in paths for file in sorted(path.rglob("config.json"))]
    if not found:
        raise RunDirectoryError(f"no run directory in {', '.join(map(str, paths)) or 'an empty list'}")
    return list(dict.fromkeys(found))
