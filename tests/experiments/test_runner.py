"""A run killed at any moment and resumed equals the run that was never killed."""

from __future__ import annotations

import json
import math
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxpomdp.experiments import record, runner, sweep
from jaxpomdp.experiments.arrays import load_arrays
from jaxpomdp.experiments.config import RunConfig, seed_range
from jaxpomdp.experiments.results import Criterion, load_run, merge_runs, outcome, score
from jaxpomdp.experiments.sweep import Job, in_chunks, memory_maps_left, plan, run_jobs
from tests.experiments.fake import FakeAgent, build_fake

CONFIG = RunConfig(
    agent="fake", seeds=(3, 4, 5), trials=23, evaluate_every=10, evaluation_trials=8, final_trials=9
)
RESULTS = ("trials.csv", "phases.csv", "edits.jsonl", "evaluations.csv", "final.csv", "model.npz")


class KilledError(Exception):
    """Stands for the end of the process."""


def run(path, config=CONFIG, **settings):
    return runner.run(config, path, make=build_fake, progress="none", **settings)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return run(tmp_path_factory.mktemp("whole") / "run")


def same(a, b):
    for name in RESULTS[:-1]:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    left, right = load_arrays(a / "model.npz")[0], load_arrays(b / "model.npz")[0]
    assert left.keys() == right.keys()
    for name in left:
        np.testing.assert_array_equal(left[name], right[name])


@pytest.mark.parametrize("save_seconds", [0.0, 1000.0])
@pytest.mark.parametrize("die_at", range(1, 6))
def test_killed_in_a_phase(tmp_path, monkeypatch, whole, die_at, save_seconds):
    calls = iter(range(1, 100))
    original = FakeAgent.run

    def dying(self, state):
        if next(calls) == die_at:
            raise KilledError
        return original(self, state)

    with monkeypatch.context() as patch:
        patch.setattr(FakeAgent, "run", dying)
        with pytest.raises(KilledError):
            run(tmp_path, save_seconds=save_seconds)
    same(run(tmp_path, save_seconds=save_seconds), whole)


