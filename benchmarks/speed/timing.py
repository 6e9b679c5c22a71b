"""Timing in turns: every contestant once a round, so that a busy machine slows all alike; medians count."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp

Call = Callable[[], object]


def seconds(call: Call) -> float:
    """Return how long one call takes."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def medians(calls: Mapping[str, Call], rounds: int, budget: float) -> dict[str, float]:
    """Return the median seconds of each call; one that used up its budget sits out the remaining rounds."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            if sum(taken[name]) < budget:
                taken[name].append(seconds(call))
    return {name: statistics.median(times) for name, times in taken.items()}


def limits(rounds: int = 5) -> dict[str, float]:
    """Return what this machine can do: GFLOP/s of a large matrix product, GB/s of reading and writing."""
    square = jnp.ones((2048, 2048), jnp.float32)
    product = jax.jit(lambda x: jnp.matmul(x, x))
    long = jnp.ones(1 << 26, jnp.float32)
    scale = jax.jit(lambda x: x * 1.5)
    calls = {
        "gemm": lambda: jax.block_until_ready(product(square)),
        "stream": lambda: jax.block_until_ready(scale(long)),
    }
    for call in calls.values():
        call()
    taken = medians(calls, rounds, 60)
    return {"gflops": 2 * 2048**3 / taken["gemm"] / 1e9, "gbytes": 2 * 4 * (1 << 26) / taken["stream"] / 1e9}
