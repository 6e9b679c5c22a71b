"""Kernels in C++ behind JAX's foreign function interface: on the CPU, in float32, where a compiler is found.

``available()`` says whether they can be used; its first call compiles them, once per machine (some seconds).
The others work under ``jit``, ``vmap`` and inside loops as any JAX function does, but have no derivatives.
They use the cores that the process may run on, or as many threads as the environment variable
``JAXPOMDP_THREADS`` says; results do not depend on that. ``JAXPOMDP_NATIVE=0`` turns all of it off.

Shapes: ``S`` models, ``B`` rows, ``T`` steps, ``N`` states, ``A`` actions.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Posterior
from jaxpomdp.kernels.coupled import CoupledPosterior
from jaxpomdp.kernels.memory import MemoryChain, MemoryCounts, MemoryPosterior
from jaxpomdp.kernels.native.build import loaded

__all__ = [
    "Acted",
    "ActingModel",
    "WorldTables",
    "act",
    "available",
    "coupled_estep",
    "estep",
    "filter_tapes",
    "marginal_estep",
    "memory_estep",
    "sarsa_replay",
]

RULES = ("sarsa", "q")
Rows = tuple[Array, Array]


def available() -> bool:
    """Say whether the native kernels can be used here: JAX computes on the CPU, and the library was built."""
    return jax.default_backend() == "cpu" and loaded()


def _check(name: str, value: Array, shape: tuple[int, ...], dtype: type) -> None:
    """Raise if an array has not the shape and dtype that C++ will take it to have."""
    if jnp.shape(value) != shape or value.dtype != dtype:
        came = f"{value.dtype}{list(jnp.shape(value))}"
        raise ValueError(f"{name} must be {jnp.dtype(dtype).name}{list(shape)}, got {came}")


def _check_tapes(
    init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array
) -> None:
    """Check the arguments of ``estep`` and ``filter_tapes`` against one another."""
    if jnp.ndim(log_obs) != 4 or jnp.ndim(trans) != 4:
        raise ValueError(
            "log_obs must have shape [S, B, T, N] and trans [S, A, N, N], "
            f"got {list(jnp.shape(log_obs))} and {list(jnp.shape(trans))}"
        )
    models, rows, steps, states = jnp.shape(log_obs)
    _check("init", init, (models, states), jnp.float32)
    _check("trans", trans, (models, jnp.shape(trans)[1], states, states), jnp.float32)
    _check("log_obs", log_obs, (models, rows, steps, states), jnp.float32)
    _check("actions", actions, (models, rows, steps), jnp.int32)
    _check("start", start, (models, rows, steps), jnp.bool_)
    _check("valid", valid, (models, rows, steps), jnp.bool_)


def _float32(*shapes: tuple[int, ...]) -> tuple[jax.ShapeDtypeStruct, ...]:
    return tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)


def estep(init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Smooth all rows of all models: ``kernels.smoothing.smooth`` for each, counts summed over rows.

    Args:
        init: probabilities float32 ``[S, N]``.
        trans: probabilities float32 ``[S, A, N, N]`` (row: from, column: to).
        log_obs: float32 ``[S, B, T, N]``; a missing step is a row of zeros.
        actions: int32 ``[S, B, T]``; the last of a trial is ignored.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.

    Returns:
        ``Posterior``: ``log_evidence[S, B]``, ``gamma[S, B, T, N]``, ``xi[S, A, N, N]``, ``initial[S, N]``.

    Raises:
        ValueError: an argument of another shape or dtype.

    Source: Rabiner (1989); thesis section 3.3.
    """
    _check_tapes(init, trans, log_obs, actions, start, valid)
    results = _float32(actions.shape[:2], log_obs.shape, trans.shape, init.shape)
    call = jax.ffi.ffi_call("jaxpomdp_estep", results, vmap_method="broadcast_all")
    return Posterior(*call(init, trans, log_obs, actions, start, valid))


def coupled_estep(
    init: tuple[Array, Array],
    trans: tuple[Array, Array],
    log_obs: tuple[Array, Array],
    actions: Array,
    start: Array,
    valid: Array,
) -> CoupledPosterior:
    """Smooth all rows of all models of two chains: ``coupled_exact.smooth_joint`` for each, counts summed.

    Fastest where the second chain is the one of more states.

    Args:
        init: probabilities float32 ``[S, N_c]`` of each chain.
        trans: probabilities float32 ``[S, A, N_1, N_2, N_c]``.
        log_obs: float32 ``[S, B, T, N_c]``; a missing step is a row of zeros.
        actions: int32 ``[S, B, T]``; the last of a trial is ignored.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.

    Returns:
        ``log_evidence[S, B]``, ``gamma[c][S, B, T, N_c]``, ``xi[c]`` as ``trans[c]``, ``initial[c]`` as
        ``init[c]``.

    Raises:
        ValueError: an argument of another shape or dtype.

    Source: thesis section 3.4; Brand (1997) for the factored form.
    """
    return _coupled("jaxpomdp_coupled", init, trans, log_obs, actions, start, valid)


def marginal_estep(
    init: tuple[Array, Array],
    trans: tuple[Array, Array],
    log_obs: tuple[Array, Array],
    actions: Array,
    start: Array,
    valid: Array,
) -> CoupledPosterior:
    """Smooth as ``coupled_estep`` but approximately: ``coupled_marginals.smooth_marginals`` for each tape.

    Source: Boyen and Koller (1998; 1999 for the backward sweep).
    """
    return _coupled("jaxpomdp_marginals", init, trans, log_obs, actions, start, valid)


