"""Safe files for parameters: arrays in an ``.npz``, structure in a JSON header, nothing that can run code.

A file is a NumPy archive with one entry per array and the entry ``header``, JSON in bytes::

    {"format": "jaxpomdp.params", "version": 1, "family": "flat", "tree": ..., "metadata": {...}}

The tree names only classes that are registered here; loading builds those and nothing else.
"""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp.models.coupled import CoupledParams, Strand
from jaxpomdp.models.coupled_tree import CoupledTreeParams
from jaxpomdp.models.emission import Categorical, DiagonalGaussian, ReturnModel
from jaxpomdp.models.flat import FlatParams
from jaxpomdp.models.full_gaussian import FullGaussian
from jaxpomdp.models.hierarchical import TreeParams

FORMAT = "jaxpomdp.params"
VERSION = 1
KINDS: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        FlatParams,
        TreeParams,
        CoupledParams,
        CoupledTreeParams,
        Strand,
        Categorical,
        DiagonalGaussian,
        FullGaussian,
        ReturnModel,
    )
}
"""The classes that files may name. Other families add theirs with ``register``."""
_NUMBERS = "biuf"


class Stored(NamedTuple):
    """What a file held: ``params`` (arrays as they were saved), the ``family``'s name, and ``metadata``."""

    params: Any
    family: str
    metadata: dict[str, Any]


def register(cls: type) -> type:
    """Let files hold a pytree dataclass; returns it, so it can be a decorator."""
    KINDS[cls.__name__] = cls
    return cls


def save(
    path: str | Path, params: Any, *, family: str = "flat", metadata: dict[str, Any] | None = None
) -> None:
    """Write parameters to exactly this path; a reader sees the old file or the new one, never half of one.

    Args:
        path: the file; an ``.npz`` ending is usual and not required.
        params: a pytree of arrays in registered dataclasses, tuples, lists and dicts.
        family: the name of the family that the parameters belong to.
        metadata: anything JSON can hold.

    Raises:
        ValueError: something in ``params`` or ``metadata`` cannot be stored; nothing is written then.
    """
    arrays: dict[str, np.ndarray] = {}
    tree = _describe(params, arrays, "params")
    header = {"format": FORMAT, "version": VERSION, "family": family, "tree": tree}
    header["metadata"] = {} if metadata is None else metadata
    try:
        text = json.dumps(header, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"metadata must be plain JSON, got {error}") from None
    _write(Path(path), {"header": np.frombuffer(text.encode(), np.uint8), **arrays})


def load(path: str | Path) -> Stored:
    """Read what ``save`` wrote; arrays come back bit for bit, as JAX arrays.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no file of this kind or version, or it is damaged.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"path must be a file written by save, got {path}, which does not exist")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, AttributeError) as error:
        raise ValueError(f"{path} must be a NumPy archive of plain arrays, got {error}") from None
    header = _header(path, arrays)
    return Stored(_build(path, header["tree"], arrays), header["family"], header["metadata"])


def _describe(node: Any, arrays: dict[str, np.ndarray], place: str) -> dict[str, Any]:
    """Return the JSON description of a pytree, and put its arrays aside."""
    if type(node) in KINDS.values() and dataclasses.is_dataclass(node):
        fields = {f.name: getattr(node, f.name) for f in dataclasses.fields(node)}
        return {"kind": type(node).__name__, "fields": _entries(fields, arrays, place)}
    if isinstance(node, dict) and all(isinstance(key, str) for key in node):
        return {"kind": "dict", "fields": _entries(node, arrays, place)}
    if type(node) in (tuple, list):
        items = [_describe(item, arrays, f"{place}[{i}]") for i, item in enumerate(node)]
        return {"kind": type(node).__name__, "items": items}
    if node is None:
        return {"kind": "none"}
    return _put_aside(node, arrays, place)


def _entries(fields: dict[str, Any], arrays: dict[str, np.ndarray], place: str) -> dict[str, Any]:
    return {name: _describe(value, arrays, f"{place}.{name}") for name, value in fields.items()}


def _put_aside(leaf: Any, arrays: dict[str, np.ndarray], place: str) -> dict[str, Any]:
    if not isinstance(leaf, (jax.Array, np.ndarray, np.generic, bool, int, float)):
        raise ValueError(f"{place} must be an array or a registered class, got {type(leaf).__name__}")
    array = np.asarray(leaf)
    if array.dtype.kind not in _NUMBERS:
        raise ValueError(f"{place} must hold plain numbers, got dtype {array.dtype}")
    arrays[place] = array
    return {"kind": "array", "name": place, "shape": list(array.shape), "dtype": array.dtype.str}


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write beside the path, flush to disk, then move into place."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, allow_pickle=False, **arrays)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _header(path: Path, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    try:
        header = json.loads(arrays.pop("header").tobytes().decode())
    except (KeyError, UnicodeDecodeError, json.JSONDecodeError):
        raise ValueError(f"{path} must have a JSON entry named header, got none that can be read") from None
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError(f"{path} must be of format {FORMAT!r}, got another")
    if header.get("version") != VERSION:
        raise ValueError(f"{path} must be of version {VERSION}, got {header.get('version')}")
    missing = sorted({"family", "tree", "metadata"} - set(header))
    if missing:
        raise ValueError(f"{path} must have a whole header, got none of {missing}")
    return header


def _build(path: Path, node: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Return the pytree that a description stands for."""
    kind = node.get("kind") if isinstance(node, dict) else None
    if kind == "array":
        return _taken(path, node, arrays)
    if kind == "none":
        return None
    if kind in ("tuple", "list") and "items" in node:
        items = [_build(path, item, arrays) for item in node["items"]]
        return tuple(items) if kind == "tuple" else items
    if kind != "dict" and kind not in KINDS:
        raise ValueError(f"{path} must hold one of {sorted(KINDS)}, got {kind!r}")
    fields = {name: _build(path, value, arrays) for name, value in node.get("fields", {}).items()}
    if kind == "dict":
        return fields
    expected = {field.name for field in dataclasses.fields(KINDS[kind])}
    if set(fields) != expected:
        raise ValueError(f"{path}: {kind} must have the fields {sorted(expected)}, got {sorted(fields)}")
    return KINDS[kind](**fields)


def _taken(path: Path, node: dict[str, Any], arrays: dict[str, np.ndarray]) -> jax.Array | np.ndarray:
    array = arrays.get(node.get("name", ""))
    if array is None:
        raise ValueError(f"{path} must hold the array {node.get('name')!r}, got no such entry")
    if list(array.shape) != node.get("shape") or array.dtype.str != node.get("dtype"):
        expected, came = f"{node.get('dtype')}{node.get('shape')}", f"{array.dtype.str}{list(array.shape)}"
        raise ValueError(f"{path}: {node['name']} must be {expected}, got {came}")
    loaded = jnp.asarray(array)
    # Without 64-bit JAX a float64 array would lose bits; it stays a NumPy array then.
    return loaded if loaded.dtype == array.dtype else array
