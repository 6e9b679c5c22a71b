"""W5: agents that act in the 89-state maze, each with a belief over 70 states and SARSA(lambda)."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from timing import LACKING, medians, on_cpu, reason
from workloads import AGENT

import jaxpomdp as jp
from jaxpomdp.agents.control import ControlConfig, Schedule
from jaxpomdp.agents.trial import Actor, run_trials
from jaxpomdp.envs import world as worlds

AGENTS = (21, 1024, 16384, 131072)
STATES = AGENT.states
CONTROL = ControlConfig(alpha=0.01, gamma=0.95, lam=0.9, schedule=Schedule(0.2, 0.2, 1, "constant"))

Entry = tuple[Callable[[], Any], int]
"""A call, and the steps that it takes."""


DISTINCT = 1024
"""So many models differ; more are copies."""


@partial(jax.jit, static_argnames="count")
def random_models(count: int) -> Any:
    """Draw models on the device, every row of probabilities evenly from all there are."""
    world = jp.make("maze89")
    like = jp.random_params(0, STATES, world.num_actions, world.num_observations)
    (channel,) = like.emissions

    def rows(key: jax.Array, log_prob: jax.Array) -> jax.Array:
        return jax.nn.log_softmax(jnp.log(jax.random.exponential(key, log_prob.shape)))

    def model(key: jax.Array) -> Any:
        init, trans, emit = jax.random.split(key, 3)
        return replace(
            like,
            log_init=rows(init, like.log_init),
            log_trans=rows(trans, like.log_trans),
            emissions=(replace(channel, log_prob=rows(emit, channel.log_prob)),),
        )

    some = jax.vmap(model)(jax.random.split(jax.random.key(0), min(count, DISTINCT)))
    return jax.tree.map(lambda x: x[jnp.arange(count) % DISTINCT], some)


def agents(count: int, plan: str, *, own_model: bool) -> Entry:
    """Return a call that runs a trial of every agent, and the steps that it takes."""
    world = jp.make("maze89")
    models = random_models(count if own_model else 1)
    keys = jax.vmap(lambda seed: jax.random.key_data(jax.random.key(seed)))(jnp.arange(count))
    zero = jnp.zeros(count, jnp.int32)
    actor = Actor(keys, jnp.zeros((count, STATES, world.num_actions)), zero, zero)

    def call() -> Any:
        run = run_trials(jp.FLAT, CONTROL, world, models, actor, trials=1, plan=plan)
        return jax.block_until_ready(run)

    return call, int(jnp.sum(call()[0].steps))


def worlds_alone(count: int, steps: int = 100) -> tuple[Any, int]:
    """Return a call that steps as many worlds with random actions, and nothing else."""
    world = jp.make("maze89")

    @jax.jit
    def walk(key: jax.Array) -> jax.Array:
        def step(state: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
            uniforms = jax.random.uniform(key, (count, 4))
            action = (uniforms[:, 3] * world.num_actions).astype(jnp.int32)
            out = jax.vmap(worlds.step, (None, 0, 0, 0))(world, state, action, uniforms[:, :3])
            return jnp.where(out.terminated, 0, out.state), jnp.sum(out.reward)

        return jax.lax.scan(step, jnp.zeros(count, jnp.int32), jax.random.split(key, steps))[1]

    return lambda: jax.block_until_ready(walk(jax.random.key(0))), count * steps


def gymnax_alone(count: int, steps: int = 100) -> tuple[Any, int]:
    """Return a call that steps gymnax's MemoryChain with random actions, and nothing else."""
    env, params = import_module("gymnax").make("MemoryChain-bsuite")

    @jax.jit
    def walk(key: jax.Array) -> jax.Array:
        _, begun = jax.vmap(env.reset, (0, None))(jax.random.split(key, count), params)

        def step(state: Any, key: jax.Array) -> tuple[Any, jax.Array]:
            one, two = jax.random.split(key)
            action = jax.random.randint(one, (count,), 0, env.num_actions)
            _, state, reward, *_ = jax.vmap(env.step, (0, 0, 0, None))(
                jax.random.split(two, count), state, action, params
            )
            return state, jnp.sum(reward)

        return jax.lax.scan(step, begun, jax.random.split(key, steps))[1]

    return lambda: jax.block_until_ready(walk(jax.random.key(0))), count * steps


