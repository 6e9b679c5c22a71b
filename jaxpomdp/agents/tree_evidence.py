"""Evidence for the tree's operators, gathered on the device from smoothed posteriors of whole tapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array, Chain, TrialBatch
from jaxpomdp.kernels.filtering import filter_tape, trial_starts
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
    over = partial(_of_model, num_symbols=num_symbols, bins=bins)
    found = jax.vmap(over)(chains, log_obs, smoothed.gamma, batch, symbols)
    return TreeEvidence(smoothed.xi, *found)


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
    chain: Chain,
    log_obs: Array,
    gamma: Array,
    batch: TrialBatch,
    symbols: Array,
    num_symbols: int,
    bins: int,
) -> tuple[Array, ...]:
    forward = jax.vmap(partial(filter_tape, chain))
    filtered = forward(log_obs, batch.actions, batch.start, batch.valid)
    first = trial_starts(batch.start, batch.valid)
    some = filtered.predicted > 0
    ratio = jnp.where(some, gamma / jnp.where(some, filtered.predicted, 1), 0)
    ratio = jnp.where(first[..., None], gamma, ratio)
    counted = batch.has_return & batch.valid
    edges = _edges(batch.returns, counted, bins)
    actions = chain.log_trans.shape[0]
    place = jnp.clip(jnp.searchsorted(edges, batch.returns, side="right") - 1, 0, bins - 1)
    cells = _Cells(
        jnp.where(batch.observed & batch.valid, symbols, -1),
        jnp.where(counted, batch.actions * bins + place, -1),
        jnp.where(counted, batch.returns, 0),
    )
    before = _before(filtered.belief, first, batch.valid)
    ways = jnp.concatenate([jnp.exp(chain.log_trans), jnp.ones_like(chain.log_trans[:, :1])], axis=1)
    driving = jnp.roll(batch.actions, 1, axis=-1)
    seen, outcomes, sums = _sums(ways, before, ratio, driving, cells, num_symbols, actions * bins, bins)
    n = gamma.shape[-1]
    returns = jnp.moveaxis(outcomes, 0, -1).reshape(n + 1, n, actions, bins)
    moments = jnp.moveaxis(sums.reshape(actions, 2, n + 1, n), (2, 3), (0, 1))
    return jnp.moveaxis(seen, 0, -1), returns, moments, edges


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


def _sums(
    trans: Array,
    before: Array,
    ratio: Array,
    actions: Array,
    cells: _Cells,
    num_symbols: int,
    num_outcomes: int,
    bins: int,
) -> tuple[Array, ...]:
    """Add up ``xi_t`` by cell in one pass over all tapes laid end to end: ``[cells, N+1, N]`` each."""

    def rows(x: Array) -> Array:
        return x.reshape(-1, *x.shape[2:])

    def step(carry: tuple[Array, ...], inputs: tuple[Any, ...]) -> tuple[tuple[Array, ...], None]:
        seen, outcomes, sums = carry
        belief, action, weight, (symbol, outcome, value) = inputs
        pair = belief[:, None] * trans[action] * weight[None]
        column = jnp.where(outcome >= 0, outcome // bins, num_outcomes)
        seen = seen.at[jnp.where(symbol >= 0, symbol, num_symbols)].add(pair, mode="drop")
        outcomes = outcomes.at[jnp.where(outcome >= 0, outcome, num_outcomes)].add(pair, mode="drop")
        powers = jnp.stack([value * pair, value**2 * pair])
        return (seen, outcomes, sums.at[column].add(powers, mode="drop")), None

    n, dtype = trans.shape[-1], trans.dtype
    blank = (
        jnp.zeros((num_symbols, n + 1, n), dtype),
        jnp.zeros((num_outcomes, n + 1, n), dtype),
        jnp.zeros((num_outcomes // bins, 2, n + 1, n), dtype),
    )
    inputs = (rows(before), rows(actions), rows(ratio), jax.tree.map(rows, cells))
    return jax.lax.scan(step, blank, inputs)[0]


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
