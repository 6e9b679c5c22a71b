"""Coupled specs on the host and padded arrays on the device; as ``packing``, strand by strand.

A coupled tree is packed as its tree, and the tables of its memory beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

import jax
import numpy as np

from jaxpomdp.models.coupled import CoupledParams, Strand
from jaxpomdp.models.coupled_tree import MEMORY, CoupledTreeParams
from jaxpomdp.models.emission import ReturnModel
from jaxpomdp.numerics import NEG
from jaxpomdp.packing import CHANNELS, TreeCapacity, pack, slots_of, unpack_all
from jaxpomdp.structure.coupled_spec import CoupledSpec, StrandSpec
from jaxpomdp.structure.coupled_tree import CoupledTreeSpec
from jaxpomdp.structure.spec import Channel


def pack_coupled(specs: Sequence[CoupledSpec], room: Sequence[int]) -> CoupledParams:
    """Return the models as one pytree of arrays with leading ``[S]`` and ``room[c]`` slots in strand ``c``.

    The numbers keep their type where the device has it, so ``unpack_coupled`` gives back equal specs.

    Raises:
        ValueError: no specs, more states than slots, or specs of different forms.
    """
    _check_alike(specs, room)
    chains = range(len(room))
    strands = tuple(_strand([spec.strands[c] for spec in specs], room[c]) for c in chains)

    def table(read: Callable[[CoupledSpec], np.ndarray], old: int, new: int) -> np.ndarray:
        return _padded([read(spec) for spec in specs], (room[old], room[new]))

    pairs = tuple(
        tuple(table(lambda spec, c=c, k=k: spec.log_pairs[c][k], k, c) for k in chains) for c in chains
    )
    weights = [spec.log_weights for spec in specs if spec.log_weights is not None]
    alone = table(lambda spec: spec.log_alone, 0, 0)
    return jax.device_put(CoupledParams(strands, pairs, np.stack(weights) if weights else None, alone))


def unpack_coupled(params: CoupledParams) -> list[CoupledSpec]:
    """Return every model as a spec; the arrays leave the device once.

    Raises:
        ValueError: the models have no leading axis.
    """
    if params.alive.ndim != 2:
        raise ValueError(f"params must have a leading axis [S], got alive of shape {params.alive.shape}")
    host = jax.device_get(params)
    return [_spec_of(host, s) for s in range(len(host.alive))]


def pack_coupled_trees(specs: Sequence[CoupledTreeSpec], capacity: int | TreeCapacity) -> CoupledTreeParams:
    """Return coupled trees as one pytree of arrays with leading ``[S]``; the memory has a slot for each leaf.

    The numbers keep their type where the device has it, so ``unpack_coupled_trees`` gives back equal specs.

    Args:
        specs: the models; their trees may have any shapes.
        capacity: as for ``packing.pack`` of trees.

    Raises:
        ValueError: no specs, more states than slots, or trees with other actions, channels or returns.
    """
    tree = pack([spec.tree for spec in specs], capacity)
    leaves = tree.alive.shape[-1]
    lead, alone = (
        _padded([getattr(spec, name) for spec in specs], (leaves, leaves))
        for name in ("log_lead", "log_alone")
    )
    slots, _ = slots_of([np.arange(spec.num_states) for spec in specs], leaves)
    heed, note = (
        np.stack([getattr(spec, name)[index] for spec, index in zip(specs, slots, strict=True)])
        for name in MEMORY[1:]
    )
    return jax.device_put(CoupledTreeParams(tree, lead, heed, note, alone))


def unpack_coupled_trees(params: CoupledTreeParams) -> list[CoupledTreeSpec]:
    """Return every coupled tree as a spec; the arrays leave the device once.

    Raises:
        ValueError: the models have no leading axis.
    """
    trees, host = unpack_all(params.tree), jax.device_get(params)
    specs = []
    for s, tree in enumerate(trees):
        alive = np.flatnonzero(host.alive[s])
        lead, alone = (x[s][:, alive][:, :, alive] for x in (host.log_lead, host.log_alone))
        specs.append(CoupledTreeSpec(tree, lead, host.log_heed[s][alive], host.log_note[s][alive], alone))
    return specs


def _padded(tables: Sequence[np.ndarray], shape: tuple[int, int]) -> np.ndarray:
    """Stack ``[A, N, N']`` tables with ``NEG`` in the spare slots."""
    padded = np.full((len(tables), tables[0].shape[0], *shape), NEG, np.result_type(*tables))
    for row, table in zip(padded, tables, strict=True):
        row[:, : table.shape[1], : table.shape[2]] = table
    return padded


def _strand(specs: Sequence[StrandSpec], capacity: int) -> Strand:
    slots, alive = slots_of([np.arange(spec.num_states) for spec in specs], capacity)

    def padded(parts: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack([part[index] for part, index in zip(parts, slots, strict=True)])

    first = padded([spec.log_init for spec in specs])
    emissions = tuple(
        CHANNELS[channel.kind](
            **{name: padded([spec.emissions[i].values[name] for spec in specs]) for name in channel.values}
        )
        for i, channel in enumerate(specs[0].emissions)
    )
    paid = [(spec.return_mean, spec.return_var) for spec in specs]
    returns = None
    if all(mean is not None and var is not None for mean, var in paid):
        returns = ReturnModel(*(padded(part) for part in zip(*paid, strict=True)))
    return Strand(np.where(alive, first, first.dtype.type(NEG)), emissions, returns, alive)


def _spec_of(params: CoupledParams, s: int) -> CoupledSpec:
    kept = [np.flatnonzero(strand.alive[s]) for strand in params.strands]

    def table(array: np.ndarray, old: int, new: int) -> np.ndarray:
        return array[s][:, kept[old]][:, :, kept[new]]

    chains = range(len(kept))
    return CoupledSpec(
        tuple(_strand_of(strand, s, alive) for strand, alive in zip(params.strands, kept, strict=True)),
        tuple(tuple(table(params.log_pairs[c][k], k, c) for k in chains) for c in chains),
        None if params.log_weights is None else params.log_weights[s],
        table(params.log_alone, 0, 0),
    )


def _strand_of(strand: Strand, s: int, alive: np.ndarray) -> StrandSpec:
    channels = tuple(
        Channel(type(channel).__name__, {f.name: getattr(channel, f.name)[s][alive] for f in fields(channel)})
        for channel in strand.emissions
    )
    if strand.returns is None:
        return StrandSpec(strand.log_init[s][alive], channels)
    returns = (getattr(strand.returns, name)[s][alive] for name in ("mean", "var"))
    return StrandSpec(strand.log_init[s][alive], channels, *returns)


def _check_alike(specs: Sequence[CoupledSpec], room: Sequence[int]) -> None:
    if not specs:
        raise ValueError("specs must hold at least one model, got none")
    forms = [_form(spec) for spec in specs]
    for s, form in enumerate(forms):
        if form != forms[0]:
            raise ValueError(f"specs must be alike; specs[0] has {forms[0]}, specs[{s}] has {form}")
    if len(room) != len(specs[0].strands):
        raise ValueError(f"room must have {len(specs[0].strands)} numbers, one a strand, got {list(room)}")


def _form(spec: CoupledSpec) -> str:
    """Describe what the specs of one pack have in common."""

    def of(strand: StrandSpec) -> str:
        channels = [c.kind + str({n: v.shape[1:] for n, v in c.values.items()}) for c in strand.emissions]
        columns = "no" if strand.return_mean is None else strand.return_mean.shape[1]
        return f"{columns} return columns and channels {', '.join(channels) or 'none'}"

    rule = "product" if spec.log_weights is None else "mixture"
    strands = "; ".join(map(of, spec.strands))
    return f"{spec.num_actions} actions, {rule} coupling, strands of {strands}"
