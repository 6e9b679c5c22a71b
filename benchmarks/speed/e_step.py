"""Times one E-step under every plan, and one re-estimation of hmmlearn beside it, all in one run.

    python benchmarks/speed/e_step.py [ROUNDS]

hmmlearn has neither actions nor batches of models: it gets one model with one action and as many steps, which
is less work than ours. Rounds go around all contestants in turn, so that a busy machine slows them alike; the
median counts.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp import Chain
from jaxpomdp.kernels.posterior import PLANS, posterior


class Workload(NamedTuple):
    """``S`` models, each with ``B`` tapes of ``T`` steps; ``N`` states, ``A`` actions, ``O`` symbols."""

    models: int
    tapes: int
    steps: int
    states: int
    actions: int
    symbols: int


WORKLOADS = {
    "hallway": Workload(models=21, tapes=12, steps=64, states=16, actions=4, symbols=16),
    "89-state maze": Workload(models=21, tapes=50, steps=251, states=70, actions=5, symbols=17),
}


LARGEST_SCAN = 32
"""The scan plan, the definition of the others, takes a minute an E-step with many states: left out there."""


def draw(load: Workload) -> tuple[Chain, jax.Array, jax.Array, jax.Array, jax.Array]:
    """Draw the arguments of ``posterior``."""
    keys = jax.random.split(jax.random.key(0), 5)
    shape = (load.models, load.tapes, load.steps)
    trans = jax.random.dirichlet(
        keys[0], jnp.ones(load.states), (load.models, load.actions, load.states), jnp.float32
    )
    init = jax.random.dirichlet(keys[1], jnp.ones(load.states), (load.models,), jnp.float32)
    emit = jax.random.dirichlet(keys[2], jnp.ones(load.symbols), (load.models, load.states), jnp.float32)
    seen = jax.random.randint(keys[3], shape, 0, load.symbols)
    log_obs = jax.vmap(lambda table, o: jnp.log(table).T[o])(emit, seen)
    actions = jax.random.randint(keys[4], shape, 0, load.actions)
    start = jnp.zeros(shape, bool).at[..., 0].set(True)
    chain = Chain(jnp.log(init), jnp.log(trans))
    return chain, log_obs, actions, start, jnp.ones(shape, bool)


def ours(load: Workload, plan: str) -> Callable[[], object]:
    """Return a call of ``posterior``, compiled."""
    arguments = draw(load)

    def call() -> object:
        return jax.block_until_ready(posterior(*arguments, plan=plan))

    call()
    return call


def hmmlearn(load: Workload) -> Callable[[], object]:
    """Return a call of hmmlearn's ``fit`` with one iteration, on as many steps."""
    from hmmlearn.hmm import CategoricalHMM

    rows = load.models * load.tapes
    symbols = np.random.default_rng(0).integers(load.symbols, size=(rows * load.steps, 1))
    model = CategoricalHMM(load.states, n_iter=1, implementation="scaling", n_features=load.symbols)
    model.fit(symbols, [load.steps] * rows)
    model.init_params = ""  # go on from there, instead of from a new draw
    return lambda: model.fit(symbols, [load.steps] * rows)


def contestants(load: Workload) -> dict[str, Callable[[], object]]:
    """Return every plan that runs on this machine and is not hopeless, and the peer."""
    calls = {}
    for plan in PLANS:
        if plan == "scan" and load.states > LARGEST_SCAN:
            continue
        try:
            calls[plan] = ours(load, plan)
        except (ValueError, RuntimeError) as refusal:
            print(f"  {plan}: not here ({refusal})")
    return {**calls, "hmmlearn (no actions)": hmmlearn(load)}


def medians(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Time every call once a round; return the median milliseconds of each."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            taken[name].append(1e3 * (time.perf_counter() - begin))
    return {name: statistics.median(times) for name, times in taken.items()}


def main(rounds: int) -> None:
    """Print a table for each workload."""
    for title, load in WORKLOADS.items():
        print(f"\n{title}: {load.models} models x {load.tapes} tapes x {load.steps} steps, N = {load.states}")
        times = medians(contestants(load), rounds)
        for name, value in times.items():
            print(f"  {name:24}{value:10.1f} ms{value / times['auto']:8.1f} x auto")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
