"""The same worlds stepped on the host, one agent at a time: for Gymnasium and for a person who plays.

A compiled step costs some hundred microseconds to call from Python; this costs a few. Given the same numbers
it does what :func:`jaxpomdp.envs.world.step` does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxpomdp.envs.world import World


class HostStep(NamedTuple):
    """As :class:`jaxpomdp.envs.world.Step`, in Python numbers."""

    state: int
    observation: int
    reward: float
    terminated: bool


class HostWorld:
    """A world's tables as NumPy arrays.

    Args:
        world: to copy.

    Example:
        >>> from jaxpomdp.envs.registry import make
        >>> host = HostWorld(make("tmaze-2"))
        >>> host.reset(np.array([0.7, 0.0]))
        (1, 1)
        >>> host.step(1, 1, np.array([0.5, 0.5, 0.5])).state
        3
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self._start, self._first = np.asarray(world.start_cdf), np.asarray(world.first_observation_cdf)
        self._transition, self._observation = (
            np.asarray(world.transition_cdf),
            np.asarray(world.observation_cdf),
        )
        self._successors, self._reward = np.asarray(world.successors), np.asarray(world.reward)
        self._terminal, self._noise = np.asarray(world.terminal), float(world.reward_noise)

    def reset(self, uniforms: np.ndarray) -> tuple[int, int]:
        """Begin a trial; returns the state and the observation. ``uniforms`` is ``[2]`` in [0, 1)."""
        state = _draw(self._start, uniforms[0])
        return state, _draw(self._first[state], uniforms[1])

    def step(self, state: int, action: int, uniforms: np.ndarray) -> HostStep:
        """Act once; ``uniforms`` is ``[3]`` in [0, 1).

        Raises:
            ValueError: the world has no such action.
        """
        if not 0 <= action < self.world.num_actions:
            raise ValueError(f"action must be in 0..{self.world.num_actions - 1}, got {action}")
        outcome = _draw(self._transition[action, state], uniforms[0])
        arrived = int(self._successors[action, state, outcome])
        seen_after = action if self._observation.shape[0] > 1 else 0
        observation = _draw(self._observation[seen_after, arrived], uniforms[1])
        noise = 0.0 if self._terminal[state] else self._noise * (2 * float(uniforms[2]) - 1)
        reward = float(self._reward[action, state, outcome]) + noise
        return HostStep(arrived, observation, reward, bool(self._terminal[arrived]))


def _draw(cdf: np.ndarray, uniform: float) -> int:
    return int(np.count_nonzero(uniform >= cdf))
