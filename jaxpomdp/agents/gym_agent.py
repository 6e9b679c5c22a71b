"""An agent that learns in any Gymnasium environment whose actions are ``Discrete`` (needs gymnasium).

The rules of acting, learning values, refitting and splitting are those of tabular worlds; only the loop runs
on the host, one compiled step for all copies of the environment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.agents import control, experience, learner
from jaxpomdp.agents.agent import Agent, AgentConfig, AgentState
from jaxpomdp.agents.best import none_yet
from jaxpomdp.agents.clock import Clock
from jaxpomdp.agents.control import Schedule
from jaxpomdp.agents.experience import Trials
from jaxpomdp.agents.gym_play import play
from jaxpomdp.agents.gym_turns import SingleTurns, VectorTurns, turns_of
from jaxpomdp.agents.kinds import Sizes, started
from jaxpomdp.agents.outcomes import summarise
from jaxpomdp.agents.trial import Actor, first_belief, memory_of, next_belief
from jaxpomdp.envs.spaces import ChannelSpec, actions_of, channels_of, encode
from jaxpomdp.models.init import Real

RANDOM = Schedule(1.0, 1.0, 1, "constant")
"""Exploration while there is no model yet."""

DEFAULT = AgentConfig()
"""The settings of a :class:`GymAgent` that is given none."""


class Interface(NamedTuple):
    """What a learner knows of where it acts, in place of a ``World``.

    A trial counts as a success if it terminated with a last reward above ``success_above``.
    """

    num_actions: int
    num_observations: tuple[int | Real, ...]
    discount: float
    success_above: float = 0.0


class _Learner(Agent):
    """The offline phase of ``Agent``, for observations of several channels, discrete or real."""

    def __init__(self, interface: Interface, config: AgentConfig) -> None:
        super().__init__(interface, config)
        self._interface = interface

    def init(self, seeds: Any) -> AgentState:
        """Return the state before the first trial."""
        state = super().init(seeds)
        channels = self._interface.num_observations
        shapes = tuple(
            np.zeros(c.dimension, np.float32) if isinstance(c, Real) else np.int32(0) for c in channels
        )
        store = experience.no_experience(len(state.recent), self.config.learner.window, shapes)
        return state._replace(experience=store)

    def blind(self, state: AgentState) -> bool:
        """Say whether there is no model yet: where real numbers are seen it needs data to start from."""
        waits = any(isinstance(channel, Real) for channel in self._interface.num_observations)
        return waits and int(np.max(np.asarray(state.actor.trials))) < self.config.learner.trials_per_phase

    def take_in(
        self, state: AgentState, actor: Actor, new: list[Trials]
    ) -> tuple[AgentState, dict[str, np.ndarray]]:
        """Remember new trials, and learn from the past where a phase is complete."""
        clock, was_blind = Clock(), self.blind(state)
        rows = summarise(new, self.world)
        state = state._replace(actor=actor, experience=experience.remember(state.experience, new))
        evidence = np.zeros(len(new))
        complete = int(np.max(np.asarray(actor.trials))) % self.config.learner.trials_per_phase == 0
        if was_blind and complete:
            state = self._informed(state)
        elif not was_blind:
            state = self._noted(state, rows["discounted"])
            state = self._judge(state, self.config.learner.trials_per_phase) if complete else state
        if complete:
            state, evidence = self._learn(state, clock)
        return state, rows | self._phase_rows(state, evidence, clock)

    def _informed(self, state: AgentState) -> AgentState:
        """Start the models from what was seen; each seed from its own."""
        settings, control_settings = self.config.learner, self.config.control
        tapes = experience.tapes_of(state.experience)
        batch = learner.with_returns(
            jax.device_put(tapes.batch),
            jnp.asarray(tapes.tail),
            gamma=settings.return_gamma,
            bootstrap=False,
        )
        seeds = np.asarray(state.actor.keys)[:, -1]
        sizes = Sizes(self._interface.num_actions, self._interface.num_observations)
        params = started(self.kind, seeds, sizes, settings, batch=jax.device_get(batch))
        q = jnp.full_like(state.actor.q, control_settings.optimism)
        best = none_yet(params, q, settings.probation)
        return state._replace(params=params, actor=replace(state.actor, q=q), best=best)


class GymAgent:
    """An agent that learns to act in a Gymnasium environment.

    Observations may be ``Discrete``, ``MultiDiscrete``, ``MultiBinary``, ``Box``, or a ``Tuple`` or ``Dict``
    of these; a component is a channel, a ``Box`` a channel of real vectors. Each copy in a vector environment
    is a seed with a model and values of its own. Where an observation is real, the first phase acts at random
    and the models start from what it saw. A terminated trial has no future; a truncated one has the agent's
    own value of where it stopped (``learner.bootstrap``).

    Args:
        env: a single or a vector environment, or the pair of a single observation space and action space.
        config: all settings; ``control.gamma`` is also the discount of the reported ``discounted`` reward.

    Attributes:
        state: everything that is learned, ``None`` before the first training; a pytree that can be stored.

    Raises:
        TypeError: a space is of another kind.
        ValueError: ``config`` has no learner.

    Example:
        >>> from gymnasium.spaces import Discrete, MultiBinary
        >>> GymAgent((MultiBinary(2), Discrete(3)))
        GymAgent(3 actions, observation[0]: 2 values, observation[1]: 2 values)
    """

    def __init__(self, env: Any, config: AgentConfig = DEFAULT) -> None:
        self._space, action_space = _spaces_of(env)
        self._actions = actions_of(action_space)
        self._channels = channels_of(self._space)
        sizes = tuple(c.size if c.kind == "categorical" else Real(c.size) for c in self._channels)
        self._learner = _Learner(Interface(self._actions.count, sizes, config.control.gamma), config)
        self.state: AgentState | None = None
        self._belief: tuple[Array, Array] | None = None

    def __repr__(self) -> str:
        return f"GymAgent({self._actions.count} actions, {', '.join(map(_described, self._channels))})"

    @property
    def edits(self) -> list[dict[str, Any]]:
        """A row for every structure edit so far."""
        return self._learner.log

    def train(
        self,
        env: Any,
        trials: int,
        *,
        seed: int | None = None,
        progress: Callable[[Mapping[str, np.ndarray]], None] | None = None,
    ) -> dict[str, np.ndarray]:
        """Learn in an environment for so many trials (each copy), in phases of ``learner.trials_per_phase``.

        Args:
            env: a single or a vector environment with the spaces that were given.
            trials: at least 1.
            seed: begin from nothing with seeds ``seed, seed + 1, ...`` (agent and environment); ``None`` goes
                on where the last training stopped, or begins with seed 0.
            progress: called after each phase, and before its rehearsals, with rows (as of ``Agent.run``).

        Returns:
            ``steps``, ``reward``, ``discounted`` and ``success`` of every trial, each ``[S, trials]``.

        Raises:
            ValueError: ``trials`` is below 1, or the number of copies or a space changed.
        """
        turns = self._turns(env, trials)
        if self.state is None and seed is None:
            seed = 0
        if seed is not None:
            self.state = self._learner.init(seed + np.arange(turns.copies))
        self._check_copies(turns)
        phases, left = [], trials
        while left:
            rows = self._phase(turns, left, seed)
            phases.append(rows)
            left, seed = left - rows["steps"].shape[1], None
            if progress:
                progress(rows)
        return _joined(phases)

    def evaluate(self, env: Any, trials: int, *, seed: int = 0) -> dict[str, np.ndarray]:
        """Act greedily without learning; rows as of ``train``. The environment is reset with ``seed``."""
        turns = self._turns(env, trials)
        self._check_copies(turns)
        greedy = control.settled(self._learner.config.control)
        family, state = self._learner.family, self.state
        _, new = play(family, greedy, state.params, state.actor, turns, trials=trials, seed=seed)
        return summarise(new, self._learner.world)

    def finish(self) -> None:
        """Go back to the best policy so far where it is to be preferred (``learner.keep_best``)."""
        self.state = self._learner.finish(self._trained())

    def begin_trial(self) -> None:
        """Forget the trial that ``act`` was in the middle of."""
        self._belief = None

    def act(self, observation: Any, *, copy: int = 0) -> int:
        """Return the greedy action in a trial that is played outside, from one observation after another.

        Args:
            observation: of a single environment; the first one after ``begin_trial`` begins a trial.
            copy: whose model and values to use.
        """
        state, family = self._trained(), self._learner.family
        one = jax.tree.map(lambda x: x[copy], state.params)
        memory, seen = memory_of(family, one), tuple(map(jnp.asarray, encode(observation, self._space)))
        if self._belief is None:
            belief = first_belief(family, memory, seen)
        else:
            belief = next_belief(family, memory, *self._belief, seen)
        action = control.rules.greedy(control.rules.action_values(state.actor.q[copy], belief))
        self._belief = belief, action
        return self._actions.first + int(action)

    def _phase(self, turns: SingleTurns | VectorTurns, most: int, seed: int | None) -> dict[str, np.ndarray]:
        """Run the trials up to the rehearsals or the next offline phase, at most ``most``, and learn."""
        state, config = self.state, self._learner.config
        every, rehearsals = config.learner.trials_per_phase, config.learner.rehearsals
        done = int(np.max(np.asarray(state.actor.trials))) % every
        rehearsing, blind = done >= every - rehearsals, self._learner.blind(state)
        trials = min(most, (every if rehearsing else every - rehearsals) - done)
        acting = control.settled(config.control) if rehearsing else config.control
        if blind:
            acting = replace(control.settled(config.control), schedule=RANDOM, sticky=0.0)
        family = self._learner.family
        actor, new = play(family, acting, state.params, state.actor, turns, trials=trials, seed=seed)
        self.state, rows = self._learner.take_in(state, actor, new)
        self._belief = None
        return rows

    def _turns(self, env: Any, trials: int) -> SingleTurns | VectorTurns:
        if trials < 1:
            raise ValueError(f"trials must be at least 1, got {trials}")
        space, action_space = _spaces_of(env)
        if channels_of(space) != self._channels or actions_of(action_space) != self._actions:
            raise ValueError(f"env must have the spaces of {self!r}, got {space} and {action_space}")
        return turns_of(env)

    def _trained(self) -> AgentState:
        if self.state is None:
            raise ValueError("the agent must be trained first: state is None")
        return self.state

    def _check_copies(self, turns: SingleTurns | VectorTurns) -> None:
        copies = len(self._trained().recent)
        if turns.copies != copies:
            raise ValueError(f"env must have {copies} copies, one for each seed, got {turns.copies}")


def _spaces_of(env: Any) -> tuple[Any, Any]:
    """Return the observation and the action space of a single environment, of one copy, or as given."""
    if isinstance(env, tuple):
        return env
    if hasattr(env, "single_observation_space"):
        return env.single_observation_space, env.single_action_space
    return env.observation_space, env.action_space


def _described(channel: ChannelSpec) -> str:
    return f"{channel.name}: {channel.size} {'values' if channel.kind == 'categorical' else 'real numbers'}"


def _joined(phases: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    names = ("steps", "reward", "discounted", "success")
    return {name: np.concatenate([rows[name] for rows in phases], axis=1) for name in names}
