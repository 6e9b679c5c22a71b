"""The value of a belief by walking the whole tree of what can be done and seen."""

from __future__ import annotations

import numpy as np


def best_value(belief, trans, obs, reward, discount, horizon, end=0.0):
    """The best plan of ``horizon`` steps, by the tree; then every belief is worth ``end``."""
    if horizon == 0:
        return end
    values = []
    for a in range(len(trans)):
        value = belief @ reward[a]
        joint = (belief @ trans[a])[:, None] * obs[a if len(obs) > 1 else 0]
        for o in range(joint.shape[1]):
            prob = joint[:, o].sum()
            if prob > 0:
                later = best_value(joint[:, o] / prob, trans, obs, reward, discount, horizon - 1, end)
                value += discount * prob * later
        values.append(value)
    return max(values)


def bracket(belief, trans, obs, reward, discount, horizon):
    """Numbers between which the value without a horizon lies."""
    return tuple(
        best_value(belief, trans, obs, reward, discount, horizon, extreme / (1 - discount))
        for extreme in (reward.min(), reward.max())
    )


def one_step(belief, vectors, trans, obs, reward, discount):
    """The value of acting once and then taking the best vector, by loops."""
    values = []
    for a in range(len(trans)):
        value = sum(belief[s] * reward[a, s] for s in range(len(belief)))
        for o in range(obs.shape[-1]):
            table = obs[a if len(obs) > 1 else 0]
            later = [
                sum(
                    belief[s] * trans[a, s, t] * table[t, o] * alpha[t]
                    for s in range(len(belief))
                    for t in range(len(belief))
                )
                for alpha in vectors
            ]
            value += discount * max(later)
        values.append(value)
    return max(values), int(np.argmax(values))
