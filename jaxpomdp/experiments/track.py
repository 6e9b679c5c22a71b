"""A live dashboard, if one is wanted: scalars for TensorBoard."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


class Tracker:
    """Writes means over seeds as TensorBoard events; without a path it writes nothing.

    Raises:
        ModuleNotFoundError: a path is given and tensorboardX is not installed.
    """

    def __init__(self, path: Path | None) -> None:
        self._writer: Any = None
        if path is None:
            return
        try:
            library = importlib.import_module("tensorboardX")
        except ModuleNotFoundError:
            raise ModuleNotFoundError("tracking needs tensorboardX: pip install 'jaxpomdp[track]'") from None
        self._writer = library.SummaryWriter(str(path))

    def write(self, group: str, trial: int, values: Mapping[str, np.ndarray]) -> None:
        """Write the mean over seeds of each value ``[S, ...]`` at a trial."""
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{name}", float(np.mean(value)), trial)

    def close(self) -> None:
        """Flush what was written."""
        if self._writer is not None:
            self._writer.close()
