"""Coupled models as a kind of model for agents: CUDHMM (thesis section 3.4).

Strand 0, the thesis's ``S^O``, emits observations; an agent acts and keeps its values by it alone. Strand 1,
``S^R``, emits the return, and takes part in learning only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal, get_args

import jax
import numpy as np

from jaxpomdp._types import Array, TrialBatch
from jaxpomdp.agents import learner
from jaxpomdp.agents.kinds import Kind, Room, Sizes, evidence_of, start_flat, state_room
from jaxpomdp.agents.learner import LearnerConfig
from jaxpomdp.coupled_packing import pack_coupled, unpack_coupled
from jaxpomdp.models import init as starts
from jaxpomdp.models.coupled import (
    COUPLED_MIXTURE,
    COUPLED_MIXTURE_APPROXIMATE,
    COUPLED_PRODUCT,
    COUPLED_PRODUCT_APPROXIMATE,
    CoupledParams,
)
from jaxpomdp.models.coupled_init import couple, silent, with_capacities
from jaxpomdp.models.em import EMConfig, e_step
from jaxpomdp.models.family import Family
from jaxpomdp.numerics import bucket
from jaxpomdp.structure.coupled_edits import COUPLED_SPLIT, Added, CoupledSplitConfig

FAMILIES = {
    ("mixture", "exact"): COUPLED_MIXTURE,
    ("mixture", "approximate"): COUPLED_MIXTURE_APPROXIMATE,
    ("product", "exact"): COUPLED_PRODUCT,
    ("product", "approximate"): COUPLED_PRODUCT_APPROXIMATE,
}
"""Families by coupling and inference."""

_CHOICES = {
    "coupling": ("product", "mixture"),
    "inference": ("exact", "approximate"),
    "added": get_args(Added),
    "columns": ("state", "action"),
}


@dataclass(frozen=True)
class CoupledModel:
    """Two coupled chains, one for observations and one for the return.

    Raises:
        ValueError: a setting is out of its range.
    """

    coupling: Literal["product", "mixture"] = "product"
    """How the chains heed each other: Brand's product (the thesis), or Zhong and Ghosh's mixture."""
    inference: Literal["exact", "approximate"] = "exact"
    """On pairs of states, or on the chains' marginals alone."""
    return_states: int = 4
    """States of strand 1 to start with."""
    return_cap: int = 12
    """States of strand 1 at most."""
    columns: Literal["state", "action"] = "state"
    """Strand 1 models a return for each state, or for each state and action."""
    own_weight: float = 0.5
    """In a mixture: how much a strand heeds itself at the start."""
    concentration: float = 10.0
    """Of the Dirichlet distribution of couplings, at the start and of new states; large is even."""
    added: Added = "state"
    """What strand 1 gains by a split: a state (the thesis), one per component, or none."""
    coupling_jitter: float = 1.0
    """Log-scale of random differences between the ways in which strand 1 leads to copies."""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        if not 1 <= self.return_states <= self.return_cap:
            raise ValueError(
                f"return_states must be in 1 .. return_cap={self.return_cap}, got {self.return_states}"
            )

    def kind(self) -> Kind:
        """Return the functions of this kind."""
        return _kind(self)


@lru_cache
def _kind(model: CoupledModel) -> Kind:
    family = FAMILIES[model.coupling, model.inference]
    return Kind(
        family=family,
        start=partial(_start, model),
        room=partial(_room, model),
        room_of=lambda params: tuple(strand.alive.shape[-1] for strand in params.strands),
        pack=pack_coupled,
        unpack=unpack_coupled,
        gather=partial(_gather, family),
        evidence=evidence_of,
        operators=partial(_operators, model),
    )


def _room(model: CoupledModel, settings: LearnerConfig, specs: list[Any]) -> Room:
    most = max([model.return_states, *(spec.sizes[1] for spec in specs)])
    return state_room(settings, specs), bucket(most, cap=model.return_cap)


def _start(
    model: CoupledModel,
    seed: int,
    sizes: Sizes,
    settings: LearnerConfig,
    room: Room,
    batch: TrialBatch | None = None,
) -> CoupledParams:
    """Start strand 0 as a flat model, strand 1 at random, and couple them at random."""
    seen = start_flat(seed, sizes, settings, (settings.states,), batch)
    own, between = (int(x) for x in np.random.SeedSequence((seed, 1)).generate_state(2))
    paid = starts.random_params(
        own,
        model.return_states,
        sizes.actions,
        1,
        batch=batch,
        by_action=model.columns == "action",
        concentration=model.concentration,
    )
    options = {"own_weight": model.own_weight, "concentration": model.concentration}
    coupled = couple(between, (seen, silent(paid)), model.coupling, **options)
    return with_capacities(coupled, room)


def _operators(model: CoupledModel, settings: LearnerConfig) -> tuple[Any, ...]:
    config = CoupledSplitConfig(
        settings.split, model.added, model.return_cap, model.coupling_jitter, model.concentration
    )
    return ((COUPLED_SPLIT, config),)


def _gather(
    family: Family, params: CoupledParams, batch: TrialBatch, trial: Array, settings: LearnerConfig
) -> tuple[Array, ...]:
    by_trial = settings.split.count == "effective"
    choices = params.log_alone.shape[-3] if settings.return_by_action else 1
    config = learner.em_config(settings)
    return gather_coupled(family, params, batch, trial, config, settings.bins, choices, by_trial)


@partial(jax.jit, static_argnames=("family", "config", "bins", "choices", "by_trial"))
def gather_coupled(
    family: Family,
    params: CoupledParams,
    batch: TrialBatch,
    trial: Array,
    config: EMConfig,
    bins: int,
    choices: int,
    by_trial: bool,
) -> tuple[Array, ...]:
    """Gather what the split tests need of strand 0, as ``learner.gather_evidence`` does of a flat model."""
    seen = e_step(family, params, batch, config)
    over: Callable[..., tuple[Array, ...]] = partial(
        learner.evidence_of_model, bins=bins, choices=choices, by_trial=by_trial
    )
    return jax.vmap(over)(seen.gamma[0], batch, trial)
