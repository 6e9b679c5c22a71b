"""Coupled chains: each chain's next state depends on the states of all; exact inference for two of them.

Given all states before, the chains move by themselves: ``P(o', r' | o, r) = P_1(o' | o, r) P_2(r' | o, r)``,
under each action. So the pair ``(o, r)`` is a Markov chain whose transitions need never be written down: a
joint belief is weighted by ``P_2``, then multiplied by ``P_1``; no array has the size of a pair times a pair.

Two rules make the tables ``P_c`` from one matrix for each pair of chains:

- ``product``: ``P_c(x' | x) = prod_k T_kc(x_k, x') / Z_c(x)`` (Brand 1997, who leaves ``Z`` out);
- ``mixture``: ``P_c(x' | x) = sum_k w_ck T_kc(x_k, x')`` (Zhong and Ghosh 2001).

Source: thesis sections 3.4 and 6.3.5; the scaling, and the test of what can be trusted, are ``smoothing``'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.kernels.filtering import EXACT, Filtered, linked_steps, observe, trial_starts
from jaxpomdp.kernels.smoothing import overlap_floor, relative_likelihood
from jaxpomdp.numerics import NEG, log_normalise, log_sum_exp


class CoupledChain(NamedTuple):
    """What inference knows of ``C`` coupled chains of ``N_1 ... N_C`` states.

    ``log_init[c]`` is ``[N_c]``; ``log_trans[c]`` is ``[A, N_1, ..., N_C, N_c]``: where it goes.
    """

    log_init: tuple[Array, ...]
    log_trans: tuple[Array, ...]


class CoupledPosterior(NamedTuple):
    """What inference gives back for one tape; each tuple has an entry per chain.

    ``log_evidence[]``; ``gamma[c][T, N_c]``, zero at padding; ``xi[c][A, N_1, ..., N_C, N_c]``, expected
    moves of chain ``c`` from every joint state; ``initial[c][N_c]``, the sum of ``gamma`` over the starts.
    """

    log_evidence: Array
    gamma: tuple[Array, ...]
    xi: tuple[Array, ...]
    initial: tuple[Array, ...]


def along_chain(matrix: Array, chain: int, chains: int) -> Array:
    """Give ``[..., N_k, N_c]`` the axes ``[..., 1, N_k, 1, N_c]`` of a table over joint states."""
    own = [matrix.shape[-2] if k == chain else 1 for k in range(chains)]
    return matrix.reshape(*matrix.shape[:-2], *own, matrix.shape[-1])


def _possible(table: Array) -> Array:
    return table > NEG / 2


def product_rows(log_pairs: Sequence[Array], own: int) -> Array:
    """Return ``log prod_k T_k(x_k, x') - log Z(x)``, ``[A, N_1, ..., N_C, N]``, for one chain to move.

    Where no next state is possible for all chains at once, the chain goes by its own matrix alone.

    Args:
        log_pairs: ``log T_k[A, N_k, N]`` from each chain ``k`` to the one that moves.
        own: its number among them.
    """
    tables = [along_chain(pair, k, len(log_pairs)) for k, pair in enumerate(log_pairs)]
    together = sum(tables[1:], tables[0])
    allowed = jnp.broadcast_to(_possible(tables[0]), together.shape)
    for table in tables[1:]:
        allowed = allowed & _possible(table)
    alone = jnp.broadcast_to(tables[own], together.shape)
    agree = jnp.any(allowed, axis=-1, keepdims=True)
    return log_normalise(jnp.where(agree, jnp.where(allowed, together, NEG), alone))


def mixture_rows(log_pairs: Sequence[Array], log_weights: Array) -> Array:
    """Return ``log sum_k w_k T_k(x_k, x')``, ``[A, N_1, ..., N_C, N]``, for one chain to move.

    Args:
        log_pairs: ``log T_k[A, N_k, N]`` from each chain ``k`` to the one that moves.
        log_weights: ``log w[C]``, of the chains it heeds.
    """
    tables = [along_chain(pair, k, len(log_pairs)) + log_weights[k] for k, pair in enumerate(log_pairs)]
    return log_sum_exp(jnp.stack(jnp.broadcast_arrays(*tables)), axis=0)


def joint_density(log_obs: tuple[Array, ...]) -> Array:
    """Return the log density of what all chains emit, ``[..., N_1, ..., N_C]``, from ``[..., N_c]`` each."""
    total = log_obs[0]
    for row in log_obs[1:]:
        total = total[..., None] + row.reshape(
            *row.shape[:-1], *(1,) * (total.ndim - row.ndim + 1), row.shape[-1]
        )
    return total


def joint_start(log_init: tuple[Array, ...]) -> Array:
    """Return the joint probability of the first states, ``[N_1, ..., N_C]``; chains start independently."""
    return jnp.exp(joint_density(log_init))


def _flat(x: Array) -> Array:
    """Join the two axes of a joint state that come first."""
    return x.reshape(-1, *x.shape[2:])


def propagate_joint(belief: Array, trans: tuple[Array, ...], action: Array) -> Array:
    """Push a joint belief ``[N_1, N_2]`` on: ``sum_{o, r} belief(o, r) P_1(o' | o, r, a) P_2(r' | o, r, a)``.

    Args:
        belief: probabilities ``[N_1, N_2]``.
        trans: probabilities ``[A, N_1, N_2, N_1]`` and ``[A, N_1, N_2, N_2]``.
        action: int scalar.
    """
    first, second = (_flat(table[action]) for table in trans)
    return jnp.matmul(first.T, second * belief.reshape(-1, 1), precision=EXACT)


def observe_joint(predicted: Array, log_obs: tuple[Array, ...]) -> tuple[Array, Array]:
    """Take in one step's observations, as ``filtering.observe`` does: the joint belief, and ``log_norm``."""
    belief, log_norm = observe(predicted.reshape(-1), joint_density(log_obs).reshape(-1))
    return belief.reshape(predicted.shape), log_norm


def update_joint(
    belief: Array, log_trans: tuple[Array, ...], action: Array, log_obs: tuple[Array, ...]
) -> tuple[Array, Array]:
    """Update a joint belief by one step of acting and seeing; exact online filtering of two chains.

    Args:
        belief: probabilities ``[N_1, N_2]``.
        log_trans: as in ``CoupledChain``.
        action: int scalar, taken before the observation.
        log_obs: ``[N_1]`` and ``[N_2]``.
    """
    return observe_joint(propagate_joint(belief, tuple(map(jnp.exp, log_trans)), action), log_obs)


def check_two(chain: CoupledChain) -> None:
    """Refuse any number of chains but two.

    Raises:
        ValueError: saying what to use instead.
    """
    if len(chain.log_init) != 2:
        raise ValueError(
            f"chain must have two chains for exact inference, got {len(chain.log_init)}; "
            "the sweep over marginals takes any number"
        )


def where_valid(valid: Array, x: Array) -> Array:
    """Return ``x[T, ...]``, zero where not ``valid[T]``."""
    return jnp.where(valid.reshape(valid.shape + (1,) * (x.ndim - 1)), x, 0)


def filter_joint(
    chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> Filtered:
    """Filter one tape under two chains, exactly: ``belief`` and ``predicted`` are ``[T, N_1, N_2]``.

    Args:
        chain: of two chains.
        log_obs: ``[T, N_1]`` and ``[T, N_2]``; rows of zeros where nothing was seen.
        actions: int ``[T]``.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.
    """
    check_two(chain)
    init, trans = joint_start(chain.log_init), tuple(map(jnp.exp, chain.log_trans))

    def step(carried: Array, inputs: Any) -> tuple[Array, Filtered]:
        rows, action, first = inputs
        predicted = jnp.where(first, init, carried)
        belief, log_norm = observe_joint(predicted, rows)
        return propagate_joint(belief, trans, action), Filtered(belief, predicted, log_norm)

    rows = tuple(jnp.where(valid[:, None], x, 0) for x in log_obs)
    filtered = lax.scan(step, init, (rows, actions, trial_starts(start, valid)))[1]
    return jax.tree.map(lambda x: where_valid(valid, x), filtered)


class _Back(NamedTuple):
    """What the backward pass carries: the future over its overlap, and the counts of both chains' moves."""

    arriving: Array
    counts: tuple[Array, Array]


def joint_futures(trans: tuple[Array, Array], arriving: Array) -> tuple[Array, Array]:
    """Return what is to come after each joint state and one chain's move, the other chain's summed out.

    ``G_1(o, r, o') = sum_{r'} P_2(r' | o, r) arriving(o', r')``, and ``G_2`` alike.

    Args:
        trans: probabilities ``[N_1, N_2, N_1]`` and ``[N_1, N_2, N_2]``, of one action.
        arriving: ``[N_1, N_2]``.
    """
    first, second = trans
    return (
        jnp.einsum("orj,ij->ori", second, arriving, precision=EXACT),
        jnp.einsum("ori,ij->orj", first, arriving, precision=EXACT),
    )


def smooth_joint_scaled(
    chain: CoupledChain, log_obs: tuple[Array, ...], actions: Array, start: Array, valid: Array
) -> tuple[CoupledPosterior, Array, Array]:
    """Smooth one tape with renormalised probabilities; arguments as ``filter_joint``.

    Returns:
        The posterior; joint marginals ``gamma[T, N_1, N_2]``; a bool scalar, no underflow that matters.
    """
    filtered = filter_joint(chain, log_obs, actions, start, valid)
    trans, linked = tuple(map(jnp.exp, chain.log_trans)), linked_steps(start, valid)
    rows = joint_density(log_obs)
    weight = relative_likelihood(rows.reshape(rows.shape[0], -1), valid).reshape(rows.shape)
    floor = overlap_floor(rows.dtype)

    def step(carry: _Back, inputs: tuple[Array, ...]) -> tuple[_Back, tuple[Array, Array]]:
        here, predicted, belief, action, goes_on = inputs
        now = (trans[0][action], trans[1][action])
        futures = joint_futures(now, carry.arriving)
        share = jnp.where(goes_on, belief, 0)[..., None]
        counts = tuple(n.at[action].add(share * g) for n, g in zip(carry.counts, futures, strict=True))
        beta = jnp.where(goes_on, jnp.sum(now[0] * futures[0], axis=-1), 1)
        peak = jnp.max(beta)
        future = here * beta / jnp.where(peak > 0, peak, 1)
        overlap = jnp.sum(predicted * future)
        trusted = overlap >= floor
        arriving = future * jnp.where(trusted, 1 / jnp.where(trusted, overlap, 1), 0)
        return _Back(arriving, counts), (predicted * arriving, trusted)

    empty = _Back(jnp.zeros_like(rows[0]), tuple(map(jnp.zeros_like, trans)))
    steps = (weight, filtered.predicted, filtered.belief, actions, linked)
    end, (joint, trusted) = lax.scan(step, empty, steps, reverse=True)
    xi = tuple(table * counts for table, counts in zip(trans, end.counts, strict=True))
    return gathered(jnp.sum(filtered.log_norm), joint, xi, start, valid), joint, jnp.all(trusted | ~valid)


def gathered(
    log_evidence: Array, joint: Array, xi: tuple[Array, ...], start: Array, valid: Array
) -> CoupledPosterior:
    """Make a posterior of joint marginals ``[T, N_1, N_2]`` and counts."""
    gamma = (jnp.sum(joint, axis=2), jnp.sum(joint, axis=1))
    first = trial_starts(start, valid)
    initial = tuple(jnp.sum(where_valid(first, x), axis=0) for x in gamma)
    return CoupledPosterior(log_evidence, gamma, xi, initial)
