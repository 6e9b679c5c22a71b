"""README tables are made from results."""

from __future__ import annotations

import importlib.util
from pathlib import Path

from jaxpomdp.experiments import thesis
from jaxpomdp.experiments.record import write_json
from jaxpomdp.experiments.reproduce import markdown_table

SCRIPT = Path(__file__).resolve().parents[2] / "benchmarks" / "thesis" / "readme.py"
RESULT = {"rows": [{"row": "human", "published": {"goal_percent": 100}, "measured": {}}]}
TEXT = "before\n<!-- table-3.1 -->\nold\n<!-- end -->\nbetween\n<!-- fig-3.4 -->\n<!-- end -->\n"


def script():
    spec = importlib.util.spec_from_file_location("readme", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_with_a_result_are_filled_and_others_left_alone(tmp_path):
    write_json(tmp_path / "table-3.1.json", RESULT)
    made = script().filled(TEXT, tmp_path)
    assert markdown_table(thesis.find("table-3.1"), RESULT) in made
    assert "old" not in made
    assert made.endswith("between\n<!-- fig-3.4 -->\n<!-- end -->\n")
    assert script().filled(made, tmp_path) == made
