"""A chain that may heed a memory: exact inference on pairs of an active state and a remembered one.

Beside the chain runs a flat one, its memory, with a node for every state: it remembers one state that was
active before. In each step the memory first takes note of the active state, or keeps what it holds; then
activity moves by the chain, or, where what is held says so, by the memory's own row::

    P(m | o, r)  = note(r) [m = o] + keep(r) [m = r]
    P(o' | o, m) = chain(m) T_a(o, o') + memory(m) C_a(m, o')

So a move can depend on the very state it leaves, and on one left long ago. The pair ``(o, r)`` is a Markov
chain that is never written down: a step costs a product of two matrices ``N`` by ``N``, not ``N^4``. A trial
starts with its first state remembered. Source: thesis section 6.3.5; the scaling is ``smoothing``'s.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain, Posterior
from jaxpomdp.kernels.filtering import EXACT, linked_steps, observe, trial_starts
from jaxpomdp.kernels.smoothing import overlap_floor, relative_likelihood
from jaxpomdp.numerics import NEG, log_sum_exp


class MemoryChain(NamedTuple):
    """What inference knows of a chain of ``N`` states and its memory.

    Attributes:
        log_init: ``[N]``.
        log_trans: ``[A, N, N]``, the chain's own transitions.
        log_lead: ``[A, N, N]``, where activity goes when it heeds the memory, by the remembered state.
        log_heed: ``[N, 2]``, whether it moves by the chain or by the memory, by the remembered state.
        log_note: ``[N, 2]``, whether the memory lets go of it to note the active state, or keeps it.
    """

    log_init: Array
    log_trans: Array
    log_lead: Array
    log_heed: Array
    log_note: Array


class MemoryCounts(NamedTuple):
    """How often each part was used: moves by the chain, by the memory, and the two choices.

    Shapes as in ``MemoryChain``: ``chain[A, N, N]``, ``lead[A, N, N]``, ``heed[N, 2]``, ``note[N, 2]``.
    """

    chain: Array
    lead: Array
    heed: Array
    note: Array


class MemoryPosterior(NamedTuple):
    """As ``Posterior``, of the states; with ``held[T, N]``, what is remembered, and ``counts``."""

    log_evidence: Array
    gamma: Array
    xi: Array
    initial: Array
    held: Array
    counts: MemoryCounts


class PairsFiltered(NamedTuple):
    """The forward pass: ``predicted[T, N, N]`` (active, remembered) before each step's observation.

    The belief after it is ``predicted * ratio[T, N, 1]``; ``log_norm[T]`` as in ``Filtered``.
    """

    predicted: Array
    ratio: Array
    log_norm: Array


def remember(belief: Array, note: Array) -> Array:
    """Let the memory note the active state or keep its own: ``[N, N]`` (active, remembered) of a belief.

    Args:
        belief: probabilities ``[N, N]`` of active and remembered states.
        note: probabilities ``[N, 2]``.
    """
    noted = jnp.matmul(belief, note[:, 0], precision=EXACT)
    return belief * note[None, :, 1] + jnp.diag(noted)


def move(pairs: Array, model: MemoryChain, action: Array) -> Array:
    """Let activity move by the chain or by the memory: ``[N, N]`` to ``[N, N]``, after ``remember``.

    Args:
        pairs: probabilities of active and remembered states.
        model: probabilities, not logarithms.
        action: int scalar.
    """
    by_chain, by_memory = model.log_heed.T[:, None]
    own = jnp.matmul(model.log_trans[action].T, pairs * by_chain, precision=EXACT)
    return own + model.log_lead[action].T * (by_memory * jnp.sum(pairs, axis=0, keepdims=True))


def filter_pairs(
    chain: MemoryChain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> PairsFiltered:
    """Filter one tape over pairs of an active and a remembered state.

    Args:
        chain: the model.
        log_obs: ``[T, N]``, of the active state; a missing step is a row of zeros.
        actions: int ``[T]``.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.
    """
    model = MemoryChain(*map(jnp.exp, chain))
    init = jnp.diag(model.log_init)

    def step(carried: Array, inputs: tuple[Array, ...]) -> tuple[Array, PairsFiltered]:
        row, action, first = inputs
        predicted = jnp.where(first, init, carried)
        active = jnp.sum(predicted, axis=1)
        belief, log_norm = observe(active, row)
        ratio = jnp.where(active > 0, belief / jnp.where(active > 0, active, 1), 0)
        following = move(remember(predicted * ratio[:, None], model.log_note), model, action)
        return following, PairsFiltered(predicted, ratio, log_norm)

    rows = jnp.where(valid[:, None], log_obs, 0)
    return lax.scan(step, init, (rows, actions, trial_starts(start, valid)))[1]


class _Back(NamedTuple):
    """What the backward pass carries: the future over its overlap, and counts to be scaled by the tables."""

    arriving: Array
    counts: MemoryCounts
    led: Array


def smooth_pairs(
    chain: MemoryChain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> MemoryPosterior:
    """Smooth one tape over pairs of an active and a remembered state; arguments as ``filter_pairs``.

    Time is ``O(T N^3)``, memory ``O(T N^2)``. An impossible step is treated as a missing one, as by
    ``smooth``; where underflow leaves past and future no overlap, the future is forgotten there.
    """
    model = MemoryChain(*map(jnp.exp, chain))
    filtered = filter_pairs(chain, log_obs, actions, start, valid)
    weight = relative_likelihood(log_obs, valid)
    floor = overlap_floor(weight.dtype)

    def step(carry: _Back, inputs: tuple[Array, ...]) -> tuple[_Back, tuple[Array, Array]]:
        here, predicted, ratio, action, goes_on = inputs
        belief = predicted * ratio[:, None]
        carry, beta = _counted(carry, model, belief, action, goes_on)
        future = here[:, None] * jnp.where(goes_on, beta, 1)
        overlap = jnp.sum(predicted * future)
        trusted = overlap >= floor
        scaled = future / jnp.where(trusted, overlap, 1)
        arriving = jnp.where(trusted, scaled, jnp.broadcast_to(ratio[:, None], future.shape))
        joint = predicted * arriving
        return carry._replace(arriving=arriving), (jnp.sum(joint, axis=1), jnp.sum(joint, axis=0))

    blank = jnp.zeros_like(model.log_trans)
    counts = MemoryCounts(blank, blank, *map(jnp.zeros_like, (model.log_heed, model.log_note)))
    steps = (weight, filtered.predicted, filtered.ratio, actions, linked_steps(start, valid))
    end, (gamma, held) = lax.scan(step, _Back(jnp.zeros_like(blank[0]), counts, blank), steps, reverse=True)
    gamma, held = (jnp.where(valid[:, None], x, 0) for x in (gamma, held))
    own = model.log_trans * end.counts.chain
    counts = end.counts._replace(chain=own, lead=model.log_lead * end.counts.lead)
    initial = jnp.sum(jnp.where(trial_starts(start, valid)[:, None], gamma, 0), axis=0)
    evidence = jnp.sum(jnp.where(valid, filtered.log_norm, 0))
    return MemoryPosterior(evidence, gamma, own + end.led, initial, held, counts)


def _counted(
    carry: _Back, model: MemoryChain, belief: Array, action: Array, goes_on: Array
) -> tuple[_Back, Array]:
    """Count one step's moves and choices, and return what is to come after each pair, its peak one."""
    (by_chain, by_memory), (note, keep) = model.log_heed.T[:, None], model.log_note.T[:, None]
    trans, lead, arriving = model.log_trans[action], model.log_lead[action], carry.arriving
    past = jnp.where(goes_on, belief, 0)
    pairs = remember(past, model.log_note)
    held = jnp.sum(pairs, axis=0, keepdims=True)
    promised = lead * arriving.T
    own = by_chain * jnp.matmul(trans, arriving, precision=EXACT)
    told = by_memory * jnp.sum(promised, axis=1)[None]
    ahead = own + told
    same = jnp.diag(ahead)[:, None]
    heed = jnp.sum(pairs * own, axis=0), (held * told)[0]
    noted = jnp.sum(past * same * note, axis=0), jnp.sum(past * ahead * keep, axis=0)
    counts = MemoryCounts(
        carry.counts.chain.at[action].add(jnp.matmul(pairs * by_chain, arriving.T, precision=EXACT)),
        carry.counts.lead.at[action].add((by_memory * held).T * arriving.T),
        carry.counts.heed + jnp.stack(heed, axis=1),
        carry.counts.note + jnp.stack(noted, axis=1),
    )
    led = carry.led.at[action].add(jnp.matmul(pairs * by_memory, promised, precision=EXACT))
    beta = keep * ahead + note * same
    peak = jnp.max(beta)
    return _Back(arriving, counts, led), beta / jnp.where(peak > 0, peak, 1)


