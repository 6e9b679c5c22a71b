"""The ``blocked`` plan: a long tape in about ``sqrt(T)`` blocks that go through time side by side.

One step of a few small models leaves an accelerator idle, so that a tape costs its number of steps in turn,
whatever their size. Here that number is five times ``sqrt(T)``, for ``N`` times the arithmetic:

1. every block is filtered from each state in which it may begin (a product of its step matrices, ``[N, N]``);
2. these responses are chained from block to block, forward and backward;
3. every block is filtered and smoothed again, now from what the past and the future of the tape say of it.

A block entered in state ``i`` has probability ``exp(c_i)`` and predicts by ``q_i`` the state after it. So
``predicted'(j) ∝ sum_i predicted(i) exp(c_i) q_i(j)`` is what the next block begins with, and
``future(i) ∝ exp(c_i) sum_j q_i(j) future'(j)`` what a block says to the one before it.

The arithmetic of a step is that of ``smoothing.smooth_scaled``, and so is the test of what can be trusted:
``q_i`` loses to underflow what a filter that begins in ``i`` loses, and ``c_i`` are logarithms.

Source: Hassan, Särkkä and García-Fernández (2021), "Temporal parallelization of inference in hidden Markov
models", who take a parallel prefix sum over single steps; two levels of blocks do less arithmetic.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, Chain, Posterior
from jaxpomdp.kernels.filtering import (
    EXACT,
    Filtered,
    filter_step,
    linked_steps,
    trial_starts,
    without_padding,
)
from jaxpomdp.kernels.smoothing import backward_step, join_passes, relative_likelihood
from jaxpomdp.numerics import NEG, safe_log


class Blocks(NamedTuple):
    """A tape in ``K`` blocks of ``L`` steps, every array ``[K, L, ...]``; padded at its end."""

    log_obs: Array
    weight: Array
    actions: Array
    first: Array
    linked: Array


class Response(NamedTuple):
    """What blocks do to each state they may begin in: ``after[K, N, N]``, and ``log_prob[K, N]``.

    ``after(i, .)`` predicts the state after the block; ``log_prob(i)`` is that of all that the block shows,
    up to a number that all states share.
    """

    after: Array
    log_prob: Array


def block_length(steps: int) -> int:
    """Return how many steps a block holds: the square root, so that a tape has as many blocks."""
    return math.ceil(math.sqrt(steps))


def _cut(log_obs: Array, actions: Array, start: Array, valid: Array) -> Blocks:
    """Cut a tape, ``[T, ...]``, into blocks; what is missing at the end is filled with steps of padding."""
    steps = valid.shape[0]
    length = block_length(steps)
    first, linked = trial_starts(start, valid), linked_steps(start, valid)
    rows, weight = jnp.where(valid[:, None], log_obs, 0), relative_likelihood(log_obs, valid)

    def cut(x: Array, filling: float) -> Array:
        lacking = [(0, -steps % length)] + [(0, 0)] * (x.ndim - 1)
        return jnp.pad(x, lacking, constant_values=filling).reshape(-1, length, *x.shape[1:])

    drives = jnp.where(linked, actions, 0)
    return Blocks(cut(rows, 0), cut(weight, 1), cut(drives, 0), cut(first, False), cut(linked, False))


def _respond(init: Array, trans: Array, block: Blocks) -> Response:
    """Filter one block from each state, all states at once."""

    def step(so_far: Response, inputs: tuple[Array, Array, Array]) -> tuple[Response, None]:
        after, now = jax.vmap(partial(filter_step, init, trans), (0, None))(so_far.after, inputs)
        # What no state can show is ignored: it must not drown what tells the states apart.
        log_prob = so_far.log_prob + (now.log_norm - jnp.max(now.log_norm))
        return Response(after, log_prob - jnp.max(log_prob)), None

    begin = Response(jnp.eye(init.shape[0], dtype=init.dtype), jnp.zeros_like(init))
    return lax.scan(step, begin, (block.log_obs, block.actions, block.first))[0]


def _predictions(init: Array, responses: Response) -> Array:
    """Return what all blocks before say of the first state of each block, ``[K, N]``."""

    def step(predicted: Array, response: Response) -> tuple[Array, Array]:
        log_weight = jnp.where(predicted > 0, safe_log(predicted) + response.log_prob, NEG)
        weight = jnp.where(predicted > 0, jnp.exp(log_weight - jnp.max(log_weight)), 0)
        total = jnp.sum(weight)
        share = weight / jnp.where(total > 0, total, 1)
        return jnp.matmul(share, response.after, precision=EXACT), predicted

    return lax.scan(step, init, responses)[1]


def _futures(responses: Response) -> Array:
    """Return what all blocks after each one say of the state after it, ``[K, N]``; the largest is one."""

    def step(future: Array, response: Response) -> tuple[Array, Array]:
        log_future = safe_log(jnp.matmul(response.after, future, precision=EXACT)) + response.log_prob
        return jnp.exp(log_future - jnp.max(log_future)), future

    return lax.scan(step, jnp.ones_like(responses.log_prob[0]), responses, reverse=True)[1]


def _filter_block(init: Array, trans: Array, predicted: Array, block: Blocks) -> Filtered:
    inputs = (block.log_obs, block.actions, block.first)
    return lax.scan(partial(filter_step, init, trans), predicted, inputs)[1]


def _weigh_block(trans: Array, future: Array, block: Blocks) -> Array:
    inputs = (block.weight, block.actions, block.linked)
    return lax.scan(partial(backward_step, trans), future, inputs, reverse=True)[1]


def smooth_blocked(
    chain: Chain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> tuple[Posterior, Array]:
    """Smooth one tape, its blocks side by side; arguments and results as ``smoothing.smooth_scaled``."""
    init, trans = jnp.exp(chain.log_init), jnp.exp(chain.log_trans)
    blocks = _cut(log_obs, actions, start, valid)
    responses = jax.vmap(partial(_respond, init, trans))(blocks)
    filtered = jax.vmap(partial(_filter_block, init, trans))(_predictions(init, responses), blocks)
    future = jax.vmap(partial(_weigh_block, trans))(_futures(responses), blocks)
    filtered, future = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:])[: valid.shape[0]], (filtered, future)
    )
    return join_passes(trans, without_padding(filtered, valid), future, actions, start, valid)
