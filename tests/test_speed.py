"""The speed benchmark: its page says what was measured, and what goes wrong in a part stays there."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

import pytest

SPEED = Path(__file__).resolve().parents[1] / "benchmarks" / "speed"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(SPEED)
    return importlib.import_module


def test_the_page_shows_times_shares_and_who_was_left_out(load: Any) -> None:
    page, loads = load("page"), load("workloads").LOADS
    row = {"milliseconds": 2.0, "times_ours": 1.0, "compile_seconds": 0.25, "note": "plan `grouped`"}
    result = {
        "name": "speed-gpu",
        "device": "A GPU",
        "machine": "a CPU",
        "limits": {"gflops": loads["W1"].flop / 1e6, "gbytes": loads["W1"].bytes / 0.2e6},
        "W1": {"what": "much", "contestants": {"ours": row}, "left_out": {"dynamax": "ImportError"}},
        "W5": {"21": {"ours, a model each": 1e6}, "left_out": {}},
        "W6": {"cold": {"stopped_after": 60.0, "trials": 250}},
        "problems": {"W3": "exit status -9", "W1": ""},
    }
    text = page.page(result)
    assert "| ours | 2 | 1 | 0.25 | - | 50 % | 10 % | plan `grouped` |" in text
    for told in ("A GPU (a CPU)", "dynamax (ImportError)", "- W3: exit status -9", "](speed-gpu.png)"):
        assert told in text
    assert "- W1" not in text


def test_a_step_of_an_agent_costs_what_its_equations_say(load: Any) -> None:
    cost = load("workloads").step_cost
    matrix, values = 70 * 70, 70 * 5
    assert cost(own_model=True).bytes - cost(own_model=False).bytes == 4 * matrix
    assert cost(own_model=True).flop == 2 * matrix + 5 * values + 6 * 70


@pytest.mark.parametrize(
    ("shares", "told"), [((0.3, 0.2), "arithmetic"), ((0.1, 0.9), "bandwidth"), ((0.1, 3.0), "cache")]
)
def test_what_is_nearer_to_its_limit_bounds(load: Any, shares: tuple[float, float], told: str) -> None:
    bound = load("page").bound
    assert bound(*shares) == told
    assert bound(0.05, 0.04) == "latency"


def test_a_line_cut_short_is_no_result(load: Any) -> None:
    newest = load("processes").newest
    assert newest('noise\n{"W5": 1}\n{"W5": 1, "W6": {"co') == {"W5": 1}
    assert newest("") == {}


def test_a_task_that_fails_says_why(load: Any) -> None:
    processes = load("processes")
    assert processes.last_result("nothing", processes.Settings(), math.inf) == {
        "error": "KeyError: 'nothing'"
    }
