"""Coupled hidden Markov models (thesis sections 3.4 and 6.3.5): parameters, and a family for each coupling.

Several chains, the strands, each with states and emissions of its own; where each goes depends on the states
of all (``couplings``). Strand 0 is the thesis's ``S^O``, by which an agent acts; a strand with a return model
and no channels is its ``S^R``.

Acting uses strand 0 alone, as a chain of its own. The other strands are what learning knew and acting does
not: its transitions are ``T(o, o') = sum_r n(o, r, o') / sum_{r, o'} n(o, r, o')`` with ``n`` the expected
moves when the model was last re-estimated (plus the prior's pseudo-counts). Of all Markov chains on ``S^O``
this one gives the data, as the coupled model sees them, the highest expected log-likelihood: the M-step of a
flat model. It is kept as ``log_alone``; it is no part of what learning maximises.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Chain, TrialBatch, pytree
from jaxpomdp.kernels.coupled import CoupledChain, CoupledPosterior
from jaxpomdp.kernels.coupled_plans import coupled_posterior, marginal_posterior
from jaxpomdp.kernels.emissions import tempered, unless_missing
from jaxpomdp.models import estimates
from jaxpomdp.models.coupled_checks import check
from jaxpomdp.models.couplings import MIXTURE, PRODUCT, Coupling, kept_rows, live_pairs, to_chain
from jaxpomdp.models.emission import GaussianStatistics, ReturnModel
from jaxpomdp.models.family import Family, Prior
from jaxpomdp.numerics import NEG


@pytree
class Strand:
    """One chain: ``log_init[N]``, its channels (maybe none), its returns (or None), ``alive[N]``.

    The channels of a batch belong to the strands in order: first those of strand 0, then of strand 1.
    """

    log_init: Array
    emissions: tuple[Any, ...]
    returns: ReturnModel | None
    alive: Array


@pytree
class CoupledParams:
    """Parameters of ``C`` coupled chains.

    Attributes:
        strands: tuple of ``C`` strands, of ``N_c`` states each.
        log_pairs: ``log_pairs[c][k]`` is ``[A, N_k, N_c]``, log rows of strand ``c`` heeding ``k``.
        log_weights: ``[C, C]``, log of how much strand (row) heeds strand (column); None in a product.
        log_alone: ``[A, N_0, N_0]``, log transitions of strand 0 by itself, for acting.
    """

    strands: tuple[Strand, ...]
    log_pairs: tuple[tuple[Array, ...], ...]
    log_weights: Array | None
    log_alone: Array

    @property
    def alive(self) -> Array:
        """Return which states of strand 0 exist, bool ``[N_0]``."""
        return self.strands[0].alive


class StrandStatistics(NamedTuple):
    """Expected counts ``initial[N]``; an entry per channel; returns' moments, or None."""

    initial: Array
    emissions: tuple[Any, ...]
    returns: GaussianStatistics | None


class CoupledStatistics(NamedTuple):
    """Of every strand; of the coupling (``Coupling.counts``); moves ``[A, N_0, N_0]`` of strand 0."""

    strands: tuple[StrandStatistics, ...]
    moves: Any
    alone: Array


