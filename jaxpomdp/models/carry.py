"""Statistics to carry into EM beside a batch's own: what is known already, as if it had been seen.

``em_step`` and ``fit`` take them as ``carry``. For stepwise (incremental) EM carry the decayed statistics of
the batches before: ``scale_statistics(statistics, decay)``, and add each new batch's with ``add_statistics``.
The functions here make statistics of a model, or of transitions alone; for one flat model, so ``vmap`` them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array
from jaxpomdp.models.flat import FLAT, FlatParams, FlatStatistics
from jaxpomdp.numerics import normalise


def model_as_data(params: FlatParams, strength: float | Array) -> FlatStatistics:
    """Count every distribution of a model as seen ``strength`` times: carried, it pulls EM to that model.

    Args:
        params: one model, as the one of the phase before.
        strength: data per row; each transition row counts ``strength`` transitions, and so on.

    Returns:
        FlatStatistics: with no data of their own (variance floors are left to the batch).
    """
    chain = FLAT.acting(params)
    return FlatStatistics(
        strength * jnp.exp(chain.log_init),
        strength * jnp.exp(chain.log_trans),
        tuple(channel.as_counts(strength) for channel in params.emissions),
        params.returns.as_counts(strength),
    )


def averaged_transitions(statistics: FlatStatistics, strength: float | Array) -> FlatStatistics:
    """Count for each action ``strength`` transitions spread as those of all actions together.

    Carried, it is a Dirichlet prior with the action-averaged row as its mean: an action that was never tried
    in a state is expected to do what the others do there. A state never left counts nothing.

    Args:
        statistics: what ``em_step`` reported of the batch (``StepInfo.statistics``), one model's.
        strength: transitions per row.

    Returns:
        FlatStatistics: zero but for the transitions.
    """
    pooled = jnp.sum(statistics.transitions, axis=0, keepdims=True)
    rows = strength * normalise(pooled, jnp.zeros_like(pooled))
    nothing = jax.tree.map(jnp.zeros_like, statistics)
    return nothing._replace(transitions=jnp.broadcast_to(rows, statistics.transitions.shape))
