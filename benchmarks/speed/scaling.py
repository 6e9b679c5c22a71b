"""``seeds``: how an E-step like W2's grows with the number of models, until the device's memory is full."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from timing import LACKING, medians, on_cpu, reason, seconds
from workloads import LOADS, Load, log_likelihood

from jaxpomdp import Chain
from jaxpomdp.kernels.posterior import posterior

MODELS = (1, 4, 21, 84, 336, 1344, 5376)
ON_A_CPU = 4
"""So many of these on a CPU, whose memory is not the limit here."""

BUDGET = 3.0


@partial(jax.jit, static_argnums=0)
def drawn(load: Load, key: jax.Array) -> tuple[Any, ...]:
    """Draw models and trials as ``workloads.draw`` does, on the device."""
    keys = jax.random.split(key, 5)

    def rows(key: jax.Array, *shape: int) -> jax.Array:
        weight = jax.random.exponential(key, shape) ** 2 + 1e-6
        return jnp.log(weight / jnp.sum(weight, axis=-1, keepdims=True))

    chains = Chain(
        rows(keys[0], load.models, load.states),
        rows(keys[1], load.models, load.actions, load.states, load.states),
    )
    shape = (load.models, load.trials, load.steps)
    emit = jnp.exp(rows(keys[2], load.models, load.states, load.symbols))
    log_obs = jax.vmap(log_likelihood)(emit, jax.random.randint(keys[3], shape, 0, load.symbols))
    start = jnp.zeros(shape, bool).at[..., 0].set(True)
    return chains, log_obs, jax.random.randint(keys[4], shape, 0, load.actions), start, jnp.ones_like(start)


def timed(load: Load, plans: list[str], rounds: int) -> tuple[dict[str, float], dict[str, str]]:
    """Return the seconds of an E-step under each plan, and why others failed."""
    calls, failed = {}, {}
    try:
        arguments = jax.block_until_ready(drawn(load, jax.random.key(load.models)))
    except LACKING as error:
        return {}, dict.fromkeys(plans, reason(error))
    for plan in plans:
        call = partial(_finished, plan, arguments)
        try:
            seconds(call)
            calls[plan] = call
        except LACKING as error:
            failed[plan] = reason(error)
    return medians(calls, rounds, BUDGET), failed


def _finished(plan: str, arguments: tuple[Any, ...]) -> None:
    jax.block_until_ready(posterior(*arguments, plan=plan))


def seeds(rounds: int) -> Iterator[dict[str, Any]]:
    """Yield milliseconds of an E-step for each number of models and plan."""
    plans = ["auto"] if on_cpu() else ["grouped", "scan", "blocked"]
    rows, failed = [], {}
    for models in MODELS[: ON_A_CPU if on_cpu() else None]:
        load = LOADS["W2"]._replace(models=models)
        taken, lacking = timed(load, [plan for plan in plans if plan not in failed], rounds)
        gc.collect()
        failed |= {plan: f"{models:,} models: {why}" for plan, why in lacking.items()}
        if taken:
            best = min(taken.values())
            rows.append(
                {
                    "models": models,
                    "milliseconds": {plan: 1e3 * value for plan, value in taken.items()},
                    "models_per_second": models / best,
                }
            )
        yield {"seeds": {"what": str(LOADS["W2"]._replace(models=1)), "rows": rows, "failed": failed}}
