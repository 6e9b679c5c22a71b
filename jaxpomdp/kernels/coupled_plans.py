"""Evaluation plans of coupled chains: the posterior of many models on many tapes, whichever plan runs.

- ``scan`` is the definition: ``smooth_joint`` under two maps; no array has the size of a pair times a pair.
- ``pairs`` writes the pair of states down as one chain, for the C++ loop of ``posterior``, which skips pairs
  of no weight; on CPU in float32 where it could be built. It takes the memory of a flat chain of ``N_1 N_2``
  states.
- ``auto`` takes ``pairs`` where it can and there are no more than ``MOST_PAIRS``, and ``scan`` elsewhere.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Chain, Posterior
from jaxpomdp.kernels import native
from jaxpomdp.kernels.coupled import CoupledChain, CoupledPosterior, check_two, joint_density
from jaxpomdp.kernels.coupled_exact import smooth_joint
from jaxpomdp.kernels.coupled_marginals import smooth_marginals_of_tapes
from jaxpomdp.kernels.posterior import posterior
from jaxpomdp.numerics import NEG

Rows = tuple[Array, ...]


def _added(each: CoupledPosterior) -> CoupledPosterior:
    """Add the counts of each model's tapes."""
    xi, initial = (tuple(jnp.sum(x, axis=1) for x in part) for part in (each.xi, each.initial))
    return each._replace(xi=xi, initial=initial)


def _mapped(kernel: Any, chains: CoupledChain, *tapes: Any) -> CoupledPosterior:
    """Map a kernel over tapes and models."""
    over_tapes = jax.vmap(kernel, in_axes=(None, 0, 0, 0, 0))
    return _added(jax.vmap(over_tapes)(chains, *tapes))


MOST_PAIRS = 1024
"""Pairs of states up to which ``auto`` writes them down as one chain."""


def pair_chain(chains: CoupledChain) -> Chain:
    """Return two chains (leading ``S``) as one of ``N_1 N_2`` states, numbered ``o N_2 + r``."""
    first, second = chains.log_trans
    models, actions, one, two = first.shape[:4]
    moves = jnp.maximum(first[..., :, None] + second[..., None, :], NEG)
    init = jnp.maximum(joint_density(chains.log_init), NEG)
    pairs = one * two
    return Chain(init.reshape(models, pairs), moves.reshape(models, actions, pairs, pairs))


def _paired(chains: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array) -> Posterior:
    rows = jnp.maximum(joint_density(log_obs), NEG)
    rows = rows.reshape(*rows.shape[:-2], -1)
    return posterior(pair_chain(chains), rows, actions, start, valid)


def _pairs_plan(chains: CoupledChain, *tapes: Any) -> CoupledPosterior:
    """Smooth the pair as one chain, and sum each chain's share out of what comes back."""
    one, two = (x.shape[-1] for x in chains.log_init)
    seen = _paired(chains, *tapes)
    gamma, initial = (x.reshape(*x.shape[:-1], one, two) for x in (seen.gamma, seen.initial))
    xi = seen.xi.reshape(*seen.xi.shape[:2], one, two, one, two)
    both = lambda x: (jnp.sum(x, axis=-1), jnp.sum(x, axis=-2))  # noqa: E731
    return CoupledPosterior(seen.log_evidence, both(gamma), both(xi), both(initial))


PLANS = {"scan": partial(_mapped, smooth_joint), "pairs": _pairs_plan}
"""The evaluation plans of exact inference."""


def choose_plan(plan: str, chains: CoupledChain) -> str:
    """Resolve ``auto``.

    Raises:
        ValueError: ``plan`` is not known, or there are not two chains.
    """
    if plan not in ("auto", *PLANS):
        raise ValueError(f"plan must be one of {('auto', *PLANS)}, got {plan!r}")
    check_two(chains)
    if plan != "auto":
        return plan
    few = chains.log_init[0].shape[-1] * chains.log_init[1].shape[-1] <= MOST_PAIRS
    fast = chains.log_init[0].dtype == jnp.float32 and native.available()
    return "pairs" if few and fast else "scan"


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
        plan: ``auto`` or one of ``PLANS``; all give the same up to rounding.

    Returns:
        ``log_evidence[S, B]``, ``gamma[c][S, B, T, N_c]``; ``xi`` and ``initial``, sums over the tapes.

    Raises:
        ValueError: ``plan`` is not known, there are not two chains, or the shapes do not fit.
    """
    chosen = choose_plan(plan, chains)
    _check_shapes(chains, log_obs, actions, start, valid)
    return _posterior(chains, log_obs, actions, start, valid, plan=chosen)


@partial(jax.jit, static_argnames="plan")
def marginal_posterior(
    chains: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array, *, plan: str = "auto"
) -> CoupledPosterior:
    """Smooth as ``coupled_posterior`` but approximately, and any number of chains: ``smooth_marginals``.

    There is one plan; ``plan`` is taken for the sake of the signature.
    """
    _check_shapes(chains, log_obs, actions, start, valid)
    return jax.vmap(smooth_marginals_of_tapes)(chains, log_obs, actions, start, valid)


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
