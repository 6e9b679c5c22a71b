"""Progress where it is shown: a bar on a terminal, a plain line now and then elsewhere, or nothing."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self, TextIO

SECONDS_BETWEEN_LINES = 10.0


class Progress:
    """A counter with a text: a tqdm bar if tqdm is there and ``stream`` is a terminal, else plain lines.

    Args:
        name: said first.
        total: what the count runs up to.
        kind: ``"auto"``, ``"lines"`` or ``"none"``.
        stream: standard error by default.
        seconds: between plain lines.
    """

    def __init__(
        self,
        name: str,
        total: int,
        kind: str = "auto",
        stream: TextIO | None = None,
        seconds: float = SECONDS_BETWEEN_LINES,
    ) -> None:
        self.name, self.total, self.kind, self.seconds = name, total, kind, seconds
        self.stream = sys.stderr if stream is None else stream
        self._started = self._said = time.monotonic()
        self._bar = self._make_bar() if kind == "auto" and self.stream.isatty() else None

    def _make_bar(self) -> Any:
        bar = find_tqdm()
        if bar is None:
            return None
        form = "{desc} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}] {postfix}"
        return bar(total=self.total, desc=self.name, file=self.stream, bar_format=form, dynamic_ncols=True)

    def update(self, done: int, text: str = "") -> None:
        """Show that ``done`` of the total are behind us."""
        if self._bar is not None:
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update(done - self._bar.n)
        elif self.kind != "none" and (done >= self.total or time.monotonic() - self._said >= self.seconds):
            self._said = time.monotonic()
            self.say(f"{self.name} {done}/{self.total} [{self._said - self._started:.0f} s] {text}".rstrip())

    def say(self, text: str) -> None:
        """Print a line without breaking the bar."""
        if self._bar is not None:
            self._bar.write(text, file=self.stream)
        elif self.kind != "none":
            print(text, file=self.stream, flush=True)

    def __enter__(self) -> Self:
        """Return the counter itself."""
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the bar."""
        if self._bar is not None:
            self._bar.close()


def find_tqdm() -> Callable[..., Any] | None:
    """Return tqdm's bar, or None where it is not installed."""
    try:
        from tqdm import tqdm
    except ImportError:
        return None
    return tqdm
