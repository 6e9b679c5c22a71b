"""Settings of nested frozen dataclasses, changed by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from typing import Any


def with_settings(config: Any, settings: Mapping[str, Any]) -> Any:
    """Return a (nested) dataclass with settings changed by name: ``theta`` or ``learner.split.stay``.

    A bare name must belong to one field only, or to the outermost field of that name.

    Raises:
        ValueError: no such setting, or a name that more than one part has.
    """
    for name, value in settings.items():
        config = _with(config, _path(config, name), value)
    return config


def _with(config: Any, path: tuple[str, ...], value: Any) -> Any:
    head, *rest = path
    inner = _with(getattr(config, head), tuple(rest), value) if rest else value
    return replace(config, **{head: inner})


def _path(config: Any, name: str) -> tuple[str, ...]:
    wanted = tuple(name.split("."))
    paths = [path for path in _paths(config) if path[-len(wanted) :] == wanted]
    shallow = [path for path in paths if len(path) == min(map(len, paths))]
    if len(shallow) == 1:
        return shallow[0]
    if shallow:
        raise ValueError(f"setting {name!r} is ambiguous: {', '.join('.'.join(p) for p in shallow)}")
    known = ", ".join(".".join(path) for path in _paths(config))
    raise ValueError(f"setting {name!r} is unknown; the settings are {known}")


def _paths(config: Any, prefix: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    found = []
    for item in dataclasses.fields(config):
        value = getattr(config, item.name)
        found.append((*prefix, item.name))
        if dataclasses.is_dataclass(value):
            found += _paths(value, (*prefix, item.name))
    return found
