"""The sizes that keep the code readable: short functions and files of one thought."""

from __future__ import annotations

import ast
import statistics
from pathlib import Path

import jaxpomdp

PACKAGE = Path(jaxpomdp.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))


def code_lines(function: ast.FunctionDef, source: list[str]) -> int:
    """Count a function's lines of code: without its docstring, blank lines and lines of comment."""
    body = function.body[1:] if ast.get_docstring(function) is not None else function.body
    if not body:
        return 1
    signature = source[function.lineno - 1 : function.body[0].lineno - 1]
    text = source[body[0].lineno - 1 : function.end_lineno]
    return sum(1 for line in (*signature, *text) if line.strip() and not line.strip().startswith("#"))


def function_sizes() -> dict[str, int]:
    sizes = {}
    for file in FILES:
        text = file.read_text()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                label = f"{file.relative_to(PACKAGE)}:{node.lineno} {node.name}"
                sizes[label] = code_lines(node, text.splitlines())
    return sizes


def test_functions_are_short() -> None:
    sizes = function_sizes()
    assert {label: size for label, size in sizes.items() if size > 60} == {}
    assert statistics.median(sizes.values()) <= 10
    assert statistics.quantiles(sizes.values(), n=10)[-1] <= 30


def test_files_are_of_one_thought() -> None:
    lengths = {str(file.relative_to(PACKAGE)): len(file.read_text().splitlines()) for file in FILES}
    assert {name: length for name, length in lengths.items() if length >= 350} == {}
