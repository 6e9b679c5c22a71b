"""Small trees as parameters, for the tests of the hierarchical model."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxpomdp.models.hierarchical import HIERARCHICAL, TreeParams
from jaxpomdp.packing import TreeCapacity, pack
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_init import random_tree
from tests.models.problems import ACTIONS, SYMBOLS, light_posterior, scaled_posterior

LEAVES, INTERNAL, LEVELS = 5, 3, 2
LIGHT_TREE = HIERARCHICAL._replace(posterior=light_posterior)
SCALED_TREE = HIERARCHICAL._replace(posterior=scaled_posterior)


def spec_of(seed: int, states: int = LEAVES, by_action: bool = False, levels: int = LEVELS) -> TreeSpec:
    """A random tree of two levels that has at least one internal state below the root."""
    while True:
        spec = random_tree(seed, states, ACTIONS, SYMBOLS, levels=levels, vertical_by_action=by_action)
        if spec.num_internal > 1 or states < 3 or levels < 2:
            return spec
        seed += 1000


def tree(seed: int = 0, capacity: TreeCapacity | None = None, **options: Any) -> TreeParams:
    """One model, without a leading axis."""
    spec = spec_of(seed, **options)
    exact = TreeCapacity(spec.num_states, spec.num_internal, int(spec.depth.max()))
    return jax.tree.map(lambda x: x[0], pack([spec], exact if capacity is None else capacity))


def numbers(params: TreeParams) -> dict[str, np.ndarray]:
    """The probabilities that matter, of every model, whatever the room."""
    return {name: np.exp(np.asarray(getattr(params, name))) for name in ("log_vertical", "log_horizontal")}
