"""A Gymnasium environment as turns: what every copy of it went through in one call, trial by trial.

One environment is a batch of one copy. Vector environments begin a new trial by themselves; where that hides
the last observation of the old one (``SAME_STEP``) the call becomes two turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxpomdp.agents.experience import Trials
from jaxpomdp.envs.spaces import actions_of, encode

IDLE, ACTED, BEGAN = range(3)
"""What a copy did in a turn: nothing that counts, one action, or the reset of a trial."""


class Turn(NamedTuple):
    """What ``S`` copies went through: an array ``[S, ...]`` per channel of ``observations``, else ``[S]``.

    ``reward``, ``terminated`` and ``ended`` (terminated or truncated) belong to an action, if there was one.
    """

    kind: np.ndarray
    observations: tuple[np.ndarray, ...]
    reward: np.ndarray
    terminated: np.ndarray
    ended: np.ndarray


def _resets(kind: np.ndarray, observations: tuple[np.ndarray, ...]) -> Turn:
    none = np.zeros(len(kind), bool)
    return Turn(kind, observations, np.zeros(len(kind), np.float32), none, none)


class SingleTurns:
    """Turns of one environment."""

    copies = 1

    def __init__(self, env: Any) -> None:
        self._env, self.space = env, env.observation_space
        self._first = actions_of(env.action_space).first

    def reset(self, seed: int | None) -> Turn:
        """Begin a trial."""
        return _resets(np.full(1, BEGAN), self._encoded(self._env.reset(seed=seed)[0]))

    def step(self, actions: np.ndarray) -> list[Turn]:
        """Act once, with ``actions[1]`` counted from 0; a trial that is over is followed by the next one."""
        observation, reward, terminated, truncated, _ = self._env.step(self._first + int(actions[0]))
        over = bool(terminated or truncated)
        outcome = np.float32([reward]), np.array([bool(terminated)]), np.array([over])
        acted = Turn(np.full(1, ACTED), self._encoded(observation), *outcome)
        return [acted, self.reset(None)] if over else [acted]

    def _encoded(self, observation: Any) -> tuple[np.ndarray, ...]:
        return tuple(channel[None] for channel in encode(observation, self.space))


class VectorTurns:
    """Turns of a vector environment, in the two modes in which trials follow each other by themselves.

    Raises:
        ValueError: the mode is another one.
    """

    def __init__(self, env: Any) -> None:
        from gymnasium.vector import AutoresetMode

        mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        if mode is AutoresetMode.DISABLED:
            raise ValueError("env must reset by itself (NEXT_STEP or SAME_STEP), got autoreset_mode DISABLED")
        self._env, self._same_step = env, mode is AutoresetMode.SAME_STEP
        self.copies, self.space = env.num_envs, env.single_observation_space
        self._first = actions_of(env.single_action_space).first
        self._over = np.zeros(self.copies, bool)

    def reset(self, seed: int | None) -> Turn:
        """Begin a trial in every copy; copy ``i`` has seed ``seed + i``."""
        self._over = np.zeros(self.copies, bool)
        return _resets(np.full(self.copies, BEGAN), encode(self._env.reset(seed=seed)[0], self.space))

    def step(self, actions: np.ndarray) -> list[Turn]:
        """Act once in every copy, with ``actions[S]`` counted from 0."""
        seen, reward, terminated, truncated, info = self._env.step(
            self._first + np.asarray(actions, np.int64)
        )
        over = np.asarray(terminated) | np.asarray(truncated)
        channels = encode(seen, self.space)
        outcome = np.asarray(reward, np.float32), np.array(terminated), over
        if self._same_step:
            acted = Turn(np.full(self.copies, ACTED), self._with_last(channels, info, over), *outcome)
            return [acted, _resets(np.where(over, BEGAN, IDLE), channels)] if over.any() else [acted]
        kind = np.where(self._over, BEGAN, ACTED)
        self._over = over
        return [Turn(kind, channels, *outcome)]

    def _with_last(
        self, channels: tuple[np.ndarray, ...], info: Any, over: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Put in the last observation of the trials that are over."""
        whole = tuple(channel.copy() for channel in channels)
        for i in np.flatnonzero(over):
            for channel, last in zip(whole, encode(info["final_obs"][i], self.space), strict=True):
                channel[i] = last
        return whole


def turns_of(env: Any) -> SingleTurns | VectorTurns:
    """Return the turns of a single or a vector environment."""
    from gymnasium.vector import VectorEnv

    return VectorTurns(env) if isinstance(env, VectorEnv) else SingleTurns(env)


class Reaction(NamedTuple):
    """An agent's answer to a turn, each ``[S]``: its next ``action``, and the ``best`` value that it sees."""

    action: np.ndarray
    best: np.ndarray


def trials_of(turns: Sequence[Turn], reactions: Sequence[Reaction]) -> list[Trials]:
    """Cut turns into each copy's trials, all of which must have ended; idle turns do not count."""
    turn = Turn(
        np.stack([t.kind for t in turns]),
        tuple(np.stack(channel) for channel in zip(*(t.observations for t in turns), strict=True)),
        *(np.stack([t[i] for t in turns]) for i in range(2, 5)),
    )
    reaction = Reaction(*(np.stack(part) for part in zip(*reactions, strict=True)))
    return [_trials_of_copy(turn, reaction, s) for s in range(turn.kind.shape[1])]


def _trials_of_copy(turn: Turn, reaction: Reaction, s: int) -> Trials:
    rows = np.flatnonzero(turn.kind[:, s] != IDLE)
    ended, terminated = turn.ended[rows, s], turn.terminated[rows, s]
    ends = np.flatnonzero(ended)
    paid = np.roll(turn.reward[rows, s], -1)
    return Trials(
        np.diff(np.concatenate([[-1], ends])),
        terminated[ends],
        np.where(terminated[ends], 0, reaction.best[rows, s][ends]).astype(np.float32),
        tuple(channel[rows, s] for channel in turn.observations),
        np.where(ended, 0, reaction.action[rows, s]).astype(np.int32),
        np.where(ended, 0, paid).astype(np.float32),
    )
