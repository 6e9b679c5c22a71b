"""Inference in C++: expected counts of flat, coupled and remembering chains, and filtering.

Shapes: ``S`` models, ``B`` rows, ``T`` steps, ``N`` states, ``A`` actions.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Posterior
from jaxpomdp.kernels.coupled import CoupledPosterior
from jaxpomdp.kernels.memory import MemoryChain, MemoryCounts, MemoryPosterior
from jaxpomdp.kernels.native.arguments import check, float32

Rows = tuple[Array, Array]


def _check_tapes(
    init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array
) -> None:
    """Check the arguments of ``estep`` and ``filter_tapes`` against one another."""
    if jnp.ndim(log_obs) != 4 or jnp.ndim(trans) != 4:
        raise ValueError(
            "log_obs must have shape [S, B, T, N] and trans [S, A, N, N], "
            f"got {list(jnp.shape(log_obs))} and {list(jnp.shape(trans))}"
        )
    models, rows, steps, states = jnp.shape(log_obs)
    check("init", init, (models, states), jnp.float32)
    check("trans", trans, (models, jnp.shape(trans)[1], states, states), jnp.float32)
    check("log_obs", log_obs, (models, rows, steps, states), jnp.float32)
    check("actions", actions, (models, rows, steps), jnp.int32)
    check("start", start, (models, rows, steps), jnp.bool_)
    check("valid", valid, (models, rows, steps), jnp.bool_)


def estep(init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Smooth all rows of all models: ``kernels.smoothing.smooth`` for each, counts summed over rows.

    Args:
        init: probabilities float32 ``[S, N]``.
        trans: probabilities float32 ``[S, A, N, N]`` (row: from, column: to).
        log_obs: float32 ``[S, B, T, N]``; a missing step is a row of zeros.
        actions: int32 ``[S, B, T]``; the last of a trial is ignored.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.

    Returns:
        ``Posterior``: ``log_evidence[S, B]``, ``gamma[S, B, T, N]``, ``xi[S, A, N, N]``, ``initial[S, N]``.

    Raises:
        ValueError: an argument of another shape or dtype.

    Source: Rabiner (1989); thesis section 3.3.
    """
    _check_tapes(init, trans, log_obs, actions, start, valid)
    results = float32(actions.shape[:2], log_obs.shape, trans.shape, init.shape)
    call = jax.ffi.ffi_call("jaxpomdp_estep", results, vmap_method="broadcast_all")
    return Posterior(*call(init, trans, log_obs, actions, start, valid))


def coupled_estep(
    init: tuple[Array, Array],
    trans: tuple[Array, Array],
    log_obs: tuple[Array, Array],
    actions: Array,
    start: Array,
    valid: Array,
) -> CoupledPosterior:
    """Smooth all rows of all models of two chains: ``coupled_exact.smooth_joint`` for each, counts summed.

    Fastest where the second chain is the one of more states.

    Args:
        init: probabilities float32 ``[S, N_c]`` of each chain.
        trans: probabilities float32 ``[S, A, N_1, N_2, N_c]``.
        log_obs: float32 ``[S, B, T, N_c]``; a missing step is a row of zeros.
        actions: int32 ``[S, B, T]``; the last of a trial is ignored.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.

    Returns:
        ``log_evidence[S, B]``, ``gamma[c][S, B, T, N_c]``, ``xi[c]`` as ``trans[c]``, ``initial[c]`` as
        ``init[c]``.

    Raises:
        ValueError: an argument of another shape or dtype.

    Source: thesis section 3.4; Brand (1997) for the factored form.
    """
    return _coupled("jaxpomdp_coupled", init, trans, log_obs, actions, start, valid)


def marginal_estep(
    init: tuple[Array, Array],
    trans: tuple[Array, Array],
    log_obs: tuple[Array, Array],
    actions: Array,
    start: Array,
    valid: Array,
) -> CoupledPosterior:
    """Smooth as ``coupled_estep`` but approximately: ``coupled_marginals.smooth_marginals`` for each tape.

    Source: Boyen and Koller (1998; 1999 for the backward sweep).
    """
    return _coupled("jaxpomdp_marginals", init, trans, log_obs, actions, start, valid)


