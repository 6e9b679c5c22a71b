"""Fill the tables of README.md from benchmarks/results/*.json; --check only says whether they are up to date.

A table stands between ``<!-- NAME -->`` and ``<!-- end -->``, NAME being that of an experiment (table-3.1).
"""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

from jaxpomdp.experiments import thesis
from jaxpomdp.experiments.reproduce import markdown_table

ROOT = Path(__file__).resolve().parents[2]
PLACE = re.compile(
    r"(<!-- (?P<name>(?!end )[a-z]+(?:-[\w.]+)*) -->\n)(?P<table>.*?)(<!-- end -->)", re.DOTALL
)


def filled(text: str, results: Path) -> str:
    """Return the text with every table whose result is there; a table without a result stays as it is."""
    known = thesis.experiments()

    def table(place: re.Match[str]) -> str:
        file = results / f"{place['name']}.json"
        if place["name"] not in known or not file.exists():
            return place[0]
        made = markdown_table(known[place["name"]], json.loads(file.read_text()))
        return f"{place[1]}\n{made}\n\n{place[4]}"

    return PLACE.sub(table, text)


def main(arguments: list[str]) -> int:
    readme = ROOT / "README.md"
    before = readme.read_text()
    after = filled(before, ROOT / "benchmarks" / "results")
    if "--check" in arguments:
        print(
            "README.md is up to date"
            if before == after
            else "README.md differs: run benchmarks/thesis/readme.py"
        )
        return int(before != after)
    readme.write_text(after)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
