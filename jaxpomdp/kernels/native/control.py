"""Acting and SARSA replay in C++.

Shapes: ``S`` models, ``B`` rows, ``T`` steps, ``N`` states, ``A`` actions.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array
from jaxpomdp.kernels.native.arguments import check, float32

RULES = ("sarsa", "q")


def sarsa_replay(
    q: Array,
    beliefs: Array,
    actions: Array,
    rewards: Array,
    start: Array,
    valid: Array,
    terminated: Array,
    *,
    alpha: Array | float,
    gamma: Array | float,
    lam: Array | float,
    passes: int = 1,
    replacing: bool = False,
    rule: str = "sarsa",
) -> Array:
    """Learn again from stored trials: ``kernels.control.replay_tape`` over the rows of each model in turn.

    ``delta_t = r_t + gamma Q(b_{t+1}, a_{t+1}) - Q(b_t, a_t)``, ``e := gamma lambda e``,
    ``e(., a_t) += b_t``, ``q += alpha delta_t e``. The last step of a trial has no action: its value is 0 if
    it terminated, else ``max_a Q(b, a)``. A start clears the traces.

    Args:
        q: float32 ``[S, N, A]``, with ``Q(b, a) = sum_i b(i) q(i, a)``.
        beliefs: float32 ``[S, B, T, N]``.
        actions: int32 ``[S, B, T]``.
        rewards: float32 ``[S, B, T]``, paid for ``actions``.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.
        terminated: bool ``[S, B, T]``, the world ended the trial at this step.
        alpha: learning rate, a scalar or ``[S]``; may be traced, as the next two.
        gamma: discount.
        lam: lambda, the decay of the traces besides the discount.
        passes: how often to go over all rows.
        replacing: traces take ``max(e, b)`` for the sum (Singh and Sutton, 1996).
        rule: ``sarsa``, or ``q`` for the maximum over actions at every next step (traces are not cut).

    Returns:
        The new ``q[S, N, A]``.

    Raises:
        ValueError: an argument of another shape or dtype, an unknown rule, or a negative number of passes.

    Source: thesis section 3.3; Sutton and Barto (1998), chapter 7.
    """
    if rule not in RULES or passes < 0:
        raise ValueError(f"rule must be one of {RULES} and passes at least 0, got {rule!r} and {passes}")
    if jnp.ndim(beliefs) != 4 or jnp.ndim(q) != 3:
        shapes = f"{list(jnp.shape(beliefs))} and {list(jnp.shape(q))}"
        raise ValueError(f"beliefs must have shape [S, B, T, N] and q [S, N, A], got {shapes}")
    models, rows, steps, states = jnp.shape(beliefs)
    check("q", q, (models, states, jnp.shape(q)[2]), jnp.float32)
    check("beliefs", beliefs, (models, rows, steps, states), jnp.float32)
    check("actions", actions, (models, rows, steps), jnp.int32)
    check("rewards", rewards, (models, rows, steps), jnp.float32)
    for name, flags in (("start", start), ("valid", valid), ("terminated", terminated)):
        check(name, flags, (models, rows, steps), jnp.bool_)
    per_model = (jnp.broadcast_to(jnp.asarray(x, jnp.float32), (models,)) for x in (alpha, gamma, lam))
    settings = jnp.stack(tuple(per_model), axis=-1)
    call = jax.ffi.ffi_call("jaxpomdp_replay", *float32(q.shape), vmap_method="broadcast_all")
    flags = {"passes": passes, "replacing": replacing, "greedy": rule == "q"}
    return call(q, beliefs, actions, rewards, start, valid, terminated, settings, **flags)


class ActingModel(NamedTuple):
    """What acting needs of ``M`` models: ``init[M, N]``, ``trans[M, A, N, N]``, ``log_obs[M, O, N]``."""

    init: Array
    trans: Array
    log_obs: Array


class WorldTables(NamedTuple):
    """A world of ``X`` states and ``K`` outcomes; fields, in their order, as in ``envs.world.World``."""

    successors: Array
    transition_cdf: Array
    reward: Array
    observation_cdf: Array
    first_observation_cdf: Array
    start_cdf: Array
    terminal: Array
    reward_noise: Array


class Acted(NamedTuple):
    """New ``q[S, N, A]``, ``steps[S]`` taken, and a log ``[S, L]``; where not ``active``, it is zero."""

    q: Array
    steps: Array
    observation: Array
    action: Array
    reward: Array
    arrived: Array
    active: Array
    ended: Array
    terminated: Array
    best: Array


def act(
    model: ActingModel,
    q: Array,
    draws: Array,
    level: Array,
    world: WorldTables,
    settings: Array,
    *,
    replacing: bool,
    rule: str,
    exploration: str,
) -> Acted:
    """Run trials of ``S`` agents, each learning values on its way: ``agents.trial.run_trials``.

    Args:
        model: of each agent, or one (``M = 1``) that all share.
        q: float32 ``[S, N, A]``.
        draws: uniforms float32 ``[S, trials + 1, limit + 1, 6]``: three for the world, three for a choice.
        level: float32 ``[S, trials * limit + 1]``, epsilon or temperature after so many more steps.
        world: where they act.
        settings: float32 ``[4]``: learning rate, discount, lambda, chance that exploring repeats the action.
        replacing: kind of trace.
        rule: ``sarsa`` or ``q``.
        exploration: ``epsilon`` or ``boltzmann``.

    Raises:
        ValueError: an argument of another shape or dtype, or an unknown rule.
    """
    if rule not in RULES:
        raise ValueError(f"rule must be one of {RULES}, got {rule!r}")
    seeds, states, actions = jnp.shape(q)
    trials, limit = draws.shape[1] - 1, draws.shape[2] - 1
    models, symbols = model.log_obs.shape[:2]
    _, places, outcomes = world.successors.shape
    if models not in (1, seeds):
        raise ValueError(f"model must have a leading axis of 1 or {seeds}, got {models}")
    single = (
        ("q", q, (seeds, states, actions)),
        ("draws", draws, (seeds, trials + 1, limit + 1, 6)),
        ("level", level, (seeds, trials * limit + 1)),
        ("settings", settings, (4,)),
        ("model.init", model.init, (models, states)),
        ("model.trans", model.trans, (models, actions, states, states)),
        ("model.log_obs", model.log_obs, (models, symbols, states)),
        ("world.transition_cdf", world.transition_cdf, (actions, places, outcomes)),
        ("world.reward", world.reward, (actions, places, outcomes)),
        ("world.observation_cdf", world.observation_cdf, (world.observation_cdf.shape[0], places, symbols)),
        ("world.first_observation_cdf", world.first_observation_cdf, (places, symbols)),
        ("world.start_cdf", world.start_cdf, (places,)),
        ("world.reward_noise", world.reward_noise, ()),
    )
    for name, array, shape in single:
        check(name, array, shape, jnp.float32)
    check("world.successors", world.successors, (actions, places, outcomes), jnp.int32)
    check("world.terminal", world.terminal, (places,), jnp.bool_)
    whole, real, flag = (
        (jax.ShapeDtypeStruct((seeds, trials * limit), t)) for t in ("int32", "float32", "bool")
    )
    steps = jax.ShapeDtypeStruct((seeds,), jnp.int32)
    results = (*float32(q.shape), steps, whole, whole, real, whole, flag, flag, flag, real)
    call = jax.ffi.ffi_call("jaxpomdp_act", results, vmap_method="sequential")
    flags = {"replacing": replacing, "greedy": rule == "q", "boltzmann": exploration == "boltzmann"}
    return Acted(*call(*model, q, draws, level, *world, settings, **flags))
