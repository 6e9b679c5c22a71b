"""Every experiment from its file to its four results, with an agent that is a stand-in."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from jaxpomdp.experiments import thesis
from jaxpomdp.experiments.experiment import summarise
from jaxpomdp.experiments.reproduce import Effort, markdown_table, reproduce
from tests.experiments.fake import FakeAgent

NAMES = tuple(thesis.experiments())


def stand_in(config):
    return None, FakeAgent()


def effort(tmp_path, **settings):
    return Effort(quick=True, progress="none", work=tmp_path / "runs", out=tmp_path / "results", **settings)


@pytest.mark.parametrize("name", NAMES)
def test_every_experiment_writes_its_results(tmp_path, name):
    experiment = thesis.find(name)
    result = reproduce(experiment, effort(tmp_path), make=stand_in)
    written = json.loads((tmp_path / "results" / f"{name}.json").read_text())
    assert written == result
    assert set(written) == {"name", "command", "versions", "settings", "seeds", "seconds", "rows"}
    assert written["seeds"] == [1000, 1001]
    assert [row["row"] for row in written["rows"]] == [row.name for row in experiment.rows]
    for row, source in zip(written["rows"], experiment.rows, strict=True):
        assert set(row) == {"row", "published", "measured", "per_seed"}
        assert bool(row["measured"]) == (source.run is not None)
        for metric in row["measured"].values():
            assert set(metric) == {"value", "low", "high"}
    assert (tmp_path / "results" / f"{name}.png").stat().st_size > 10_000
    for suffix in ("csv", "md"):
        text = (tmp_path / "results" / f"{name}.{suffix}").read_text()
        assert all(row.name in text for row in experiment.rows)


def test_a_second_time_runs_nothing(tmp_path, monkeypatch):
    experiment = thesis.find("fig-3.9")
    first = reproduce(experiment, effort(tmp_path), make=stand_in)
    monkeypatch.setattr(FakeAgent, "run", lambda *_: pytest.fail("ran again"))
    assert reproduce(experiment, effort(tmp_path), make=stand_in) == first


def test_figures_share_their_runs(tmp_path, monkeypatch):
    reproduce(thesis.find("fig-3.9"), effort(tmp_path), make=stand_in)
    monkeypatch.setattr(FakeAgent, "run", lambda *_: pytest.fail("ran again"))
    reproduce(thesis.find("fig-3.10"), effort(tmp_path), make=stand_in)


def test_effort_sets_seeds_and_trials_but_leaves_what_does_not_train(tmp_path):
    experiment = thesis.find("table-3.1")
    rows = tuple(row for row in experiment.rows if row.name in ("random walk", "UDHMM, θ = 0"))
    result = reproduce(
        replace(experiment, rows=rows), effort(tmp_path, trials=10, first_seed=5), make=stand_in
    )
    assert result["seeds"] == [5, 6]
    assert [run["trials"] for run in result["settings"].values()] == [0, 10]


def test_unknown_names_are_answered_with_the_known_ones():
    with pytest.raises(ValueError, match=r"table-3\.1.*did you mean 'table-3\.1'"):
        thesis.find("table-31")
    assert set(NAMES) <= set(thesis.experiments())


def scores(goal, steps, late=None):
    per_seed = {"goal_percent": goal, "median_steps": steps, "mean_steps": steps, "mean_reward": goal}
    per_seed = {name: np.array(x, float) for name, x in (per_seed | {"mean_discounted": goal}).items()}
    if late is None:
        return per_seed
    held = np.isfinite(late)
    return per_seed | {"success_held": held, "success_ever": held, "trials_to_hold": np.array(late, float)}


def test_the_median_run_gives_its_own_steps():
    metrics = summarise(scores([80, 99, 90], [70, 20, 250]))
    assert metrics["goal_percent"].value == 90
    assert metrics["median_steps"].value == 70
    assert metrics["median_run_steps"].value == 250
    assert metrics["worst_goal_percent"].value == 80
    assert metrics["mean_goal_percent"].value == pytest.approx(269 / 3)


@pytest.mark.parametrize(
    ("late", "value"), [([10, 20, np.inf], 20), ([10, np.inf, np.inf], np.inf), ([np.inf] * 3, np.inf)]
)
def test_runs_that_never_hold_are_infinitely_late(late, value):
    assert summarise(scores([1, 2, 3], [1, 2, 3], late))["trials_to_hold"].value == value


def test_tables_print_published_beside_measured():
    experiment = thesis.find("table-3.1")
    one = dict.fromkeys(("value", "low", "high"), 251.0)
    rows = [
        {"row": "a", "published": {"median_steps": ">251"}, "measured": {"median_steps": one}},
        {"row": "b", "published": {"goal_percent": 100}, "measured": {}},
    ]
    lines = markdown_table(experiment, {"rows": rows}).splitlines()
    assert lines[2].startswith("| a |  |  | >251 | >251 |")
    assert lines[3].startswith("| b | 100 |  |  |  |")
