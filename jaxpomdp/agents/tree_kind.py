"""Hierarchical models as a kind of model for agents: HUDHMM and its operators (thesis chapter 6).

An agent believes in production states (the leaves) and keeps its values by them, as the flat agent does; the
tree says how activity moves between them, and grows by operators that compare what was active before.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any, Literal, get_args

import jax
import numpy as np

from jaxpomdp import packing
from jaxpomdp._types import Array, TrialBatch
from jaxpomdp.agents import learner
from jaxpomdp.agents.kinds import Kind, Room, Sizes, start_flat, state_room
from jaxpomdp.agents.learner import LearnerConfig
from jaxpomdp.agents.tree_evidence import evidence_of_model, gather_tree_evidence
from jaxpomdp.models.family import Family
from jaxpomdp.models.hierarchical import HIERARCHICAL, TreeParams
from jaxpomdp.models.init import stack_models
from jaxpomdp.numerics import bucket
from jaxpomdp.packing import TreeCapacity
from jaxpomdp.structure.edits import Operator
from jaxpomdp.structure.leaf_split import LEAF_SPLIT
from jaxpomdp.structure.operators import TREE_OPERATORS
from jaxpomdp.structure.tree_evidence import TreeEvidence
from jaxpomdp.structure.tree_init import Form, tree_over
from jaxpomdp.structure.tree_tests import TreeSplitConfig

TreeRule = Literal["observation", "brother", "uncle", "parent", "leaf"]
HMO: tuple[TreeRule, ...] = ("observation", "brother", "uncle", "parent")
"""The Hierarchical Model Operators (thesis 6.3)."""


@dataclass(frozen=True)
class HierarchicalModel:
    """A tree of states that grows by the Hierarchical Model Operators.

    Raises:
        ValueError: a setting is out of its range, or a name is unknown.
    """

    form: Form = "diverse"
    """The first tree: ``diverse``, branches of many depths, or ``sober``, two levels of like branches."""
    shape: str = ""
    """A given first tree instead, as nested brackets of state numbers: ``[[0, 1], [2, 3], 4]``."""
    levels: int = 3
    """Levels of the first tree at most."""
    vertical_by_action: bool = False
    """What a branch activates depends on the action that led there."""
    concentration: float = 1.0
    """Of the Dirichlet distributions that the first probabilities are drawn from; large is even."""
    operators: tuple[TreeRule, ...] = HMO
    """Which operators run, in this order; ``leaf`` is the flat agent's split (3.3), with its settings."""
    return_bins: int = 16
    """Bins of the returns that operators compare."""
    tests: TreeSplitConfig = field(default_factory=TreeSplitConfig)
    """When an operator fires, and how it shares probability."""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if self.form not in get_args(Form):
            raise ValueError(f"form must be one of {', '.join(get_args(Form))}, got {self.form!r}")
        for name, bound in {"levels": 1, "return_bins": 2}.items():
            if getattr(self, name) < bound:
                raise ValueError(f"{name} must be at least {bound}, got {getattr(self, name)}")
        for name in self.operators:
            if name not in get_args(TreeRule):
                raise ValueError(f"operators must be of {', '.join(get_args(TreeRule))}, got {name!r}")
        if not self.concentration > 0:
            raise ValueError(f"concentration must be positive, got {self.concentration}")

    def kind(self) -> Kind:
        """Return the functions of this kind."""
        return _kind(self)

    def nested(self) -> list[Any] | None:
        """Return the given tree as nested lists, None where it is drawn.

        Raises:
            ValueError: ``shape`` is not made of brackets and numbers.
        """
        if not self.shape:
            return None
        try:
            return json.loads(self.shape)
        except json.JSONDecodeError as error:
            raise ValueError(f"shape must be like [[0, 1], 2], got {self.shape!r}: {error}") from None


@lru_cache
def _kind(model: HierarchicalModel) -> Kind:
    return Kind(
        family=HIERARCHICAL,
        start=partial(start_tree, model),
        room=tree_room,
        room_of=room_of_trees,
        pack=lambda specs, room: packing.pack(specs, TreeCapacity(*room)),
        unpack=packing.unpack_all,
        gather=lambda params, *rest: gather_of_leaves(HIERARCHICAL, params, params, model.return_bins, *rest),
        evidence=evidence_of_tree,
        operators=partial(_operators, model),
    )


def _operators(model: HierarchicalModel, settings: LearnerConfig) -> tuple[tuple[Operator, Any], ...]:
    known = {name: (operator, model.tests) for name, operator in TREE_OPERATORS.items()}
    known["leaf"] = LEAF_SPLIT, settings.split
    return tuple(known[name] for name in model.operators)


def start_tree(
    model: HierarchicalModel,
    seed: int,
    sizes: Sizes,
    settings: LearnerConfig,
    room: Room,
    batch: TrialBatch | None = None,
) -> TreeParams:
    """Start leaves as the states of a flat model, and put a random (or the given) tree over them."""
    flat = start_flat(seed, sizes, settings, (settings.states,), batch)
    leaves = packing.unpack(stack_models([flat]), 0)
    own = np.random.SeedSequence((seed, 2))
    spec = tree_over(
        np.random.default_rng(own),
        leaves,
        levels=model.levels,
        form=model.form,
        shape=model.nested(),
        vertical_by_action=model.vertical_by_action,
        concentration=model.concentration,
    )
    return jax.tree.map(lambda x: x[0], packing.pack([spec], TreeCapacity(*room)))


def tree_room(settings: LearnerConfig, specs: list[Any]) -> TreeCapacity:
    """Return slots for these trees; for a first tree, as many internal states as its leaves can need."""
    leaves = state_room(settings, specs)
    if specs:
        return packing.room_for(specs, leaves)
    return TreeCapacity(leaves, bucket(settings.states), bucket(1, least=4))


def room_of_trees(params: TreeParams) -> TreeCapacity:
    """Return the slots that packed trees have."""
    leaves, depths = params.path.shape[-2:]
    return TreeCapacity(leaves, params.log_vertical.shape[-2], depths - 1)


def gather_of_leaves(
    family: Family,
    params: Any,
    tree: TreeParams,
    bins: int,
    batch: TrialBatch,
    trial: Array,
    settings: LearnerConfig,
) -> TreeEvidence:
    """Gather what the operators compare, on the device; the first channel is what counts as seen.

    Args:
        family: of the models.
        params: of the models.
        tree: the trees in them.
        bins: of the returns.
        batch: tapes.
        trial: not needed; the number of each step's trial.
        settings: of the learner.
    """
    symbols = tree.emissions[0].log_prob.shape[-1]
    config = learner.em_config(settings)
    return gather_tree_evidence(family, params, batch, batch.observations[0], config, symbols, bins)


def evidence_of_tree(arrays: Any, s: int, spec: Any) -> TreeEvidence:
    """Return what one seed's tapes say of the leaves of its tree."""
    return evidence_of_model(TreeEvidence(*arrays), s, spec.num_states)
