"""Evaluation plans: the posterior of many models on many tapes, with one result whichever plan runs.

``scan`` is the definition: ``smooth`` under two maps. The other plans carry the whole batch through time at
once, so that each step is a few large matrix products.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Chain, Posterior
from jaxpomdp.kernels.smoothing import smooth

PLANS = ("auto", "scan")


def _scan_plan(chains: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Map ``smooth`` over tapes and models, then add the counts of each model's tapes."""
    over_tapes = jax.vmap(smooth, in_axes=(None, 0, 0, 0, 0))
    each = jax.vmap(over_tapes)(chains, log_obs, actions, start, valid)
    return each._replace(xi=jnp.sum(each.xi, axis=1), initial=jnp.sum(each.initial, axis=1))


@partial(jax.jit, static_argnames="plan")
def posterior(
    chains: Chain, log_obs: Array, actions: Array, start: Array, valid: Array, *, plan: str = "auto"
) -> Posterior:
    """Smooth ``B`` tapes under each of ``S`` models.

    Args:
        chains: ``log_init[S, N]``, ``log_trans[S, A, N, N]``.
        log_obs: ``[S, B, T, N]``.
        actions: int ``[S, B, T]``.
        start: bool ``[S, B, T]``.
        valid: bool ``[S, B, T]``.
        plan: one of ``PLANS``.

    Returns:
        ``log_evidence[S, B]``, ``gamma[S, B, T, N]``, ``xi[S, A, N, N]``, ``initial[S, N]``; the last two are
        sums over the tapes.

    Raises:
        ValueError: ``plan`` is not known.
    """
    if plan not in PLANS:
        raise ValueError(f"plan must be one of {PLANS}, got {plan!r}")
    return _scan_plan(chains, log_obs, actions, start, valid)
