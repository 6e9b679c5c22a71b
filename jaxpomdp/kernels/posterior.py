"""Evaluation plans: the posterior of many models on many tapes, with one result whichever plan runs.

- ``scan`` is the definition: ``smooth`` under two maps.
- ``grouped`` carries the whole batch through time at once (``grouped``), for any device and dtype.
- ``blocked`` cuts tapes into blocks that go through time side by side (``blocked``), for long tapes of few
  small models on an accelerator.
- ``native`` is the loop in C++ (``native``), on CPU in float32 where it could be built.
- ``auto`` takes ``native`` where it can, on an accelerator the plan that measurements there say is fastest
  for these sizes, and ``grouped`` elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain, Posterior
from jaxpomdp.kernels import native
from jaxpomdp.kernels.blocked import smooth_blocked
from jaxpomdp.kernels.grouped import smooth_grouped
from jaxpomdp.kernels.smoothing import smooth, smooth_exact


def _scan_plan(chains: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Map ``smooth`` over tapes and models, then add the counts of each model's tapes."""
    over_tapes = jax.vmap(smooth, in_axes=(None, 0, 0, 0, 0))
    each = jax.vmap(over_tapes)(chains, log_obs, actions, start, valid)
    return each._replace(xi=jnp.sum(each.xi, axis=1), initial=jnp.sum(each.initial, axis=1))


def _grouped_plan(chains: Chain, *tapes: Array) -> Posterior:
    """Smooth in groups, then add the tapes that underflowed, one by one, by ``smooth_exact``."""
    return _complete(*smooth_grouped(chains, *tapes), chains, *tapes)


def _blocked_plan(chains: Chain, *tapes: Array) -> Posterior:
    """Map ``smooth_blocked`` over tapes and models, add counts, then add the tapes that underflowed."""
    over_tapes = jax.vmap(smooth_blocked, in_axes=(None, 0, 0, 0, 0))
    each, trusted = jax.vmap(over_tapes)(chains, *tapes)
    xi = jnp.sum(jnp.where(trusted[..., None, None, None], each.xi, 0), axis=1)
    initial = jnp.sum(jnp.where(trusted[..., None], each.initial, 0), axis=1)
    return _complete(each._replace(xi=xi, initial=initial), trusted, chains, *tapes)


def _complete(result: Posterior, trusted: Array, chains: Chain, *tapes: Array) -> Posterior:
    """Add the tapes that the result lacks, where ``trusted[S, B]`` is False; the loop turns once for each."""
    per_model = trusted.shape[1]

    def add(carry: tuple[Array, Posterior]) -> tuple[Array, Posterior]:
        lacking, total = carry
        index = jnp.argmax(lacking)
        model, tape = jnp.divmod(index, per_model)
        one = smooth_exact(jax.tree.map(lambda x: x[model], chains), *(x[model, tape] for x in tapes))
        return lacking.at[index].set(False), Posterior(
            total.log_evidence.at[model, tape].set(one.log_evidence),
            total.gamma.at[model, tape].set(one.gamma),
            total.xi.at[model].add(one.xi),
            total.initial.at[model].add(one.initial),
        )

    return lax.while_loop(lambda carry: jnp.any(carry[0]), add, (~trusted.reshape(-1), result))[1]


def _native_plan(chains: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Hand the batch to the C++ loop."""
    tapes = (log_obs, actions.astype(jnp.int32), start, valid)
    return native.estep(jnp.exp(chains.log_init), jnp.exp(chains.log_trans), *tapes)


_PLANS: dict[str, Callable[..., Posterior]] = {
    "scan": _scan_plan,
    "grouped": _grouped_plan,
    "blocked": _blocked_plan,
    "native": _native_plan,
}

PLANS = ("auto", *_PLANS)
"""Names of the evaluation plans."""


def accelerator_seconds(models: int, tapes: int, steps: int, states: int) -> dict[str, float]:
    """Return what each plan would take on a GPU.

    A step costs its launches and what it moves, ``S B N^2`` numbers; ``blocked`` makes about ``5 sqrt(T)``
    steps, and products of step matrices. The constants fit benchmarks/results/speed-gpu.json (an H200).
    """
    moved = models * tapes * states**2
    return {
        "scan": steps * (24e-6 + 6.4e-12 * moved),
        "grouped": steps * (65e-6 + 2.7e-12 * moved),
        "blocked": 75e-6 * math.sqrt(steps) + 4.2e-13 * moved * steps * states,
    }


def choose_plan(plan: str, dtype: jnp.dtype, sizes: tuple[int, int, int, int]) -> str:
    """Resolve ``auto`` for ``sizes = (S, B, T, N)``, and check that a named plan can run here.

    Raises:
        ValueError: ``plan`` is not known, or is ``native`` where that cannot run.
    """
    chosen = native.resolved(plan, PLANS, dtype)
    if chosen != "auto":
        return chosen
    if jax.default_backend() == "cpu":
        return "grouped"
    costs = accelerator_seconds(*sizes)
    return min(costs, key=lambda name: costs[name])


@partial(jax.jit, static_argnames="plan")
def _posterior(chains: Chain, *tapes: Array, plan: str) -> Posterior:
    return _PLANS[plan](chains, *tapes)


def posterior(
    chains: Chain, log_obs: Array, actions: Array, start: Array, valid: Array, *, plan: str = "auto"
) -> Posterior:
    """Smooth ``B`` tapes under each of ``S`` models; what ``smoothing.smooth`` does, for many.

    Args:
        chains: ``log_init[S, N]``, ``log_trans[S, A, N, N]``.
        log_obs: ``[S, B, T, N]``; a missing step is a row of zeros.
        actions: int ``[S, B, T]``.
        start: bool ``[S, B, T]``.
        valid: bool ``[S, B, T]``.
        plan: one of ``PLANS``; all give the same up to rounding.

    Returns:
        ``log_evidence[S, B]``, ``gamma[S, B, T, N]``, ``xi[S, A, N, N]``, ``initial[S, N]``; the last two are
        sums over the tapes.

    Raises:
        ValueError: ``plan`` is not known or cannot run here, or the shapes do not fit.
    """
    _check_shapes(chains, log_obs, actions, start, valid)
    return _posterior(
        chains, log_obs, actions, start, valid, plan=choose_plan(plan, log_obs.dtype, log_obs.shape)
    )


def _check_shapes(chains: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> None:
    """Raise if the leading axes disagree, naming the argument."""
    if log_obs.ndim != 4:
        raise ValueError(f"log_obs must have shape [S, B, T, N], got {log_obs.shape}")
    models, _, _, states = log_obs.shape
    wanted = {"actions": actions, "start": start, "valid": valid}
    for name, array in wanted.items():
        if array.shape != log_obs.shape[:3]:
            raise ValueError(f"{name} must have shape {log_obs.shape[:3]} as log_obs, got {array.shape}")
    if chains.log_init.shape != (models, states):
        raise ValueError(f"log_init must have shape {(models, states)}, got {chains.log_init.shape}")
    got = chains.log_trans.shape
    if len(got) != 4 or (got[0], *got[2:]) != (models, states, states):
        raise ValueError(f"log_trans must have shape [{models}, A, {states}, {states}], got {got}")
