"""Compile the native kernels once per machine, into the user's cache, and load them once per process.

Everything here may fail (no compiler, no headers, a read-only home): then there is no library and callers take
another route. The reason is logged at level INFO.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

import jax
import jaxlib

SOURCE = Path(__file__).with_name("estep.cc")
TARGETS = {"jaxpomdp_estep": "JaxpomdpEstep", "jaxpomdp_filter": "JaxpomdpFilter"}
"""Names of the custom calls, and the symbols that serve them."""

FLAGS = ("-O3", "-march=native", "-std=c++17", "-ffp-contract=fast", "-fPIC", "-shared", "-pthread")
SECONDS_TO_COMPILE = 300
_LOG = logging.getLogger(__name__)


def compiler() -> str | None:
    """Return the path of the system's C++ compiler (``$CXX`` first), or None."""
    names = (os.environ.get("CXX"), "g++", "clang++", "c++")
    return next((path for name in names if name and (path := shutil.which(name))), None)


def cache_dir() -> Path:
    """Return ``$XDG_CACHE_HOME/jaxpomdp``, by default ``~/.cache/jaxpomdp``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxpomdp"


def _processor() -> str:
    """Describe the processor: code compiled for one kind must not run on another that shares the home."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    telling = {line for line in lines if line.startswith(("flags", "Features", "model name", "CPU part"))}
    return "\n".join([platform.machine(), platform.processor(), *sorted(telling)])


def _version(command: str) -> str:
    return subprocess.run([command, "--version"], capture_output=True, text=True, timeout=60, check=True).stdout


def library_path(command: str) -> Path:
    """Name the library by all that it depends on: source, compiler, flags, jaxlib and processor."""
    parts = (SOURCE.read_text(), command, _version(command), *FLAGS, jaxlib.__version__, _processor())
    return cache_dir() / f"native-{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:32]}.so"


def _compile(command: str, path: Path) -> None:
    """Compile next to ``path``, then rename: other processes see the whole library or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder) / path.name
        arguments = [command, *FLAGS, "-I", jax.ffi.include_dir(), str(SOURCE), "-o", str(made)]
        subprocess.run(arguments, capture_output=True, text=True, timeout=SECONDS_TO_COMPILE, check=True)
        made.replace(path)


def _load() -> None:
    command = compiler()
    if command is None:
        raise OSError("no C++ compiler found")
    path = library_path(command)
    if not path.exists():
        _compile(command, path)
    library = ctypes.CDLL(str(path))
    for name, symbol in TARGETS.items():
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(getattr(library, symbol)), platform="cpu")


@functools.cache
def loaded() -> bool:
    """Compile if needed, load and register the kernels; False if that is turned off or fails. Tried once."""
    if os.environ.get("JAXPOMDP_NATIVE") == "0":
        return False
    try:
        _load()
    except Exception as error:  # whatever goes wrong, there is another route
        _LOG.info("no native kernels: %s %s", error, getattr(error, "stderr", "") or "")
        return False
    return True
