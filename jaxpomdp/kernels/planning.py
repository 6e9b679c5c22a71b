"""Planning on a known model: values of states, bounds on the value of beliefs, and point-based backups.

A model is ``trans[A, N, N]``, ``obs[1 or A, N, O]`` at the state arrived in, ``reward[A, N]`` and a discount
below one; ``end_trials`` makes its terminal states worthless for ever. The value of a belief is the largest
``alpha . b`` over a set of vectors, each of which stands for a plan and the action it begins with.

For every belief: ``point-based <= best achievable <= informed bound <= QMDP`` (Hauskrecht 2000).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.numerics import NEG, normalise


class Vectors(NamedTuple):
    """``vectors[K, N]`` with the ``actions[K]`` they begin with; rows from ``count[]`` on are not used."""

    vectors: Array
    actions: Array
    count: Array


def end_trials(trans: Array, reward: Array, terminal: Array) -> tuple[Array, Array]:
    """Make every terminal state keep the agent for ever and pay nothing.

    Args:
        trans: ``[A, N, N]``.
        reward: ``[A, N]``.
        terminal: bool ``[N]``.
    """
    stay = jnp.eye(trans.shape[-1], dtype=trans.dtype)
    return jnp.where(terminal[None, :, None], stay[None], trans), jnp.where(terminal[None, :], 0, reward)


def after(belief: Array, trans: Array, obs: Array) -> Array:
    """Return ``P(s', o | b, a) = sum_s b(s) T(s, a, s') O(a, s', o)`` for every action, ``[A, O, N]``."""
    predicted = jnp.einsum("i,aij->aj", belief, trans)
    return predicted[:, None, :] * jnp.swapaxes(obs, 1, 2)


def _iterate(update, table: Array, tolerance: float, limit: int) -> Array:
    """Apply a contraction until no entry changes by more than ``tolerance``, at most ``limit`` times."""

    def going(carry: tuple[Array, Array, Array]) -> Array:
        return (carry[1] > tolerance) & (carry[2] < limit)

    def once(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        new = update(carry[0])
        return new, jnp.max(jnp.abs(new - carry[0])), carry[2] + 1

    return lax.while_loop(going, once, (table, jnp.full((), jnp.inf, table.dtype), jnp.zeros((), int)))[0]


@jax.jit
def value_iteration(
    trans: Array, reward: Array, discount: float, tolerance: float = 1e-6, limit: int = 100_000
) -> Array:
    """Solve the fully observed problem: ``Q(a, s) = r(a, s) + gamma sum_s' T(s, a, s') max_a' Q(a', s')``.

    Returns:
        ``Q[A, N]``. As vectors it is QMDP (Littman, Cassandra and Kaelbling 1995), an upper bound on the
        value of every belief, since it takes the state as known after one step.
    """

    def update(q: Array) -> Array:
        return reward + discount * jnp.einsum("aij,j->ai", trans, jnp.max(q, axis=0))

    return _iterate(update, jnp.zeros_like(reward), tolerance, limit)


@jax.jit
def informed_bound(
    trans: Array, obs: Array, reward: Array, discount: float, tolerance: float = 1e-6, limit: int = 100_000
) -> Array:
    """Return the fast informed bound ``[A, N]`` (Hauskrecht 2000), between the best value and QMDP.

    ``Q(a, s) = r(a, s) + gamma sum_o max_a' sum_s' T(s, a, s') O(a, s', o) Q(a', s')``.
    """

    def update(q: Array) -> Array:
        seen = jnp.swapaxes(obs, 1, 2)[:, :, None, :] * q[None, None]
        worth = jnp.einsum("aij,aobj->aiob", trans, jnp.broadcast_to(seen, (trans.shape[0], *seen.shape[1:])))
        return reward + discount * jnp.sum(jnp.max(worth, axis=-1), axis=-1)

    return _iterate(update, value_iteration(trans, reward, discount, tolerance, limit), tolerance, limit)


@jax.jit
def blind_values(trans: Array, reward: Array, discount: float) -> Array:
    """Return for each action the value of taking it for ever, ``(I - gamma T_a)^-1 r_a``, ``[A, N]``.

    Each is the value of a plan, so together they are a lower bound to start from.
    """
    identity = jnp.eye(trans.shape[-1], dtype=trans.dtype)
    return jnp.linalg.solve(identity[None] - discount * trans, reward[..., None])[..., 0]


def backup(
    belief: Array, current: Vectors, trans: Array, obs: Array, reward: Array, discount: float
) -> tuple[Array, Array]:
    """Return the best plan's vector at a belief, a step longer than those of ``current``, and its action.

    ``alpha_a(s) = r(a, s) + gamma sum_s' T(s, a, s') sum_o O(a, s', o) alpha^{a, o}(s')`` where
    ``alpha^{a, o}`` is the best of ``current`` after ``a`` and ``o``; of these the largest ``alpha_a . b``.

    Returns:
        ``alpha[N]`` and an int scalar.
    """
    scores = jnp.einsum("aoj,kj->aok", after(belief, trans, obs), current.vectors)
    scores = jnp.where(_used(current), scores, NEG)
    following = current.vectors[jnp.argmax(scores, axis=-1)]
    future = jnp.einsum("ajo,aoj->aj", jnp.broadcast_to(obs, (trans.shape[0], *obs.shape[1:])), following)
    alphas = reward + discount * jnp.einsum("aij,aj->ai", trans, future)
    action = jnp.argmax(alphas @ belief)
    return alphas[action], action


def _used(vectors: Vectors) -> Array:
    return (jnp.arange(vectors.actions.shape[0]) < vectors.count)[None, None, :]


def value_at(beliefs: Array, current: Vectors) -> tuple[Array, Array]:
    """Return ``max_k alpha_k . b`` for every belief of ``[B, N]``, and which vector it is, both ``[B]``."""
    scores = jnp.where(_used(current)[0], beliefs @ current.vectors.T, NEG)
    return jnp.max(scores, axis=-1), jnp.argmax(scores, axis=-1)


class _Sweep(NamedTuple):
    """Inside one sweep: the new vectors, what each belief is worth under them, backups done, and a key."""

    new: Vectors
    worth: Array
    done: Array
    key: Array


LEAST = 32
"""Backups in a sweep at least: if the first vector already holds every belief, others may still gain."""


def sweep(
    key: Array,
    beliefs: Array,
    current: Vectors,
    trans: Array,
    obs: Array,
    reward: Array,
    discount: float,
    slack: float = 0.0,
) -> Vectors:
    """Improve every belief by backing up only some of them (Perseus; Spaan and Vlassis 2005).

    A belief that is not yet worth as much as before is drawn and backed up; the new vector often improves
    many others as well, which then need none of their own. A little slack spares the vectors that would only
    defend the last digits of one belief each; every vector is still a plan's value, so the bound stays sound.

    Args:
        key: draws the beliefs.
        beliefs: ``[B, N]``.
        current: the vectors so far, whose shape is the capacity for the new ones too.
        trans: of the model.
        obs: of the model.
        reward: of the model.
        discount: below one.
        slack: a belief may lose so much of the spread of values between beliefs.

    Returns:
        The new vectors; if the capacity was not enough, ``count`` is the capacity and some beliefs are worse.
    """
    before, best_before = value_at(beliefs, current)
    margin = slack * jnp.ptp(before)

    def waiting(carry: _Sweep) -> Array:
        return carry.worth < before - margin

    def going(carry: _Sweep) -> Array:
        unfinished = jnp.any(waiting(carry)) | (carry.done < LEAST)
        return unfinished & (carry.new.count < current.actions.shape[0])

    def once(carry: _Sweep) -> _Sweep:
        key, draw = jax.random.split(carry.key)
        still = waiting(carry)
        i = jnp.argmax(jnp.where(still | ~jnp.any(still), jax.random.uniform(draw, still.shape), -1))
        alpha, action = backup(beliefs[i], current, trans, obs, reward, discount)
        better = alpha @ beliefs[i] >= before[i]
        alpha = jnp.where(better, alpha, current.vectors[best_before[i]])
        action = jnp.where(better, action, current.actions[best_before[i]])
        kept = still[i] | (alpha @ beliefs[i] > carry.worth[i] + margin)
        # a belief that was drawn is done whatever rounding says, so the loop ends
        worth = jnp.maximum(carry.worth, beliefs @ alpha).at[i].max(before[i])
        new = _append(carry.new, alpha, action, kept)
        return _Sweep(new, jnp.where(kept, worth, carry.worth), carry.done + 1, key)

    none = Vectors(jnp.zeros_like(current.vectors), jnp.zeros_like(current.actions), jnp.zeros((), jnp.int32))
    start = _Sweep(none, jnp.full_like(before, -jnp.inf), jnp.zeros((), jnp.int32), key)
    return lax.while_loop(going, once, start).new


def _append(vectors: Vectors, alpha: Array, action: Array, kept: Array) -> Vectors:
    """Write one row behind the others; the next overwrites it unless it is ``kept``."""
    return Vectors(
        vectors.vectors.at[vectors.count].set(alpha),
        vectors.actions.at[vectors.count].set(action.astype(vectors.actions.dtype)),
        vectors.count + kept,
    )


class _Search(NamedTuple):
    """Over all sweeps: the last complete vectors, do they improve, sweeps left, did one overflow."""

    vectors: Vectors
    improving: Array
    left: Array
    full: Array
    key: Array


@jax.jit
def perseus(
    key: Array,
    beliefs: Array,
    current: Vectors,
    trans: Array,
    obs: Array,
    reward: Array,
    discount: float,
    sweeps: int,
    slack: float,
    tolerance: float,
) -> tuple[Vectors, Array, Array]:
    """Sweep until beliefs gain little, ``sweeps`` are spent, or the capacity is too small.

    Args:
        key: draws the beliefs to back up.
        beliefs: ``[B, N]``.
        current: vectors that are a lower bound already, such as ``blind_values``.
        trans: of the model.
        obs: of the model.
        reward: of the model.
        discount: below one.
        sweeps: at most so many.
        slack: see :func:`sweep`.
        tolerance: stop when the mean gain of a sweep is below this part of the spread of values.

    Returns:
        The last complete vectors, how many sweeps are left, and whether a sweep overflowed the capacity.
    """

    def going(carry: _Search) -> Array:
        return carry.improving & (carry.left > 0) & ~carry.full

    def once(carry: _Search) -> _Search:
        key, draw = jax.random.split(carry.key)
        new = sweep(draw, beliefs, carry.vectors, trans, obs, reward, discount, slack)
        before, after_it = value_at(beliefs, carry.vectors)[0], value_at(beliefs, new)[0]
        improving = jnp.mean(after_it - before) > tolerance * jnp.ptp(after_it)
        full = new.count >= new.actions.shape[0]
        kept = jax.tree.map(lambda old, fresh: jnp.where(full, old, fresh), carry.vectors, new)
        return _Search(kept, improving, carry.left - 1, full, key)

    start = _Search(current, jnp.array(True), jnp.asarray(sweeps), jnp.array(False), key)
    end = lax.while_loop(going, once, start)
    return end.vectors, end.left, end.full


def spread(key: Array, candidates: Array, count: int) -> Array:
    """Choose candidates far from each other: each next one is farthest (L1) from all chosen so far.

    Args:
        key: draws the first.
        candidates: beliefs ``[C, N]``.
        count: how many; static.

    Returns:
        int ``[count]``, which candidates; a set that has no more different ones repeats itself.
    """
    first = jax.random.randint(key, (), 0, candidates.shape[0])

    def once(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], Array]:
        distance, chosen = carry
        here = jnp.sum(jnp.abs(candidates - candidates[chosen][None]), axis=-1)
        distance = jnp.minimum(distance, here)
        return (distance, jnp.argmax(distance)), chosen

    everywhere = jnp.full(candidates.shape[0], jnp.inf, candidates.dtype)
    return lax.scan(once, (everywhere, first), None, length=count)[1]


def update(belief: Array, action: Array, observation: Array, trans: Array, obs: Array) -> Array:
    """Return the belief after an action and an observation; one that the model calls impossible is ignored.

    All actions' products are formed and one is kept: under ``vmap`` that is one matrix product.
    """
    predicted = jnp.einsum("i,aij->aj", belief, trans)[action]
    seen_after = action if obs.shape[0] > 1 else 0
    return normalise(predicted * obs[seen_after, :, observation], predicted)
