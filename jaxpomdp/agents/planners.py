"""Planners on a given model: QMDP, most likely state, informed bound, Perseus; and how good a policy is.

A policy is a set of vectors with actions: it takes the action of the vector with the largest ``alpha . b``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxpomdp._types import Array
from jaxpomdp.envs import world as worlds
from jaxpomdp.envs.world import TrueModel, World
from jaxpomdp.kernels import planning
from jaxpomdp.kernels.planning import Vectors
from jaxpomdp.numerics import NEG, normalise

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


DEFAULT = PlannerConfig()


class Policy(NamedTuple):
    """``vectors[K, N]`` with their ``actions[K]``; ``sharpen[]`` takes the most likely state for certain.

    A row that is not used holds ``NEG`` throughout, so that policies from one planner have one shape.
    """

    vectors: Array
    actions: Array
    sharpen: Array


def act(policy: Policy, belief: Array, uniform: Array) -> Array:
    """Return the action ``actions[argmax_k alpha_k . b]`` for one belief.

    Args:
        policy: the vectors.
        belief: ``[N]``.
        uniform: a number in [0, 1) that picks among states that are exactly equally likely; only ``sharpen``
            uses it. Taking always the first would run in circles in a world with symmetries.

    Returns:
        An int scalar.
    """
    state = _draw((belief >= jnp.max(belief)).astype(belief.dtype), uniform)
    certain = jax.nn.one_hot(state, belief.shape[0], dtype=belief.dtype)
    belief = jnp.where(policy.sharpen, certain, belief)
    return policy.actions[jnp.argmax(policy.vectors @ belief)]


def value(policy: Policy, belief: Array) -> Array:
    """Return ``max_k alpha_k . b`` for one belief: for Perseus what the policy earns at least from there."""
    return jnp.max(policy.vectors @ belief)


def plan(model: TrueModel, discount: float, config: PlannerConfig = DEFAULT, *, seed: int = 0) -> Policy:
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


def first_belief(model: TrueModel, observation: Array) -> Array:
    """Return the belief ``[N]`` after the observation at a reset."""
    return normalise(model.start * model.first[:, observation], model.start)


def evaluate_policy(
    world: World, policy: Policy, *, model: TrueModel | None = None, trials: int = 251, seed: int = 0
) -> dict[str, np.ndarray]:
    """Let a policy act in a world and say how each trial went.

    Args:
        world: where it acts, for at most ``world.step_limit`` actions a trial.
        policy: from :func:`plan`.
        model: what it tracks its belief by; by default the truth.
        trials: how many, side by side.
        seed: of the draws, which depend on (seed, trial, step) alone.

    Returns:
        ``steps`` int, ``reward``, ``discounted`` = ``sum_t gamma^t r_t``, ``success``, each ``[trials]``.
    """
    model = worlds.model_of(world) if model is None else model
    keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.key(seed), jnp.arange(trials))
    rows = _evaluate(world, policy, model, keys)
    return {name: np.asarray(getattr(rows, name)) for name in ("steps", "reward", "discounted", "success")}


class _Trial(NamedTuple):
    """One trial under way; when it is over nothing changes any more."""

    state: Array
    belief: Array
    over: Array
    steps: Array
    reward: Array
    discounted: Array
    success: Array


@jax.jit
def _evaluate(world: World, policy: Policy, model: TrueModel, keys: Array) -> _Trial:
    """Run one trial for each key, all side by side, until the last is over."""
    draw = partial(jax.random.uniform, shape=(world.step_limit + 1, worlds.UNIFORMS_PER_STEP + 1))
    uniforms = jax.vmap(draw)(keys)
    advance = jax.vmap(partial(_advance, world, policy, model), in_axes=(0, 0, None))

    def going(carry: tuple[Array, _Trial]) -> Array:
        return (carry[0] < world.step_limit) & ~jnp.all(carry[1].over)

    def body(carry: tuple[Array, _Trial]) -> tuple[Array, _Trial]:
        return carry[0] + 1, advance(carry[1], uniforms[:, carry[0]], carry[0])

    begin = jax.vmap(partial(_first_step, world, model))(uniforms[:, -1])
    return lax.while_loop(going, body, (jnp.zeros((), jnp.int32), begin))[1]


def _first_step(world: World, model: TrueModel, uniforms: Array) -> _Trial:
    state, observation = worlds.reset(world, uniforms[: worlds.UNIFORMS_PER_RESET])
    nothing = jnp.zeros((), world.reward.dtype)
    over = world.terminal[state]
    belief = first_belief(model, observation)
    return _Trial(state, belief, over, jnp.int32(0), nothing, nothing, jnp.array(False))


def _advance(
    world: World, policy: Policy, model: TrueModel, now: _Trial, uniforms: Array, t: Array
) -> _Trial:
    action = act(policy, now.belief, uniforms[-1])
    out = worlds.step(world, now.state, action, uniforms[:-1])
    after = _Trial(
        out.state,
        planning.update(now.belief, action, out.observation, model.trans, model.obs),
        out.terminated,
        now.steps + 1,
        now.reward + out.reward,
        now.discounted + world.discount**t * out.reward,
        out.terminated & (out.reward > world.success_above),
    )
    return jax.tree.map(lambda x, y: jnp.where(now.over, x, y), now, after)
