"""Planners on a given model: QMDP, most likely state, informed bound, and Perseus."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.agents.policies import Policy, act, first_belief
from jaxpomdp.envs.world import TrueModel
from jaxpomdp.kernels import planning
from jaxpomdp.kernels.planning import Vectors
from jaxpomdp.numerics import NEG

METHODS = ("perseus", "qmdp", "most-likely", "informed")


@dataclass(frozen=True)
class PlannerConfig:
    """How to plan.

    Raises:
        ValueError: the method is unknown, or a number is out of its range.
    """

    method: str = "perseus"
    """``perseus``, ``qmdp``, ``most-likely`` (state) or ``informed`` (bound)."""
    beliefs: int = 800
    """Perseus: beliefs to improve; half are drawn from those met, half are chosen far from each other."""
    rounds: int = 3
    """Perseus: how often beliefs are collected anew, by the policy found so far."""
    sweeps: int = 20
    """Perseus: at most so many sweeps in a round."""
    slack: float = 0.01
    """Perseus: a belief may lose this part of the spread of values in a sweep; fewer vectors, much faster."""
    tolerance: float = 2e-4
    """Perseus: a round ends when a sweep's mean gain is below this part of the spread of values."""
    explorers: int = 32
    """Simulated agents of each kind (random, most likely state, the policy so far) that collect beliefs."""
    horizon: int = 100
    """Steps that each of them takes in a round."""
    sticky: float = 0.5
    """Chance that a random explorer repeats its action, without which it would not cross a long corridor."""
    epsilon: float = 0.1
    """Share of random actions of the other explorers."""
    capacity: int = 384
    """Perseus: room for so many vectors; doubled when it is full, which compiles anew."""

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {METHODS}, got {self.method!r}")
        for name in ("beliefs", "rounds", "sweeps", "explorers", "horizon", "capacity"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.beliefs > 3 * self.explorers * self.horizon:
            most = 3 * self.explorers * self.horizon
            raise ValueError(f"beliefs must be at most 3 * explorers * horizon = {most}, got {self.beliefs}")


PERSEUS = PlannerConfig()


def plan(model: TrueModel, discount: float, config: PlannerConfig = PERSEUS, *, seed: int = 0) -> Policy:
    """Plan on a model.

    Args:
        model: dense tables, of a world (``model_of``) or learned.
        discount: gamma, below one.
        config: settings.
        seed: of the draws; only Perseus draws.

    Returns:
        A policy for beliefs over the model's states.

    Raises:
        ValueError: the discount is not in [0, 1).

    Example:
        >>> from jaxpomdp.envs.hallway import hallway_navigation
        >>> from jaxpomdp.envs.world import model_of
        >>> policy = plan(model_of(hallway_navigation()), 0.9, PlannerConfig("qmdp"))
        >>> policy.actions.tolist()
        [0, 1, 2, 3]
    """
    if not 0 <= discount < 1:
        raise ValueError(f"discount must lie in [0, 1), got {discount}")
    trans, reward = planning.end_trials(model.trans, model.reward, model.terminal)
    model = model._replace(trans=trans, reward=reward)
    if config.method == "informed":
        return _simple(planning.informed_bound(trans, model.obs, reward, discount))
    heuristic = _simple(planning.value_iteration(trans, reward, discount), config.method == "most-likely")
    if config.method in ("qmdp", "most-likely"):
        return heuristic
    return _perseus(model, discount, config, jax.random.key(seed), heuristic)


def _simple(table: Array, sharpen: bool = False) -> Policy:
    return Policy(table, jnp.arange(table.shape[0], dtype=jnp.int32), jnp.array(sharpen))


def _perseus(
    model: TrueModel, discount: float, config: PlannerConfig, key: Array, heuristic: Policy
) -> Policy:
    """Collect beliefs, sweep over them, and again; the vectors are a lower bound throughout."""
    blind = planning.blind_values(model.trans, model.reward, discount)
    vectors = _resized(Vectors(blind, heuristic.actions, jnp.int32(blind.shape[0])), config.capacity)
    beliefs = jnp.tile(model.start[None], (config.beliefs, 1))
    for r in range(config.rounds):
        collecting, searching = jax.random.split(jax.random.fold_in(key, r))
        beliefs = _collect(collecting, model, _guides(heuristic, vectors), beliefs, config)
        vectors = _search(searching, beliefs, vectors, model, discount, config)
    return _policy_of(vectors)


def _search(
    key: Array, beliefs: Array, vectors: Vectors, model: TrueModel, discount: float, config: PlannerConfig
) -> Vectors:
    """Run Perseus, again in a larger buffer each time that it was full."""
    left = config.sweeps
    while True:
        vectors, left, full = planning.perseus(
            key,
            beliefs,
            vectors,
            model.trans,
            model.obs,
            model.reward,
            discount,
            left,
            config.slack,
            config.tolerance,
        )
        if not bool(full):
            return vectors
        vectors = _resized(vectors, 2 * vectors.actions.shape[0])


def _resized(vectors: Vectors, capacity: int) -> Vectors:
    extra = max(0, capacity - vectors.actions.shape[0])
    rows = jnp.pad(vectors.vectors, ((0, extra), (0, 0)))
    return Vectors(rows, jnp.pad(vectors.actions, (0, extra)), vectors.count)


def _policy_of(vectors: Vectors) -> Policy:
    used = (jnp.arange(vectors.actions.shape[0]) < vectors.count)[:, None]
    return Policy(jnp.where(used, vectors.vectors, NEG), vectors.actions, jnp.array(False))


def _guides(heuristic: Policy, vectors: Vectors) -> Policy:
    """Return the policies that collect beliefs, stacked: any (for random), most likely state, so far."""
    so_far = _policy_of(vectors)
    rows = jnp.full_like(so_far.vectors, NEG).at[: heuristic.actions.shape[0]].set(heuristic.vectors)
    actions = jnp.zeros_like(so_far.actions).at[: heuristic.actions.shape[0]].set(heuristic.actions)
    most_likely = Policy(rows, actions, jnp.array(True))
    return jax.tree.map(lambda *x: jnp.stack(x), most_likely, most_likely, so_far)


@partial(jax.jit, static_argnames="config")
def _collect(key: Array, model: TrueModel, guides: Policy, known: Array, config: PlannerConfig) -> Array:
    """Return ``config.beliefs`` beliefs ``[B, N]``: half drawn from those met now, half spread over all."""
    walking, drawing, spreading = jax.random.split(key, 3)
    epsilon = jnp.array([1.0, config.epsilon, config.epsilon])
    keys = jax.random.split(walking, (3, config.explorers))
    walk = jax.vmap(partial(_wander, model, config), in_axes=(None, None, 0))
    met = jax.vmap(walk)(guides, epsilon, keys).reshape(-1, model.start.shape[0])
    drawn = met[jax.random.randint(drawing, (config.beliefs - config.beliefs // 2,), 0, met.shape[0])]
    pool = jnp.concatenate([known, met])
    far = planning.spread(spreading, pool, config.beliefs // 2)
    return jnp.concatenate([drawn, pool[far]])


class _Explorer(NamedTuple):
    state: Array
    belief: Array
    action: Array


def _wander(model: TrueModel, config: PlannerConfig, guide: Policy, epsilon: Array, key: Array) -> Array:
    """Return the beliefs ``[horizon, N]`` that one agent comes by; it begins anew after a terminal state."""
    num_actions = model.trans.shape[0]

    def step(now: _Explorer, uniform: Array) -> tuple[_Explorer, Array]:
        anything = (uniform[0] * num_actions).astype(jnp.int32)
        random = jnp.where(uniform[1] < config.sticky, now.action, anything)
        action = jnp.where(uniform[2] < epsilon, random, act(guide, now.belief, uniform[3]))
        state = _draw(model.trans[action, now.state], uniform[4])
        seen_after = action if model.obs.shape[0] > 1 else 0
        observation = _draw(model.obs[seen_after, state], uniform[5])
        belief = planning.update(now.belief, action, observation, model.trans, model.obs)
        on, fresh = _Explorer(state, belief, action), _begin(model, uniform[6:8], anything)
        return jax.tree.map(lambda x, y: jnp.where(model.terminal[state], x, y), fresh, on), now.belief

    uniforms = jax.random.uniform(key, (config.horizon, 8))
    return lax.scan(step, _begin(model, uniforms[-1, 6:8], jnp.int32(0)), uniforms)[1]


def _begin(model: TrueModel, uniforms: Array, action: Array) -> _Explorer:
    state = _draw(model.start, uniforms[0])
    return _Explorer(state, first_belief(model, _draw(model.first[state], uniforms[1])), action)


def _draw(prob: Array, uniform: Array) -> Array:
    """Return an index drawn from ``prob[K]``; the scaled uniform keeps clear of a sum rounded below one."""
    total = jnp.cumsum(prob)
    return jnp.sum(total <= uniform * total[-1], dtype=jnp.int32)
