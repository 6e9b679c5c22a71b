"""Kernels in C++ behind JAX's foreign function interface: on the CPU, in float32, where a compiler is found.

``available()`` says whether they can be used; its first call compiles them, once per machine (some seconds).
The others work under ``jit``, ``vmap`` and inside loops as any JAX function does, but have no derivatives.
They use the cores that the process may run on, or as many threads as the environment variable
``JAXPOMDP_THREADS`` says; results do not depend on that. ``JAXPOMDP_NATIVE=0`` turns all of it off.
"""

from __future__ import annotations

import jax

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
    "sarsa_replay",
]


def available() -> bool:
    """Say whether the native kernels can be used here: JAX computes on the CPU, and the library was built."""
    return jax.default_backend() == "cpu" and loaded()
