"""Compile the native kernels once per machine, into the user's cache, and load them once per process.

All of it may fail (no compiler, no headers, a home that cannot be written): then there is no library, and
callers take another route. The reason is logged at level INFO.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib.metadata
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax

FOLDER = Path(__file__).parent
SOURCE = FOLDER / "estep.cc"
TARGETS = {
    "jaxpomdp_estep": "JaxpomdpEstep",
    "jaxpomdp_filter": "JaxpomdpFilter",
    "jaxpomdp_coupled": "JaxpomdpCoupled",
    "jaxpomdp_marginals": "JaxpomdpMarginals",
    "jaxpomdp_memory": "JaxpomdpMemory",
    "jaxpomdp_replay": "JaxpomdpReplay",
    "jaxpomdp_act": "JaxpomdpAct",
}
"""Names of the custom calls, and the symbols that serve them."""

FLAGS = ("-O2", "-march=native", "-std=c++17", "-ffp-contract=fast", "-w", "-fPIC", "-shared", "-pthread")
SECONDS_TO_COMPILE = 300
_LOG = logging.getLogger(__name__)


def compiler() -> str | None:
    """Return the path of the system's C++ compiler (``$CXX`` first), or None."""
    names = (os.environ.get("CXX"), "g++", "clang++", "c++")
    return next((path for name in names if name and (path := shutil.which(name))), None)


def cache_dir() -> Path:
    """Return ``$XDG_CACHE_HOME/jaxpomdp``, by default ``~/.cache/jaxpomdp``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxpomdp"


def processor() -> str:
    """Describe the processor: what is compiled for one kind must not run on another that shares the home."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    telling = {line for line in lines if line.startswith(("flags", "Features", "model name", "CPU part"))}
    return "\n".join([platform.machine(), platform.processor(), *sorted(telling)])


def library_path(command: str) -> Path:
    """Name the library by all that it depends on: sources, compiler, flags, jaxlib and processor."""
    version = subprocess.run([command, "--version"], capture_output=True, text=True, timeout=60, check=True)
    sources = [path.read_text() for path in sorted(FOLDER.glob("*.[ch]*"))]
    parts = (*sources, command, version.stdout, *FLAGS, importlib.metadata.version("jaxlib"), processor())
    return cache_dir() / f"native-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:32]}.so"


def build(command: str, path: Path) -> None:
    """Compile next to ``path``, then rename: other processes see the whole library or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / path.name
        arguments = [command, *FLAGS, "-I", jax.ffi.include_dir(), str(SOURCE), "-o", str(made)]
        subprocess.run(arguments, capture_output=True, text=True, timeout=SECONDS_TO_COMPILE, check=True)
        made.replace(path)


def load() -> None:
    """Build the library unless it is there, load it, and register its kernels with JAX.

    Raises:
        OSError: no compiler, or the library cannot be written or loaded.
        subprocess.SubprocessError: the compiler failed.
    """
    command = compiler()
    if command is None:
        raise OSError("no C++ compiler found")
    path = library_path(command)
    if not path.exists():
        build(command, path)
    library = ctypes.CDLL(str(path))
    for name, symbol in TARGETS.items():
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(library, symbol)), platform="cpu")


@functools.cache
def loaded() -> bool:
    """Say whether the kernels could be built and loaded; False if turned off. Tried once per process."""
    if os.environ.get("JAXPOMDP_NATIVE") == "0":
        return False
    try:
        load()
    except Exception as error:  # whatever goes wrong, there is another route
        _LOG.info("no native kernels: %s %s", error, getattr(error, "stderr", None) or "")
        return False
    return True