def own_channels(params: CoupledParams, channels: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    """Deal a batch's channels out to the strands."""
    ends = list(accumulate(len(strand.emissions) for strand in params.strands))
    return [channels[begin:end] for begin, end in zip([0, *ends[:-1]], ends, strict=True)]


def live(params: CoupledParams) -> tuple[tuple[Array, ...], ...]:
    """Return ``log_pairs`` with ``NEG`` wherever a state does not exist."""
    return live_pairs(params.log_pairs, [strand.alive for strand in params.strands])


def _mask(strand: Strand, rows: Array) -> Array:
    return jnp.where(jnp.broadcast_to(strand.alive, rows.shape), rows, NEG)


def _densities(strand: Strand, observations: tuple[Array, ...], observed: Array) -> Array:
    """Return the log density of a strand's channels, ``[..., N]``; zeros if it has none."""
    nothing = jnp.zeros((*observed.shape, strand.alive.shape[-1]), strand.log_init.dtype)
    pairs = zip(strand.emissions, observations, strict=True)
    return unless_missing(sum((channel.log_density(x) for channel, x in pairs), nothing), observed)


def _log_obs(params: CoupledParams, observations: tuple[Array, ...], observed: Array) -> Array:
    strand = params.strands[0]
    return _mask(strand, _densities(strand, own_channels(params, observations)[0], observed))


def _acting(params: CoupledParams) -> Chain:
    strand = params.strands[0]
    both = strand.alive[..., :, None] & strand.alive[..., None, :]
    alone = jnp.where(both[..., None, :, :], params.log_alone, NEG)
    return Chain(_mask(strand, strand.log_init), alone)


def _learning_rows(strand: Strand, channels: tuple[Array, ...], batch: TrialBatch, theta: float) -> Array:
    rows = _densities(strand, channels, batch.observed)
    if theta != 0 and strand.returns is not None:
        log_return = strand.returns.log_density(batch.returns, batch.actions)
        rows = tempered(rows, log_return, theta, batch.has_return)
    return _mask(strand, rows)


def coupled_chain(coupling: Coupling, params: CoupledParams) -> CoupledChain:
    """Return what inference knows of a coupled model."""
    init = tuple(_mask(strand, strand.log_init) for strand in params.strands)
    return CoupledChain(init, coupling.tables(live(params), params.log_weights))


def _learning(
    coupling: Coupling, params: CoupledParams, batch: TrialBatch, theta: float
) -> tuple[CoupledChain, tuple[Array, ...]]:
    dealt = zip(params.strands, own_channels(params, batch.observations), strict=True)
    rows = tuple(_learning_rows(strand, channels, batch, theta) for strand, channels in dealt)
    return coupled_chain(coupling, params), rows


def _frozen(old: CoupledParams, new: CoupledParams, prior: Prior) -> CoupledParams:
    """Put back the parts that the prior freezes."""
    fields = {"init": "log_init", "emissions": "emissions", "returns": "returns"}
    parts = [fields[part] for part in prior.freeze if part in fields]
    pairs = zip(old.strands, new.strands, strict=True)
    strands = tuple(replace(y, **{name: getattr(x, name) for name in parts}) for x, y in pairs)
    if "transitions" in prior.freeze:
        return replace(old, strands=strands)
    return replace(new, strands=strands)


def _feasible(params: CoupledParams, batch: TrialBatch, prior: Prior, carry: Any) -> CoupledParams:
    seen, paid = batch.observed & batch.valid, batch.has_return & batch.valid
    carried = (None,) * len(params.strands) if carry is None else carry.strands

    def lifted(strand: Strand, channels: tuple[Array, ...], extra: StrandStatistics | None) -> Strand:
        extras = (None,) * len(channels) if extra is None else extra.emissions
        triples = zip(strand.emissions, channels, extras, strict=True)
        emissions = tuple(channel.feasible(x, seen, prior, more) for channel, x, more in triples)
        if strand.returns is None:
            return replace(strand, emissions=emissions)
        more = None if extra is None else extra.returns
        returns = strand.returns.feasible(batch.returns, paid, prior, more)
        return replace(strand, emissions=emissions, returns=returns)

    strands = tuple(map(lifted, params.strands, own_channels(params, batch.observations), carried))
    return _frozen(params, replace(params, strands=strands), prior)


def _strand_statistics(
    strand: Strand, channels: tuple[Array, ...], batch: TrialBatch, gamma: Array, initial: Array
) -> StrandStatistics:
    seen, paid = batch.observed & batch.valid, batch.has_return & batch.valid

    def counted(channel: Any, x: Array) -> Any:
        return channel.collect(estimates.weighted_sums(gamma, channel.features(x, seen)), x, seen, gamma)

    emissions = tuple(map(counted, strand.emissions, channels))
    if strand.returns is None:
        return StrandStatistics(initial, emissions, None)
    features = strand.returns.features(batch.returns, batch.actions, paid)
    sums = estimates.weighted_sums(gamma, features)
    return StrandStatistics(initial, emissions, strand.returns.collect(sums, batch.returns, paid))


def _statistics(
    coupling: Coupling, params: CoupledParams, batch: TrialBatch, posterior: CoupledPosterior
) -> CoupledStatistics:
    dealt = own_channels(params, batch.observations)
    each = zip(params.strands, dealt, posterior.gamma, posterior.initial, strict=True)
    strands = tuple(_strand_statistics(strand, x, batch, gamma, first) for strand, x, gamma, first in each)
    moves = coupling.counts(live(params), params.log_weights, posterior.xi)
    return CoupledStatistics(strands, moves, to_chain(posterior.xi[0], 0))


def _updated(strand: Strand, statistics: StrandStatistics, prior: Prior) -> Strand:
    """Return the strand of highest posterior density; states that do not exist keep what they have."""

    def keep(x: Array, y: Array) -> Array:
        return jnp.where(strand.alive.reshape(-1, *(1,) * (x.ndim - 1)), y, x)

    init = estimates.dirichlet_mode(_mask(strand, strand.log_init), statistics.initial, prior.initial)
    pairs = zip(strand.emissions, statistics.emissions, strict=True)
    emissions = tuple(channel.updated(counts, prior) for channel, counts in pairs)
    returns = None if strand.returns is None else strand.returns.updated(statistics.returns, prior)
    new = Strand(init, emissions, returns, strand.alive)
    return jax.tree.map(keep, strand, new)


def _m_step(
    coupling: Coupling, params: CoupledParams, statistics: CoupledStatistics, prior: Prior
) -> CoupledParams:
    pairs = zip(params.strands, statistics.strands, strict=True)
    strands = tuple(_updated(strand, counts, prior) for strand, counts in pairs)
    rows, weights = coupling.updated(live(params), params.log_weights, statistics.moves, prior.transition)
    alone = estimates.dirichlet_mode(_acting(params).log_trans, statistics.alone, prior.transition)
    kept = kept_rows(params.log_pairs, rows, [strand.alive for strand in strands])
    return _frozen(params, CoupledParams(strands, kept, weights, alone), prior)


def _strand_scores(params: CoupledParams, statistics: CoupledStatistics, theta: float, score: Any) -> Array:
    """Add up ``score(channel, counts)`` over strands and channels, returns ``theta`` times."""
    total = jnp.zeros((), params.log_alone.dtype)
    for strand, counts in zip(params.strands, statistics.strands, strict=True):
        each = [score(c, n) for c, n in zip(strand.emissions, counts.emissions, strict=True)]
        each += [] if strand.returns is None else [theta * score(strand.returns, counts.returns)]
        total = total + sum(jnp.sum(jnp.where(strand.alive, x, 0)) for x in each)
    return total


def _log_prior(params: CoupledParams, statistics: CoupledStatistics, prior: Prior, theta: float) -> Array:
    total = _strand_scores(params, statistics, theta, lambda channel, n: channel.log_prior(n, prior))
    for strand in params.strands:
        total = total + estimates.dirichlet_score(_mask(strand, strand.log_init), prior.initial)
    rows = [pair for pairs in live(params) for pair in pairs]
    rows += [] if params.log_weights is None else [params.log_weights]
    return total + sum(jnp.sum(estimates.dirichlet_score(row, prior.transition)) for row in rows)


def _expected(
    coupling: Coupling, params: CoupledParams, statistics: CoupledStatistics, theta: float
) -> Array:
    total = _strand_scores(params, statistics, theta, lambda channel, n: channel.expected(n))
    for strand, counts in zip(params.strands, statistics.strands, strict=True):
        total = total + estimates.dirichlet_score(_mask(strand, strand.log_init), counts.initial)
    return total + coupling.expected(live(params), params.log_weights, statistics.moves)


def _to_free(params: CoupledParams) -> dict[str, Any]:
    return {
        "init": tuple(strand.log_init for strand in params.strands),
        "transitions": (params.log_pairs, params.log_weights),
        "emissions": tuple(tuple(c.to_free() for c in strand.emissions) for strand in params.strands),
        "returns": tuple(None if s.returns is None else s.returns.to_free() for s in params.strands),
    }


def _from_free(params: CoupledParams, free: dict[str, Any], prior: Prior) -> CoupledParams:
    def made(strand: Strand, init: Array, channels: tuple[Any, ...], returns: Any) -> Strand:
        emissions = tuple(c.from_free(x) for c, x in zip(strand.emissions, channels, strict=True))
        model = None if strand.returns is None else strand.returns.from_free(returns)
        return Strand(
            estimates.free_rows(_mask(strand, strand.log_init), init), emissions, model, strand.alive
        )

    parts = (free[name] for name in ("init", "emissions", "returns"))
    strands = tuple(map(made, params.strands, *parts))
    logits, weights = free["transitions"]
    rows = jax.tree.map(estimates.free_rows, live(params), logits)
    kept = kept_rows(params.log_pairs, rows, [strand.alive for strand in strands])
    heeds = None if params.log_weights is None else estimates.free_rows(params.log_weights, weights)
    return _frozen(params, CoupledParams(strands, kept, heeds, params.log_alone), prior)


def _count_free(params: CoupledParams, prior: Prior, theta: float) -> Array:
    """Count what the data decide; in a product one factor per next state can go to either pair of strands."""
    strands = params.strands
    rows = sum(jnp.sum(estimates.count_free_entries(pair)) for pairs in live(params) for pair in pairs)
    if params.log_weights is None:
        shared = sum(jnp.maximum(jnp.sum(strand.alive) - 1, 0) for strand in strands)
        rows = rows - (len(strands) - 1) * params.log_alone.shape[0] * shared
    else:
        rows = rows + jnp.sum(estimates.count_free_entries(params.log_weights))
    emitted = [jnp.where(s.alive, c.count_free(), 0) for s in strands for c in s.emissions]
    paid = [jnp.where(s.alive, s.returns.count_free(), 0) for s in strands if s.returns is not None]
    counts = {
        "init": sum(estimates.count_free_entries(_mask(s, s.log_init)) for s in strands),
        "transitions": rows,
        "emissions": sum(jnp.sum(x) for x in emitted),
        "returns": sum(jnp.sum(x) for x in paid) * (theta > 0),
    }
    return jnp.asarray(sum(count for part, count in counts.items() if part not in prior.freeze))


def coupled_family(coupling: Coupling, posterior: Callable[..., Any], name: str) -> Family:
    """Return the family of models coupled by this rule, with this inference."""
    return Family(
        name=name,
        acting=_acting,
        log_obs=_log_obs,
        learning=partial(_learning, coupling),
        feasible=_feasible,
        statistics=partial(_statistics, coupling),
        m_step=partial(_m_step, coupling),
        log_prior=_log_prior,
        expected=partial(_expected, coupling),
        to_free=_to_free,
        from_free=_from_free,
        count_free=_count_free,
        check=partial(check, weighted=coupling is MIXTURE),
        posterior=posterior,
    )


COUPLED_MIXTURE = coupled_family(MIXTURE, coupled_posterior, "coupled_mixture")
"""Two strands, mixture coupling, exact inference: exact EM."""

COUPLED_PRODUCT = coupled_family(PRODUCT, coupled_posterior, "coupled_product")
"""Two strands, product coupling, exact inference: generalised EM."""

COUPLED_MIXTURE_APPROXIMATE = coupled_family(MIXTURE, marginal_posterior, "coupled_mixture_approximate")
"""Two or more strands, mixture coupling, inference on marginals: the objective may fall."""

COUPLED_PRODUCT_APPROXIMATE = coupled_family(PRODUCT, marginal_posterior, "coupled_product_approximate")
"""Two or more strands, product coupling, inference on marginals: the objective may fall."""
