"""Evaluation plans of coupled chains: the posterior of many models on many tapes, whichever plan runs.

- ``scan`` is the definition: ``smooth_joint``, or approximately ``smooth_marginals``, mapped.
- ``native`` is the same in C++ (``native``) for two chains, on CPU in float32 where it could be built.
- ``auto`` takes ``native`` where it can, and ``scan`` elsewhere.

None has an array of the size of a pair times a pair.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.kernels import native
from jaxpomdp.kernels.coupled import CoupledChain, CoupledPosterior, check_two
from jaxpomdp.kernels.coupled_exact import smooth_joint
from jaxpomdp.kernels.coupled_marginals import smooth_marginals_of_tapes

Rows = tuple[Array, ...]


def _added(each: CoupledPosterior) -> CoupledPosterior:
    """Add the counts of each model's tapes."""
    xi, initial = (tuple(jnp.sum(x, axis=1) for x in part) for part in (each.xi, each.initial))
    return each._replace(xi=xi, initial=initial)


def _mapped(kernel: Any, chains: CoupledChain, *tapes: Any) -> CoupledPosterior:
    """Map a kernel over tapes and models."""
    over_tapes = jax.vmap(kernel, in_axes=(None, 0, 0, 0, 0))
    return _added(jax.vmap(over_tapes)(chains, *tapes))


def _turned(tables: Rows) -> Rows:
    """Exchange the two chains in their tables, ``[S, A, N_1, N_2, N_c]`` each."""
    return tuple(jnp.swapaxes(table, 2, 3) for table in tables[::-1])


def _in_native(
    kernel: Any, chains: CoupledChain, log_obs: Rows, actions: Array, *flags: Array
) -> CoupledPosterior:
    """Hand the batch to a C++ loop, the larger chain last, whose states fill its vectors."""
    if chains.log_init[0].shape[-1] > chains.log_init[1].shape[-1]:
        turned = CoupledChain(chains.log_init[::-1], _turned(chains.log_trans))
        seen = _in_native(kernel, turned, log_obs[::-1], actions, *flags)
        return CoupledPosterior(seen.log_evidence, seen.gamma[::-1], _turned(seen.xi), seen.initial[::-1])
    init, trans = (tuple(map(jnp.exp, tables)) for tables in chains)
    return kernel(init, trans, log_obs, actions.astype(jnp.int32), *flags)


_EXACT = {"scan": partial(_mapped, smooth_joint), "native": partial(_in_native, native.coupled_estep)}
_MARGINAL = {
    "scan": jax.vmap(smooth_marginals_of_tapes),
    "native": partial(_in_native, native.marginal_estep),
}

PLANS = ("auto", *_EXACT)
"""Names of the evaluation plans, of exact inference and of the sweep over marginals."""


def choose_plan(plan: str, chains: CoupledChain, log_obs: Rows = ()) -> str:
    """Resolve ``auto``, and check that a named plan can run here.

    Raises:
        ValueError: ``plan`` is not known or cannot run here.
    """
    number = len(chains.log_init)
    if plan == "native" and number != 2:
        raise ValueError(f"plan 'native' needs two chains, got {number}")
    if plan == "auto" and number != 2:
        return "scan"
    dtype = np.result_type(*(x.dtype for x in (*chains.log_init, *chains.log_trans, *log_obs)))
    chosen = native.resolved(plan, PLANS, dtype)
    return "scan" if chosen == "auto" else chosen


@partial(jax.jit, static_argnames="plan")
def _exact(chains: CoupledChain, *tapes: Any, plan: str) -> CoupledPosterior:
    return _EXACT[plan](chains, *tapes)


@partial(jax.jit, static_argnames="plan")
def _marginal(chains: CoupledChain, *tapes: Any, plan: str) -> CoupledPosterior:
    return _MARGINAL[plan](chains, *tapes)


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
        ValueError: ``plan`` is not known or cannot run here, there are not two chains, or the shapes do not
            fit.

    Source: thesis section 3.4; Brand (1997), Zhong and Ghosh (2001) for the couplings.
    """
    check_two(chains)
    chosen = choose_plan(plan, chains, log_obs)
    _check_shapes(chains, log_obs, actions, start, valid)
    return _exact(chains, log_obs, actions, start, valid, plan=chosen)


def marginal_posterior(
    chains: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array, *, plan: str = "auto"
) -> CoupledPosterior:
    """Smooth as ``coupled_posterior`` but approximately, and any number of chains: ``smooth_marginals``.

    Args:
        chains: ``log_init[c][S, N_c]``, ``log_trans[c][S, A, N_1, ..., N_C, N_c]``.
        log_obs: ``[S, B, T, N_c]`` for each chain.
        actions: int ``[S, B, T]``.
        start: bool ``[S, B, T]``.
        valid: bool ``[S, B, T]``.
        plan: one of ``PLANS``; ``native`` takes two chains.

    Returns:
        As ``coupled_posterior``, of as many chains as there are; the log-evidence is approximate too.

    Raises:
        ValueError: ``plan`` is not known or cannot run here, or the shapes do not fit.

    Source: Boyen and Koller (1998, 1999).
    """
    chosen = choose_plan(plan, chains, log_obs)
    _check_shapes(chains, log_obs, actions, start, valid)
    return _marginal(chains, log_obs, actions, start, valid, plan=chosen)


def _check_shapes(chains: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array) -> None:
    """Raise if the leading axes disagree, naming the argument."""
    for name, array in {"start": start, "valid": valid}.items():
        if array.shape != actions.shape:
            raise ValueError(f"{name} must have shape {actions.shape} as actions, got {array.shape}")
    sizes = tuple(x.shape[-1] for x in chains.log_init)
    for c, (row, table) in enumerate(zip(log_obs, chains.log_trans, strict=True)):
        if chains.log_init[c].shape[:-1] != actions.shape[:1]:
            got = chains.log_init[c].shape
            raise ValueError(f"log_init[{c}] must have shape {(actions.shape[0], sizes[c])}, got {got}")
        if row.shape != (*actions.shape, sizes[c]):
            raise ValueError(f"log_obs[{c}] must have shape {(*actions.shape, sizes[c])}, got {row.shape}")
        if table.shape[2:] != (*sizes, sizes[c]) or table.shape[0] != actions.shape[0]:
            wanted = f"[{actions.shape[0]}, A, {', '.join(map(str, (*sizes, sizes[c])))}]"
            raise ValueError(f"log_trans[{c}] must have shape {wanted}, got {table.shape}")
