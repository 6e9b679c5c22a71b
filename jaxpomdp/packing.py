"""The one bridge between ragged specs on the host and padded arrays on the device.

A padded array is the ragged one read through an index ``slots[S, capacity]``: the state in each slot, and
state 0 in spare slots (so that every parameter stays valid there). ``alive`` tells them apart, and spare
slots have no probability. Carrying a value through an edit is the same read with the edit's ``origin``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.models.emission import Categorical, DiagonalGaussian, ReturnModel
from jaxpomdp.models.flat import FlatParams
from jaxpomdp.models.full_gaussian import FullGaussian
from jaxpomdp.models.hierarchical import TreeParams
from jaxpomdp.numerics import NEG, bucket
from jaxpomdp.structure.spec import Channel, FlatSpec
from jaxpomdp.structure.topology import paths_of
from jaxpomdp.structure.tree import TreeSpec

CHANNELS = {kind.__name__: kind for kind in (Categorical, DiagonalGaussian, FullGaussian)}
"""Emission classes by the name that a spec's ``Channel.kind`` gives them."""

Tree = TypeVar("Tree")


class TreeCapacity(NamedTuple):
    """Slots for the leaves and the internal states of trees, and the depth there is room for."""

    leaves: int
    internal: int
    levels: int


def room_for(specs: Sequence[TreeSpec], leaves: int) -> TreeCapacity:
    """Return slots for growing trees: internal states and levels in buckets, so that shapes change rarely."""
    internal = max((spec.num_internal for spec in specs), default=1)
    levels = max((int(spec.depth.max()) for spec in specs), default=1)
    return TreeCapacity(leaves, bucket(internal), bucket(levels, least=4, step=1.5))


@overload
def pack(specs: Sequence[FlatSpec], capacity: int) -> FlatParams: ...
@overload
def pack(specs: Sequence[TreeSpec], capacity: int | TreeCapacity) -> TreeParams: ...
def pack(
    specs: Sequence[FlatSpec] | Sequence[TreeSpec], capacity: int | TreeCapacity
) -> FlatParams | TreeParams:
    """Return the models as one pytree of arrays with leading ``[S]`` and ``capacity`` slots for states.

    The numbers keep their type where the device has it, so ``unpack(pack(specs, capacity), s) == specs[s]``.
    Trees of any shapes fit one capacity; a number is that of leaves (``room_for`` makes room for the rest).

    Raises:
        ValueError: no specs, more states than slots, or specs with other actions, channels or returns.
    """
    _check_alike(specs)
    if isinstance(specs[0], TreeSpec):
        return _pack_trees(specs, room_for(specs, capacity) if isinstance(capacity, int) else capacity)
    return _pack_flat(specs, capacity)


def _pack_flat(specs: Sequence[Any], capacity: Any) -> FlatParams:
    slots, alive = slots_of([np.arange(spec.num_states) for spec in specs], capacity)
    emissions, returns = _padded_leaves(specs, slots)
    log_init = np.where(
        alive, _read([spec.log_init for spec in specs], slots), _like([spec.log_trans for spec in specs], NEG)
    )
    log_trans = _padded_transitions(specs, capacity)
    return jax.device_put(FlatParams(log_init, log_trans, emissions, returns, alive))


def _read(parts: Sequence[np.ndarray], slots: np.ndarray) -> np.ndarray:
    return np.stack([part[index] for part, index in zip(parts, slots, strict=True)])


def _padded_leaves(specs: Sequence[Any], slots: np.ndarray) -> tuple[tuple[Any, ...], ReturnModel]:
    """Return the emissions and the returns of the states in each slot."""
    emissions = tuple(
        CHANNELS[channel.kind](
            **{
                name: _read([spec.emissions[c].values[name] for spec in specs], slots)
                for name in channel.values
            }
        )
        for c, channel in enumerate(specs[0].emissions)
    )
    mean, var = (
        _read([getattr(spec, name) for spec in specs], slots) for name in ("return_mean", "return_var")
    )
    return emissions, ReturnModel(mean, var)


def _pack_trees(specs: Sequence[TreeSpec], capacity: TreeCapacity) -> TreeParams:
    slots, alive = slots_of([np.arange(spec.num_states) for spec in specs], capacity.leaves)
    most = max(spec.num_internal for spec in specs)
    if most > capacity.internal:
        raise ValueError(f"capacity must hold {most} internal states, got {capacity.internal}")
    models, nodes, actions = len(specs), capacity.leaves + capacity.internal, specs[0].num_actions
    tables, absent = specs[0].log_vertical.shape[0], _like([spec.log_horizontal for spec in specs], NEG)
    vertical = np.full((models, tables, capacity.internal, nodes), absent)
    horizontal = np.full((models, actions, nodes, nodes + 1), absent)
    path = np.full((models, capacity.leaves, capacity.levels + 1), -1, np.int32)
    for s, spec in enumerate(specs):
        place = _places(spec, capacity.leaves)
        vertical[s][:, : spec.num_internal, place] = spec.log_vertical
        horizontal[s][:, place[:, None], np.append(place, nodes)[None]] = spec.log_horizontal
        ways = paths_of(spec.parent, spec.num_states, capacity.levels)
        path[s, : spec.num_states] = np.where(ways < 0, -1, place[np.maximum(ways, 0)])
    emissions, returns = _padded_leaves(specs, slots)
    return jax.device_put(TreeParams(vertical, horizontal, path, emissions, returns, alive))


