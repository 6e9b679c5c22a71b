"""The ``grouped`` plan: a whole batch goes through time together, its tapes grouped by action at every step.

At one step each tape needs its belief times the matrix of its own action. Picking matrices per tape moves
``N^2`` numbers per tape and step; multiplying by every action's matrix does ``A`` times the work. Here the
tapes of one model that take the same action become the rows of one matrix product. Groups differ in size, so
at each step the smallest of a few capacities is taken that holds the largest group. Transition counts are
formed at the end, from all steps of a model sorted by action, in tiles of one action each.

The arithmetic is that of ``smoothing.smooth_scaled``, and so is the test of what can be trusted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain, Posterior
from jaxpomdp.kernels.filtering import EXACT, linked_steps, trial_starts
from jaxpomdp.kernels.smoothing import overlap_floor
from jaxpomdp.numerics import NEG

TILE = 256
"""Rows per matrix product when transitions are counted."""

SHARES = (1.3, 2.0)
"""Group capacities to choose from, in units of an even share of the tapes; the last resort is all of them."""


class Groups(NamedTuple):
    """Rows (axis ``K``) sorted into groups by action; rows that lead nowhere form the last group, ``A``.

    ``order[..., K]`` lists the rows group by group; ``offset[..., A]`` and ``size[..., A]`` say where each
    group lies in it; ``group[..., K]`` and ``rank[..., K]`` say where each row went.
    """

    order: Array
    offset: Array
    size: Array
    group: Array
    rank: Array


class Steps(NamedTuple):
    """A batch on the time axis, one row per tape of any model (``R = S B``); every array leads with ``T``."""

    weight: Array
    first: Array
    linked: Array
    valid: Array
    groups: Groups


def group_rows(actions: Array, linked: Array, num_actions: int) -> Groups:
    """Sort rows by action, in linear time; ``actions[..., K]`` and ``linked[..., K]``."""
    group = jnp.where(linked, jnp.clip(actions, 0, num_actions - 1), num_actions)
    member = jax.nn.one_hot(group, num_actions + 1, dtype=jnp.int32)
    below = jnp.cumsum(member, axis=-2)
    size = below[..., -1, :]
    offset = jnp.cumsum(size, axis=-1) - size
    rank = jnp.sum(below * member, axis=-1) - 1
    order = _inverse_permutation(rank + jnp.sum(offset[..., None, :] * member, axis=-1))
    return Groups(order, offset[..., :-1], size[..., :-1], group, rank)


def _inverse_permutation(place: Array) -> Array:
    """Invert permutations of the last axis, ``int[..., K]``, by one scatter."""
    rows = place.shape[-1]
    flat = place.reshape(-1, rows)
    index = flat + rows * jnp.arange(flat.shape[0])[:, None]
    source = jnp.broadcast_to(jnp.arange(rows), flat.shape)
    empty = jnp.zeros(flat.size, source.dtype)
    return empty.at[index.reshape(-1)].set(source.reshape(-1), unique_indices=True).reshape(place.shape)


def _take(rows: Array, index: Array) -> Array:
    """Pick rows by indices known to be in bounds."""
    return rows.at[index].get(mode="promise_in_bounds")


def _exchange(groups: Groups, capacity: int) -> tuple[Array, Array]:
    """Return which row fills each slot, ``[S, A, capacity]``, and which slot serves each row, ``[S, B]``."""
    models, num_actions = groups.size.shape
    tapes = groups.order.shape[-1]
    model = jnp.arange(models)[:, None]
    place = jnp.minimum(groups.offset[..., None] + jnp.arange(capacity)[None, None, :], tapes - 1)
    row = jnp.take_along_axis(groups.order, place.reshape(models, -1), axis=-1) + tapes * model
    local = jnp.minimum(groups.group, num_actions - 1) * capacity + jnp.minimum(groups.rank, capacity - 1)
    return row.reshape(place.shape), local + num_actions * capacity * model


def capacities(tapes: int, num_actions: int) -> tuple[int, ...]:
    """Return the group capacities to choose from, ascending; the last holds all tapes."""
    some = {4 * -(-int(tapes / num_actions * share) // 4) for share in SHARES}
    return (*sorted(size for size in some if 0 < size <= 0.7 * tapes), tapes)


def _product_at(capacity: int) -> Callable[[Groups, Array, Array], Array]:
    """Return ``grouped_product`` for groups of at most ``capacity`` rows."""

    def product(groups: Groups, rows: Array, matrices: Array) -> Array:
        row, slot = _exchange(groups, capacity)
        moved = jnp.matmul(_take(rows, row), matrices, precision=EXACT)
        return _take(moved.reshape(-1, rows.shape[-1]), slot.reshape(-1))

    return product


def grouped_product(groups: Groups, rows: Array, matrices: Array) -> Array:
    """Multiply each row by the matrix of its model and action; rows of no group come back as anything finite.

    Args:
        groups: of the ``B`` tapes of each model, fields ``[S, ...]``.
        rows: ``[S B, N]``.
        matrices: ``[S, A, N, N]``.
    """
    sizes = capacities(groups.order.shape[-1], groups.size.shape[-1])
    choice = jnp.sum(jnp.max(groups.size) > jnp.array(sizes[:-1], groups.size.dtype))
    return lax.switch(choice, [_product_at(size) for size in sizes], groups, rows, matrices)


def _tiles(groups: Groups) -> tuple[Array, Array, Array]:
    """Cut the groups of one model into tiles: rows ``[tiles, TILE]``, which are real, the tiles' actions."""
    rows, num_actions = groups.order.shape[-1], groups.size.shape[-1]
    tile = jnp.arange(rows // TILE + num_actions)
    last = jnp.cumsum(-(-groups.size // TILE))
    action = jnp.sum(tile[:, None] >= last[None, :], axis=-1)
    known = jnp.minimum(action, num_actions - 1)
    begin = last[known] - -(-groups.size[known] // TILE)
    within = ((tile - begin) * TILE)[:, None] + jnp.arange(TILE)[None, :]
    real = (within < groups.size[known][:, None]) & (action < num_actions)[:, None]
    place = jnp.where(real, groups.offset[known][:, None] + within, 0)
    return groups.order[place], real, action


def grouped_counts(groups: Groups, belief: Array, arriving: Array, row_of: Array) -> Array:
    """Return ``sum_k belief_k arriving_k^T`` over the rows of each group, ``[A, N, N]``, for one model.

    Args:
        groups: of the model's ``K`` steps.
        belief: ``[rows, N]``, of all models.
        arriving: ``[rows, N]``.
        row_of: int ``[K]``, where the model's steps lie in these.
    """
    num_actions, states = groups.size.shape[-1], belief.shape[-1]
    step, real, action = _tiles(groups)
    row = _take(row_of, step)
    left, right = (jnp.where(real[..., None], _take(x, row), 0) for x in (belief, arriving))
    each = jnp.einsum("kri,krj->kij", left, right, precision=EXACT)
    owner = (action[None, :] == jnp.arange(num_actions)[:, None]).astype(each.dtype)
    total = jnp.matmul(owner, each.reshape(each.shape[0], -1), precision=EXACT)
    return total.reshape(num_actions, states, states)


def _count_transitions(
    belief: Array, arriving: Array, actions: Array, linked: Array, num_actions: int
) -> Array:
    """Return ``sum_t belief_t arriving_{t+1}^T`` by action, ``[S, A, N, N]``, one model after the other.

    ``belief[T, S B, N]``; ``arriving[T, S B, N]`` holds at ``t`` what comes after ``t``.
    """
    models, tapes, steps = actions.shape
    flat = belief.reshape(-1, belief.shape[-1]), arriving.reshape(-1, belief.shape[-1])
    acts, links = (x.transpose(0, 2, 1).reshape(models, -1) for x in (actions, linked))
    inside = (jnp.arange(steps) * models * tapes)[:, None] + jnp.arange(tapes)[None, :]

    def count(inputs: tuple[Groups, Array]) -> Array:
        groups, model = inputs
        return grouped_counts(groups, *flat, (inside + model * tapes).reshape(-1))

    return lax.map(count, (group_rows(acts, links, num_actions), jnp.arange(models)))


def _by_time(x: Array) -> Array:
    """Turn ``[S, B, T, ...]`` into ``[T, S B, ...]``."""
    moved = jnp.moveaxis(x, 2, 0)
    return moved.reshape(moved.shape[0], -1, *moved.shape[3:])


def _safe_inverse(x: Array, usable: Array) -> Array:
    """Return ``1 / x`` as a column, and zero where it is not usable."""
    return jnp.where(usable, 1 / jnp.where(usable, x, 1), 0)[:, None]


def _forward(init: Array, trans: Array, steps: Steps) -> tuple[Array, Array]:
    """Run forward from ``init[R, N]``: beliefs ``[T, R, N]`` and normalisers ``[T, R]`` (one at padding)."""

    def step(carried: Array, now: Steps) -> tuple[Array, tuple[Array, Array]]:
        joint = jnp.where(now.first[:, None], init, carried) * now.weight
        norm = jnp.sum(joint, axis=-1)
        usable = now.valid & (norm > 0)
        belief = joint * _safe_inverse(norm, usable)
        return grouped_product(now.groups, belief, trans), (belief, jnp.where(usable, norm, 1))

    return lax.scan(step, init, steps)[1]


class _Backward(NamedTuple):
    """What the backward pass carries; ``gamma[S, B, T, N]`` is filled from the end."""

    arriving: Array
    gamma: Array
    initial: Array
    trusted: Array


def _backward(back: Array, steps: Steps, belief: Array, norm: Array, gamma: Array) -> tuple[_Backward, Array]:
    """Run backward; ``back[S, A, N, N]`` are the transposed transitions, ``gamma`` a buffer of zeros.

    Returns:
        The last carry, and for each step what arrived at it from the next one, ``[T, R, N]``.
    """
    floor = overlap_floor(belief.dtype)

    def step(carry: _Backward, inputs: tuple[Steps, Array, Array, Array]) -> tuple[_Backward, Array]:
        now, belief_t, norm_t, t = inputs
        beta = grouped_product(now.groups, carry.arriving, back)
        size = jnp.sum(beta, axis=-1)
        beta = jnp.where(now.linked[:, None], beta * _safe_inverse(size, size > 0), 1)
        joint = belief_t * beta
        total = jnp.sum(joint, axis=-1)
        trusted = norm_t * total >= floor
        gamma_t = joint * _safe_inverse(total, trusted)
        arriving = now.weight * beta * _safe_inverse(norm_t * total, trusted)
        row = gamma_t.reshape(*carry.gamma.shape[:2], 1, -1)
        filled = lax.dynamic_update_slice_in_dim(carry.gamma, row, t, 2)
        initial = carry.initial + jnp.where(now.first[:, None], gamma_t, 0)
        kept = carry.trusted & (trusted | ~now.valid)
        return _Backward(arriving, filled, initial, kept), carry.arriving

    empty = jnp.zeros_like(belief[0])
    carry = _Backward(empty, gamma, empty, jnp.ones_like(steps.valid[0]))
    return lax.scan(step, carry, (steps, belief, norm, jnp.arange(norm.shape[0])), reverse=True)


def smooth_grouped(
    chains: Chain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> tuple[Posterior, Array]:
    """Smooth all tapes of all models with renormalised probabilities; arguments as ``posterior.posterior``.

    Returns:
        The posterior, and ``bool[S, B]``: the tape's numbers can be trusted (no underflow that matters). One
        that cannot is left out of ``xi`` and ``initial``.
    """
    models, tapes = actions.shape[:2]
    num_actions = chains.log_trans.shape[1]
    trans = jnp.exp(chains.log_trans)
    first, linked = trial_starts(start, valid), linked_steps(start, valid)
    peak = jnp.maximum(jnp.max(log_obs, axis=-1), NEG)
    weight = jnp.where(valid[..., None], jnp.exp(log_obs - peak[..., None]), 1)
    groups = group_rows(jnp.moveaxis(actions, 2, 0), jnp.moveaxis(linked, 2, 0), num_actions)
    steps = Steps(_by_time(weight), _by_time(first), _by_time(linked), _by_time(valid), groups)
    belief, norm = _forward(jnp.repeat(jnp.exp(chains.log_init), tapes, axis=0), trans, steps)
    last, arriving = _backward(jnp.swapaxes(trans, -1, -2), steps, belief, norm, jnp.zeros_like(log_obs))
    trusted = last.trusted.reshape(models, tapes)
    counts = _count_transitions(belief, arriving, actions, linked & trusted[..., None], num_actions)
    evidence = jnp.sum(jnp.log(norm), axis=0).reshape(models, tapes)
    evidence = evidence + jnp.sum(jnp.where(valid, peak, 0), axis=-1)
    initial = jnp.where(trusted[..., None], last.initial.reshape(models, tapes, -1), 0)
    return Posterior(evidence, last.gamma, trans * counts, jnp.sum(initial, axis=1)), trusted
