"""Approximate inference for two or more coupled chains: a sweep that keeps only each chain's marginals.

Forward, the belief after each step is replaced by the product of its marginals (assumed density filtering).
Backward, the future of a joint state is a product over the chains of what each one's next state promises, and
is averaged over the other chains' filtered beliefs. Exact for one chain, and for chains that ignore each
other; else the error grows with the coupling, and EM with these counts need not be monotone.

Source: Boyen and Koller (1998; 1999 for the backward sweep).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.kernels.coupled import CoupledChain, CoupledPosterior, where_valid
from jaxpomdp.kernels.filtering import EXACT, linked_steps, observe, trial_starts
from jaxpomdp.kernels.smoothing import heeded_rows
from jaxpomdp.numerics import normalise, safe_log

Rows = tuple[Array, ...]


class MarginalFiltered(NamedTuple):
    """The forward sweep: ``belief[c]``, ``predicted[c]`` ``[T, N_c]``, zero at padding; ``log_norm[T]``."""

    belief: Rows
    predicted: Rows
    log_norm: Array


def outer(rows: Rows) -> Array:
    """Return the product of one row per chain as a table over joint states, ``[N_1, ..., N_C]``."""
    total = rows[0]
    for row in rows[1:]:
        total = total[..., None] * row.reshape(*(1,) * total.ndim, -1)
    return total


def propagate_marginals(belief: Rows, trans: Rows, action: Array) -> Rows:
    """Push marginals on: ``sum_x prod_k belief_k(x_k) P_c(x' | x, a)`` for each chain ``c``.

    Args:
        belief: probabilities ``[N_c]``, one row per chain.
        trans: probabilities ``[A, N_1, ..., N_C, N_c]``.
        action: int scalar.
    """
    joint = outer(belief).reshape(-1)
    tables = (jnp.moveaxis(table, 0, -2).reshape(joint.shape[0], -1) for table in trans)
    pushed = (jnp.matmul(joint, table, precision=EXACT) for table in tables)
    return tuple(x.reshape(table.shape[0], -1)[action] for x, table in zip(pushed, trans, strict=True))


def observe_marginals(predicted: Rows, log_obs: Rows) -> tuple[Rows, Array]:
    """Take in what each chain emits, by itself; what is impossible for a chain is ignored there."""
    seen = [observe(p, row) for p, row in zip(predicted, log_obs, strict=True)]
    return tuple(belief for belief, _ in seen), sum((norm for _, norm in seen), jnp.zeros(()))


def update_marginals(belief: Rows, log_trans: Rows, action: Array, log_obs: Rows) -> tuple[Rows, Array]:
    """Update the marginals by one step of acting and seeing; approximate online filtering.

    Returns:
        The marginals, and the (approximate) log-probability of the observation given the past.
    """
    return observe_marginals(propagate_marginals(belief, tuple(map(jnp.exp, log_trans)), action), log_obs)


def filter_marginals(
    chain: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array
) -> MarginalFiltered:
    """Filter one tape, keeping only marginals; arguments as ``smooth_marginals``."""
    init, trans = (tuple(map(jnp.exp, tables)) for tables in chain)

    def step(carried: Rows, inputs: Any) -> tuple[Rows, MarginalFiltered]:
        rows, action, first = inputs
        predicted = tuple(jnp.where(first, x, y) for x, y in zip(init, carried, strict=True))
        belief, log_norm = observe_marginals(predicted, rows)
        return propagate_marginals(belief, trans, action), MarginalFiltered(belief, predicted, log_norm)

    rows = tuple(jnp.where(valid[:, None], x, 0) for x in log_obs)
    filtered = lax.scan(step, init, (rows, actions, trial_starts(start, valid)))[1]
    return jax.tree.map(lambda x: where_valid(valid, x), filtered)


def _scaled(x: Array) -> Array:
    """Scale so that the largest entry is one; a row of zeros comes back as ones: it says nothing."""
    peak = jnp.max(x)
    return jnp.where(peak > 0, x / jnp.where(peak > 0, peak, 1), 1)


def _promises(trans: Rows, action: Array, future: Rows) -> Rows:
    """Return what each chain's next state promises, from every joint state: ``[N_1, ..., N_C]`` per chain."""
    return tuple(
        jnp.tensordot(table, row, axes=1, precision=EXACT)[action]
        for table, row in zip(trans, future, strict=True)
    )


def _all_but(rows: Rows, chain: int) -> Array:
    """Multiply all but one."""
    total = jnp.ones_like(rows[0])
    for k, row in enumerate(rows):
        total = total if k == chain else total * row
    return total


def _mean_promise(joint: Array, belief: Array, promise: Array, chain: int) -> Array:
    """Average a promise over the other chains' beliefs: ``[N_c]``; where the chain cannot be, zero."""
    axes = tuple(k for k in range(joint.ndim) if k != chain)
    mass = jnp.sum(joint * promise, axis=axes)
    return jnp.where(belief > 0, mass / jnp.where(belief > 0, belief, 1), 0)


class _Swept(NamedTuple):
    """Of a step: each chain's smoothed marginal, and the two sides of its expected move."""

    gamma: Rows
    leaving: Rows
    arriving: Rows


def _backward(trans: Rows, weight: Rows, belief: Rows, actions: Array, linked: Array) -> _Swept:
    chains = range(len(trans))

    def step(future: Rows, inputs: Any) -> tuple[Rows, _Swept]:
        here, now, action, goes_on = inputs
        promises, joint = _promises(trans, action, future), outer(now)
        total = jnp.sum(joint * _all_but(promises, -1))
        share = jnp.where(goes_on & (total > 0), 1 / jnp.where(total > 0, total, 1), 0)
        leaving = tuple(joint * _all_but(promises, c) * share for c in chains)
        every = _scaled(_all_but(promises, -1))
        means = (_scaled(_mean_promise(joint, now[c], every, c)) for c in chains)
        beta = tuple(jnp.where(goes_on, x, 1) for x in means)
        gamma = tuple(normalise(now[c] * beta[c], now[c]) for c in chains)
        before = tuple(_scaled(here[c] * beta[c]) for c in chains)
        return before, _Swept(gamma, leaving, future)

    last = tuple(jnp.ones_like(x[0]) for x in weight)
    return lax.scan(step, last, (weight, belief, actions, linked), reverse=True)[1]


def _move_counts(table: Array, leaving: Array, arriving: Array, actions: Array) -> Array:
    """Return ``P(x, x') sum_t [a_t = a] leaving_t(x) arriving_t(x')``: one matrix product per action."""
    steps = actions.size
    left, right = leaving.reshape(steps, -1), arriving.reshape(steps, -1)

    def count(action: Array) -> Array:
        chosen = jnp.where((actions.reshape(steps, 1) == action), left, 0)
        return jnp.matmul(chosen.T, right, precision=EXACT)

    return table * lax.map(count, jnp.arange(table.shape[0])).reshape(table.shape)


def _sweep(
    chain: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array
) -> tuple[Array, _Swept]:
    """Sweep one tape: its log-evidence, and what each step adds to the counts; gamma is zero at padding."""
    filtered = filter_marginals(chain, log_obs, actions, start, valid)
    seen = zip(filtered.predicted, log_obs, strict=True)
    weight = tuple(jnp.exp(heeded_rows(safe_log(predicted), row)) for predicted, row in seen)
    trans = tuple(map(jnp.exp, chain.log_trans))
    swept = _backward(trans, weight, filtered.belief, actions, linked_steps(start, valid))
    gamma = tuple(where_valid(valid, x) for x in swept.gamma)
    return jnp.sum(filtered.log_norm), swept._replace(gamma=gamma)


def smooth_marginals_of_tapes(
    chain: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array
) -> CoupledPosterior:
    """Smooth ``B`` tapes of one model, as ``smooth_marginals`` does one; ``xi`` and ``initial`` are summed.

    The counts of all tapes come from one matrix product: a table of counts per tape would cost more than
    the sweeps.
    """
    log_evidence, swept = jax.vmap(_sweep, in_axes=(None, 0, 0, 0, 0))(chain, log_obs, actions, start, valid)
    sides = zip(chain.log_trans, swept.leaving, swept.arriving, strict=True)
    xi = tuple(_move_counts(jnp.exp(table), left, right, actions) for table, left, right in sides)
    first = jax.vmap(trial_starts)(start, valid)
    initial = tuple(jnp.sum(jnp.where(first[..., None], x, 0), axis=(0, 1)) for x in swept.gamma)
    return CoupledPosterior(log_evidence, swept.gamma, xi, initial)


def smooth_marginals(
    chain: CoupledChain, log_obs: Rows, actions: Array, start: Array, valid: Array
) -> CoupledPosterior:
    """Smooth one tape under two or more coupled chains, approximately; as ``smooth_joint``, which is exact.

    Time is ``O(T N_1 ... N_C max N_c)``, memory ``O(T N_1 ... N_C)``. The log-evidence is approximate too.

    Args:
        chain: of ``C`` chains.
        log_obs: ``[T, N_c]`` for each chain; rows of zeros where nothing was seen.
        actions: int ``[T]``; the last of a trial is ignored.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.
    """
    tape = jax.tree.map(lambda x: x[None], (log_obs, actions, start, valid))
    seen = smooth_marginals_of_tapes(chain, *tape)
    return seen._replace(log_evidence=seen.log_evidence[0], gamma=tuple(x[0] for x in seen.gamma))
