"""Run directories: exact restoring, cutting off what was not committed, clear refusals."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.experiments.arrays import DamagedFileError, flatten, load_arrays, save_arrays, unflatten
from jaxpomdp.experiments.record import (
    RunDirectoryError,
    changed_versions,
    open_run,
    read_table,
    table_text,
    write_json,
)

DESCRIPTION = {"format": 1, "run": {"trials": 5}, "agent": {"theta": 0.2}}
ROW = (3, 1, 12, np.float32(0.1), np.float32(1 / 3), np.True_)


def some_state(size=3):
    return {
        "key": jax.random.key(7),
        "belief": jnp.linspace(0, 1, size),
        "counts": (np.arange(size), 4),
        "on": np.ones(size, bool),
    }


def committed(path, trial=1):
    with open_run(path, DESCRIPTION) as record:
        record.restore(some_state())
        record.commit(some_state(), {"trial": trial}, {"trials": [ROW]})


def test_flatten_and_back_is_exact_and_sizes_may_grow():
    state = some_state(5)
    back = unflatten(some_state(3), flatten(state))
    assert jax.random.bits(back["key"]) == jax.random.bits(state["key"])
    assert isinstance(back["counts"][1], int)
    for name, array in flatten(state).items():
        np.testing.assert_array_equal(flatten(back)[name], array)


def test_unflatten_names_what_does_not_fit():
    arrays = flatten(some_state())
    with pytest.raises(DamagedFileError, match=r"lacks \[\"\['on'\]\"\]"):
        unflatten(some_state(), {name: x for name, x in arrays.items() if "on" not in name})
    with pytest.raises(DamagedFileError, match=r"\['belief'\] must be like float32 of rank 1, got int64"):
        unflatten(some_state(), arrays | {"['belief']": np.zeros(3, int)})


def test_arrays_are_never_pickled(tmp_path):
    with pytest.raises(ValueError, match="Python objects under x"):
        save_arrays(tmp_path / "a.npz", {"x": np.array([{}], dtype=object)}, {})
    np.savez(tmp_path / "b.npz", x=np.array([{}], dtype=object))
    with pytest.raises(DamagedFileError, match=r"b\.npz is damaged"):
        load_arrays(tmp_path / "b.npz")


def test_a_commit_comes_back(tmp_path):
    committed(tmp_path, trial=9)
    with open_run(tmp_path, DESCRIPTION) as record:
        state, progress = record.restore(some_state())
        assert record.resumed
    assert progress == {"trial": 9}
    np.testing.assert_array_equal(state["belief"], some_state()["belief"])


def test_rows_after_the_last_commit_are_cut_off(tmp_path):
    committed(tmp_path)
    before = (tmp_path / "trials.csv").read_bytes()
    with open(tmp_path / "trials.csv", "ab") as file:
        file.write(b"3,2,half a r")
    (tmp_path / "phases.csv").write_text("never committed\n")
    with open_run(tmp_path, DESCRIPTION) as record:
        record.restore(some_state())
    assert (tmp_path / "trials.csv").read_bytes() == before
    assert not (tmp_path / "phases.csv").exists()


def test_floats_survive_the_table_exactly(tmp_path):
    committed(tmp_path)
    table = read_table(tmp_path / "trials.csv")
    assert np.float32(table["discounted"][0]) == np.float32(1 / 3)
    assert table["success"][0] == 1


def test_another_configuration_is_refused_by_the_name_of_the_field(tmp_path):
    committed(tmp_path)
    other = {"format": 1, "run": {"trials": 7}, "agent": {"theta": 0.2}}
    with pytest.raises(RunDirectoryError, match=r"run\.trials: 5 -> 7\. "), open_run(tmp_path, other):
        pass


def test_a_damaged_checkpoint_is_refused(tmp_path):
    committed(tmp_path)
    data = (tmp_path / "checkpoint.npz").read_bytes()
    (tmp_path / "checkpoint.npz").write_bytes(data[: len(data) // 2])
    with open_run(tmp_path, DESCRIPTION) as record, pytest.raises(DamagedFileError, match="damaged"):
        record.restore(some_state())


@pytest.mark.parametrize("damage", [lambda data: data[:-3], lambda data: data.replace(b"12", b"13")])
def test_a_damaged_table_is_refused(tmp_path, damage):
    committed(tmp_path)
    file = tmp_path / "trials.csv"
    file.write_bytes(damage(file.read_bytes()))
    with (
        open_run(tmp_path, DESCRIPTION) as record,
        pytest.raises(RunDirectoryError, match=r"trials\.csv is damaged"),
    ):
        record.restore(some_state())


def test_a_damaged_configuration_is_refused(tmp_path):
    committed(tmp_path)
    (tmp_path / "config.json").write_text("{")
    with (
        pytest.raises(RunDirectoryError, match=r"config\.json is not readable"),
        open_run(tmp_path, DESCRIPTION),
    ):
        pass


def test_foreign_files_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("dear")
    with pytest.raises(RunDirectoryError, match=r"no run directory: it holds 'thesis\.tex'"):
        committed(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_one_writer_at_a_time(tmp_path):
    with (
        open_run(tmp_path, DESCRIPTION),
        pytest.raises(RunDirectoryError, match="another process is working"),
        open_run(tmp_path, DESCRIPTION),
    ):
        pass


def test_changed_versions_are_named(tmp_path):
    committed(tmp_path)
    assert changed_versions(tmp_path) == []
    old = json.loads((tmp_path / "versions.json").read_text())
    write_json(tmp_path / "versions.json", old | {"jax": "0.0"})
    assert changed_versions(tmp_path)[0].startswith("jax: 0.0 -> ")


def test_table_text_has_one_line_per_row():
    assert table_text([ROW]) == "3,1,12,0.100000001,0.333333343,1\n"
