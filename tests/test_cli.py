"""The commands as a person types them, with an agent that is a stand-in."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import replace

import pytest

from jaxpomdp import cli
from jaxpomdp.experiments import runner
from jaxpomdp.experiments.grid import grid, parse_settings
from jaxpomdp.experiments.record import read_table
from tests.experiments.fake import FakeAgent, FakeConfig


@pytest.fixture(autouse=True)
def stand_in(monkeypatch):
    original = runner.named_agent

    def named_agent(name, world, settings):
        fake = name == "udhmm" and "theta" not in settings
        return FakeAgent(replace(FakeConfig(), **settings)) if fake else original(name, world, settings)

    monkeypatch.setattr(runner, "named_agent", named_agent)


def call(*words):
    return cli.main([str(word) for word in words])


def train(out, *more):
    return call(
        "train", "--out", out, "--seeds", 3, "--trials", 20, "--evaluate-every", 10,
        "--evaluation-trials", 5, "--final-trials", 6, "--progress", "none", *more,
    )  # fmt: skip


def test_train_evaluate_and_plot(tmp_path, capsys):
    assert train(tmp_path / "run") == 0
    said = capsys.readouterr().out
    assert "seed 2" in said
    assert "all (medians, mean)" in said
    assert call("evaluate", tmp_path / "run", "--trials", 4) == 0
    assert "4 greedy trials per seed, as it ended" in capsys.readouterr().out
    assert call("plot", tmp_path / "run", "--out", tmp_path / "curve.png") == 0
    assert (tmp_path / "curve.png").stat().st_size > 10_000


def test_the_same_command_resumes_and_another_is_refused(tmp_path, capsys):
    assert train(tmp_path) == 0
    first = (tmp_path / "trials.csv").read_bytes()
    assert train(tmp_path) == 0
    assert (tmp_path / "trials.csv").read_bytes() == first
    assert train(tmp_path, "--set", "speed=0.5") == 2
    assert "agent.speed: 0.02 -> 0.5" in capsys.readouterr().err


def test_mistakes_are_answered_with_the_choices(tmp_path, capsys, monkeypatch):
    assert train(tmp_path / "a", "--agent", "udhm") == 2
    said = capsys.readouterr().err
    assert "agent must be one of" in said
    assert "perseus" in said
    assert "did you mean 'udhmm'" in said
    assert train(tmp_path / "b", "--set", "theta=1", "gamma=0", "thetta=2") == 2
    assert "setting 'thetta' is unknown" in capsys.readouterr().err
    assert train(tmp_path / "b", "--set", "speed") == 2
    assert "name=value, got 'speed'" in capsys.readouterr().err
    assert call("evaluate", tmp_path / "nothing") == 2
    assert "no run directory" in capsys.readouterr().err
    assert call("reproduce", "table-31") == 2
    assert "did you mean 'table-3.1'" in capsys.readouterr().err
    assert call("reproduce") == 2
    assert "fig-3.10" in capsys.readouterr().err
    assert call("play", "--env", "maze8") == 2
    assert "did you mean 'maze89'" in capsys.readouterr().err
    monkeypatch.setenv("JAXPOMDP_TRACEBACK", "1")
    with pytest.raises(ValueError, match="name must be one of"):
        call("reproduce", "table-31")


def test_a_stopped_command_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(FakeAgent, "run", stop)
        assert train(tmp_path) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert train(tmp_path) == 0


@pytest.mark.parametrize("name", ["train", "evaluate", "play", "show", "plot", "sweep", "reproduce", "demo"])
def test_help_teaches_with_examples(name, capsys):
    with pytest.raises(SystemExit) as done:
        call(name, "--help")
    said = capsys.readouterr().out
    assert done.value.code == 0
    assert f"  jaxpomdp {name}" in said


def test_help_lists_the_commands(capsys):
    with pytest.raises(SystemExit):
        call()
    said = capsys.readouterr().out
    assert all(name in said for name in ("train", "reproduce", "demo"))


def test_without_tyro_the_answer_is_a_sentence(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tyro", None)
    assert call("demo") == 2
    assert "pip install 'jaxpomdp[cli]'" in capsys.readouterr().err


def test_sweep_runs_every_combination(tmp_path, capsys):
    words = (
        "sweep",
        "--out",
        tmp_path,
        "--vary",
        "speed=0.01,0.5",
        "--seeds",
        3,
        "--chunk",
        2,
        "--trials",
        10,
    )
    assert call(*words, "--progress", "none") == 0
    assert len(list(tmp_path.rglob("summary.json"))) == 4
    said = capsys.readouterr().out
    assert "speed 0.01" in said
    assert "speed 0.5" in said
    assert call("plot", tmp_path, "--out", tmp_path / "sweep.png") == 0


def test_grids_and_settings_refuse_what_is_not_of_the_form():
    with pytest.raises(ValueError, match="each setting once"):
        parse_settings(["a=1", "a=2"])
    with pytest.raises(ValueError, match="name=value"):
        grid(None, [], [], ["theta="])


def test_reproduce_writes_the_files_and_prints_the_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(runner, "named_agent", lambda *_: FakeAgent())
    work = ("--out", tmp_path / "results", "--work", tmp_path / "runs")
    assert call("reproduce", "fig-3.9", "--quick", "--progress", "none", *work) == 0
    assert "Figure 3.9" in capsys.readouterr().out
    written = json.loads((tmp_path / "results" / "fig-3.9.json").read_text())
    assert written["command"] == "jaxpomdp reproduce fig-3.9 --quick"


def test_demo_shows_a_table_and_draws(tmp_path, capsys):
    assert call("demo", "--out", tmp_path, "--seeds", 2, "--trials", 200, "--progress", "none") == 0
    said = capsys.readouterr().out
    assert "thesis: UDHMM" in said
    assert "here: UDHMM, 200 trials, median of 2 seeds" in said
    assert "the median agent is past the best policy without memory" in said
    assert (tmp_path / "figures" / "learning.png").stat().st_size > 10_000


def play(monkeypatch, text, *words):
    monkeypatch.setattr("sys.stdin", io.StringIO(text))
    return call("play", *words)


def test_play_keeps_score_and_shows_only_observations(tmp_path, capsys, monkeypatch):
    moves = "e\nwhat\n1\nn\ns\ne\ne\ns\nn\nq\n"
    assert play(monkeypatch, moves, "--env", "tmaze-1", "--seed", 2, "--out", tmp_path / "played.csv") == 0
    said = capsys.readouterr().out
    assert "no such action: north, east, south, west?" in said
    table = read_table(tmp_path / "played.csv")
    assert f"{len(table['steps'])} trial" in said
    assert table["steps"].min() >= 3
    assert set(table["success"]) <= {0, 1}
    signals = said.count("signal up >") + said.count("signal down >")
    assert signals >= len(table["steps"])


def test_play_is_the_same_game_for_the_same_seed(capsys, monkeypatch):
    games = []
    for _ in range(2):
        play(monkeypatch, "1\n2\n3\n4\n1\nq\n", "--seed", 5)
        games.append(capsys.readouterr().out)
    assert games[0] == games[1]
    assert "does not count" in games[0]
