"""Run the Python blocks of a document in order, as a reader would who pastes them one after another."""

from __future__ import annotations

import re
import sys
from pathlib import Path


def python_blocks(text: str) -> list[str]:
    """Give the contents of the fenced blocks marked ``python``."""
    return re.findall(r"^```python\n(.*?)^```", text, flags=re.MULTILINE | re.DOTALL)


def run_blocks(document: Path) -> int:
    """Run every block with the names that the blocks before it left, and return how many there were."""
    names: dict[str, object] = {"__name__": "__document__"}
    blocks = python_blocks(document.read_text(encoding="utf-8"))
    for number, block in enumerate(blocks, start=1):
        exec(compile(block, f"{document.name}, python block {number}", "exec"), names)
    return len(blocks)


if __name__ == "__main__":
    for argument in sys.argv[1:]:
        print(f"{run_blocks(Path(argument))} examples of {argument} ran")
