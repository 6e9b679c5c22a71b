"""Kinds of model, as an agent sees them: where they start, how they are packed, and how they grow.

Inference knows a model by its ``Family``; an agent also starts models, finds evidence for changes of their
structure, and carries them between the device and the host. ``Kind`` holds those functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxpomdp import packing
from jaxpomdp._types import Array, TrialBatch
from jaxpomdp.agents import learner
from jaxpomdp.agents.learner import LearnerConfig
from jaxpomdp.models import init as starts
from jaxpomdp.models.family import Family
from jaxpomdp.models.flat import FLAT
from jaxpomdp.numerics import bucket
from jaxpomdp.structure.evidence import ReturnEvidence
from jaxpomdp.structure.splits import STATE_SPLIT

Room = tuple[int, ...]
"""Slots of the arrays of a packed model, axis by axis; the first is the capacity for states that act."""


class Sizes(NamedTuple):
    """What a world lets an agent do and see; ``observations`` is a number of symbols, or one per channel."""

    actions: int
    observations: Any


class Kind(NamedTuple):
    """A kind of model as functions; a spec has ``num_states``, the states that act and have Q-values.

    Attributes:
        family: the contract with inference.
        start: ``(seed, sizes, settings, room, batch) -> params`` of one model; ``batch`` is data of one seed
            to start from, or None.
        room: ``(settings, specs) -> Room``, slots enough for these specs and for how a model starts.
        room_of: ``params -> Room`` of packed models.
        pack: ``(specs, room) -> params`` with leading ``S``.
        unpack: ``params -> list of specs``.
        gather: ``(params, batch, trial, settings) -> arrays`` on the device, for ``S`` models.
        evidence: ``(arrays, s, spec) ->`` what the operators take, for one seed, on the host.
        operators: ``settings -> pairs`` of an operator and its config.
    """

    family: Family
    start: Callable[..., Any]
    room: Callable[..., Room]
    room_of: Callable[[Any], Room]
    pack: Callable[..., Any]
    unpack: Callable[[Any], list[Any]]
    gather: Callable[..., Any]
    evidence: Callable[..., Any]
    operators: Callable[[LearnerConfig], Any]


def roomier(one: Room, other: Room) -> Room:
    """Return the room that holds both."""
    return tuple(map(max, one, other))


def start_flat(
    seed: int, sizes: Sizes, settings: LearnerConfig, room: Room, batch: TrialBatch | None = None
) -> Any:
    """Draw one flat model, as ``settings.initial`` says."""
    make = starts.observation_seeded if settings.initial == "observation" else starts.random_params
    options = {"batch": batch, "by_action": settings.return_by_action, "capacity": room[0]}
    return make(seed, settings.states, *sizes, **options)


def state_room(settings: LearnerConfig, specs: list[Any]) -> int:
    """Return slots for the states of these specs and of a start: few sizes, and no more than may be."""
    states = max([settings.states, *(spec.num_states for spec in specs)])
    return bucket(states, cap=max(settings.policy.node_cap, states))


def gather_returns(
    family: Family, params: Any, batch: TrialBatch, trial: Array, settings: LearnerConfig
) -> tuple[Array, ...]:
    """Gather the returns of every state, on the device."""
    by_trial = settings.split.count == "effective"
    return learner.gather_evidence(
        family, params, batch, trial, learner.em_config(settings), settings.bins, by_trial
    )


def evidence_of(arrays: tuple[np.ndarray, ...], s: int, spec: Any) -> ReturnEvidence:
    """Return what one seed's returns say of the states of its spec."""
    return learner.evidence_of_seed(arrays, s, np.ones(spec.num_states, bool))


FLAT_KIND = Kind(
    family=FLAT,
    start=start_flat,
    room=lambda settings, specs: (state_room(settings, specs),),
    room_of=lambda params: (params.alive.shape[-1],),
    pack=lambda specs, room: packing.pack(specs, room[0]),
    unpack=packing.unpack_all,
    gather=lambda *arguments: gather_returns(FLAT, *arguments),
    evidence=evidence_of,
    operators=lambda settings: ((STATE_SPLIT, settings.split),),
)
"""The flat UDHMM (thesis section 3.3)."""


@dataclass(frozen=True)
class FlatModel:
    """One chain that emits observations and returns; it has no settings of its own."""

    def kind(self) -> Kind:
        """Return the functions of this kind."""
        return FLAT_KIND


def started(
    kind: Kind,
    seeds: np.ndarray,
    sizes: Sizes,
    settings: LearnerConfig,
    *,
    least: Room | None = None,
    batch: TrialBatch | None = None,
) -> Any:
    """Start a model for each seed, with leading ``S``.

    Args:
        kind: of model.
        seeds: ints ``[S]``.
        sizes: of the world.
        settings: of the learner.
        least: room that they must have.
        batch: data ``[S, B, T]`` on the host to start from, each seed from its own.
    """
    room = kind.room(settings, [])
    room = room if least is None else roomier(room, least)
    tapes = [None if batch is None else jax.tree.map(lambda x, s=s: x[s], batch) for s in range(len(seeds))]
    models = [
        kind.start(int(seed), sizes, settings, room, tape) for seed, tape in zip(seeds, tapes, strict=True)
    ]
    return starts.stack_models(models)
