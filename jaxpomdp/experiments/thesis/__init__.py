"""The thesis's tables and figures, one file each: settings, published figures with their source, plot.

To add one, put a file here that defines ``EXPERIMENT``; its command is ``jaxpomdp reproduce`` and its name.
"""

from __future__ import annotations

import importlib
import pkgutil

from jaxpomdp.experiments.config import did_you_mean
from jaxpomdp.experiments.experiment import Experiment


def experiments() -> dict[str, Experiment]:
    """Return every experiment by name, in the order of the file names."""
    modules = [importlib.import_module(f"{__name__}.{info.name}") for info in pkgutil.iter_modules(__path__)]
    found = [module.EXPERIMENT for module in modules if hasattr(module, "EXPERIMENT")]
    return {experiment.name: experiment for experiment in found}


def find(name: str) -> Experiment:
    """Return an experiment by name.

    Raises:
        ValueError: there is none of this name.
    """
    known = experiments()
    if name not in known:
        hint = did_you_mean(name, known)
        raise ValueError(f"name must be one of {', '.join(known)} or all, got {name!r}{hint}")
    return known[name]
