"""Trained agents out of run directories, and what a directory can be that is none."""

from __future__ import annotations

import numpy as np
import pytest

from jaxpomdp.experiments import runner
from jaxpomdp.experiments.arrays import flatten
from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.record import RunDirectoryError, read_json, write_json
from jaxpomdp.experiments.report import labels, merge_by_configuration, plot_runs, run_report
from jaxpomdp.experiments.restore import config_of, find_runs, restore
from tests.experiments.fake import FakeAgent, build_fake

CONFIG = RunConfig(agent="fake", seeds=(3, 4), trials=10, final_trials=4, settings=(("speed", 0.5),))


@pytest.fixture
def done(tmp_path):
    return runner.run(CONFIG, tmp_path / "run", make=build_fake, progress="none")


@pytest.fixture
def stopped(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(FakeAgent, "finish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            runner.run(CONFIG, tmp_path / "stopped", make=build_fake, progress="none")
    return tmp_path / "stopped"


def test_the_configuration_comes_back(done):
    assert config_of(done) == CONFIG


def test_a_complete_run_gives_the_agent_as_it_ended(done, stopped):
    found, unfinished = restore(done, build_fake), restore(stopped, build_fake)
    assert found.complete
    assert not unfinished.complete
    for name, array in flatten(found.state).items():
        np.testing.assert_array_equal(array, flatten(unfinished.state)[name])


def test_changed_presets_are_named(done):
    description = read_json(done / "config.json")
    write_json(
        done / "config.json", {**description, "agent": {**description["agent"], "trials_per_phase": 7}}
    )
    with pytest.raises(RunDirectoryError, match=r"agent\.trials_per_phase: 7 -> 5"):
        restore(done, build_fake)


def test_what_is_no_run_is_refused(tmp_path, done):
    with pytest.raises(RunDirectoryError, match="no run directory"):
        config_of(tmp_path)
    with pytest.raises(RunDirectoryError, match="no run directory in an empty list"):
        find_runs([])
    write_json(done / "config.json", {"run": {"settings": [], "seeds": [1], "colour": "red"}})
    with pytest.raises(RunDirectoryError, match="of another version"):
        config_of(done)


def test_a_run_without_a_commit_has_no_model(stopped):
    (stopped / "checkpoint.npz").unlink()
    with pytest.raises(RunDirectoryError, match="no model yet"):
        restore(stopped, build_fake)


def test_curves_are_labelled_by_what_differs(tmp_path):
    configs = [RunConfig(**{**CONFIG.__dict__, "settings": (("speed", x),)}) for x in (0.1, 0.9)]
    more = RunConfig(**{**configs[0].__dict__, "seeds": (8,)})
    for i, config in enumerate([*configs, more]):
        runner.run(config, tmp_path / "runs" / str(i), make=build_fake, progress="none")
    runs = merge_by_configuration([tmp_path / "runs"])
    assert [run.seeds for run in runs] == [[3, 4, 8], [3, 4]]
    assert labels(runs) == ["speed 0.1", "speed 0.9"]
    assert labels(runs[:1]) == ["maze89, fake"]


def test_runs_without_trials_have_no_curve(tmp_path):
    runner.run(RunConfig(agent="fake", trials=0, final_trials=2), tmp_path, make=build_fake, progress="none")
    with pytest.raises(RunDirectoryError, match="nothing to plot"):
        plot_runs([tmp_path], tmp_path / "x.png")


def test_the_report_says_what_each_seed_scored(done):
    lines = run_report(done).splitlines()
    assert lines[0] == "4 greedy trials per seed, as it ended:"
    assert [line.split("  ")[0] for line in lines[2:-1]] == ["seed 3", "seed 4", "all (medians, mean)"]
