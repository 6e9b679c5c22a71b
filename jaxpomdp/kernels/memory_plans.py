"""Evaluation plans of chains with a memory: the posterior of many models on many tapes, whichever plan runs.

- ``pairs`` is the definition: ``smooth_pairs`` under two maps, ``O(N^3)`` a step.
- ``awake`` is ``pairs`` for models whose memory is awake; one that is asleep (never heeded, never kept) is
  the chain alone, and costs what that costs.
- ``native`` is the same in C++ (``native``), on CPU in float32 where it could be built: ``O((K + 1) N^2)`` a
  step, where ``K`` states are ever kept.
- ``auto`` takes ``native`` where it can, and ``awake`` elsewhere.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxpomdp._types import Array, Chain
from jaxpomdp.kernels import native
from jaxpomdp.kernels.filtering import linked_steps, trial_starts
from jaxpomdp.kernels.memory import MemoryChain, MemoryCounts, MemoryPosterior, smooth_pairs
from jaxpomdp.kernels.posterior import posterior
from jaxpomdp.numerics import NEG


def _pairs_plan(chains: MemoryChain, *tapes: Array) -> MemoryPosterior:
    """Take models one after the other: the forward pass of one holds ``[B, T, N, N]``."""
    return lax.map(lambda inputs: _of_pairs(*inputs), (chains, *tapes))


def _awake_plan(chains: MemoryChain, *tapes: Array) -> MemoryPosterior:
    """Leave pairs alone in models whose memory is asleep."""

    def of_model(inputs: Any) -> MemoryPosterior:
        chain, *own = inputs
        awake = jnp.any(chain.log_heed[:, 1] > NEG / 2) | jnp.any(chain.log_note[:, 1] > NEG / 2)
        return lax.cond(awake, _of_pairs, _asleep, chain, *own)

    return lax.map(of_model, (chains, *tapes))


def _of_pairs(chain: MemoryChain, *tapes: Array) -> MemoryPosterior:
    """Smooth every tape of one model, and add up the counts."""
    each = jax.vmap(partial(smooth_pairs, chain))(*tapes)
    sums = jax.tree.map(lambda x: jnp.sum(x, axis=0), (each.xi, each.initial, each.counts))
    return each._replace(xi=sums[0], initial=sums[1], counts=sums[2])


def _asleep(
    chain: MemoryChain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> MemoryPosterior:
    """Smooth the chain alone: what is remembered is the state one step before."""
    tapes = (log_obs, actions, start, valid)
    alone = Chain(chain.log_init[None], chain.log_trans[None])
    seen = jax.tree.map(lambda x: x[0], posterior(alone, *(x[None] for x in tapes)))
    starts, linked = trial_starts(start, valid), linked_steps(start, valid)
    before = jnp.roll(seen.gamma, 1, axis=1)
    held = jnp.where(valid[..., None], jnp.where(starts[..., None], seen.gamma, before), 0)
    noted = jnp.sum(jnp.where(linked[..., None], held, 0), axis=(0, 1))
    left, none = jnp.sum(seen.xi, axis=(0, 2)), jnp.zeros_like(noted)
    choices = (jnp.stack([x, none], axis=1) for x in (left, noted))
    counts = MemoryCounts(seen.xi, jnp.zeros_like(seen.xi), *choices)
    return MemoryPosterior(seen.log_evidence, seen.gamma, seen.xi, seen.initial, held, counts)


def _native_plan(
    chains: MemoryChain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> MemoryPosterior:
    """Hand the batch to the C++ loop."""
    model = MemoryChain(*map(jnp.exp, chains))
    return native.memory_estep(model, log_obs, actions.astype(jnp.int32), start, valid)


_PLANS = {"pairs": _pairs_plan, "awake": _awake_plan, "native": _native_plan}

PLANS = ("auto", *_PLANS)
"""Names of the evaluation plans."""


def choose_plan(plan: str, dtype: Any) -> str:
    """Resolve ``auto``, and check that a named plan can run here.

    Raises:
        ValueError: ``plan`` is not known, or is ``native`` where that cannot run.
    """
    chosen = native.resolved(plan, PLANS, dtype)
    return "awake" if chosen == "auto" else chosen


@partial(jax.jit, static_argnames="plan")
def _posterior(chains: MemoryChain, *tapes: Any, plan: str) -> MemoryPosterior:
    return _PLANS[plan](chains, *tapes)


def memory_posterior(
    chains: MemoryChain, log_obs: Array, actions: Array, start: Array, valid: Array, *, plan: str = "auto"
) -> MemoryPosterior:
    """Smooth ``B`` tapes under each of ``S`` models: ``smooth_pairs`` for many.

    Args:
        chains: with leading ``S``.
        log_obs: ``[S, B, T, N]``.
        actions: int ``[S, B, T]``.
        start: bool ``[S, B, T]``.
        valid: bool ``[S, B, T]``.
        plan: one of ``PLANS``; all give the same up to rounding.

    Returns:
        ``log_evidence[S, B]``, ``gamma`` and ``held`` ``[S, B, T, N]``; the rest are sums over the tapes.

    Raises:
        ValueError: ``plan`` is not known or cannot run here, or the shapes of ``log_init``, ``log_obs``,
            ``actions`` and flags do not fit.

    Source: thesis section 6.3.5.
    """
    chosen = choose_plan(plan, np.result_type(*(x.dtype for x in (log_obs, *chains))))
    for name, array in {"actions": actions, "start": start, "valid": valid}.items():
        if array.shape != log_obs.shape[:3]:
            raise ValueError(f"{name} must have shape {log_obs.shape[:3]} as log_obs, got {array.shape}")
    if chains.log_init.shape != (log_obs.shape[0], log_obs.shape[-1]):
        wanted = (log_obs.shape[0], log_obs.shape[-1])
        raise ValueError(f"log_init must have shape {wanted}, got {chains.log_init.shape}")
    return _posterior(chains, log_obs, actions, start, valid, plan=chosen)
