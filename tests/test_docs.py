"""Runs what the documents show: the examples in docstrings, and the Python blocks of the README in order."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import jaxpomdp
from tools.run_readme import run_blocks

ROOT = Path(__file__).resolve().parents[1]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
README = ROOT / "README.md"


def modules() -> list[str]:
    found = pkgutil.walk_packages(jaxpomdp.__path__, prefix="jaxpomdp.")
    return ["jaxpomdp", *sorted(module.name for module in found)]


@pytest.mark.parametrize("name", modules())
def test_docstring_examples(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert results.failed == 0


@pytest.mark.slow
def test_readme_examples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each block may use what the blocks before it defined; asserts in them are part of the example."""
    monkeypatch.chdir(tmp_path)
    assert run_blocks(README) == README.read_text().count("```python")


def test_pictures_and_files_that_the_readme_names_exist() -> None:
    targets = re.findall(r"\]\(([^)#]+?)\)|src=\"([^\"]+)\"", README.read_text())
    local = [link or source for link, source in targets if "://" not in (link or source)]
    assert [path for path in local if not (ROOT / path).exists()] == []
