"""What trials came to."""

from __future__ import annotations

import numpy as np

from jaxpomdp.agents.experience import Trials
from jaxpomdp.envs.world import World


def summarise(trials: list[Trials], world: World) -> dict[str, np.ndarray]:
    """Return what trials came to: ``steps``, ``reward``, ``discounted``, ``success``, ``[S, trials]``."""
    rows = [_summary(seed, world) for seed in trials]
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def _summary(trials: Trials, world: World) -> dict[str, np.ndarray]:
    begins = np.cumsum(trials.lengths) - trials.lengths
    inside = np.arange(len(trials.rewards)) - np.repeat(begins, trials.lengths)
    last_reward = trials.rewards[begins + trials.lengths - 2]
    return {
        "steps": trials.lengths - 1,
        "reward": np.add.reduceat(trials.rewards, begins),
        "discounted": np.add.reduceat(trials.rewards * world.discount**inside, begins),
        "success": trials.terminated & (last_reward > world.success_above),
    }
