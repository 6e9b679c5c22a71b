"""Two coupled chains in logarithms, where probabilities underflow; and ``smooth_joint``, which knows where.

Sums and maxima over pairs of joint states run over one next state of the first chain at a time: here too no
array has the size of a pair times a pair.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.kernels.coupled import (
    CoupledChain,
    CoupledPosterior,
    check_two,
    gathered,
    joint_density,
    smooth_joint_scaled,
    where_valid,
)
from jaxpomdp.kernels.filtering import Filtered, linked_steps, trial_starts
from jaxpomdp.kernels.smoothing import heeded_rows
from jaxpomdp.numerics import NEG, log_sum_exp


def reduce_pairs(reduce: Callable[[Array], Array], score: Array, first: Array, second: Array) -> Array:
    """Reduce ``score(o, r) + first(o, r, o') + second(o, r, r')`` over ``(o, r)``: ``[N_1, N_2]``.

    Args:
        reduce: takes ``[J, N_2]`` to ``[N_2]``.
        score: ``[N_1, N_2]``.
        first: log-probabilities ``[N_1, N_2, N_1]``.
        second: log-probabilities ``[N_1, N_2, N_2]``.
    """
    ahead = second.reshape(-1, second.shape[-1])

    def arrive(column: Array) -> Array:
        return reduce(jnp.maximum(column.reshape(-1, 1) + ahead, NEG))

    return lax.map(arrive, jnp.moveaxis(score[..., None] + first, -1, 0))


def sum_pairs(scores: Array) -> Array:
    """Return the log-sum-exp over the first axis."""
    return log_sum_exp(scores, axis=0)


def filter_joint_exact(
    chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> Filtered:
    """Filter one tape as ``filter_joint``, in logarithms; belief and prediction come back as logarithms."""
    check_two(chain)
    init = jnp.maximum(joint_density(chain.log_init), NEG)

    def step(carried: Array, inputs: Any) -> tuple[Array, Filtered]:
        row, action, first = inputs
        predicted = jnp.where(first, init, carried)
        joint = jnp.maximum(predicted + row, NEG)
        joint = jnp.where(predicted > NEG / 2, joint, NEG)
        norm = log_sum_exp(joint.reshape(-1))
        possible = norm > NEG / 2
        belief = jnp.where(possible & (joint > NEG / 2), joint - norm, jnp.where(possible, NEG, predicted))
        ahead = reduce_pairs(sum_pairs, belief, *(table[action] for table in chain.log_trans))
        return ahead, Filtered(belief, predicted, jnp.where(possible, norm, NEG))

    rows = jnp.where(valid[:, None, None], jnp.maximum(joint_density(log_obs), NEG), 0)
    filtered = lax.scan(step, init, (rows, actions, trial_starts(start, valid)))[1]
    return filtered._replace(log_norm=where_valid(valid, filtered.log_norm))


def _futures(tables: tuple[Array, Array], ahead: Array) -> tuple[Array, Array]:
    """Return ``joint_futures`` in logarithms: ``[N_1, N_2, N_1]`` and ``[N_1, N_2, N_2]``."""
    first, second = tables
    one = lax.map(lambda row: log_sum_exp(jnp.maximum(second + row[None, None], NEG)), ahead)
    two = lax.map(lambda row: log_sum_exp(jnp.maximum(first + row[None, None], NEG)), ahead.T)
    return jnp.moveaxis(one, 0, -1), jnp.moveaxis(two, 0, -1)


def _shares(log_weight: Array) -> Array:
    """Return ``exp(log_weight)`` scaled to sum to one over all entries; zeros when all are ``NEG``."""
    weight = jnp.where(log_weight > NEG / 2, jnp.exp(log_weight - jnp.max(log_weight)), 0)
    total = jnp.sum(weight)
    return weight / jnp.where(total > 0, total, 1)


def smooth_joint_exact(
    chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> tuple[CoupledPosterior, Array]:
    """Smooth one tape in logarithms: slow and exact; arguments as ``smooth_joint``.

    Returns:
        The posterior, and the joint marginals ``gamma[T, N_1, N_2]``.
    """
    linked = linked_steps(start, valid)
    filtered = filter_joint_exact(chain, log_obs, actions, start, valid)
    heeded = _heeded(filtered.predicted, joint_density(log_obs))

    def step(carry: tuple[Array, Any], inputs: tuple[Array, ...]) -> tuple[tuple[Array, Any], Array]:
        (ahead, counts), (row, belief, action, goes_on) = carry, inputs
        tables = (chain.log_trans[0][action], chain.log_trans[1][action])
        futures = _futures(tables, ahead)
        moves = [_shares(belief[..., None] + t + f) for t, f in zip(tables, futures, strict=True)]
        counts = tuple(n.at[action].add(jnp.where(goes_on, x, 0)) for n, x in zip(counts, moves, strict=True))
        beta = log_sum_exp(jnp.maximum(tables[0] + futures[0], NEG))
        peak = jnp.max(beta)
        beta = jnp.where(goes_on, jnp.where(peak > NEG / 2, jnp.maximum(beta - peak, NEG), beta), 0)
        future = jnp.maximum(row + beta, NEG)
        return (future, counts), future

    empty = (jnp.zeros_like(heeded[0]), tuple(map(jnp.zeros_like, chain.log_trans)))
    steps = (heeded, filtered.belief, actions, linked)
    (_, xi), future = lax.scan(step, empty, steps, reverse=True)
    joint = where_valid(valid, jax.vmap(_shares)(jnp.maximum(filtered.predicted + future, NEG)))
    return gathered(jnp.sum(filtered.log_norm), joint, xi, start, valid), joint


def _heeded(predicted: Array, rows: Array) -> Array:
    """Shift rows ``[T, N_1, N_2]`` as ``heeded_rows`` does those of one chain."""
    flat = (x.reshape(x.shape[0], -1) for x in (predicted, rows))
    return heeded_rows(*flat).reshape(rows.shape)


def smooth_both(
    chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> tuple[CoupledPosterior, Array]:
    """Smooth one tape under two chains, exactly: the posterior, and the joint marginals ``[T, N_1, N_2]``.

    Arguments as ``smooth_joint``.
    """
    tape = (log_obs, actions, start, valid)
    posterior, joint, trusted = smooth_joint_scaled(chain, *tape)
    # A loop of zero or one turns: under vmap a `cond` would always run both branches, a loop need not.
    _, result = lax.while_loop(
        lambda carry: ~carry[0],
        lambda carry: (jnp.ones_like(carry[0]), smooth_joint_exact(chain, *tape)),
        (trusted, (posterior, joint)),
    )
    return result


def smooth_joint(
    chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> CoupledPosterior:
    """Smooth one tape under two coupled chains, exactly, with the expected moves of each chain.

    Time ``O(T N_1^2 N_2^2)``, as a flat chain of ``N_1 N_2`` states; memory ``O(T N_1 N_2)``, and tables.
    An impossible step is treated as a missing one and adds ``NEG`` to the log-evidence; nothing is ever NaN.

    Args:
        chain: of two chains.
        log_obs: ``[T, N_1]`` and ``[T, N_2]``, unnormalised is fine; rows of zeros where nothing was seen.
        actions: int ``[T]``; the last of a trial is ignored.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.

    Raises:
        ValueError: there are not two chains.
    """
    return smooth_both(chain, log_obs, actions, start, valid)[0]
