"""Worlds by name."""

from __future__ import annotations

import re
from collections.abc import Callable
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
    """Make a world by its name.

    Args:
        name: ``maze89``, ``maze57``, ``tiger-grid``, ``hallway``, ``tmaze-N`` with a corridor of ``N`` moves;
            any of them followed by ``-noise`` for the noise of thesis section 3.5.1.
        **settings: of the world's own function, such as ``step_limit``.

    Raises:
        ValueError: no world has this name.

    Example:
        >>> make("tmaze-5").num_states
        14
        >>> make("hallway-noise").name
        'hallway-noise'
    """
    base = name.removesuffix(_NOISE)
    corridor = re.fullmatch(r"tmaze-(\d+)", base)
    if corridor:
        base, settings = "tmaze", {"length": int(corridor[1]), **settings}
    if base not in _MAKERS:
        known = ", ".join(names())
        raise ValueError(f"name must be one of {known}, tmaze-N, or one of these with {_NOISE}, got {name!r}")
    world = _MAKERS[base](**settings)
    return noisy(world) if name.endswith(_NOISE) else world
