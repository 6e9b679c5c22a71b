"""Print one pinned version for everything that jaxpomdp with all its extras needs, without addresses."""

from __future__ import annotations

import json
import subprocess
import sys

COMMAND = (
    *(sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"),
    *("--report", "-", ".[dev,cluster,track,neural]"),
)
HEADER = """\
# The versions that the results were measured with: pip install -c constraints.txt '.[dev]'
# Written by `make constraints`."""


def main() -> None:
    """Ask pip what it would install afresh, and print it sorted."""
    report = json.loads(subprocess.run(COMMAND, capture_output=True, text=True, check=True).stdout)
    found = {item["metadata"]["name"]: item["metadata"]["version"] for item in report["install"]}
    found.pop("jaxpomdp")
    print(HEADER)
    for name in sorted(found, key=str.lower):
        print(f"{name}=={found[name]}")


if __name__ == "__main__":
    main()
