"""The most likely path of states (Viterbi 1967; Rabiner 1989, section III.B)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain
from jaxpomdp.kernels.filtering import linked_steps, trial_starts
from jaxpomdp.numerics import NEG


class Decoded(NamedTuple):
    """The best path ``states[T]`` (-1 at padding) and ``log_prob[]``, of it jointly with the tape."""

    states: Array
    log_prob: Array


class _Best(NamedTuple):
    """At each step, over paths that end in each state: log-probability less the best one's, and whence."""

    score: Array
    before: Array
    gain: Array


def _search(chain: Chain, log_obs: Array, actions: Array, first: Array) -> _Best:
    def step(carried: Array, inputs: tuple[Array, ...]) -> tuple[Array, _Best]:
        row, action, begins = inputs
        arrivals = carried[:, None] + chain.log_trans[action]
        before = jnp.argmax(arrivals, axis=0)
        predicted = jnp.maximum(jnp.where(begins, chain.log_init, jnp.max(arrivals, axis=0)), NEG)
        joint = jnp.maximum(predicted + row, NEG)
        possible = jnp.max(joint) > NEG / 2
        joint = jnp.where(possible, joint, predicted)
        gain = jnp.max(joint)
        score = jnp.where(joint > NEG / 2, joint - gain, NEG)
        return score, _Best(score, before, jnp.where(possible, gain, NEG))

    leading = jnp.roll(actions, 1)
    return lax.scan(step, chain.log_init, (log_obs, leading, first))[1]


def viterbi(chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array) -> Decoded:
    """Find the most likely path of each trial on a tape: ``argmax_s p(s, observations)``.

    Scores are kept relative to the best one, so their accuracy does not decline along the tape. An impossible
    step is treated as a missing one and adds ``NEG`` to ``log_prob``. Of equal paths the one with the lower
    state number, compared from the end, is taken.

    Args:
        chain: ``log_init[N]``, ``log_trans[A, N, N]``.
        log_obs: ``[T, N]``; a missing step is a row of zeros.
        actions: int ``[T]``; the last of a trial is ignored.
        start: bool ``[T]``, first step of a trial.
        valid: bool ``[T]``, False at padding.
    """
    rows = jnp.where(valid[:, None], log_obs, 0)
    best = _search(chain, rows, actions, trial_starts(start, valid))

    def trace(following: Array, inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        score, after, goes_on = inputs
        state = jnp.where(goes_on, after[following], jnp.argmax(score))
        return state, state

    after = jnp.roll(best.before, -1, axis=0)
    steps = (best.score, after, linked_steps(start, valid))
    states = lax.scan(trace, jnp.zeros((), best.before.dtype), steps, reverse=True)[1]
    return Decoded(jnp.where(valid, states, -1), jnp.sum(jnp.where(valid, best.gain, 0)))
