"""The coupled hierarchy (thesis section 6.3.5): a tree of production states, and a flat chain that remembers.

The tree moves activity between its leaves as ``HIERARCHICAL`` does, by ``T*``. The flat chain has a node for
every leaf: it notes the leaf that is active, or keeps the one it has, and while it holds some nodes activity
heeds it: it then goes where the node's own row says, past the hierarchy (``kernels.memory``). By that a
transition can depend on which cousin was active, which no table of a tree can say.

All is a mixture: each move is made by the tree or by the memory, and which is hidden; its posterior credits
the tree's tables (``tree_counts``) and the memory's rows apart, so every M-step is exact and the objective
never falls. A node that nothing was written for is not heeded (a zero, and zeros stay), and then the model is
the tree alone; learning refines what a cousin split wrote and writes nothing of its own accord.

Acting is by the leaves alone (the thesis's ``S^O``), as in ``models.coupled``: a flat chain over them, with
the expected moves of the coupled model as counts, ``log_alone``. It is free of the tree's shape, so it too
tells cousins apart.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array, Chain, TrialBatch, pytree
from jaxpomdp.kernels.memory import MemoryChain, MemoryPosterior, state_posterior
from jaxpomdp.kernels.memory_plans import memory_posterior
from jaxpomdp.models import estimates
from jaxpomdp.models.checks import check_data
from jaxpomdp.models.estimates import check_rows
from jaxpomdp.models.family import Family, Prior
from jaxpomdp.models.flat import FlatStatistics
from jaxpomdp.models.hierarchical import HIERARCHICAL, TreeParams, check_tree_params
from jaxpomdp.numerics import NEG, stop_if_not_finite

MEMORY = ("log_lead", "log_heed", "log_note")
"""The tables of the memory, by their names as parameters; the first is per action."""


@pytree
class CoupledTreeParams:
    """Parameters of a tree of ``N`` leaves and of a memory with a node for each, capacity included.

    Attributes:
        tree: the tree, its leaves' emissions and returns.
        log_lead: ``[A, N, N]``, log probability of each leaf where activity heeds the memory, by its node.
        log_heed: ``[N, 2]``, by the memory's node: activity moves by the tree, or by the memory.
        log_note: ``[N, 2]``, by the memory's node: it is let go for the leaf that is active, or kept.
        log_alone: ``[A, N, N]``, log transitions of the leaves by themselves, for acting.
    """

    tree: TreeParams
    log_lead: Array
    log_heed: Array
    log_note: Array
    log_alone: Array

    @property
    def alive(self) -> Array:
        """Return which leaves exist, bool ``[N]``."""
        return self.tree.alive


class CoupledTreeStatistics(NamedTuple):
    """The tree's share of everything; ``lead``, ``heed``, ``note`` of the memory; all moves ``[A, N, N]``."""

    tree: FlatStatistics
    lead: Array
    heed: Array
    note: Array
    alone: Array


def _between_leaves(params: CoupledTreeParams, table: Array) -> Array:
    both = params.alive[..., :, None] & params.alive[..., None, :]
    return jnp.where(both[..., None, :, :], table, NEG)


def _acting(params: CoupledTreeParams) -> Chain:
    init = HIERARCHICAL.acting(params.tree).log_init
    return Chain(init, _between_leaves(params, params.log_alone))


def memory_chain(params: CoupledTreeParams) -> MemoryChain:
    """Return what inference knows of one model."""
    tree = HIERARCHICAL.acting(params.tree)
    lead = _between_leaves(params, params.log_lead)
    return MemoryChain(tree.log_init, tree.log_trans, lead, params.log_heed, params.log_note)


def _log_obs(params: CoupledTreeParams, observations: tuple[Array, ...], observed: Array) -> Array:
    return HIERARCHICAL.log_obs(params.tree, observations, observed)


def _learning(params: CoupledTreeParams, batch: TrialBatch, theta: float) -> tuple[MemoryChain, Array]:
    return memory_chain(params), HIERARCHICAL.learning(params.tree, batch, theta)[1]


def acting_model(params: CoupledTreeParams, batch: TrialBatch, theta: float) -> tuple[Chain, Array]:
    """Return the chain that acts with what learning sees at each step: the leaves alone, as one flat model.

    It stands in for ``Family.learning`` where evidence about leaves is gathered.
    """
    return _acting(params), HIERARCHICAL.learning(params.tree, batch, theta)[1]


def _feasible(params: CoupledTreeParams, batch: TrialBatch, prior: Prior, carry: Any) -> CoupledTreeParams:
    extra = None if carry is None else carry.tree
    return replace(params, tree=HIERARCHICAL.feasible(params.tree, batch, prior, extra))


def _statistics(
    params: CoupledTreeParams, batch: TrialBatch, posterior: MemoryPosterior
) -> CoupledTreeStatistics:
    tree = HIERARCHICAL.statistics(params.tree, batch, state_posterior(posterior))
    return CoupledTreeStatistics(tree, *posterior.counts[1:], posterior.xi)


