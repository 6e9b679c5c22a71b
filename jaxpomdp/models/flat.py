"""The flat action-conditioned hidden Markov model (thesis section 3.3): ``FLAT`` and its parameters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Chain, Posterior, TrialBatch, pytree
from jaxpomdp.kernels.emissions import tempered, unless_missing
from jaxpomdp.models import estimates
from jaxpomdp.models.checks import check
from jaxpomdp.models.emission import GaussianStatistics, ReturnModel
from jaxpomdp.models.family import Family, Prior
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


def _mask(params: FlatParams, log_density: Array) -> Array:
    return jnp.where(jnp.broadcast_to(params.alive, log_density.shape), log_density, NEG)


def _acting(params: FlatParams) -> Chain:
    alive = params.alive
    both = alive[:, None] & alive[None, :]
    return Chain(_mask(params, params.log_init), jnp.where(both[None], params.log_trans, NEG))


def _observation_density(params: FlatParams, observations: tuple[Array, ...], observed: Array) -> Array:
    total = sum(channel.log_density(x) for channel, x in zip(params.emissions, observations, strict=True))
    return unless_missing(total, observed)


def _log_obs(params: FlatParams, observations: tuple[Array, ...], observed: Array) -> Array:
    return _mask(params, _observation_density(params, observations, observed))


def _learning(params: FlatParams, batch: TrialBatch, theta: float) -> tuple[Chain, Array]:
    log_obs = _observation_density(params, batch.observations, batch.observed)
    if theta != 0:
        log_return = params.returns.log_density(batch.returns, batch.actions)
        log_obs = tempered(log_obs, log_return, theta, batch.has_return)
    return _acting(params), _mask(params, log_obs)


def _masks(batch: TrialBatch) -> tuple[Array, Array]:
    """Return where observations, and where modelled returns, exist."""
    return batch.observed & batch.valid, batch.has_return & batch.valid


def _feasible(params: FlatParams, batch: TrialBatch, prior: Prior, carry: Any) -> FlatParams:
    seen, paid = _masks(batch)
    carried = (None,) * len(params.emissions) if carry is None else carry.emissions
    channels = zip(params.emissions, batch.observations, carried, strict=True)
    emissions = tuple(channel.feasible(x, seen, prior, extra) for channel, x, extra in channels)
    returns = params.returns.feasible(batch.returns, paid, prior, None if carry is None else carry.returns)
    return _frozen(params, replace(params, emissions=emissions, returns=returns), prior)


def _statistics(params: FlatParams, batch: TrialBatch, posterior: Posterior) -> FlatStatistics:
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


def _keep_absent(params: FlatParams, old: Any, new: Any) -> Any:
    """Take the new rows of the states that exist, and the old rows of spare capacity."""

    def keep(x: Array, y: Array) -> Array:
        return jnp.where(params.alive.reshape(-1, *(1,) * (x.ndim - 1)), y, x)

    return jax.tree.map(keep, old, new)


def _m_step(params: FlatParams, statistics: FlatStatistics, prior: Prior) -> FlatParams:
    chain = _acting(params)
    pairs = zip(params.emissions, statistics.emissions, strict=True)
    emissions = tuple(channel.updated(counts, prior) for channel, counts in pairs)
    returns = params.returns.updated(statistics.returns, prior)
    new = FlatParams(
        estimates.dirichlet_mode(chain.log_init, statistics.initial, prior.initial),
        estimates.dirichlet_mode(chain.log_trans, statistics.transitions, prior.transition),
        _keep_absent(params, params.emissions, emissions),
        _keep_absent(params, params.returns, returns),
        params.alive,
    )
    return _frozen(params, new, prior)


def _frozen(old: FlatParams, new: FlatParams, prior: Prior) -> FlatParams:
    """Put back the parts that the prior freezes."""
    fields = {"init": "log_init", "transitions": "log_trans", "emissions": "emissions", "returns": "returns"}
    return replace(new, **{fields[part]: getattr(old, fields[part]) for part in prior.freeze})


def _chain_score(chain: Chain, initial: float | Array, transitions: float | Array) -> Array:
    rows = estimates.dirichlet_score(chain.log_trans, transitions)
    return estimates.dirichlet_score(chain.log_init, initial) + jnp.sum(rows)


def _score(params: FlatParams, chain_score: Array, emissions: Iterable[Array], returns: Array) -> Array:
    return chain_score + jnp.sum(jnp.where(params.alive, sum(emissions) + returns, 0))


def _log_prior(params: FlatParams, statistics: FlatStatistics, prior: Prior, theta: float) -> Array:
    chain = _acting(params)
    rows = _chain_score(chain, prior.initial, prior.transition)
    pairs = zip(params.emissions, statistics.emissions, strict=True)
    emissions = [channel.log_prior(counts, prior) for channel, counts in pairs]
    returns = theta * params.returns.log_prior(statistics.returns, prior)
    return _score(params, rows, emissions, returns)


def _expected(params: FlatParams, statistics: FlatStatistics, theta: float) -> Array:
    chain = _acting(params)
    rows = _chain_score(chain, statistics.initial, statistics.transitions)
    pairs = zip(params.emissions, statistics.emissions, strict=True)
    emissions = [channel.expected(counts) for channel, counts in pairs]
    returns = theta * params.returns.expected(statistics.returns)
    return _score(params, rows, emissions, returns)


def _to_free(params: FlatParams) -> dict[str, Any]:
    return {
        "init": params.log_init,
        "transitions": params.log_trans,
        "emissions": tuple(channel.to_free() for channel in params.emissions),
        "returns": params.returns.to_free(),
    }


def _from_free(params: FlatParams, free: dict[str, Any], prior: Prior) -> FlatParams:
    chain = _acting(params)
    channels = zip(params.emissions, free["emissions"], strict=True)
    emissions = tuple(channel.from_free(leaves) for channel, leaves in channels)
    new = FlatParams(
        estimates.free_rows(chain.log_init, free["init"]),
        estimates.free_rows(chain.log_trans, free["transitions"]),
        _keep_absent(params, params.emissions, emissions),
        _keep_absent(params, params.returns, params.returns.from_free(free["returns"])),
        params.alive,
    )
    return _frozen(params, new, prior)


def _count_free(params: FlatParams, prior: Prior, theta: float) -> Array:
    chain = _acting(params)
    counts = {
        "init": estimates.count_free_entries(chain.log_init),
        "transitions": jnp.sum(estimates.count_free_entries(chain.log_trans)),
        "emissions": jnp.sum(jnp.where(params.alive, sum(c.count_free() for c in params.emissions), 0)),
        "returns": jnp.sum(jnp.where(params.alive, params.returns.count_free(), 0)) * (theta > 0),
    }
    return jnp.asarray(sum(count for part, count in counts.items() if part not in prior.freeze))


FLAT = Family(
    name="flat",
    acting=_acting,
    log_obs=_log_obs,
    learning=_learning,
    feasible=_feasible,
    statistics=_statistics,
    m_step=_m_step,
    log_prior=_log_prior,
    expected=_expected,
    to_free=_to_free,
    from_free=_from_free,
    count_free=_count_free,
    check=check,
)
"""The flat model as a family."""