@pytest.mark.parametrize("name", ["_append", "finish", "commit"])
@pytest.mark.parametrize("die_at", [1, 2, 3])
def test_killed_while_writing(tmp_path, monkeypatch, whole, name, die_at):
    calls = iter(range(1, 100))
    original = getattr(record.RunDirectory, name)

    def dying(self, *args):
        if next(calls) == die_at:
            if name == "_append":
                original(self, *args)
            raise KilledError
        return original(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(record.RunDirectory, name, dying)
        if name == "finish" and die_at > 1:
            run(tmp_path, save_seconds=0.0)
        else:
            with pytest.raises(KilledError):
                run(tmp_path, save_seconds=0.0)
    same(run(tmp_path), whole)


def test_a_complete_run_is_left_as_it_is(tmp_path, monkeypatch):
    run(tmp_path)
    monkeypatch.setattr(FakeAgent, "init", lambda *_: pytest.fail("trained again"))
    run(tmp_path)


def test_what_is_on_disk_is_what_happened(whole):
    data = load_run(whole)
    assert data.seeds == [3, 4, 5]
    assert data.trials["steps"].shape == (3, 25)
    assert data.evaluations["trial"].tolist() == [[10, 20]] * 3
    assert data.phases["states"].shape == (3, 5)
    summary = record.read_json(whole / "summary.json")
    assert summary["seconds"]["acting"] == 2.5
    assert summary["seconds"]["all"] >= summary["seconds"]["evaluating"] > 0
    edits = [json.loads(line) for line in (whole / "edits.jsonl").read_text().splitlines()]
    assert [edit["trial"] for edit in edits] == [5, 10, 15, 20, 25]
    assert {(edit["seed"], edit["draw_seed"]) for edit in edits} == {(3, 99)}
    np.testing.assert_allclose(summary["goal_percent"], score(data.final)["goal_percent"])


def test_edits_are_judged_by_the_trials_around_them(whole):
    data = load_run(whole)
    rewards = data.trials["discounted"][0].reshape(5, 5).mean(1)
    judged = [json.loads(line) for line in (whole / "edits-judged.jsonl").read_text().splitlines()]
    assert [edit["trial"] for edit in judged] == [5, 10, 15, 20, 25]
    np.testing.assert_allclose([edit["discounted_before"] for edit in judged], rewards)
    np.testing.assert_allclose([edit["discounted_after"] for edit in judged[:-1]], rewards[1:])
    assert judged[-1]["discounted_after"] is None


def test_nothing_to_learn_is_only_judged(tmp_path):
    config = RunConfig(agent="fake", seeds=(1, 2), trials=0, final_trials=7)
    data = load_run(run(tmp_path, config))
    assert data.trials == {}
    assert data.final["steps"].shape == (2, 7)
    assert outcome(Criterion(bound=0.0), data).held.all()


def test_seeds_do_not_depend_on_their_chunk(tmp_path, whole):
    jobs = plan([CONFIG], tmp_path, chunk=2, make=build_fake)[0]
    run_jobs(jobs, progress="none", make=build_fake)
    merged, data = merge_runs([load_run(job.path) for job in jobs]), load_run(whole)
    assert merged.seeds == data.seeds
    np.testing.assert_array_equal(merged.final["steps"], data.final["steps"])
    np.testing.assert_array_equal(merged.trials["steps"], data.trials["steps"])


def test_workers_give_what_one_process_gives(tmp_path, whole):
    jobs = plan([CONFIG, RunConfig(agent="fake", trials=5, final_trials=2)], tmp_path, make=build_fake)
    run_jobs([job for row in jobs for job in row], workers=2, progress="none", make=build_fake)
    same(jobs[0][0].path, whole)


def test_a_process_of_many_jobs_forgets_what_it_compiled_before_maps_run_out(tmp_path, monkeypatch):
    """A reproduction in one process once died of them: LLVM could not allocate memory."""
    function = jax.jit(lambda x: x + 1)
    jobs = [Job(RunConfig(seeds=(s,), trials=4), tmp_path / str(s)) for s in (0, 1)]
    for left, kept in ((math.inf, 1), (sweep.FEW_MAPS, 1), (sweep.FEW_MAPS - 1, 0)):
        function(1)
        monkeypatch.setattr(sweep, "memory_maps_left", lambda left=left: left)
        run_jobs(jobs, progress="none", make=build_fake)
        assert function._cache_size() == kept


def test_memory_maps_are_counted_where_the_system_says(tmp_path):
    assert memory_maps_left(tmp_path, tmp_path) == math.inf
    (tmp_path / "maps").write_text("one\ntwo\n")
    (tmp_path / "max_map_count").write_text("10\n")
    assert memory_maps_left(tmp_path, tmp_path) == 8


def test_directories_tell_configurations_apart(tmp_path):
    slow = RunConfig(**{**CONFIG.__dict__, "settings": (("speed", 0.01),)})
    paths = [job.path for row in plan([CONFIG, slow], tmp_path, chunk=2, make=build_fake) for job in row]
    assert len(set(paths)) == 4
    assert paths[0].name == "seeds-3-4-of-2"


@pytest.mark.parametrize(
    ("field", "value"), [("seeds", ()), ("seeds", (1, 1)), ("trials", -1), ("final_trials", 0)]
)
def test_bad_numbers_are_named(field, value):
    with pytest.raises(ValueError, match=field):
        RunConfig(**{field: value})


def test_seed_ranges_and_chunks_are_checked():
    assert seed_range(1000, 2) == (1000, 1001)
    with pytest.raises(ValueError, match="seeds must be at least 1, got 0"):
        seed_range(0, 0)
    with pytest.raises(ValueError, match="chunk must be 0"):
        in_chunks(CONFIG, -1)
    with pytest.raises(ValueError, match="workers must be at least 1"):
        run_jobs([], workers=0)


def test_tracking_writes_means_over_seeds(tmp_path, monkeypatch):
    written = []
    writer = SimpleNamespace(
        add_scalar=lambda *row: written.append(row), close=lambda: written.append("closed")
    )
    monkeypatch.setitem(sys.modules, "tensorboardX", SimpleNamespace(SummaryWriter=lambda path: writer))
    data = load_run(run(tmp_path, track=True))
    assert written[-1] == "closed"
    first = next(row for row in written if row[0] == "training/steps")
    assert first[1:] == (data.trials["steps"][:, :5].mean(), 5)
    assert sum(row[0] == "greedy/goal_percent" for row in written) == 2


def test_tracking_without_the_library_is_answered_with_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ModuleNotFoundError, match=r"jaxpomdp\[track\]"):
        run(tmp_path, track=True)


def test_success_is_ever_or_held_and_dated():
    values = np.array([[90.0, 96, 50, 97], [96, 96, 96, 96], [10, 10, 10, 96], [10, 10, 96, 97]])
    trial = np.broadcast_to(np.array([10.0, 20, 30, 40]), (4, 4))
    final = {"success": values[:, -1:] / 100, "steps": trial, "reward": trial, "discounted": trial}
    data = load_run_like(values[:, :-1], trial[:, :-1], final)
    found = outcome(Criterion(), data)
    assert found.ever.tolist() == [True] * 4
    assert found.held.tolist() == [False, True, False, True]
    assert found.trials_to_hold.tolist() == [np.inf, 10, np.inf, 30]


def load_run_like(values, trial, final):
    from pathlib import Path

    from jaxpomdp.experiments.results import RunData

    evaluations = {"goal_percent": values, "trial": trial}
    return RunData(Path(), {}, [0], {"trial": np.full((4, 1), 40.0)}, evaluations, {}, final, 0.0)
