"""Where the time of a run goes."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import jax
import numpy as np

PARTS = ("acting", "fitting", "structure", "replaying")
"""What agents report of a phase."""
COMPILING = ("/jax/core/compile/jaxpr_to_mlir_module_duration", "/jax/core/compile/backend_compile_duration")


class Stopwatch:
    """Seconds by part of a run.

    Attributes:
        spent: seconds by name: the agent's parts, ``evaluating``, ``compiling`` (XLA's share of the others,
            tracing not counted), and ``all``.
    """

    def __init__(self, spent: Mapping[str, float] | None = None) -> None:
        self.spent = dict(spent or {})
        self._last = time.monotonic()

    def add(self, name: str, seconds: float) -> None:
        """Charge seconds to a part."""
        self.spent[name] = self.spent.get(name, 0.0) + seconds

    def add_phase(self, phase: Mapping[str, np.ndarray]) -> None:
        """Charge what an agent reports of a phase, one value for each seed, all the same."""
        for name in PARTS:
            if name in phase:
                self.add(name, float(phase[name][0]))

    @contextmanager
    def measuring(self, name: str) -> Iterator[None]:
        """Charge what happens inside to a part."""
        begun = time.monotonic()
        yield
        self.add(name, time.monotonic() - begun)

    @contextmanager
    def counting_compilation(self) -> Iterator[None]:
        """Charge what JAX compiles inside to ``compiling``."""

        def listen(event: str, seconds: float, **_: object) -> None:
            if event in COMPILING:
                self.add("compiling", seconds)

        jax.monitoring.register_event_duration_secs_listener(listen)
        try:
            yield
        finally:
            jax.monitoring.unregister_event_duration_listener(listen)

    def total(self) -> dict[str, float]:
        """Return the seconds by part up to now, rounded."""
        now = time.monotonic()
        self.add("all", now - self._last)
        self._last = now
        return {name: round(seconds, 3) for name, seconds in self.spent.items()}


def in_words(spent: Mapping[str, float]) -> str:
    """Return the seconds as a line, the total first.

    >>> in_words({"acting": 3.2, "all": 10.0})
    '10.0 s: acting 3.2'
    """
    parts = ", ".join(f"{name} {seconds:.1f}" for name, seconds in spent.items() if name != "all")
    return f"{spent.get('all', 0.0):.1f} s: {parts}" if parts else f"{spent.get('all', 0.0):.1f} s"
