"""The flat action-conditioned hidden Markov model (thesis section 3.3): ``FLAT`` and its parameters.

``chain_family`` makes the family of any model whose production states emit and earn as the flat ones do and
whose transitions come from two tables of probability rows; the flat model is the plainest of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Chain, Posterior, TrialBatch, pytree
from jaxpomdp.kernels.emissions import tempered, unless_missing
from jaxpomdp.models import estimates
from jaxpomdp.models.checks import check
from jaxpomdp.models.emission import GaussianStatistics, ReturnModel
from jaxpomdp.models.family import PARTS, Family, Prior
from jaxpomdp.numerics import NEG


@pytree
class FlatParams:
    """Parameters of a model of ``N`` states; per-state leaves have ``N`` first (``log_trans``: axes 1 and 2).

    Attributes:
        log_init: ``[N]``, log probability of the first state.
        log_trans: ``[A, N, N]``, log probability of going from (row) to (column) under each action.
        emissions: tuple of channels (``Categorical``, ``DiagonalGaussian``, ``FullGaussian``), all emitted.
        returns: ``ReturnModel``, the return from each state on.
        alive: bool ``[N]``, the state exists (else it is spare capacity).
    """

    log_init: Array
    log_trans: Array
    emissions: tuple[Any, ...]
    returns: ReturnModel
    alive: Array


class FlatStatistics(NamedTuple):
    """Expected counts ``initial[N]``, ``transitions[A, N, N]``; an entry per channel; returns' moments."""

    initial: Array
    transitions: Array
    emissions: tuple[Any, ...]
    returns: GaussianStatistics


class Tables(NamedTuple):
    """How a model's chain is made of two tables of log-probability rows (last axis).

    Parameters have the leaves ``emissions``, ``returns`` and ``alive`` of ``FlatParams`` besides.

    Attributes:
        names: the parameters' fields that hold the tables of the parts "init" and "transitions".
        chain: ``params -> Chain``.
        rows: ``params -> (init, transitions)``, the tables with ``NEG`` wherever nothing can go.
        counts: ``(params, statistics) -> (init, transitions)``, how often each entry was used.
    """

    names: tuple[str, str]
    chain: Callable[[Any], Chain]
    rows: Callable[[Any], tuple[Array, Array]]
    counts: Callable[[Any, FlatStatistics], tuple[Array, Array]]


def _mask(params: Any, log_density: Array) -> Array:
    return jnp.where(jnp.broadcast_to(params.alive, log_density.shape), log_density, NEG)


def _observation_density(params: Any, observations: tuple[Array, ...], observed: Array) -> Array:
    total = sum(channel.log_density(x) for channel, x in zip(params.emissions, observations, strict=True))
    return unless_missing(total, observed)


def _log_obs(params: Any, observations: tuple[Array, ...], observed: Array) -> Array:
    return _mask(params, _observation_density(params, observations, observed))


def _learning(tables: Tables, params: Any, batch: TrialBatch, theta: float) -> tuple[Chain, Array]:
    log_obs = _observation_density(params, batch.observations, batch.observed)
    if theta != 0:
        log_return = params.returns.log_density(batch.returns, batch.actions)
        log_obs = tempered(log_obs, log_return, theta, batch.has_return)
    return tables.chain(params), _mask(params, log_obs)


def _masks(batch: TrialBatch) -> tuple[Array, Array]:
    """Return where observations, and where modelled returns, exist."""
    return batch.observed & batch.valid, batch.has_return & batch.valid


def _feasible(tables: Tables, params: Any, batch: TrialBatch, prior: Prior, carry: Any) -> Any:
    seen, paid = _masks(batch)
    carried = (None,) * len(params.emissions) if carry is None else carry.emissions
    channels = zip(params.emissions, batch.observations, carried, strict=True)
    emissions = tuple(channel.feasible(x, seen, prior, extra) for channel, x, extra in channels)
    returns = params.returns.feasible(batch.returns, paid, prior, None if carry is None else carry.returns)
    return _frozen(tables, params, replace(params, emissions=emissions, returns=returns), prior)


def _statistics(params: Any, batch: TrialBatch, posterior: Posterior) -> FlatStatistics:
    (seen, paid), gamma = _masks(batch), posterior.gamma
    channels = list(zip(params.emissions, batch.observations, strict=True))
    features = [channel.features(x, seen) for channel, x in channels]
    features.append(params.returns.features(batch.returns, batch.actions, paid))
    sums = estimates.weighted_sums(gamma, jnp.concatenate(features, axis=-1))
    ends = list(accumulate(part.shape[-1] for part in features))
    *parts, last = jnp.split(sums, ends[:-1])
    emissions = tuple(
        channel.collect(part, x, seen, gamma) for (channel, x), part in zip(channels, parts, strict=True)
    )
    returns = params.returns.collect(last, batch.returns, paid)
    return FlatStatistics(posterior.initial, posterior.xi, emissions, returns)


def _keep_absent(params: Any, old: Any, new: Any) -> Any:
    """Take the new rows of the states that exist, and the old rows of spare capacity."""

    def keep(x: Array, y: Array) -> Array:
        return jnp.where(params.alive.reshape(-1, *(1,) * (x.ndim - 1)), y, x)

    return jax.tree.map(keep, old, new)


