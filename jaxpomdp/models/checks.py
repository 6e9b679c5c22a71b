"""Checks at public edges, on the host: what comes in fits the model, or a sentence says what does not."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxpomdp._types import TrialBatch
from jaxpomdp.models.estimates import check_positive, check_rows
from jaxpomdp.numerics import stop_if_not_finite


def _shape(name: str, array: Any, expected: tuple[int, ...]) -> None:
    if tuple(array.shape) != expected:
        raise ValueError(f"{name} must have shape {expected}, got {tuple(array.shape)}")


def check_batch(batch: TrialBatch, actions: int) -> None:
    """Refuse a batch whose arrays disagree in shape, that is empty, or that holds unknown actions.

    Raises:
        ValueError: naming the field.
    """
    shape = tuple(batch.valid.shape)
    for name in ("actions", "rewards", "returns", "start", "terminated", "observed", "has_return"):
        _shape(f"batch.{name}", getattr(batch, name), shape)
    valid = np.asarray(batch.valid)
    if not valid.any():
        raise ValueError(f"batch must hold at least one step, got none in {shape}")
    taken = np.asarray(batch.actions)
    unknown = valid & ((taken < 0) | (taken >= actions))
    if unknown.any():
        raise ValueError(f"batch.actions must be in 0..{actions - 1}, got {taken[unknown][0]}")
    for index, channel in enumerate(batch.observations):
        if tuple(channel.shape[: len(shape)]) != shape:
            name, came = f"batch.observations[{index}]", tuple(channel.shape)
            raise ValueError(f"{name} must have a shape that starts with {shape}, got {came}")
    modelled = np.asarray(batch.returns)[np.asarray(batch.has_return) & valid]
    if not np.isfinite(modelled).all():
        raise ValueError("batch.returns must be finite where has_return, got NaN or infinity")


def check_leaves(params: Any) -> None:
    """Refuse parameters whose emissions and returns do not fit their states (any leading axes).

    Raises:
        ValueError: naming the field.
    """
    alive = np.asarray(params.alive)
    if not alive.any(axis=-1).all():
        raise ValueError("params.alive must hold at least one state of every model, got none")
    stop_if_not_finite("params", params)
    for path, leaf in jax.tree_util.tree_leaves_with_path((params.emissions, params.returns)):
        if tuple(leaf.shape[: alive.ndim]) != alive.shape:
            name = f"params (emissions, returns){jax.tree_util.keystr(path)}"
            raise ValueError(f"{name} must have a shape that starts with {alive.shape}, got {leaf.shape}")
    check_positive("params.returns.var", params.returns.var, alive)
    for index, channel in enumerate(params.emissions):
        channel.check_params(alive, f"params.emissions[{index}]")


def check_params(params: Any) -> None:
    """Refuse flat parameters (any leading axes) that disagree in shape or are no probabilities.

    Raises:
        ValueError: naming the field.
    """
    check_leaves(params)
    alive = np.asarray(params.alive)
    lead, states = alive.shape[:-1], alive.shape[-1]
    actions = params.log_trans.shape[-3]
    _shape("params.log_init", params.log_init, (*lead, states))
    _shape("params.log_trans", params.log_trans, (*lead, actions, states, states))
    check_rows("params.log_init", params.log_init, np.ones(lead, bool))
    everywhere = np.broadcast_to(alive[..., None, :], (*lead, actions, states))
    check_rows("params.log_trans", params.log_trans, everywhere)


def check(params: Any, batch: TrialBatch) -> None:
    """Refuse flat parameters or a batch that inference cannot use, before anything is compiled.

    Raises:
        ValueError: naming the argument, what was expected, and what came.
    """
    check_params(params)
    check_data(params, batch, params.log_trans.shape[-3])


def check_data(params: Any, batch: TrialBatch, actions: int) -> None:
    """Refuse a batch that does not fit a model of production states: its channels, returns, actions.

    Raises:
        ValueError: naming the argument, what was expected, and what came.
    """
    check_batch(batch, actions)
    if params.returns.mean.shape[-1] not in (1, actions):
        raise ValueError(
            f"params.returns must have 1 or {actions} columns (one per action), "
            f"got {params.returns.mean.shape[-1]}"
        )
    if len(params.emissions) != len(batch.observations):
        raise ValueError(
            f"batch.observations must have {len(params.emissions)} channels, got {len(batch.observations)}"
        )
    seen = np.asarray(batch.observed & batch.valid)
    for index, (channel, x) in enumerate(zip(params.emissions, batch.observations, strict=True)):
        channel.check(np.asarray(x), seen, f"batch.observations[{index}]")
