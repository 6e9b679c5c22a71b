"""Kernels in C++ behind JAX's foreign function interface: on the CPU, in float32, where a compiler is found.

``available()`` says whether they can be used; its first call compiles them, once per machine (some seconds).
The others work under ``jit``, ``vmap`` and inside loops as any JAX function does, but have no derivatives.
They use the cores that the process may run on, or as many threads as the environment variable
``JAXPOMDP_THREADS`` says; results do not depend on that. ``JAXPOMDP_NATIVE=0`` turns all of it off.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from jaxpomdp.kernels.native.build import loaded
from jaxpomdp.kernels.native.control import Acted, ActingModel, WorldTables, act, sarsa_replay
from jaxpomdp.kernels.native.inference import coupled_estep, estep, filter_tapes, marginal_estep, memory_estep

__all__ = [
    "Acted",
    "ActingModel",
    "WorldTables",
    "act",
    "available",
    "coupled_estep",
    "estep",
    "filter_tapes",
    "marginal_estep",
    "memory_estep",
    "resolved",
    "sarsa_replay",
]


def available() -> bool:
    """Say whether the native kernels can be used here: JAX computes on the CPU, and the library was built."""
    return jax.default_backend() == "cpu" and loaded()


def resolved(plan: str, plans: Sequence[str], dtype: Any) -> str:
    """Return the plan, for ``auto`` ``native`` where it can run; elsewhere ``auto`` stays to be chosen.

    Args:
        plan: one of ``plans``.
        plans: names of plans; ``auto`` and ``native`` are among them.
        dtype: of the numbers.

    Raises:
        ValueError: ``plan`` is not known, or is ``native`` where that cannot run.
    """
    if plan not in plans:
        raise ValueError(f"plan must be one of {plans}, got {plan!r}")
    fits = plan in ("auto", "native") and dtype == jnp.float32 and available()
    if plan == "native" and not fits:
        raise ValueError(f"plan 'native' needs float32 on a CPU with a compiler, got {jnp.dtype(dtype).name}")
    return "native" if fits else plan
