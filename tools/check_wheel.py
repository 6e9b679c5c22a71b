"""Check an installed jaxpomdp from outside its repository: public names, data, the command's manners."""

from __future__ import annotations

import subprocess
import sys
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

import jaxpomdp

SOURCES = ("kernels/native", ".cc")


def check_names() -> None:
    """Load every public name."""
    for name in jaxpomdp.__all__:
        getattr(jaxpomdp, name)


def check_native_source() -> None:
    """The C++ source must travel with the wheel, since it is compiled where it runs."""
    folder = resources.files("jaxpomdp").joinpath(SOURCES[0])
    if not any(entry.name.endswith(SOURCES[1]) for entry in folder.iterdir()):
        sys.exit(f"the wheel lacks the C++ source: no *{SOURCES[1]} in {SOURCES[0]}")


def check_command() -> None:
    """Without the extra, the command must say how to get it, without a traceback."""
    command = Path(sys.executable).with_name("jaxpomdp")
    done = subprocess.run([command, "--help"], capture_output=True, text=True, check=False)
    if find_spec("tyro") is None and ("jaxpomdp[cli]" not in done.stderr or "Traceback" in done.stderr):
        sys.exit(f"`jaxpomdp --help` without the extra said:\n{done.stdout}{done.stderr}")


if __name__ == "__main__":
    check_names()
    check_native_source()
    check_command()
    print(f"jaxpomdp {jaxpomdp.__version__} works from {Path(jaxpomdp.__file__).parent}")
