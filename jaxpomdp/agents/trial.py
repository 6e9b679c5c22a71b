"""The online phase: many trials of many seeds as one device loop that never sees structure.

Every seed runs through its own trials without waiting for the others, so a trial of 5 steps does not pay for
251. The numbers that drive chance are drawn beforehand from (seed, trial, step).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxpomdp._types import Array, pytree
from jaxpomdp.agents import control
from jaxpomdp.agents.control import ControlConfig, Lane, Memory
from jaxpomdp.envs import world as worlds
from jaxpomdp.envs.world import World
from jaxpomdp.kernels import native
from jaxpomdp.kernels.filtering import observe, propagate
from jaxpomdp.models.family import Family

_DRAWS = worlds.UNIFORMS_PER_STEP + control.UNIFORMS_PER_CHOICE


@pytree
class Actor:
    """What the online phase carries from trial to trial, with leading axis ``S``.

    Attributes:
        keys: uint32 ``[S, 2]``, the root of each seed's draws.
        q: ``[S, N, A]``.
        trials: int ``[S]``, trials done.
        steps: int ``[S]``, actions taken.
    """

    keys: Array
    q: Array
    trials: Array
    steps: Array


class Log(NamedTuple):
    """What happened, action by action and in order: every array is ``[S, L]``.

    ``observation`` before the ``action``, ``reward`` for it, ``arrived`` the observation after it;
    ``active`` (else the seed had finished), ``ended``, ``terminated``, and ``best``, the agent's own best
    value of where it arrived.
    """

    observation: Array
    action: Array
    reward: Array
    arrived: Array
    active: Array
    ended: Array
    terminated: Array
    best: Array


class _Seed(NamedTuple):
    lane: Lane
    state: Array
    observation: Array
    trial: Array
    t: Array


def memory_of(family: Family, params: Any) -> Memory:
    """Return what acting needs of a model (one model, or with leading ``S``)."""
    chain = family.acting(params)
    return Memory(jnp.exp(chain.log_init), jnp.exp(chain.log_trans), params)


def first_belief(family: Family, memory: Memory, observations: tuple[Array, ...]) -> Array:
    """Return the belief after the first observation of a trial, ``[N]``."""
    log_obs = family.log_obs(memory.params, observations, jnp.array(True))
    return observe(memory.init, log_obs)[0]


def next_belief(
    family: Family, memory: Memory, belief: Array, action: Array, observations: tuple[Array, ...]
) -> Array:
    """Return the belief after one action and what was seen then, ``[N]`` (thesis section 3.3)."""
    log_obs = family.log_obs(memory.params, observations, jnp.array(True))
    return observe(propagate(belief, memory.trans, action), log_obs)[0]


def _draws(keys: Array, first: Array, trials: int, limit: int) -> Array:
    """Return uniforms ``[S, trials + 1, limit + 1, u]`` of (seed, trial, step); row 0 is for the reset."""
    numbers = first[:, None] + jnp.arange(trials + 1)[None, :]
    of_trial = jax.vmap(jax.vmap(jax.random.fold_in, in_axes=(None, 0)))(keys, numbers)
    return jax.vmap(jax.vmap(lambda key: jax.random.uniform(key, (limit + 1, _DRAWS))))(of_trial)


def _reset(
    family: Family, config: ControlConfig, world: World, memory: Memory, seed: _Seed, uniforms: Array
) -> _Seed:
    state, observation = worlds.reset(world, uniforms[: worlds.UNIFORMS_PER_RESET])
    belief = first_belief(family, memory, (observation,))
    lane = control.begin(config, seed.lane, belief, uniforms[worlds.UNIFORMS_PER_STEP :])
    return _Seed(lane, state, observation, seed.trial, jnp.zeros_like(seed.t))


def _advance(
    family: Family,
    config: ControlConfig,
    rate: float,
    world: World,
    trials: int,
    memory: Memory,
    seed: _Seed,
    draws: Array,
) -> tuple[_Seed, Log]:
    """One action of one seed; a seed that has done its trials stands still."""
    active = seed.trial < trials
    uniforms = draws[seed.trial, seed.t + 1]
    lane = seed.lane
    out = worlds.step(world, seed.state, lane.action, uniforms[: worlds.UNIFORMS_PER_STEP])
    ended = out.terminated | (seed.t + 1 >= world.step_limit)
    belief = next_belief(family, memory, lane.belief, lane.action, (out.observation,))
    learned, best = control.learn(
        config,
        lane,
        belief,
        out.reward,
        out.terminated,
        ended,
        uniforms[worlds.UNIFORMS_PER_STEP :],
        jnp.where(active, rate, 0),
    )
    log = Log(
        seed.observation,
        lane.action,
        out.reward,
        out.observation,
        active,
        ended & active,
        out.terminated,
        best,
    )
    learned = learned._replace(steps=jnp.where(active, learned.steps, lane.steps))
    onward = _Seed(learned, out.state, out.observation, seed.trial, seed.t + 1)
    fresh = _reset(family, config, world, memory, onward, draws[seed.trial + ended, 0])
    fresh = fresh._replace(trial=seed.trial + 1)
    moved = jax.tree.map(lambda x, y: jnp.where(ended, x, y), fresh, onward)
    rest = moved._replace(trial=seed.trial, t=seed.t)
    return jax.tree.map(lambda x, y: jnp.where(active, x, y), moved, rest), log


PLANS = ("auto", "loop", "native")
"""How trials may be run: a loop of JAX's own, or the native kernel; both do the same, up to rounding."""


