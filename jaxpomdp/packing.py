"""The one bridge between ragged specs on the host and padded arrays on the device.

A padded array is the ragged one read through an index ``slots[S, capacity]``: the state in each slot, and
state 0 in spare slots (so that every parameter stays valid there). ``alive`` tells them apart, and spare
slots have no probability. Carrying a value through an edit is the same read with the edit's ``origin``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.models.emission import Categorical, DiagonalGaussian, ReturnModel
from jaxpomdp.models.flat import FlatParams
from jaxpomdp.models.full_gaussian import FullGaussian
from jaxpomdp.numerics import NEG
from jaxpomdp.structure.spec import Channel, FlatSpec

CHANNELS = {kind.__name__: kind for kind in (Categorical, DiagonalGaussian, FullGaussian)}
"""Emission classes by the name that a spec's ``Channel.kind`` gives them."""

Tree = TypeVar("Tree")


def pack(specs: Sequence[FlatSpec], capacity: int) -> FlatParams:
    """Return the models as one pytree of arrays with leading ``[S]`` and ``capacity`` slots for states.

    The numbers keep their type where the device has it, so ``unpack(pack(specs, capacity), s) == specs[s]``.

    Raises:
        ValueError: no specs, more states than slots, or specs with other actions, channels or returns.
    """
    _check_alike(specs)
    slots, alive = slots_of([np.arange(spec.num_states) for spec in specs], capacity)

    def padded(parts: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack([part[index] for part, index in zip(parts, slots, strict=True)])

    emissions = tuple(
        CHANNELS[channel.kind](
            **{name: padded([spec.emissions[c].values[name] for spec in specs]) for name in channel.values}
        )
        for c, channel in enumerate(specs[0].emissions)
    )
    log_init = np.where(alive, padded([spec.log_init for spec in specs]), _like(specs, NEG))
    mean, var = (padded([getattr(spec, name) for spec in specs]) for name in ("return_mean", "return_var"))
    log_trans = _padded_transitions(specs, capacity)
    return jax.device_put(FlatParams(log_init, log_trans, emissions, ReturnModel(mean, var), alive))


def unpack(params: FlatParams, s: int) -> FlatSpec:
    """Return model ``s`` of packed models as a spec.

    Raises:
        ValueError: the models have no leading axis, or no such model.
    """
    _expect_leading_axis(params)
    if not 0 <= s < params.alive.shape[0]:
        raise ValueError(f"s must be 0 .. {params.alive.shape[0] - 1}, got {s}")
    return _spec_of(jax.device_get(params), s)


def unpack_all(params: FlatParams) -> list[FlatSpec]:
    """Return every model as a spec; the arrays leave the device once.

    Raises:
        ValueError: the models have no leading axis.
    """
    _expect_leading_axis(params)
    host = jax.device_get(params)
    return [_spec_of(host, s) for s in range(host.alive.shape[0])]


def carry(values: Tree, origins: Sequence[np.ndarray], capacity: int, axis: int = 1) -> Tree:
    """Carry per-state values through edits: slot n of model s takes old slot ``origins[s][n]``; spare ones 0.

    Args:
        values: arrays ``[S, old capacity, ...]`` (a pytree of them), such as Q-values ``[S, cap, A]``.
        origins: per model, ``[N']`` ints; ``arange(N)`` where nothing was edited.
        capacity: slots of the result.
        axis: the axis of states, after ``S``.

    Raises:
        ValueError: more states than slots, or another number of models.
    """
    slots, alive = slots_of(origins, capacity)
    for leaf in jax.tree.leaves(values):
        if leaf.shape[0] != len(origins):
            raise ValueError(f"values must have {len(origins)} models (as origins), got shape {leaf.shape}")
    return _carry(values, slots, alive, axis)


def slots_of(origins: Sequence[np.ndarray], capacity: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``slots`` int ``[S, capacity]`` (0 where spare) and ``alive`` bool ``[S, capacity]``.

    Raises:
        ValueError: more states than slots.

    >>> slots, alive = slots_of([np.array([0, 1, 1])], 4)
    >>> slots.tolist(), alive.tolist()
    ([[0, 1, 1, 0]], [[True, True, True, False]])
    """
    most = max((len(origin) for origin in origins), default=0)
    if most > capacity:
        raise ValueError(f"capacity must hold the largest model's {most} states, got {capacity}")
    slots = np.zeros((len(origins), capacity), np.int32)
    for row, origin in zip(slots, origins, strict=True):
        row[: len(origin)] = origin
    sizes = np.array([len(origin) for origin in origins])
    return slots, np.arange(capacity) < sizes[:, None]


@partial(jax.jit, static_argnames="axis")
def _carry(values: Any, slots: Array, alive: Array, axis: int) -> Any:
    def through(leaf: Array) -> Array:
        shape = [1] * leaf.ndim
        shape[0], shape[axis] = slots.shape
        moved = jnp.take_along_axis(leaf, slots.reshape(shape), axis)
        return jnp.where(jnp.broadcast_to(alive.reshape(shape), moved.shape), moved, 0)

    return jax.tree.map(through, values)


def _padded_transitions(specs: Sequence[FlatSpec], capacity: int) -> np.ndarray:
    padded = np.full((len(specs), specs[0].num_actions, capacity, capacity), _like(specs, NEG))
    for row, spec in zip(padded, specs, strict=True):
        row[:, : spec.num_states, : spec.num_states] = spec.log_trans
    return padded


def _like(specs: Sequence[FlatSpec], number: float) -> np.floating:
    return np.result_type(*(spec.log_trans for spec in specs)).type(number)


def _spec_of(params: FlatParams, s: int) -> FlatSpec:
    """Return the spec of one model of arrays on the host."""
    alive = np.flatnonzero(params.alive[s])
    channels = (
        Channel(type(channel).__name__, {f.name: getattr(channel, f.name)[s][alive] for f in fields(channel)})
        for channel in params.emissions
    )
    return FlatSpec(
        params.log_init[s][alive],
        params.log_trans[s][:, alive][:, :, alive],
        tuple(channels),
        params.returns.mean[s][alive],
        params.returns.var[s][alive],
    )


def _expect_leading_axis(params: FlatParams) -> None:
    if params.alive.ndim != 2:
        raise ValueError(f"params must have a leading axis [S], got alive of shape {params.alive.shape}")


def _check_alike(specs: Sequence[FlatSpec]) -> None:
    if not specs:
        raise ValueError("specs must hold at least one model, got none")
    for s, spec in enumerate(specs):
        if _form(spec) != _form(specs[0]):
            forms = f"specs[0] has {_form(specs[0])}, specs[{s}] has {_form(spec)}"
            raise ValueError(f"specs must be alike; {forms}")
    unknown = [c.kind for c in specs[0].emissions if c.kind not in CHANNELS]
    if unknown:
        raise ValueError(f"channels must be of kinds {', '.join(CHANNELS)}, got {', '.join(unknown)}")


def _form(spec: FlatSpec) -> str:
    """Describe what the specs of one pack have in common."""
    channels = [c.kind + str({name: v.shape[1:] for name, v in c.values.items()}) for c in spec.emissions]
    columns = spec.return_mean.shape[1]
    return f"{spec.num_actions} actions, {columns} return columns, channels {', '.join(channels) or 'none'}"