def _places(spec: TreeSpec, leaves: int) -> np.ndarray:
    """Return ``[M]``: the padded number of every node; internal states begin after all slots of leaves."""
    return np.concatenate([np.arange(spec.num_states), leaves + np.arange(spec.num_internal)])


@overload
def unpack(params: FlatParams, s: int) -> FlatSpec: ...
@overload
def unpack(params: TreeParams, s: int) -> TreeSpec: ...
def unpack(params: FlatParams | TreeParams, s: int) -> FlatSpec | TreeSpec:
    """Return model ``s`` of packed models as a spec.

    Raises:
        ValueError: the models have no leading axis, or no such model.
    """
    _expect_leading_axis(params)
    if not 0 <= s < params.alive.shape[0]:
        raise ValueError(f"s must be 0 .. {params.alive.shape[0] - 1}, got {s}")
    return _spec_of(jax.device_get(params), s)


@overload
def unpack_all(params: FlatParams) -> list[FlatSpec]: ...
@overload
def unpack_all(params: TreeParams) -> list[TreeSpec]: ...
def unpack_all(params: FlatParams | TreeParams) -> list[FlatSpec] | list[TreeSpec]:
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
    padded = np.full(
        (len(specs), specs[0].num_actions, capacity, capacity), _like([spec.log_trans for spec in specs], NEG)
    )
    for row, spec in zip(padded, specs, strict=True):
        row[:, : spec.num_states, : spec.num_states] = spec.log_trans
    return padded


def _like(tables: Sequence[np.ndarray], number: float) -> np.floating:
    return np.result_type(*tables).type(number)


def _spec_of(params: Any, s: int) -> Any:
    """Return the spec of one model of arrays on the host."""
    alive = np.flatnonzero(params.alive[s])
    channels = tuple(
        Channel(type(channel).__name__, {f.name: getattr(channel, f.name)[s][alive] for f in fields(channel)})
        for channel in params.emissions
    )
    leaves = (channels, params.returns.mean[s][alive], params.returns.var[s][alive])
    if isinstance(params, TreeParams):
        leaf_parent, node_parent, vertical, horizontal = _tree_of(params, s)
        return TreeSpec(leaf_parent, node_parent, vertical, horizontal, *leaves)
    return FlatSpec(params.log_init[s][alive], params.log_trans[s][:, alive][:, :, alive], *leaves)


def _tree_of(params: Any, s: int) -> tuple[np.ndarray, ...]:
    """Return ``leaf_parent``, ``node_parent`` and the two tables of one model, without spare slots."""
    path, slots = params.path[s], params.path.shape[-2]
    alive = np.flatnonzero(params.alive[s])
    used = np.unique(path[path >= slots])
    above = np.full(params.log_horizontal.shape[-2], -1)
    for depth in range(path.shape[1] - 1):
        here = path[:, depth + 1] >= 0
        above[path[here, depth + 1]] = path[here, depth]
    number = np.full(len(above) + 1, -1)
    number[used] = np.arange(len(used))
    place = np.concatenate([alive, used])
    columns = np.append(place, len(above))
    vertical = params.log_vertical[s][:, used - slots][:, :, place]
    horizontal = params.log_horizontal[s][:, place][:, :, columns]
    return number[above[alive]], number[above[used]], vertical, horizontal


def _expect_leading_axis(params: Any) -> None:
    if params.alive.ndim != 2:
        raise ValueError(f"params must have a leading axis [S], got alive of shape {params.alive.shape}")


def _check_alike(specs: Sequence[Any]) -> None:
    if not specs:
        raise ValueError("specs must hold at least one model, got none")
    for s, spec in enumerate(specs):
        if _form(spec) != _form(specs[0]):
            forms = f"specs[0] has {_form(specs[0])}, specs[{s}] has {_form(spec)}"
            raise ValueError(f"specs must be alike; {forms}")
    unknown = [c.kind for c in specs[0].emissions if c.kind not in CHANNELS]
    if unknown:
        raise ValueError(f"channels must be of kinds {', '.join(CHANNELS)}, got {', '.join(unknown)}")


def _form(spec: Any) -> str:
    """Describe what the specs of one pack have in common."""
    channels = [c.kind + str({name: v.shape[1:] for name, v in c.values.items()}) for c in spec.emissions]
    columns = spec.return_mean.shape[1]
    kind = f"tree with {len(spec.log_vertical)} vertical tables, " if isinstance(spec, TreeSpec) else ""
    counts = f"{spec.num_actions} actions, {columns} return columns"
    return f"{kind}{counts}, channels {', '.join(channels) or 'none'}"