def choose_plan(plan: str, dtype: Any) -> str:
    """Resolve ``auto``, and check that a named plan can run here.

    Raises:
        ValueError: ``plan`` is not known, or is ``native`` where that cannot run.
    """
    chosen = native.resolved(plan, PLANS, dtype)
    return "loop" if chosen == "auto" else chosen


def run_trials(
    family: Family,
    config: ControlConfig,
    world: World,
    params: Any,
    actor: Actor,
    *,
    trials: int,
    learning: bool = True,
    plan: str = "auto",
) -> tuple[Actor, Log, Array]:
    """Run ``trials`` trials of every seed, learning values on the way (thesis section 3.3, online phase).

    Args:
        family: the kind of model.
        config: control settings.
        world: shared by all seeds.
        params: models with leading axis ``S``, or 1 for a model that all share.
        actor: keys, values and counts.
        trials: for each seed.
        learning: False leaves the values as they are.
        plan: one of ``PLANS``.

    Returns:
        The actor, the log ``[S, trials * step_limit]``, and how many of its columns were written.

    Raises:
        ValueError: ``plan`` is not known or cannot run here.
    """
    chosen = choose_plan(plan, actor.q.dtype)
    return _run(family, config, world, params, actor, trials=trials, learning=learning, plan=chosen)


@partial(jax.jit, static_argnames=("family", "config", "trials", "learning", "plan"))
def _run(
    family: Family,
    config: ControlConfig,
    world: World,
    params: Any,
    actor: Actor,
    *,
    trials: int,
    learning: bool,
    plan: str,
) -> tuple[Actor, Log, Array]:
    memory = jax.vmap(partial(memory_of, family))(params)
    draws = _draws(actor.keys, actor.trials, trials, world.step_limit)
    rate = config.alpha if learning else 0.0
    run = _natively if plan == "native" else _in_a_loop
    q, steps, log, count = run(family, config, rate, world, trials, memory, actor, draws)
    return Actor(actor.keys, q, actor.trials + trials, steps), log, count


def _natively(
    family: Family,
    config: ControlConfig,
    rate: float,
    world: World,
    trials: int,
    memory: Memory,
    actor: Actor,
    draws: Array,
) -> tuple[Array, Array, Log, Array]:
    symbols = jnp.arange(world.num_observations)
    seen = jnp.ones(symbols.shape, bool)
    log_obs = jax.vmap(lambda params: family.log_obs(params, (symbols,), seen))(memory.params)
    ahead = jnp.arange(trials * world.step_limit + 1)[None, :]
    level = config.schedule.function()(actor.steps[:, None] + ahead)
    acted = native.act(
        native.ActingModel(memory.init, memory.trans, log_obs),
        actor.q,
        draws,
        jnp.broadcast_to(level, (actor.steps.shape[0], ahead.shape[1])).astype(jnp.float32),
        native.WorldTables(*(getattr(world, name) for name in native.WorldTables._fields)),
        jnp.array([rate, config.gamma, config.lam, config.sticky], jnp.float32),
        replacing=config.replacing,
        rule=config.rule,
        exploration=config.exploration,
    )
    log = Log(*(getattr(acted, name) for name in Log._fields))
    return acted.q, actor.steps + acted.steps, log, jnp.max(acted.steps)


def _in_a_loop(
    family: Family,
    config: ControlConfig,
    rate: float,
    world: World,
    trials: int,
    memory: Memory,
    actor: Actor,
    draws: Array,
) -> tuple[Array, Array, Log, Array]:
    seeds = actor.trials.shape[0]
    shared = memory.init.shape[0] == 1
    memory = jax.tree.map(lambda x: x[0], memory) if shared else memory
    of_memory = None if shared else 0
    advance = jax.vmap(partial(_advance, family, config, rate, world, trials), in_axes=(of_memory, 0, 0))
    begin = jax.vmap(partial(_reset, family, config, world), in_axes=(of_memory, 0, 0))
    zero = jnp.zeros(seeds, jnp.int32)
    nothing = jnp.zeros(actor.q.shape[:2], actor.q.dtype)
    lane = Lane(actor.q, jnp.zeros_like(actor.q), nothing, zero, zero > 0, actor.steps)
    seed = begin(memory, _Seed(lane, zero, zero, zero, zero), draws[:, 0, 0])
    shapes = jax.eval_shape(advance, memory, seed, draws)[1]
    log = jax.tree.map(lambda x: jnp.zeros((trials * world.step_limit, *x.shape), x.dtype), shapes)

    def unfinished(carry: tuple[Array, _Seed, Log]) -> Array:
        return jnp.any(carry[1].trial < trials)

    def body(carry: tuple[Array, _Seed, Log]) -> tuple[Array, _Seed, Log]:
        count, now, so_far = carry
        now, row = advance(memory, now, draws)
        write = lambda x, y: lax.dynamic_update_index_in_dim(x, y, count, 0)  # noqa: E731
        return count + 1, now, jax.tree.map(write, so_far, row)

    count, seed, log = lax.while_loop(unfinished, body, (jnp.zeros((), jnp.int32), seed, log))
    return seed.lane.q, seed.lane.steps, jax.tree.map(jnp.transpose, log), count