def pair_chain(chain: MemoryChain) -> Chain:
    """Return chain and memory as one chain of ``N^2`` states, numbered ``active * N + remembered``.

    It is what the kernels here do not write down; with it the best path and random ones come from
    ``decoding`` and ``sampling``.
    """
    n = chain.log_init.shape[0]
    same = jnp.eye(n, dtype=bool)
    note, keep = (column[None, :, None] for column in chain.log_note.T)
    noted, kept = jnp.where(same[:, None], note, NEG), jnp.where(same[None], keep, NEG)
    held = log_sum_exp(jnp.stack(jnp.broadcast_arrays(noted, kept)), axis=0)
    by_chain, by_memory = (column[None, None, :, None] for column in chain.log_heed.T)
    parts = jnp.broadcast_arrays(chain.log_trans[:, :, None] + by_chain, chain.log_lead[:, None] + by_memory)
    moved = log_sum_exp(jnp.stack(parts), axis=0)
    both = held[None, ..., None] + moved[:, :, None]
    pairs = jnp.maximum(jnp.swapaxes(both, -1, -2).reshape(-1, n * n, n * n), NEG)
    return Chain(jnp.where(same, chain.log_init, NEG).reshape(-1), pairs)


def state_posterior(seen: MemoryPosterior) -> Posterior:
    """Return what is known of the states alone, with the moves made by the chain alone as ``xi``."""
    return Posterior(seen.log_evidence, seen.gamma, seen.counts.chain, seen.initial)
