"""A state as named arrays in one npz file: by tree path, written whole or not at all, never unpickled."""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

META = "__meta__"


class DamagedFileError(ValueError):
    """An array file that is damaged or holds something else than was expected."""


def flatten(state: Any) -> dict[str, np.ndarray]:
    """Return every leaf of a state as a NumPy array under its tree path; random keys as their key data.

    >>> flatten({"belief": np.zeros(2), "count": 3})
    {"['belief']": array([0., 0.]), "['count']": array(3)}
    """
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path): np.asarray(_plain(leaf)) for path, leaf in leaves}


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _plain(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def unflatten(template: Any, arrays: Mapping[str, np.ndarray], file: Path | str = "arrays") -> Any:
    """Return a state of the template's structure from arrays by tree path; lengths may differ.

    Args:
        template: a state of the same kind of agent.
        arrays: what ``flatten`` gave.
        file: named in errors.

    Raises:
        DamagedFileError: a path is missing or unknown, or an array has another kind of type or rank.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    paths = [jax.tree_util.keystr(path) for path, _ in leaves]
    _check_paths(set(paths), set(arrays), file)
    pairs = zip(paths, leaves, strict=True)
    found = [_like(leaf, arrays[name], name, file) for name, (_, leaf) in pairs]
    return jax.tree_util.tree_unflatten(structure, found)


def _check_paths(expected: set[str], found: set[str], file: Path | str) -> None:
    if expected != found:
        lacks, extra = sorted(expected - found)[:3], sorted(found - expected)[:3]
        raise DamagedFileError(f"{file} holds another kind of state: it lacks {lacks}, {extra} is unknown")


def _like(leaf: Any, array: np.ndarray, path: str, file: Path | str) -> Any:
    """Return ``array`` as the kind of thing that the template's leaf is."""
    expected = np.asarray(_plain(leaf))
    if array.dtype.kind != expected.dtype.kind or array.ndim != expected.ndim:
        raise DamagedFileError(
            f"{file}: {path} must be like {expected.dtype} of rank {expected.ndim}, "
            f"got {array.dtype} of rank {array.ndim}"
        )
    if _is_key(leaf):
        return jax.random.wrap_key_data(jnp.asarray(array), impl=jax.random.key_impl(leaf))
    if isinstance(leaf, jax.Array):
        return jnp.asarray(array)
    return array if isinstance(leaf, np.ndarray) else array.item()


def save_arrays(file: Path, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
    """Write arrays and a JSON value to an npz file in one rename.

    Raises:
        ValueError: an array holds Python objects.
    """
    unsafe = [name for name, array in arrays.items() if array.dtype.hasobject]
    if unsafe:
        raise ValueError(f"arrays must hold numbers, got Python objects under {unsafe[0]}")
    part = file.with_name(file.name + ".part")
    with open(part, "wb") as handle:
        np.savez(handle, allow_pickle=False, **{META: np.array(json.dumps(meta))}, **arrays)
        handle.flush()
        os.fsync(handle.fileno())
    os.replace(part, file)


def load_arrays(file: Path) -> tuple[dict[str, np.ndarray], Any]:
    """Return the arrays and the JSON value of an npz file.

    Raises:
        DamagedFileError: the file is absent, cut short, altered, or not one that ``save_arrays`` wrote.
    """
    try:
        with open(file, "rb") as handle, np.load(handle, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        return arrays, json.loads(str(arrays.pop(META)))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DamagedFileError(f"{file} is damaged or not one of ours: {error}") from None
