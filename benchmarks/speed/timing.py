"""Timing in turns: every contestant once a round, so that a busy machine slows all alike; medians count."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from functools import partial

import jax
import jax.numpy as jnp

Call = Callable[[], object]

LACKING = (MemoryError, ImportError, ValueError, RuntimeError)
"""What keeps a contestant from running here; JAX reports a full device as a RuntimeError."""


def reason(error: BaseException) -> str:
    """Say in a line why a contestant does not run."""
    if "RESOURCE_EXHAUSTED" in str(error):
        return "does not fit in the device's memory"
    return f"{type(error).__name__}: {next(iter(str(error).splitlines()), '')[:200]}"


def on_cpu() -> bool:
    """Say whether JAX computes on the CPU."""
    return jax.default_backend() == "cpu"


def seconds(call: Call) -> float:
    """Return how long one call takes."""
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


TURN = 0.1
"""Seconds that a turn of short calls lasts: the first of them still finds the threads of the one before."""


def turn(call: Call) -> list[float]:
    """Return how long each call of a turn takes: one, or as many short ones as fill ``TURN``."""
    taken = [seconds(call)]
    while sum(taken) < TURN:
        taken.append(seconds(call))
    return taken


def medians(calls: Mapping[str, Call], rounds: int, budget: float) -> dict[str, float]:
    """Return the median over turns of the median seconds of a call, each turn in its round.

    Who used up its budget sits out the remaining rounds.
    """
    taken: dict[str, list[float]] = {name: [] for name in calls}
    spent = dict.fromkeys(calls, 0.0)
    for _ in range(rounds):
        for name, call in calls.items():
            if spent[name] < budget:
                times = turn(call)
                spent[name] += sum(times)
                taken[name].append(statistics.median(times))
    return {name: statistics.median(times) for name, times in taken.items()}


def limits(rounds: int = 5) -> dict[str, float]:
    """Return what this machine can do: GFLOP/s of a large matrix product, GB/s of reading and writing.

    ``gflops`` is in the full precision of float32, which our kernels ask for; ``gflops_default`` in JAX's own
    choice, where accelerators round the factors to fewer bits.
    """
    size, length = (2048, 1 << 26) if on_cpu() else (8192, 1 << 30)
    square = jax.random.normal(jax.random.key(0), (size, size))
    long = jnp.ones(length, jnp.float32)
    scale = jax.jit(lambda x: x * 1.5)
    work = {"gbytes": (lambda: scale(long), 8.0 * length)}
    for name, precision in (("gflops", "highest"), ("gflops_default", "default")):
        product = jax.jit(partial(jnp.matmul, precision=precision))
        work[name] = (partial(product, square, square), 2.0 * size**3)
    calls = {name: _waiting(call) for name, (call, _) in work.items()}
    for call in calls.values():
        call()
    taken = medians(calls, rounds, 60)
    return {name: amount / taken[name] / 1e9 for name, (_, amount) in work.items()}


def _waiting(call: Call) -> Call:
    return lambda: jax.block_until_ready(call())
