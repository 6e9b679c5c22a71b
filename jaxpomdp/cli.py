"""The command line: ``jaxpomdp COMMAND``, parsed by tyro from the commands' frozen dataclasses."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Union

from jaxpomdp.experiments.commands import COMMANDS
from jaxpomdp.kernels.native.build import cache_dir, processor

ABOUT = """Agents that learn to act in worlds they cannot fully see.

  jaxpomdp demo                                             five agents learn the 89-state maze
  jaxpomdp train --env tmaze-10 --seeds 5 --out runs/tmaze  the same command resumes it
  jaxpomdp plot runs/tmaze                                  learning curves
  jaxpomdp show runs/tmaze                                  its belief as it walks, and its model
  jaxpomdp reproduce table-3.1                              the thesis beside what is measured here

jaxpomdp COMMAND --help says more and gives examples."""


def parse(arguments: Sequence[str]) -> Any:
    """Return the command of a command line; ends the process where help is asked for or a flag is wrong.

    Raises:
        ModuleNotFoundError: tyro is not installed.
    """
    try:
        import tyro
    except ModuleNotFoundError:
        raise ModuleNotFoundError("the command line needs tyro: pip install 'jaxpomdp[cli]'") from None
    name, *rest = arguments or ["--help"]
    if name in COMMANDS:
        kind = COMMANDS[name]
        about = inspect.getdoc(kind)
        marks = () if name in FLAGS_ONLY else (tyro.conf.PositionalRequiredArgs,)
        return tyro.cli(kind, prog=f"jaxpomdp {name}", description=about, args=rest, config=marks)
    choices = [Annotated[(kind, _subcommand(tyro, each, kind))] for each, kind in COMMANDS.items()]
    either: Any = Union[tuple(choices)]  # noqa: UP007
    return tyro.cli(either, prog="jaxpomdp", description=ABOUT, args=[name, *rest])


FLAGS_ONLY = ("train", "sweep")
"""Commands whose required fields are flags; those of the others are given without one."""


def _subcommand(tyro: Any, name: str, kind: type) -> Any:
    """Return what the list of commands says of one: the first line of its help."""
    first = (inspect.getdoc(kind) or "").splitlines()[0]
    return tyro.conf.subcommand(name, prefix_name=False, description=first)


def environment() -> dict[str, str]:
    """Return the variables that make long runs fast, which libraries read when a process starts.

    Large pages, kept rather than given back, halve Baum-Welch's time, much of which is page faults; and what
    JAX compiled is kept for the next command. A variable that the user has set stays as it is.
    """
    kept = cache_dir() / f"xla-{hashlib.sha256(processor().encode()).hexdigest()[:16]}"
    wanted = {
        "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
        "MALLOC_MMAP_MAX_": "0",
        "MALLOC_TRIM_THRESHOLD_": "20000000000",
        "JAX_COMPILATION_CACHE_DIR": str(kept),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    return {name: value for name, value in wanted.items() if name not in os.environ}


def restart(missing: dict[str, str]) -> None:
    """Start this process again with more in its environment; where that is impossible, go on without."""
    if not missing or not sys.executable or not sys.platform.startswith("linux"):
        return
    with contextlib.suppress(OSError):
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | missing)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line and return its exit status: 2 after a mistake, said in one line on standard error.

    ``JAXPOMDP_TRACEBACK=1`` in the environment shows where an error came from.
    """
    if arguments is None:
        restart(environment())
    try:
        parse(sys.argv[1:] if arguments is None else arguments).run()
    except (ValueError, OSError, ModuleNotFoundError) as error:
        if os.environ.get("JAXPOMDP_TRACEBACK"):
            raise
        print(f"jaxpomdp: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\njaxpomdp: stopped; the same command goes on where it was", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