def _coupled(
    kernel: str, init: Rows, trans: Rows, log_obs: Rows, actions: Array, start: Array, valid: Array
) -> CoupledPosterior:
    """Check the arguments of a kernel of two chains against one another, and call it."""
    if jnp.ndim(trans[0]) != 5 or jnp.ndim(actions) != 3:
        shapes = f"{list(jnp.shape(trans[0]))} and {list(jnp.shape(actions))}"
        raise ValueError(
            f"trans[0] must have shape [S, A, N_1, N_2, N_1] and actions [S, B, T], got {shapes}"
        )
    batch, (_, moves, *sizes) = jnp.shape(actions), jnp.shape(trans[0])[:4]
    for c, states in enumerate(sizes):
        _check(f"init[{c}]", init[c], (batch[0], states), jnp.float32)
        _check(f"trans[{c}]", trans[c], (batch[0], moves, *sizes, states), jnp.float32)
        _check(f"log_obs[{c}]", log_obs[c], (*batch, states), jnp.float32)
    _check("actions", actions, batch, jnp.int32)
    _check("start", start, batch, jnp.bool_)
    _check("valid", valid, batch, jnp.bool_)
    results = _float32(batch[:2], *(x.shape for x in (*log_obs, *trans, *init)))
    call = jax.ffi.ffi_call(kernel, results, vmap_method="broadcast_all")
    evidence, *rest = call(*init, *trans, *log_obs, actions, start, valid)
    return CoupledPosterior(evidence, tuple(rest[:2]), tuple(rest[2:4]), tuple(rest[4:]))


def memory_estep(
    model: MemoryChain, log_obs: Array, actions: Array, start: Array, valid: Array
) -> MemoryPosterior:
    """Smooth all rows of all models with a memory: ``memory.smooth_pairs`` for each, counts summed over rows.

    Time is ``O((K + 1) N^2)`` a step, where ``K`` states of a model are ever kept in memory.

    Args:
        model: probabilities float32, not logarithms, with leading ``S``; rows of ``note`` sum to one.
        log_obs: float32 ``[S, B, T, N]``; a missing step is a row of zeros.
        actions: int32 ``[S, B, T]``; the last of a trial is ignored.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.

    Returns:
        ``log_evidence[S, B]``, ``gamma`` and ``held`` ``[S, B, T, N]``; the rest are sums over the rows.

    Raises:
        ValueError: an argument of another shape or dtype.

    Source: thesis section 6.3.5.
    """
    init, trans, lead, heed, note = model
    _check_tapes(init, trans, log_obs, actions, start, valid)
    _check("lead", lead, trans.shape, jnp.float32)
    for name, choice in (("heed", heed), ("note", note)):
        _check(name, choice, (*init.shape, 2), jnp.float32)
    shapes = (actions.shape[:2], log_obs.shape, trans.shape, init.shape, log_obs.shape)
    results = _float32(*shapes, *(x.shape for x in model[1:]))
    call = jax.ffi.ffi_call("jaxpomdp_memory", results, vmap_method="broadcast_all")
    evidence, gamma, xi, initial, held, *counts = call(*model, log_obs, actions, start, valid)
    return MemoryPosterior(evidence, gamma, xi, initial, held, MemoryCounts(*counts))


def filter_tapes(
    init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array
) -> tuple[Array, Array]:
    """Filter all rows of all models: ``kernels.filtering.filter_tape`` for each.

    Where the evidence of a step underflows, the row is filtered again in logarithms, so that a state whose
    probability no float32 holds can come back.

    Args:
        init: probabilities float32 ``[S, N]``.
        trans: probabilities float32 ``[S, A, N, N]``.
        log_obs: float32 ``[S, B, T, N]``.
        actions: int32 ``[S, B, T]``.
        start: bool ``[S, B, T]``.
        valid: bool ``[S, B, T]``.

    Returns:
        ``belief[S, B, T, N]`` and ``log_norm[S, B, T]``, both zero at padding.

    Raises:
        ValueError: an argument of another shape or dtype.
    """
    _check_tapes(init, trans, log_obs, actions, start, valid)
    results = _float32(log_obs.shape, actions.shape)
    call = jax.ffi.ffi_call("jaxpomdp_filter", results, vmap_method="broadcast_all")
    belief, log_norm = call(init, trans, log_obs, actions, start, valid)
    return belief, log_norm


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
    _check("q", q, (models, states, jnp.shape(q)[2]), jnp.float32)
    _check("beliefs", beliefs, (models, rows, steps, states), jnp.float32)
    _check("actions", actions, (models, rows, steps), jnp.int32)
    _check("rewards", rewards, (models, rows, steps), jnp.float32)
    for name, flags in (("start", start), ("valid", valid), ("terminated", terminated)):
        _check(name, flags, (models, rows, steps), jnp.bool_)
    per_model = (jnp.broadcast_to(jnp.asarray(x, jnp.float32), (models,)) for x in (alpha, gamma, lam))
    settings = jnp.stack(tuple(per_model), axis=-1)
    call = jax.ffi.ffi_call("jaxpomdp_replay", *_float32(q.shape), vmap_method="broadcast_all")
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
        _check(name, array, shape, jnp.float32)
    _check("world.successors", world.successors, (actions, places, outcomes), jnp.int32)
    _check("world.terminal", world.terminal, (places,), jnp.bool_)
    whole, real, flag = (
        (jax.ShapeDtypeStruct((seeds, trials * limit), t)) for t in ("int32", "float32", "bool")
    )
    steps = jax.ShapeDtypeStruct((seeds,), jnp.int32)
    results = (*_float32(q.shape), steps, whole, whole, real, whole, flag, flag, flag, real)
    call = jax.ffi.ffi_call("jaxpomdp_act", results, vmap_method="sequential")
    flags = {"replacing": replacing, "greedy": rule == "q", "boltzmann": exploration == "boltzmann"}
    return Acted(*call(*model, q, draws, level, *world, settings, **flags))
