"""References to judge agents by: they have no memory, are told the truth, or do not learn.

Those that learn go through the same online loop as every agent, with a model that is given: without memory it
has one state for each observation, and is told nothing else; with the truth it is the world itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.agents.agent import Agent, AgentConfig
from jaxpomdp.agents.control import ControlConfig, Schedule
from jaxpomdp.agents.planners import PERSEUS, PlannerConfig, plan
from jaxpomdp.agents.policies import Policy, rollouts
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.envs.world import TrueModel, World, model_of
from jaxpomdp.kernels import planning
from jaxpomdp.models.emission import Categorical, ReturnModel
from jaxpomdp.models.flat import FlatParams
from jaxpomdp.numerics import safe_log


@dataclass(frozen=True)
class FixedConfig:
    """An agent that does not learn: a planner on the true model, or a random walk.

    Raises:
        ValueError: a number is below one.
    """

    planner: PlannerConfig | None = PERSEUS
    """How to plan on the true model; None walks at random."""
    never: tuple[str, ...] = ()
    """Names of actions that the random walk does not take (names that the world lacks are ignored)."""
    plans: int = 4
    """So many plans are made, each with its own chance; seeds take them in turn."""
    trials_per_phase: int = 50
    """Trials in each round of ``run``."""

    def __post_init__(self) -> None:
        """Refuse numbers that mean nothing."""
        for name in ("plans", "trials_per_phase"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")


class FixedState(NamedTuple):
    """``keys[S, 2]``, ``trials[S]`` done so far, and the policy of each seed (leading ``S``)."""

    keys: Array
    trials: Array
    policy: Policy


class FixedAgent:
    """A policy that is found before the first trial and then kept; the same methods as ``Agent``.

    Args:
        world: where it acts, and what it is told.
        config: its settings.
    """

    def __init__(self, world: World, config: FixedConfig) -> None:
        self.world, self.config = world, config
        self.model = _blank(world) if config.planner is None else model_of(world)

    def init(self, seeds: Any) -> FixedState:
        """Plan, and return the state before the first trial.

        Args:
            seeds: ints ``[S]``.
        """
        seeds = np.asarray(seeds, np.int64)
        policies = [self._policy(int(seed)) for seed in seeds[: self.config.plans]]
        turn = jnp.arange(len(seeds)) % len(policies)
        policy = jax.tree.map(lambda *x: jnp.stack(x)[turn], *_same_shape(policies))
        keys = jax.vmap(jax.random.key)(jnp.asarray(seeds, jnp.uint32))
        return FixedState(jax.random.key_data(keys), jnp.zeros(len(seeds), jnp.int32), policy)

    def _policy(self, seed: int) -> Policy:
        if self.config.planner is not None:
            return plan(self.model, self.world.discount, self.config.planner, seed=seed)
        taken = [i for i, name in enumerate(self.world.action_names) if name not in self.config.never]
        return Policy(jnp.zeros((len(taken), 1)), jnp.array(taken, jnp.int32), jnp.array(False))

    def run(self, state: FixedState) -> tuple[FixedState, dict[str, np.ndarray]]:
        """Act for some trials: ``steps``, ``reward``, ``discounted``, ``success``, each ``[S, trials]``."""
        count = self.config.trials_per_phase
        numbers = state.trials[:, None] + jnp.arange(count)[None, :]
        return state._replace(trials=state.trials + count), self._rows(state, state.keys, numbers)

    def evaluate(self, state: FixedState, trials: int, key: Array) -> dict[str, np.ndarray]:
        """Act for ``trials`` trials of every seed with chance from ``key``; rows as of :meth:`run`."""
        seeds = state.trials.shape[0]
        keys = jax.vmap(lambda s: jax.random.key_data(jax.random.fold_in(key, s)))(jnp.arange(seeds))
        return self._rows(state, keys, jnp.broadcast_to(jnp.arange(trials)[None, :], (seeds, trials)))

    def finish(self, state: FixedState) -> FixedState:
        """Return the agent as it is."""
        return state

    def _rows(self, state: FixedState, keys: Array, numbers: Array) -> dict[str, np.ndarray]:
        rows = _play(self.world, self.model, state.policy, keys, numbers)
        return {name: np.asarray(x) for name, x in rows.items()}


@jax.jit
def _play(world: World, model: TrueModel, policy: Policy, keys: Array, numbers: Array) -> dict[str, Array]:
    """Run the trials ``numbers[S, trials]``, seed after seed, so that none waits for another's last."""

    def seed(case: tuple[Policy, Array, Array]) -> dict[str, Array]:
        own, key, trials = case
        of_trial = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.wrap_key_data(key), trials)
        return rollouts(world, own, model, of_trial)._asdict()

    return jax.lax.map(seed, (policy, keys, numbers))


