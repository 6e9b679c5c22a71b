"""The online phase in a Gymnasium environment: a loop on the host, with one compiled step for all copies."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.agents import control
from jaxpomdp.agents.control import ControlConfig, Lane, Memory
from jaxpomdp.agents.experience import Trials
from jaxpomdp.agents.gym_turns import ACTED, BEGAN, IDLE, Reaction, SingleTurns, Turn, VectorTurns, trials_of
from jaxpomdp.agents.trial import Actor, first_belief, memory_of, next_belief
from jaxpomdp.models.family import Family


@partial(jax.jit, static_argnames="family")
def _memories(family: Family, params: Any) -> Memory:
    return jax.vmap(partial(memory_of, family))(params)


@partial(jax.jit, static_argnames=("family", "config"))
def _react(
    family: Family,
    config: ControlConfig,
    memory: Memory,
    keys: Array,
    lane: Lane,
    turn: Turn,
    trial: Array,
    t: Array,
) -> tuple[Lane, Array]:
    """Take in one turn of every copy: learn from an outcome or begin a trial, and choose an action."""

    def one(memory: Memory, key: Array, lane: Lane, turn: Turn, trial: Array, t: Array) -> tuple[Lane, Array]:
        uniforms = jax.random.uniform(
            jax.random.fold_in(jax.random.fold_in(key, trial), t), (control.UNIFORMS_PER_CHOICE,)
        )
        belief = next_belief(family, memory, lane.belief, lane.action, turn.observations)
        rate = jnp.float32(config.alpha)
        outcome = (turn.reward, turn.terminated, turn.ended)
        acted, best = control.learn(config, lane, belief, *outcome, uniforms, rate)
        begun = control.begin(config, lane, first_belief(family, memory, turn.observations), uniforms)
        pick = lambda a, b, c: jnp.where(turn.kind == ACTED, a, jnp.where(turn.kind == BEGAN, b, c))  # noqa: E731
        return jax.tree.map(pick, acted, begun, lane), best

    return jax.vmap(one)(memory, keys, lane, turn, trial, t)


def play(
    family: Family,
    config: ControlConfig,
    params: Any,
    actor: Actor,
    turns: SingleTurns | VectorTurns,
    *,
    trials: int,
    seed: int | None = None,
) -> tuple[Actor, list[Trials]]:
    """Let every copy run ``trials`` trials; one that has done them waits. See ``trial.run_trials``.

    Chance in the agent comes from (its key, trial, step); chance in the environment is the environment's.
    """
    memory, copies = _memories(family, params), turns.copies
    zero = jnp.zeros(copies, jnp.int32)
    nothing = jnp.zeros(actor.q.shape[:2], actor.q.dtype)
    lane = Lane(actor.q, jnp.zeros_like(actor.q), nothing, zero, zero > 0, actor.steps)
    done, t = np.zeros(copies, np.int32), np.zeros(copies, np.int32)
    before = np.asarray(actor.trials)
    seen: list[Turn] = []
    reactions: list[Reaction] = []
    coming = [turns.reset(seed)]
    while True:
        for turn in coming:
            turn = turn._replace(kind=np.where(done < trials, turn.kind, IDLE))
            t = np.where(turn.kind == BEGAN, 0, t + 1).astype(np.int32)
            lane, best = _react(family, config, memory, actor.keys, lane, turn, before + done, t)
            seen.append(turn)
            reactions.append(Reaction(np.asarray(lane.action), np.asarray(best)))
            done = done + (turn.ended & (turn.kind == ACTED))
        if (done >= trials).all():
            break
        coming = turns.step(reactions[-1].action)
    return Actor(actor.keys, lane.q, actor.trials + trials, lane.steps), trials_of(seen, reactions)
