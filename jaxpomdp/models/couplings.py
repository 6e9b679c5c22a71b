"""The two rules that couple chains, as models: tables of moves, expected counts, and their re-estimation.

A pair of chains ``k -> c`` has rows ``T_kc[a, x_k, x']``; ``x`` is the joint state of all chains.

``mixture``: ``P_c(x' | x) = sum_k w_ck T_kc(x_k, x')`` says that each chain heeds one chain at a time. Which
one is hidden; its posterior ``w_ck T_kc(x_k, x') / P_c(x' | x)`` splits the expected moves, and then rows
and weights are the modes of Dirichlet distributions. That is exact EM (Zhong and Ghosh 2001): the objective
cannot fall.

``product``: ``P_c(x' | x) = prod_k T_kc(x_k, x') / Z_c(x)`` is log-linear, and has no closed M-step. With
``n_k`` the expected moves summed over the other chains, ``m_k = sum V(x) P_c(x' | x)`` what the model expects
of as many visits ``V``, and a pseudo-count ``p`` on each of a row's ``M`` possible entries, one chain's rows
at a time become ``T_k (n_k + p) / (m_k + p M T_k)``, scaled. Since ``log z <= z - 1``, this maximises a lower
bound that touches the expected log-likelihood plus log prior at the old rows. So a step never lowers it, and
neither does EM with it: generalised EM (Dempster, Laird and Rubin 1977) by iterative scaling (Darroch and
Ratcliff 1972). Where chains disagree on every next state, a chain goes by its own rows alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.kernels.coupled import along_chain, mixture_rows, product_rows
from jaxpomdp.models import estimates
from jaxpomdp.numerics import NEG, log_normalise

SWEEPS = 2
"""Rounds of iterative scaling in one M-step; any number is generalised EM."""

Pairs = Sequence[Sequence[Array]]


class Coupling(NamedTuple):
    """A rule: functions of ``log_pairs[c][k][A, N_k, N_c]`` (``NEG`` wherever nothing can go) and weights.

    Attributes:
        name: what it is called.
        tables: ``(log_pairs, log_weights) -> log_trans`` of a ``CoupledChain``.
        counts: ``(log_pairs, log_weights, xi) -> counts``, what the M-step needs of the expected moves.
        updated: ``(log_pairs, log_weights, counts, pseudo) -> (log_pairs, log_weights)``, none the worse.
        expected: ``(log_pairs, log_weights, counts) -> []``, expected log-likelihood of the moves.
    """

    name: str
    tables: Callable[..., tuple[Array, ...]]
    counts: Callable[..., Any]
    updated: Callable[..., tuple[Any, Any]]
    expected: Callable[..., Array]


def to_chain(table: Array, chain: int) -> Array:
    """Sum a table ``[A, N_1, ..., N_C, N]`` over all joint states but those of one chain: ``[A, N_k, N]``."""
    axes = tuple(k + 1 for k in range(table.ndim - 2) if k != chain)
    return jnp.sum(table, axis=axes)


def _mixture_tables(log_pairs: Pairs, log_weights: Array) -> tuple[Array, ...]:
    return tuple(mixture_rows(pairs, log_weights[c]) for c, pairs in enumerate(log_pairs))


def _mixture_counts(log_pairs: Pairs, log_weights: Array, xi: Sequence[Array]) -> tuple[Any, ...]:
    """Return how often each chain heeded each other, by move: ``counts[c][k][A, N_k, N_c]``."""
    counts = []
    for c, table in enumerate(_mixture_tables(log_pairs, log_weights)):
        probability = jnp.exp(table)
        ratio = jnp.where(probability > 0, xi[c] / jnp.where(probability > 0, probability, 1), 0)
        pairs = enumerate(log_pairs[c])
        counts.append(tuple(jnp.exp(pair + log_weights[c, k]) * to_chain(ratio, k) for k, pair in pairs))
    return tuple(counts)


def _heeded(counts: Pairs) -> Array:
    """Return how often each chain heeded each other, ``[C, C]``."""
    return jnp.stack([jnp.stack([jnp.sum(pair) for pair in pairs]) for pairs in counts])


def _mixture_updated(
    log_pairs: Pairs, log_weights: Array, counts: Pairs, pseudo: float
) -> tuple[tuple[Any, ...], Array]:
    rows = tuple(
        tuple(estimates.dirichlet_mode(old, n, pseudo) for old, n in zip(pairs, heeded, strict=True))
        for pairs, heeded in zip(log_pairs, counts, strict=True)
    )
    return rows, estimates.dirichlet_mode(log_weights, _heeded(counts), pseudo)


def _mixture_expected(log_pairs: Pairs, log_weights: Array, counts: Pairs) -> Array:
    rows = [
        jnp.sum(estimates.dirichlet_score(pair, n))
        for pairs, heeded in zip(log_pairs, counts, strict=True)
        for pair, n in zip(pairs, heeded, strict=True)
    ]
    return sum(rows, jnp.sum(estimates.dirichlet_score(log_weights, _heeded(counts))))


def _product_tables(log_pairs: Pairs, log_weights: Any) -> tuple[Array, ...]:
    return tuple(product_rows(pairs, c) for c, pairs in enumerate(log_pairs))


def _product_counts(log_pairs: Pairs, log_weights: Any, xi: Sequence[Array]) -> tuple[Array, ...]:
    return tuple(xi)


def _agree(pairs: Sequence[Array]) -> Array:
    """Return where some next state is possible for all chains, ``bool[A, N_1, ..., N_C, 1]``."""
    allowed = jnp.ones((), bool)
    for k, pair in enumerate(pairs):
        table = along_chain(pair > NEG / 2, k, len(pairs))
        allowed = table if k == 0 else allowed & table
    return jnp.any(allowed, axis=-1, keepdims=True)


def scaled_rows(log_row: Array, seen: Array, foreseen: Array, pseudo: float) -> Array:
    """Scale rows ``T`` to ``T (n + p) / (m + p M T)``, and to sum to one; without data or prior they stay.

    Args:
        log_row: ``log T[A, N_k, N]``; zeros stay.
        seen: ``n``, expected moves.
        foreseen: ``m``, what the model expects.
        pseudo: ``p``, pseudo-count of each possible entry.
    """
    possible = log_row > NEG / 2
    entries = jnp.sum(possible, axis=-1, keepdims=True)
    above = seen + pseudo
    below = foreseen + pseudo * entries * jnp.exp(log_row)
    usable = possible & (above > 0) & (below > 0)
    change = jnp.log(jnp.where(usable, above, 1)) - jnp.log(jnp.where(usable, below, 1))
    gone = (above <= 0) & (jnp.sum(jnp.where(possible, above, 0), axis=-1, keepdims=True) > 0)
    return log_normalise(jnp.where(possible & ~gone, log_row + change, NEG))


def scaled_pairs(pairs: Sequence[Array], moves: Array, own: int, pseudo: float) -> tuple[Array, ...]:
    """Improve the rows by which one chain moves, one after the other: a sweep of iterative scaling.

    Args:
        pairs: ``log T_k[A, N_k, N]`` from each chain.
        moves: expected moves ``[A, N_1, ..., N_C, N]``.
        own: the number of the chain that moves.
        pseudo: pseudo-count of each possible entry.
    """
    visits, agree, new = jnp.sum(moves, axis=-1, keepdims=True), _agree(pairs), list(pairs)
    for k in range(len(new)):
        share = jnp.ones_like(agree) if k == own else agree
        shares = moves * share, visits * jnp.exp(product_rows(new, own)) * share
        seen, foreseen = (to_chain(x, k) for x in shares)
        new[k] = scaled_rows(new[k], seen, foreseen, pseudo)
    return tuple(new)


def _product_updated(
    log_pairs: Pairs, log_weights: Any, counts: Sequence[Array], pseudo: float
) -> tuple[tuple[Any, ...], Any]:
    def improve(pairs: Sequence[Array], moves: Array, own: int) -> tuple[Array, ...]:
        return lax.fori_loop(0, SWEEPS, lambda _, rows: scaled_pairs(rows, moves, own, pseudo), tuple(pairs))

    numbered = enumerate(zip(log_pairs, counts, strict=True))
    return tuple(improve(pairs, moves, c) for c, (pairs, moves) in numbered), log_weights


def _product_expected(log_pairs: Pairs, log_weights: Any, counts: Sequence[Array]) -> Array:
    pairs = zip(_product_tables(log_pairs, log_weights), counts, strict=True)
    return sum((jnp.sum(estimates.dirichlet_score(table, n)) for table, n in pairs), jnp.zeros(()))


def live_pairs(log_pairs: Pairs, alive: Sequence[Array]) -> tuple[tuple[Array, ...], ...]:
    """Put ``NEG`` where a move would leave or reach a state that does not exist."""

    def live(pair: Array, old: Array, new: Array) -> Array:
        return jnp.where((old[:, None] & new[None, :])[None], pair, NEG)

    return tuple(
        tuple(live(pair, old, new) for pair, old in zip(pairs, alive, strict=True))
        for pairs, new in zip(log_pairs, alive, strict=True)
    )


def kept_rows(old: Any, new: Any, alive: Sequence[Array]) -> Any:
    """Take new rows of states that exist, and old ones of spare capacity; both ``[c][k][A, N_k, N_c]``."""

    def keep(x: Array, y: Array, here: Array) -> Array:
        return jnp.where(here[None, :, None], y, x)

    return tuple(tuple(map(keep, x, y, alive)) for x, y in zip(old, new, strict=True))


MIXTURE = Coupling("mixture", _mixture_tables, _mixture_counts, _mixture_updated, _mixture_expected)
"""Zhong and Ghosh's convex combination, with learned weights."""

PRODUCT = Coupling("product", _product_tables, _product_counts, _product_updated, _product_expected)
"""Brand's product of pairwise rows, normalised."""