def _same_shape(policies: list[Policy]) -> list[Policy]:
    """Repeat the last row of the shorter policies: an equal twice changes no choice."""
    longest = max(policy.actions.shape[0] for policy in policies)

    def longer(policy: Policy) -> Policy:
        extra = longest - policy.actions.shape[0]
        vectors = jnp.pad(policy.vectors, ((0, extra), (0, 0)), mode="edge")
        return Policy(vectors, jnp.pad(policy.actions, (0, extra), mode="edge"), policy.sharpen)

    return [longer(policy) for policy in policies]


def _blank(world: World) -> TrueModel:
    """Return a model of one state, which remembers nothing and costs nothing."""
    actions, observations = world.num_actions, world.num_observations
    anything = jnp.full((1, 1, observations), 1 / observations)
    one = jnp.ones(1)
    return TrueModel(jnp.ones((actions, 1, 1)), anything, jnp.zeros((actions, 1)), one, one > 1, anything[0])


def observation_model(world: World) -> FlatParams:
    """Return a model with one state for each observation, seen surely, and even chances of what follows.

    The belief is then the last observation: an agent on it has no memory.
    """
    size = world.num_observations
    even = jnp.full((world.num_actions, size, size), 1 / size)
    return _flat(jnp.full(size, 1 / size), even, jnp.eye(size))


def true_model(world: World) -> FlatParams:
    """Return the world itself as a model, so that an agent tracks the true belief.

    Raises:
        ValueError: observations depend on the action, or differ at a reset: this kind of model has neither.
    """
    model = model_of(world)
    if model.obs.shape[0] > 1 or not np.allclose(model.first, model.obs[0], atol=1e-6):
        raise ValueError(f"world {world.name!r} must have observations that depend on the state alone")
    return _flat(model.start, model.trans, model.obs[0])


def _flat(start: Array, trans: Array, obs: Array) -> FlatParams:
    size = start.shape[0]
    returns = ReturnModel(jnp.zeros((size, 1)), jnp.ones((size, 1)))
    alive = jnp.ones(size, bool)
    return FlatParams(safe_log(start), safe_log(trans), (Categorical(safe_log(obs)),), returns, alive)


def _qmdp_values(world: World) -> Array:
    """Return the values of the fully observed problem, ``[N, A]``."""
    model = model_of(world)
    trans, reward = planning.end_trials(model.trans, model.reward, model.terminal)
    return planning.value_iteration(trans, reward, world.discount).T


def _start_at(params: FlatParams, q: Array) -> Callable[[np.ndarray], tuple[FlatParams, Array]]:
    """Give every seed the same model and the same first values."""

    def fixed(seeds: np.ndarray) -> tuple[FlatParams, Array]:
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (len(seeds), *x.shape)), (params, q))

    return fixed


LOCH_SINGH = ControlConfig(alpha=0.01, gamma=0.95, lam=0.9, schedule=Schedule(0.2, 0.0, 350_000))
"""SARSA(lambda) as Loch and Singh (1998) ran it on observations."""

LEARNING: Mapping[str, AgentConfig] = {
    "memoryless": AgentConfig(LOCH_SINGH, None),
    "belief-sarsa": AgentConfig(LOCH_SINGH, None),
    "seeded-q": AgentConfig(replace(LOCH_SINGH, alpha=0.05, lam=0.0, rule="q"), None),
}
"""Without memory; on the true belief; on the true belief, Q-learning from QMDP (Littman et al., 1995)."""

FIXED: Mapping[str, FixedConfig] = {
    "random": FixedConfig(None, never=("no-op",)),
    "random-all": FixedConfig(None),
    "qmdp": FixedConfig(PlannerConfig("qmdp")),
    "most-likely": FixedConfig(PlannerConfig("most-likely")),
    "perseus": FixedConfig(PlannerConfig("perseus")),
}
"""Random walks, and planners on the true model."""


def names() -> tuple[str, ...]:
    """Return the names that :func:`make` knows."""
    return tuple(sorted([*LEARNING, *FIXED]))


def make(name: str, world: World, settings: Mapping[str, Any]) -> Agent | FixedAgent:
    """Return a reference by name; learning ones discount as the world does unless told otherwise.

    Args:
        name: one of :func:`names`.
        world: where it will act.
        settings: changed settings by name, as for ``make_agent``.

    Raises:
        ValueError: the name or a setting is unknown, or the world does not suit.
    """
    if name in FIXED:
        return FixedAgent(world, with_settings(FIXED[name], settings))
    if name not in LEARNING:
        raise ValueError(f"reference must be one of {', '.join(names())}, got {name!r}")
    config = with_settings(LEARNING[name], {"control.gamma": world.discount, **settings})
    params = observation_model(world) if name == "memoryless" else true_model(world)
    q = jnp.full((params.alive.shape[0], world.num_actions), config.control.optimism)
    return Agent(world, config, fixed=_start_at(params, _qmdp_values(world) if name == "seeded-q" else q))
