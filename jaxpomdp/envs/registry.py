"""Worlds by name, or of model files."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jaxpomdp.envs.hallway import hallway_navigation
from jaxpomdp.envs.maze89 import maze57, maze89, tiger_grid
from jaxpomdp.envs.tmaze import tmaze
from jaxpomdp.envs.world import World
from jaxpomdp.envs.wrappers import noisy

_MAKERS: dict[str, Callable[..., World]] = {
    "hallway": hallway_navigation,
    "maze57": maze57,
    "maze89": maze89,
    "tiger-grid": tiger_grid,
    "tmaze": tmaze,
}
_NOISE = "-noise"


def names() -> tuple[str, ...]:
    """Return the names that :func:`make` knows; ``-noise`` may follow each, and ``tmaze`` takes a length."""
    return tuple(sorted(_MAKERS))


def make(name: str, **settings: Any) -> World:
    """Make a world by its name, or of a model file.

    Args:
        name: ``maze89``, ``maze57``, ``tiger-grid``, ``hallway``, ``tmaze-N`` with a corridor of ``N`` moves;
            or a path that ends in ``.POMDP`` or ``.pomdpx``, whose trials end where the file starts again.
            Any of them followed by ``-noise`` has the noise of thesis section 3.5.1.
        **settings: of the world's own function, such as ``step_limit``; for files see
            :func:`jaxpomdp.envs.pomdp_world.from_pomdp`.

    Raises:
        ValueError: no world has this name, or the file is refused.
        FileNotFoundError: there is no such file.

    Example:
        >>> make("tmaze-5").num_states
        14
        >>> make("hallway-noise").name
        'hallway-noise'
    """
    base = name.removesuffix(_NOISE)
    world = _of_file(base, settings) if _is_file(base) else _named(base, settings)
    return noisy(world) if name.endswith(_NOISE) else world


def _named(name: str, settings: dict[str, Any]) -> World:
    corridor = re.fullmatch(r"tmaze-(\d+)", name)
    if corridor:
        return tmaze(int(corridor[1]), **settings)
    if name not in _MAKERS:
        known = ", ".join(names())
        raise ValueError(
            f"name must be one of {known}, tmaze-N, one of these with {_NOISE}, or a file, got {name!r}"
        )
    return _MAKERS[name](**settings)


def _is_file(name: str) -> bool:
    return name.lower().endswith((".pomdp", ".pomdpx"))


def _of_file(path: str, settings: dict[str, Any]) -> World:
    # The readers need SciPy's sparse matrices, which take a while to load.
    from jaxpomdp.envs.pomdp_file import read_pomdp
    from jaxpomdp.envs.pomdp_world import from_pomdp
    from jaxpomdp.envs.pomdpx import read_pomdpx

    read = read_pomdpx if path.lower().endswith("x") else read_pomdp
    usual: dict[str, Any] = {"goal_states": "reset", "name": Path(path).stem}
    return from_pomdp(read(Path(path)), **(usual | settings))
