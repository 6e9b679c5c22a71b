"""Evidence for the tree's operators, gathered on the device from smoothed posteriors of whole tapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array, TrialBatch
from jaxpomdp.agents.learner import filter_chains
from jaxpomdp.kernels.filtering import EXACT, trial_starts
from jaxpomdp.models.em import EMConfig, e_step
from jaxpomdp.models.family import Family
from jaxpomdp.structure.tree_evidence import TreeEvidence


class _Cells(NamedTuple):
    """What happened at each step of a tape, as numbers of cells; -1 where nothing counts."""

    symbol: Array
    outcome: Array
    returns: Array


@partial(jax.jit, static_argnames=("family", "config", "num_symbols", "bins"))
def gather_tree_evidence(
    family: Family,
    params: Any,
    batch: TrialBatch,
    symbols: Array,
    config: EMConfig,
    num_symbols: int,
    bins: int,
) -> TreeEvidence:
    """Gather ``TreeEvidence`` of ``S`` models on their tapes ``[S, B, T]``: arrays with leading ``S``.

    The weight of leaf k before and l now is the smoothed ``xi_t(k, l) = b_{t-1}(k) T_a(k, l) gamma_t(l) /
    predicted_t(l)``, that of a start before l ``gamma_t(l)``. Bins are even between the least and the largest
    modelled return of each model's tapes.

    Args:
        family: the kind of model.
        params: parameters with leading ``S``.
        batch: tapes.
        symbols: int ``[S, B, T]``, what counts as the observation: symbols, bins of numbers, or combinations
            of several channels' symbols (``joint_symbols``).
        config: theta and the plan; with theta returns are part of the posterior.
        num_symbols: O.
        bins: of the returns.
    """
    chains, log_obs = jax.vmap(partial(family.learning, theta=config.theta))(params, batch)
    smoothed = e_step(family, params, batch, config)
    belief = filter_chains(chains, log_obs, batch)
    models = (jnp.exp(chains.log_trans), belief, smoothed.gamma, batch, symbols)

    def over(model: tuple[Any, ...]) -> tuple[Array, ...]:
        count = partial(_of_model, num_symbols=num_symbols, bins=bins)
        nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(count, *model))
        return jax.lax.cond(jnp.any(model[3].valid), count, lambda *_: nothing, *model)

    return TreeEvidence(smoothed.xi, *jax.lax.map(over, models))


def joint_symbols(observations: Sequence[Array], sizes: Sequence[int]) -> tuple[Array, int]:
    """Return one symbol for what was seen in several channels of symbols together, and how many there are.

    The first channel is the most significant digit, as the observation split expects.

    >>> symbols, count = joint_symbols((jnp.array([0, 1]), jnp.array([2, 0])), (2, 3))
    >>> symbols.tolist(), count
    ([2, 3], 6)
    """
    joint = jnp.zeros_like(observations[0])
    for seen, size in zip(observations, sizes, strict=True):
        joint = joint * size + seen
    return joint, math.prod(sizes)


def _of_model(
    trans: Array,
    belief: Array,
    gamma: Array,
    batch: TrialBatch,
    symbols: Array,
    num_symbols: int,
    bins: int,
) -> tuple[Array, ...]:
    first = trial_starts(batch.start, batch.valid)
    counted = batch.has_return & batch.valid
    edges = _edges(batch.returns, counted, bins)
    actions = trans.shape[0]
    place = jnp.clip(jnp.searchsorted(edges, batch.returns, side="right") - 1, 0, bins - 1)
    cells = _Cells(
        jnp.where(batch.observed & batch.valid, symbols, -1),
        jnp.where(counted, batch.actions * bins + place, -1),
        jnp.where(counted, batch.returns, 0),
    )
    before = _before(belief, first, batch.valid)
    ways = jnp.concatenate([trans, jnp.ones_like(trans[:, :1])], axis=1)
    steps = _Steps(ways, _rows(before), _rows(gamma), _rows(jnp.roll(batch.actions, 1, axis=1)))
    symbol, outcome, value = (_rows(x) for x in cells)
    one = jnp.ones_like(value)
    seen = sums_by_cell(steps, symbol, one[:, None], num_symbols)[0]
    powers = jnp.stack([one, value, value**2], axis=-1)
    outcomes = sums_by_cell(steps, outcome, powers, actions * bins)
    n = gamma.shape[-1]
    tables = jnp.moveaxis(outcomes, (2, 3), (0, 1)).reshape(n + 1, n, 3, actions, bins)
    moments = jnp.moveaxis(jnp.sum(tables[:, :, 1:], axis=-1), 2, -1)
    return jnp.moveaxis(seen, 0, -1), tables[:, :, 0], moments, edges


def _before(belief: Array, first: Array, valid: Array) -> Array:
    """Return ``[B, T, N+1]``: the belief of the step before; one in the last place where a trial begins."""
    linked = valid & ~first
    leaves = jnp.where(linked[..., None], jnp.roll(belief, 1, axis=1), 0)
    return jnp.concatenate([leaves, first[..., None].astype(belief.dtype)], axis=-1)


def _edges(returns: Array, counted: Array, bins: int) -> Array:
    low = jnp.min(jnp.where(counted, returns, jnp.inf))
    high = jnp.max(jnp.where(counted, returns, -jnp.inf))
    some = jnp.any(counted)
    low, high = jnp.where(some, low, 0), jnp.where(some, high, 1)
    return low + (jnp.maximum(high - low, 1e-6)) * jnp.linspace(0, 1, bins + 1, dtype=returns.dtype)


class _Steps(NamedTuple):
    """All steps of a model's tapes end to end: ``before[P, N+1]`` (see ``_before``), smoothed ``now[P, N]``
    and the action in between ``action[P]``; ``ways[A, N+1, N]`` are transitions, and ones where trials begin.
    """

    ways: Array
    before: Array
    now: Array
    action: Array


BLOCK = 32
"""Steps of one cell and action that are added up by one product."""


def sums_by_cell(steps: _Steps, cell: Array, weights: Array, cells: int) -> Array:
    """Return ``sum_t w_t[k] xi_t(i, j)`` over the steps of each cell, ``[K, cells, N+1, N]``.

    Steps are sorted by cell and action and cut into blocks, so that a block costs one matrix product.

    Args:
        steps: what happened.
        cell: int ``[P]``, -1 where a step counts nowhere.
        weights: ``[P, K]``.
        cells: how many there are.
    """
    actions, *pairs = steps.ways.shape
    groups = cells * actions
    group = jnp.where(cell >= 0, cell * actions + steps.action, groups)
    slots, group_of_block = _blocks(group, groups)
    before, now = (jnp.pad(x, ((0, 1), (0, 0)))[slots] for x in (steps.before, steps.now))
    powers = jnp.pad(weights, ((0, 1), (0, 0)))[slots]

    def add(total: Array, block: tuple[Array, ...]) -> tuple[Array, None]:
        left, right, power, number = block
        place, action = jnp.divmod(number, actions)
        matrix = steps.ways[action]
        predicted = jnp.matmul(left, matrix, precision=EXACT)
        ratio = jnp.where(predicted > 0, right / jnp.where(predicted > 0, predicted, 1), 0)
        found = jnp.einsum("bk,bi,bj->kij", power, left, ratio, precision=EXACT) * matrix[None]
        return total.at[place].add(found, mode="drop"), None

    blank = jnp.zeros((cells, weights.shape[-1], *pairs), steps.ways.dtype)
    total = jax.lax.scan(add, blank, (before, now, powers, group_of_block))[0]
    return jnp.moveaxis(total, 1, 0)


def _blocks(group: Array, groups: int) -> tuple[Array, Array]:
    """Return which step fills each slot ``[blocks, BLOCK]`` (P: none), and the group of each block.

    Steps of group ``groups`` and blocks that are not needed are left out (their group is ``groups``).
    """
    size = group.shape[0]
    blocks = size // BLOCK + groups
    order = jnp.argsort(group)
    count = jnp.bincount(group, length=groups + 1)
    needed = -(-count[:groups] // BLOCK)
    end = jnp.cumsum(needed)
    begin = jnp.append(end - needed, blocks)
    rank = jnp.arange(size) - (jnp.cumsum(count) - count)[group[order]]
    place = begin[group[order]] * BLOCK + rank
    slots = jnp.full(blocks * BLOCK, size).at[place].set(order, mode="drop")
    return slots.reshape(blocks, BLOCK), jnp.searchsorted(end, jnp.arange(blocks), side="right")


def _rows(x: Array) -> Array:
    return x.reshape(-1, *x.shape[2:])


def evidence_of_model(evidence: TreeEvidence, s: int, num_states: int) -> TreeEvidence:
    """Return one model's evidence on the host, without spare slots."""
    host = TreeEvidence(*(np.asarray(x[s], np.float64) for x in jax.device_get(evidence)))
    n = num_states
    leaves, before = np.arange(n), np.append(np.arange(n), -1)
    return TreeEvidence(
        host.transitions[:, :n, :n],
        host.symbols[before][:, leaves],
        host.returns[before][:, leaves],
        host.sums[before][:, leaves],
        np.maximum.accumulate(host.edges),
    )
