"""Where the time of a round goes."""

from __future__ import annotations

import time
from typing import Any

import jax


class Clock:
    """Seconds spent by name."""

    def __init__(self) -> None:
        self.spent = dict.fromkeys(("acting", "fitting", "structure", "replaying"), 0.0)
        self._last = time.perf_counter()

    def lap(self, name: str, after: Any = None) -> None:
        """Charge the time since the last lap to ``name``, once ``after`` is computed."""
        jax.block_until_ready(after)
        now = time.perf_counter()
        self.spent[name] += now - self._last
        self._last = now
