"""Evaluation plans of coupled chains: the posterior of many models on many tapes, whichever plan runs.

- ``scan`` is the definition: ``smooth_joint`` under two maps.
- ``batched`` (and ``auto``) carries all tapes of all models through time at once.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array
from jaxpomdp.kernels.coupled import CoupledChain, CoupledPosterior
from jaxpomdp.kernels.coupled_exact import smooth_joint
from jaxpomdp.kernels.coupled_marginals import smooth_marginals

Rows = tuple[Array, ...]


def _added(each: CoupledPosterior) -> CoupledPosterior:
    """Add the counts of each model's tapes."""
    xi, initial = (tuple(jnp.sum(x, axis=1) for x in part) for part in (each.xi, each.initial))
    return each._replace(xi=xi, initial=initial)


def _mapped(kernel: Any, chains: CoupledChain, *tapes: Any) -> CoupledPosterior:
    """Map a kernel over tapes and models."""
    over_tapes = jax.vmap(kernel, in_axes=(None, 0, 0, 0, 0))
    return _added(jax.vmap(over_tapes)(chains, *tapes))


PLANS = {"auto": partial(_mapped, smooth_joint), "scan": partial(_mapped, smooth_joint)}
"""The evaluation plans of exact inference."""


@partial(jax.jit, static_argnames="plan")
def _posterior(chains: CoupledChain, *tapes: Any, plan: str) -> CoupledPosterior:
    return PLANS[plan](chains, *tapes)


def coupled_posterior(
    chains: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array, *, plan: str = "auto"
) -> CoupledPosterior:
    """Smooth ``B`` tapes under each of ``S`` models of two chains, exactly: ``smooth_joint`` for many.

    Args:
        chains: ``log_init[c][S, N_c]``, ``log_trans[c][S, A, N_1, N_2, N_c]``.
        log_obs: ``[S, B, T, N_c]`` for each chain.
        actions: int ``[S, B, T]``.
        start: bool ``[S, B, T]``.
        valid: bool ``[S, B, T]``.
        plan: one of ``PLANS``; all give the same up to rounding.

    Returns:
        ``log_evidence[S, B]``, ``gamma[c][S, B, T, N_c]``; ``xi`` and ``initial``, sums over the tapes.

    Raises:
        ValueError: ``plan`` is not known, there are not two chains, or the shapes do not fit.
    """
    if plan not in PLANS:
        raise ValueError(f"plan must be one of {tuple(PLANS)}, got {plan!r}")
    _check_shapes(chains, log_obs, actions, start, valid)
    return _posterior(chains, log_obs, actions, start, valid, plan=plan)


@partial(jax.jit, static_argnames="plan")
def marginal_posterior(
    chains: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array, *, plan: str = "auto"
) -> CoupledPosterior:
    """Smooth as ``coupled_posterior``, approximately, and for any number of chains: ``smooth_marginals``.

    There is one plan; ``plan`` is taken for the sake of the signature.
    """
    _check_shapes(chains, log_obs, actions, start, valid)
    return _mapped(smooth_marginals, chains, log_obs, actions, start, valid)


def _check_shapes(chains: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array) -> None:
    """Raise if the leading axes disagree, naming the argument."""
    for name, array in {"start": start, "valid": valid}.items():
        if array.shape != actions.shape:
            raise ValueError(f"{name} must have shape {actions.shape} as actions, got {array.shape}")
    sizes = tuple(x.shape[-1] for x in chains.log_init)
    for c, (row, table) in enumerate(zip(log_obs, chains.log_trans, strict=True)):
        if row.shape != (*actions.shape, sizes[c]):
            raise ValueError(f"log_obs[{c}] must have shape {(*actions.shape, sizes[c])}, got {row.shape}")
        if table.shape[2:] != (*sizes, sizes[c]) or table.shape[0] != actions.shape[0]:
            wanted = f"[{actions.shape[0]}, A, {', '.join(map(str, (*sizes, sizes[c])))}]"
            raise ValueError(f"log_trans[{c}] must have shape {wanted}, got {table.shape}")