def gymnasium_loop(steps: int = 5000) -> float:
    """Return the steps per second of one agent in NumPy, in a Gymnasium environment, as users write it."""
    gymnasium = import_module("gymnasium")
    env = gymnasium.make("jaxpomdp.envs.gym:jaxpomdp/Maze89-v0")
    world, rng = jp.make("maze89"), np.random.default_rng(0)
    model = jp.random_params(0, STATES, world.num_actions, world.num_observations)
    init, trans = np.exp(np.asarray(model.log_init)), np.exp(np.asarray(model.log_trans))
    emit = np.exp(np.asarray(model.emissions[0].log_prob))
    q, trace = np.zeros((STATES, world.num_actions)), np.zeros((STATES, world.num_actions))

    def observe(predicted: np.ndarray, seen: int) -> np.ndarray:
        joint = predicted * emit[:, seen]
        return joint / joint.sum()

    def choose(belief: np.ndarray) -> int:
        return int(rng.integers(world.num_actions)) if rng.random() < 0.2 else int(np.argmax(belief @ q))

    begin = time.perf_counter()
    seen, _ = env.reset(seed=0)
    belief, action = observe(init, seen), 0
    for _ in range(steps):
        seen, reward, terminated, truncated, _ = env.step(action)
        after = observe(belief @ trans[action], seen)
        then = choose(after)
        delta = reward + (0 if terminated else 0.95 * (after @ q)[then]) - belief @ q[:, action]
        trace *= 0.95 * 0.9
        trace[:, action] += belief
        q += 0.01 * delta * trace
        belief, action = after, then
        if terminated or truncated:
            seen, _ = env.reset()
            belief, trace[:] = observe(init, seen), 0
    return steps / (time.perf_counter() - begin)


def makers(count: int) -> dict[str, Callable[[], Entry]]:
    """Return how to make each entry for so many agents."""
    made: dict[str, Callable[[], Entry]] = {
        "ours, one model": partial(agents, count, "auto", own_model=False),
        "our worlds alone": partial(worlds_alone, count),
        "gymnax's MemoryChain alone": partial(gymnax_alone, count),
    }
    if on_cpu():
        made["ours, one model, XLA only"] = partial(agents, count, "loop", own_model=False)
    if count <= 1024 or not on_cpu():
        made["ours, a model each"] = partial(agents, count, "auto", own_model=True)
    return made


def compare(rounds: int) -> Iterator[dict[str, Any]]:
    """Yield environment steps per second for each number of agents, and of each peer."""
    rows: dict[str, dict[str, Any]] = {}
    left_out: dict[str, str] = {}
    for count in AGENTS[: 3 if on_cpu() else None]:
        entries = {}
        for name, make in makers(count).items():
            try:
                entries[name] = make()
                entries[name][0]()
            except LACKING as error:
                which = name if isinstance(error, ImportError) else f"{name}, {count:,} agents"
                left_out[which] = reason(error)
                entries.pop(name, None)
        taken = medians({name: call for name, (call, _) in entries.items()}, rounds, 30)
        rows[str(count)] = {name: steps / taken[name] for name, (_, steps) in entries.items()}
        yield {"W5": rows | {"left_out": left_out}}
    try:
        rows["1"] = {"a NumPy agent in a Gymnasium loop": gymnasium_loop()}
    except ImportError as error:
        left_out["a NumPy agent in a Gymnasium loop"] = reason(error)
    yield {"W5": rows | {"left_out": left_out}}