def _coupled(
    kernel: str, init: Rows, trans: Rows, log_obs: Rows, actions: Array, start: Array, valid: Array
) -> CoupledPosterior:
    """Check the arguments of a kernel of two chains against one another, and call it."""
    if jnp.ndim(trans[0]) != 5 or jnp.ndim(actions) != 3:
        shapes = f"{list(jnp.shape(trans[0]))} and {list(jnp.shape(actions))}"
        raise ValueError(
            f"trans[0] must have shape [S, A, N_1, N_2, N_1] and actions [S, B, T], got {shapes}"
        )
    batch, (_, moves, *sizes) = jnp.shape(actions), jnp.shape(trans[0])[:4]
    for c, states in enumerate(sizes):
        check(f"init[{c}]", init[c], (batch[0], states), jnp.float32)
        check(f"trans[{c}]", trans[c], (batch[0], moves, *sizes, states), jnp.float32)
        check(f"log_obs[{c}]", log_obs[c], (*batch, states), jnp.float32)
    check("actions", actions, batch, jnp.int32)
    check("start", start, batch, jnp.bool_)
    check("valid", valid, batch, jnp.bool_)
    results = float32(batch[:2], *(x.shape for x in (*log_obs, *trans, *init)))
    call = jax.ffi.ffi_call(kernel, results, vmap_method="broadcast_all")
    evidence, *rest = call(*init, *trans, *log_obs, actions, start, valid)
    return CoupledPosterior(evidence, tuple(rest[:2]), tuple(rest[2:4]), tuple(rest[4:]))


def memory_estep(
    model: MemoryChain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> MemoryPosterior:
    """Smooth all rows of all models with a memory: ``memory.smooth_pairs`` for each, counts summed over rows.

    Time is ``O((K + 1) N^2)`` a step, where ``K`` states of a model are ever kept in memory.

    Args:
        model: probabilities float32, not logarithms, with leading ``S``; rows of ``note`` sum to one.
        log_obs: float32 ``[S, B, T, N]``; a missing step is a row of zeros.
        actions: int32 ``[S, B, T]``; the last of a trial is ignored.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.

    Returns:
        ``log_evidence[S, B]``, ``gamma`` and ``held`` ``[S, B, T, N]``; the rest are sums over the rows.

    Raises:
        ValueError: an argument of another shape or dtype.

    Source: thesis section 6.3.5.
    """
    init, trans, lead, heed, note = model
    _check_tapes(init, trans, log_obs, actions, start, valid)
    check("lead", lead, trans.shape, jnp.float32)
    for name, choice in (("heed", heed), ("note", note)):
        check(name, choice, (*init.shape, 2), jnp.float32)
    shapes = (actions.shape[:2], log_obs.shape, trans.shape, init.shape, log_obs.shape)
    results = float32(*shapes, *(x.shape for x in model[1:]))
    call = jax.ffi.ffi_call("jaxpomdp_memory", results, vmap_method="broadcast_all")
    evidence, gamma, xi, initial, held, *counts = call(*model, log_obs, actions, start, valid)
    return MemoryPosterior(evidence, gamma, xi, initial, held, MemoryCounts(*counts))


def filter_tapes(
    init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array
) -> tuple[Array, Array]:
    """Filter all rows of all models: ``kernels.filtering.filter_tape`` for each.

    Where the evidence of a step underflows, the row is filtered again in logarithms, so that a state whose
    probability no float32 holds can come back.

    Args:
        init: probabilities float32 ``[S, N]``.
        trans: probabilities float32 ``[S, A, N, N]``.
        log_obs: float32 ``[S, B, T, N]``.
        actions: int32 ``[S, B, T]``.
        start: bool ``[S, B, T]``.
        valid: bool ``[S, B, T]``.

    Returns:
        ``belief[S, B, T, N]`` and ``log_norm[S, B, T]``, both zero at padding.

    Raises:
        ValueError: an argument of another shape or dtype.
    """
    _check_tapes(init, trans, log_obs, actions, start, valid)
    results = float32(log_obs.shape, actions.shape)
    call = jax.ffi.ffi_call("jaxpomdp_filter", results, vmap_method="broadcast_all")
    belief, log_norm = call(init, trans, log_obs, actions, start, valid)
    return belief, log_norm
