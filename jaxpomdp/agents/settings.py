"""Settings of nested frozen dataclasses, changed by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from typing import Any


def with_settings(config: Any, settings: Mapping[str, Any]) -> Any:
    """Return a (nested) dataclass with settings changed by name: ``theta`` or ``learner.split.stay``.

    A bare name must belong to one field only, or to the outermost field of that name. The order of names
    means nothing: parts given whole come first, and each part is made once, with all that changes in it.

    Raises:
        ValueError: no such setting, a name that more than one part has, or what a part says of its fields.
    """
    whole = {name: value for name, value in settings.items() if dataclasses.is_dataclass(value)}
    for some in (whole, {name: value for name, value in settings.items() if name not in whole}):
        config = _changed(config, {_path(config, name): value for name, value in some.items()})
    return config


def _changed(config: Any, changes: Mapping[tuple[str, ...], Any]) -> Any:
    new = {path[0]: value for path, value in changes.items() if len(path) == 1}
    for head in {path[0] for path in changes if len(path) > 1}:
        inner = {path[1:]: value for path, value in changes.items() if path[0] == head and len(path) > 1}
        new[head] = _changed(new.get(head, getattr(config, head)), inner)
    return replace(config, **new)


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
