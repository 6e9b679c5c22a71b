"""Learning to act in worlds that cannot be fully seen: action-conditioned HMMs with utility, in JAX.

The public names below load their module when they are first used, so importing the package costs nothing but
itself, and runs where Gymnasium, matplotlib and the command line's libraries are not installed.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxpomdp._types import Chain as Chain
    from jaxpomdp._types import Posterior as Posterior
    from jaxpomdp._types import TrialBatch as TrialBatch

__version__ = "0.1.0"

_HOMES = {
    "Chain": "jaxpomdp._types",
    "Posterior": "jaxpomdp._types",
    "TrialBatch": "jaxpomdp._types",
}
_ROOMS = ("agents", "cli", "envs", "experiments", "kernels", "models", "numerics", "packing", "structure")

__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """Load a public name, or a room of the house, when it is first asked for (PEP 562)."""
    if name in _ROOMS:
        return import_module(f"jaxpomdp.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'jaxpomdp' has no public name {name!r}; there are {', '.join(__all__)}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, *_ROOMS, "__version__"]
