"""What the tests of small agents share: some rounds of two seeds, and equality of whole states."""

from __future__ import annotations

import jax
import numpy as np

SEEDS = (5, 6)


def rounds(agent, count):
    """Return the state before the first round and after each."""
    states = [agent.init(SEEDS)]
    for _ in range(count):
        states.append(agent.run(states[-1])[0])
    return states


def assert_equal(one, other):
    jax.tree.map(np.testing.assert_array_equal, one, other)
