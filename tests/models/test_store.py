from __future__ import annotations

import json
import pickle
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.models import store
from jaxpomdp.models.init import Real, random_params
from jaxpomdp.models.store import load, save


def parameters(**options):
    return random_params(jax.random.key(0), 3, 2, (4, Real(2), Real(2, full=True)), capacity=4, **options)


def assert_same(x, y) -> None:
    assert jax.tree.structure(x) == jax.tree.structure(y)
    for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


def test_a_round_trip_is_exact(tmp_path: Path) -> None:
    params, path = parameters(), tmp_path / "model.npz"
    save(path, params, metadata={"seeds": [1, 2], "note": "ä"})
    stored = load(path)
    assert_same(stored.params, params)
    assert stored.family == "flat"
    assert stored.metadata == {"seeds": [1, 2], "note": "ä"}


def test_float64_keeps_its_bits(tmp_path: Path) -> None:
    with jax.enable_x64(True):
        params = parameters()
    save(tmp_path / "model.npz", params)
    assert_same(load(tmp_path / "model.npz").params, params)


def test_plain_trees(tmp_path: Path) -> None:
    tree = {"a": (jnp.arange(3), [np.float32(2.5), True]), "b": None}
    save(tmp_path / "tree", tree, family="mine")
    stored = load(tmp_path / "tree")
    assert stored.params["b"] is None
    assert isinstance(stored.params["a"], tuple)
    assert_same(jax.tree.leaves(stored.params), [jnp.arange(3), jnp.float32(2.5), jnp.array(True)])


def test_a_failed_save_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "model.npz"
    save(path, {"x": np.arange(2)})
    before = path.read_bytes()

    def broken(file, allow_pickle, **arrays):
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez", broken)
    with pytest.raises(OSError, match="disk full"):
        save(path, {"x": np.arange(3)})
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["model.npz"]


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"x": "text"}, "params.x must be an array or a registered class, got str"),
        ({"x": [np.array([object()])]}, r"params.x\[0\] must hold plain numbers"),
        ({1: np.zeros(2)}, "params must be an array or a registered class, got dict"),
    ],
)
def test_what_cannot_be_stored_is_refused(tmp_path: Path, params: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        save(tmp_path / "model.npz", params)
    assert list(tmp_path.iterdir()) == []


def test_metadata_must_be_json(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="metadata must be plain JSON"):
        save(tmp_path / "model.npz", {"x": np.zeros(1)}, metadata={"f": object()})


class Evil:
    def __reduce__(self):
        return (Path.touch, (Path("pwned"),))


def rewritten(path: Path, change) -> None:
    """Change the header of a stored file."""
    with np.load(path) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(arrays["header"].tobytes())
    change(header)
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with path.open("wb") as file:
        np.savez(file, **arrays)


def test_foreign_and_damaged_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "model.npz"
    with pytest.raises(FileNotFoundError, match="does not exist"):
        load(path)
    path.write_bytes(b"not an archive")
    with pytest.raises(ValueError, match="must be a NumPy archive"):
        load(path)
    path.write_bytes(pickle.dumps(Evil()))
    with pytest.raises(ValueError, match="must be a NumPy archive"):
        load(path)
    np.savez(path, header=np.array([Evil()], dtype=object))
    with pytest.raises(ValueError, match="must be a NumPy archive"):
        load(path)
    assert not (tmp_path / "pwned").exists()
    np.savez(path, x=np.zeros(2))
    with pytest.raises(ValueError, match="JSON entry named header"):
        load(path)
    save(path, parameters())
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="must be a NumPy archive"):
        load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(format="other"), "must be of format"),
        (lambda h: h.update(version=99), "must be of version 1, got 99"),
        (lambda h: h.pop("family"), r"got none of \['family'\]"),
        (lambda h: h["tree"].update(kind="os.system"), "must hold one of"),
        (lambda h: h["tree"]["fields"].pop("alive"), "FlatParams must have the fields"),
        (lambda h: h["tree"]["fields"]["alive"].update(shape=[9]), r"must be .*\[9\], got .*\[4\]"),
        (lambda h: h["tree"]["fields"]["alive"].update(name="gone"), "must hold the array 'gone'"),
    ],
)
def test_a_header_that_lies_is_refused(tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "model.npz"
    save(path, parameters())
    rewritten(path, change)
    with pytest.raises(ValueError, match=message):
        load(path)


def test_other_families_can_register() -> None:
    class Mine:
        pass

    assert store.register(Mine) is Mine
    assert store.KINDS.pop("Mine") is Mine
