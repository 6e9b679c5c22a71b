"""Coupled hierarchies as a kind of model for agents: HUDHMM with a memory beside it (thesis 6.3.5).

An agent acts, and keeps its values, by the leaves alone. All operators of trees edit both chains, and the
cousin split writes the memory. What they compare is gathered from the leaves as the chain that acts, which is
flat, and so knows of every leaf before, whatever the tree says.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import Any

import jax

from jaxpomdp import packing
from jaxpomdp._types import TrialBatch
from jaxpomdp.agents.kinds import Kind, Room, Sizes
from jaxpomdp.agents.learner import LearnerConfig
from jaxpomdp.agents.tree_kind import (
    HierarchicalModel,
    evidence_of_tree,
    gather_of_leaves,
    room_of_trees,
    start_tree,
    tree_room,
)
from jaxpomdp.coupled_packing import pack_coupled_trees, unpack_coupled_trees
from jaxpomdp.models.coupled_tree import COUPLED_TREE, LEAVES_ALONE, CoupledTreeParams
from jaxpomdp.models.init import stack_models
from jaxpomdp.packing import TreeCapacity
from jaxpomdp.structure.coupled_tree import coupled_tree
from jaxpomdp.structure.coupled_tree_edits import COUSIN_SPLIT, CousinSplitConfig, lifted
from jaxpomdp.structure.edits import Operator


@dataclass(frozen=True)
class CoupledTreeModel:
    """A tree of states, and a flat chain that remembers some of them.

    Raises:
        ValueError: a setting is out of its range, or a name is unknown.
    """

    tree: HierarchicalModel = field(default_factory=HierarchicalModel)
    """The first tree, and which of a tree's operators run, and when."""
    cousin: bool = True
    """Whether the cousin split runs, after the others."""
    keep: float = 0.1
    """Probability at the start that a cousin is still remembered a step later."""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        CousinSplitConfig(self.tree.tests, self.keep)

    def kind(self) -> Kind:
        """Return the functions of this kind."""
        return _kind(self)


@lru_cache
def _kind(model: CoupledTreeModel) -> Kind:
    return Kind(
        family=COUPLED_TREE,
        start=partial(_start, model),
        room=lambda settings, specs: tree_room(settings, [spec.tree for spec in specs]),
        room_of=lambda params: room_of_trees(params.tree),
        pack=lambda specs, room: pack_coupled_trees(specs, TreeCapacity(*room)),
        unpack=unpack_coupled_trees,
        gather=lambda params, *rest: gather_of_leaves(
            LEAVES_ALONE, params, params.tree, model.tree.return_bins, *rest
        ),
        evidence=evidence_of_tree,
        operators=partial(_operators, model),
    )


def _operators(model: CoupledTreeModel, settings: LearnerConfig) -> tuple[tuple[Operator, Any], ...]:
    """Return the operators with their settings: the tree's, made in both chains, and the cousin split."""
    both = [(lifted(operator), config) for operator, config in model.tree.kind().operators(settings)]
    cousin = COUSIN_SPLIT, CousinSplitConfig(model.tree.tests, model.keep)
    return (*both, cousin) if model.cousin else tuple(both)


def _start(
    model: CoupledTreeModel,
    seed: int,
    sizes: Sizes,
    settings: LearnerConfig,
    room: Room,
    batch: TrialBatch | None = None,
) -> CoupledTreeParams:
    """Start as a tree, with a memory that nothing heeds yet."""
    tree = packing.unpack(stack_models([start_tree(model.tree, seed, sizes, settings, room, batch)]), 0)
    packed = pack_coupled_trees([coupled_tree(tree)], TreeCapacity(*room))
    return jax.tree.map(lambda x: x[0], packed)
