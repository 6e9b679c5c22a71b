"""What the tests of worlds share: exact figures of a random walk."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxpomdp.envs.world import World, model_of


def share_ended(world: World, actions: Sequence[int], steps: int) -> float:
    """Return the chance that a walk of uniformly drawn actions has ended within so many steps."""
    model = model_of(world)
    walk = np.asarray(model.trans, np.float64)[list(actions)].mean(axis=0)
    after = np.asarray(model.start, np.float64) @ np.linalg.matrix_power(walk, steps)
    return float(after[np.asarray(model.terminal)].sum())