def _rows(params: CoupledTreeParams) -> tuple[Array, ...]:
    """Return the memory's tables as rows of what is possible; absent nodes have no rows."""
    here = params.alive[:, None]
    heed, note = (jnp.where(here, table, NEG) for table in (params.log_heed, params.log_note))
    return _between_leaves(params, params.log_lead), heed, note


def _m_step(params: CoupledTreeParams, statistics: CoupledTreeStatistics, prior: Prior) -> CoupledTreeParams:
    tree = HIERARCHICAL.m_step(params.tree, statistics.tree, prior)
    old = (*_rows(params), _acting(params).log_trans)
    counts, names = statistics[1:], (*MEMORY, "log_alone")
    rows = [estimates.dirichlet_mode(x, n, prior.transition) for x, n in zip(old, counts, strict=True)]
    return _renewed(params, tree, dict(zip(names, rows, strict=True)), prior)


def _renewed(
    old: CoupledTreeParams, tree: TreeParams, rows: dict[str, Array], prior: Prior
) -> CoupledTreeParams:
    """Put new rows in, but for absent nodes and where the prior freezes transitions."""
    if "transitions" in prior.freeze:
        return replace(old, tree=tree)
    here = old.alive[:, None]
    kept = {name: jnp.where(here if x.ndim == 2 else here[None], x, getattr(old, name))
            for name, x in rows.items()}  # fmt: skip
    return replace(old, tree=tree, **kept)


def _log_prior(
    params: CoupledTreeParams, statistics: CoupledTreeStatistics, prior: Prior, theta: float
) -> Array:
    rows = (jnp.sum(estimates.dirichlet_score(row, prior.transition)) for row in _rows(params))
    return HIERARCHICAL.log_prior(params.tree, statistics.tree, prior, theta) + sum(rows)


def _expected(params: CoupledTreeParams, statistics: CoupledTreeStatistics, theta: float) -> Array:
    pairs = zip(_rows(params), statistics[1:4], strict=True)
    rows = (jnp.sum(estimates.dirichlet_score(row, counts)) for row, counts in pairs)
    return HIERARCHICAL.expected(params.tree, statistics.tree, theta) + sum(rows)


def _to_free(params: CoupledTreeParams) -> dict[str, Any]:
    tree = HIERARCHICAL.to_free(params.tree)
    return tree | {"memory": tuple(getattr(params, name) for name in MEMORY)}


def _from_free(params: CoupledTreeParams, free: dict[str, Any], prior: Prior) -> CoupledTreeParams:
    pairs = zip(_rows(params), free["memory"], strict=True)
    rows = dict(zip(MEMORY, (estimates.free_rows(old, new) for old, new in pairs), strict=True))
    return _renewed(params, HIERARCHICAL.from_free(params.tree, free, prior), rows, prior)


def _count_free(params: CoupledTreeParams, prior: Prior, theta: float) -> Array:
    """Count what the data decide: of the memory, only what belongs to nodes that are heeded."""
    tree = HIERARCHICAL.count_free(params.tree, prior, theta)
    if "transitions" in prior.freeze:
        return tree
    lead, heed, note = _rows(params)
    heeded = heed[:, 1] > NEG / 2
    leads = jnp.sum(jnp.where(heeded[None], estimates.count_free_entries(lead), 0))
    return tree + leads + sum(jnp.sum(estimates.count_free_entries(x)) for x in (heed, note))


def check(params: Any, batch: TrialBatch) -> None:
    """Refuse coupled trees (any leading axes) or a batch that inference cannot use.

    Raises:
        ValueError: naming the argument, what was expected, and what came.
    """
    check_tree_params(params.tree)
    stop_if_not_finite("params", params)
    alive = np.asarray(params.alive)
    lead, leaves, actions = alive.shape[:-1], alive.shape[-1], params.tree.log_horizontal.shape[-3]
    for name in (*MEMORY, "log_alone"):
        table = getattr(params, name)
        choice = name in MEMORY[1:]
        shape = (*lead, leaves, 2) if choice else (*lead, actions, leaves, leaves)
        if tuple(table.shape) != shape:
            raise ValueError(f"params.{name} must have shape {shape}, got {tuple(table.shape)}")
        here = alive if choice else np.broadcast_to(alive[..., None, :], shape[:-1])
        check_rows(f"params.{name}", table, here)
    check_data(params.tree, batch, actions)


COUPLED_TREE: Family = Family(
    name="coupled_tree",
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
    posterior=memory_posterior,
)
"""The coupled hierarchy as a family: exact inference on pairs of a leaf and a remembered one, exact EM."""

LEAVES_ALONE: Family = COUPLED_TREE._replace(
    name="leaves_alone", learning=acting_model, posterior=HIERARCHICAL.posterior
)
"""The same leaves as a flat model of their own, that which acts: for evidence about leaves, not for EM."""