def _m_step(tables: Tables, params: Any, statistics: FlatStatistics, prior: Prior) -> Any:
    pairs = zip(params.emissions, statistics.emissions, strict=True)
    emissions = tuple(channel.updated(counts, prior) for channel, counts in pairs)
    returns = params.returns.updated(statistics.returns, prior)
    counted = zip(tables.rows(params), tables.counts(params, statistics), _pseudo(prior), strict=True)
    rows = [estimates.dirichlet_mode(old, counts, pseudo) for old, counts, pseudo in counted]
    return _renewed(tables, params, rows, emissions, returns, prior)


def _pseudo(prior: Prior) -> tuple[float, float]:
    return prior.initial, prior.transition


def _renewed(
    tables: Tables,
    old: Any,
    rows: list[Array],
    emissions: tuple[Any, ...],
    returns: ReturnModel,
    prior: Prior,
) -> Any:
    """Put new rows, channels and returns in, but for absent states and what the prior freezes."""
    new = replace(
        old,
        emissions=_keep_absent(old, old.emissions, emissions),
        returns=_keep_absent(old, old.returns, returns),
        **dict(zip(tables.names, rows, strict=True)),
    )
    return _frozen(tables, old, new, prior)


def _frozen(tables: Tables, old: Any, new: Any, prior: Prior) -> Any:
    """Put back the parts that the prior freezes."""
    fields = dict(zip(PARTS, (*tables.names, "emissions", "returns"), strict=True))
    return replace(new, **{fields[part]: getattr(old, fields[part]) for part in prior.freeze})


def _score(params: Any, rows: Iterable[Array], emissions: Iterable[Array], returns: Array) -> Array:
    per_state = jnp.sum(jnp.where(params.alive, sum(emissions) + returns, 0))
    return sum((jnp.sum(row) for row in rows), per_state)


def _log_prior(tables: Tables, params: Any, statistics: FlatStatistics, prior: Prior, theta: float) -> Array:
    pseudo = zip(tables.rows(params), _pseudo(prior), strict=True)
    rows = [estimates.dirichlet_score(row, count) for row, count in pseudo]
    pairs = zip(params.emissions, statistics.emissions, strict=True)
    emissions = [channel.log_prior(counts, prior) for channel, counts in pairs]
    return _score(params, rows, emissions, theta * params.returns.log_prior(statistics.returns, prior))


def _expected(tables: Tables, params: Any, statistics: FlatStatistics, theta: float) -> Array:
    counted = zip(tables.chain(params), (statistics.initial, statistics.transitions), strict=True)
    rows = [estimates.dirichlet_score(row, counts) for row, counts in counted]
    pairs = zip(params.emissions, statistics.emissions, strict=True)
    emissions = [channel.expected(counts) for channel, counts in pairs]
    return _score(params, rows, emissions, theta * params.returns.expected(statistics.returns))


def _to_free(tables: Tables, params: Any) -> dict[str, Any]:
    initial, transitions = (getattr(params, name) for name in tables.names)
    return {
        "init": initial,
        "transitions": transitions,
        "emissions": tuple(channel.to_free() for channel in params.emissions),
        "returns": params.returns.to_free(),
    }


def _from_free(tables: Tables, params: Any, free: dict[str, Any], prior: Prior) -> Any:
    channels = zip(params.emissions, free["emissions"], strict=True)
    emissions = tuple(channel.from_free(leaves) for channel, leaves in channels)
    logits = zip(tables.rows(params), (free["init"], free["transitions"]), strict=True)
    rows = [estimates.free_rows(old, new) for old, new in logits]
    return _renewed(tables, params, rows, emissions, params.returns.from_free(free["returns"]), prior)


def _count_free(tables: Tables, params: Any, prior: Prior, theta: float) -> Array:
    initial, transitions = (jnp.sum(estimates.count_free_entries(row)) for row in tables.rows(params))
    counts = {
        "init": initial,
        "transitions": transitions,
        "emissions": jnp.sum(jnp.where(params.alive, sum(c.count_free() for c in params.emissions), 0)),
        "returns": jnp.sum(jnp.where(params.alive, params.returns.count_free(), 0)) * (theta > 0),
    }
    return jnp.asarray(sum(count for part, count in counts.items() if part not in prior.freeze))


def chain_family(name: str, tables: Tables, check: Callable[..., None]) -> Family:
    """Return the family of models of production states whose transitions come from two tables.

    Args:
        name: what the family is called in stored files.
        tables: where the rows are, the chain that they make, and what of the statistics is theirs.
        check: ``(params, batch) -> None``, as in ``Family``.
    """
    return Family(
        name=name,
        acting=tables.chain,
        log_obs=_log_obs,
        learning=partial(_learning, tables),
        feasible=partial(_feasible, tables),
        statistics=_statistics,
        m_step=partial(_m_step, tables),
        log_prior=partial(_log_prior, tables),
        expected=partial(_expected, tables),
        to_free=partial(_to_free, tables),
        from_free=partial(_from_free, tables),
        count_free=partial(_count_free, tables),
        check=check,
    )


def _acting(params: FlatParams) -> Chain:
    alive = params.alive
    both = alive[:, None] & alive[None, :]
    return Chain(_mask(params, params.log_init), jnp.where(both[None], params.log_trans, NEG))


def _counts(params: FlatParams, statistics: FlatStatistics) -> tuple[Array, Array]:
    return statistics.initial, statistics.transitions


FLAT = chain_family("flat", Tables(("log_init", "log_trans"), _acting, _acting, _counts), check)
"""The flat model as a family."""
