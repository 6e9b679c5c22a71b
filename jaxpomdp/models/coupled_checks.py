"""Checks of coupled models at public edges, on the host, before anything is compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxpomdp._types import TrialBatch
from jaxpomdp.models.checks import check_batch
from jaxpomdp.models.estimates import check_positive, check_rows
from jaxpomdp.numerics import stop_if_not_finite


def _shape(name: str, array: Any, expected: tuple[int, ...]) -> None:
    if tuple(array.shape) != expected:
        raise ValueError(f"{name} must have shape {expected}, got {tuple(array.shape)}")


def _check_strand(name: str, strand: Any) -> None:
    alive = np.asarray(strand.alive)
    if not alive.any(axis=-1).all():
        raise ValueError(f"{name}.alive must hold at least one state of every model, got none")
    _shape(f"{name}.log_init", strand.log_init, alive.shape)
    check_rows(f"{name}.log_init", strand.log_init, np.ones(alive.shape[:-1], bool))
    for index, channel in enumerate(strand.emissions):
        channel.check_params(alive, f"{name}.emissions[{index}]")
    if strand.returns is not None:
        check_positive(f"{name}.returns.var", strand.returns.var, alive)


def _check_pairs(params: Any) -> None:
    alive = [np.asarray(strand.alive) for strand in params.strands]
    lead, actions = alive[0].shape[:-1], params.log_alone.shape[-3]
    if len(params.log_pairs) != len(alive) or any(len(pairs) != len(alive) for pairs in params.log_pairs):
        came = [len(pairs) for pairs in params.log_pairs]
        raise ValueError(f"params.log_pairs must be {len(alive)} by {len(alive)}, one a pair, got {came}")
    named = {
        f"params.log_pairs[{c}][{k}]": (pair, alive[k], alive[c].shape[-1])
        for c, pairs in enumerate(params.log_pairs)
        for k, pair in enumerate(pairs)
    }
    named["params.log_alone"] = (params.log_alone, alive[0], alive[0].shape[-1])
    for name, (table, here, columns) in named.items():
        shape = (*lead, actions, here.shape[-1], columns)
        _shape(name, table, shape)
        check_rows(name, table, np.broadcast_to(here[..., None, :], shape[:-1]))


def check(params: Any, batch: TrialBatch, *, weighted: bool) -> None:
    """Refuse coupled parameters (any leading axes) or a batch that inference cannot use.

    Args:
        params: ``CoupledParams``.
        batch: the data.
        weighted: the coupling has weights.

    Raises:
        ValueError: naming the argument, what was expected, and what came.
    """
    stop_if_not_finite("params", params)
    for c, strand in enumerate(params.strands):
        _check_strand(f"params.strands[{c}]", strand)
    _check_pairs(params)
    if weighted != (params.log_weights is not None):
        came = "none" if params.log_weights is None else "some"
        wanted = "weights in a mixture" if weighted else "None in a product"
        raise ValueError(f"params.log_weights must be {wanted}, got {came}")
    if weighted:
        chains = len(params.strands)
        lead = np.asarray(params.alive).shape[:-1]
        _shape("params.log_weights", params.log_weights, (*lead, chains, chains))
        check_rows("params.log_weights", params.log_weights, np.ones((*lead, chains), bool))
    _check_data(params, batch)


def _check_data(params: Any, batch: TrialBatch) -> None:
    """Refuse a batch with unknown actions or symbols, or of another number of channels."""
    actions = params.log_alone.shape[-3]
    check_batch(batch, actions)
    for c, strand in enumerate(params.strands):
        if strand.returns is not None and strand.returns.mean.shape[-1] not in (1, actions):
            raise ValueError(
                f"params.strands[{c}].returns must have 1 or {actions} columns (one per action), "
                f"got {strand.returns.mean.shape[-1]}"
            )
    channels = [channel for strand in params.strands for channel in strand.emissions]
    if len(channels) != len(batch.observations):
        raise ValueError(
            f"batch.observations must have {len(channels)} channels, got {len(batch.observations)}"
        )
    seen = np.asarray(batch.observed & batch.valid)
    for index, (channel, x) in enumerate(zip(channels, batch.observations, strict=True)):
        channel.check(np.asarray(x), seen, f"batch.observations[{index}]")
