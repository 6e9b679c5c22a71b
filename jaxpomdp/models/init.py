"""Where a fit starts: at random, or with every state peaked on one observation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, TrialBatch
from jaxpomdp.models import estimates
from jaxpomdp.models.emission import Categorical, DiagonalGaussian, ReturnModel
from jaxpomdp.models.flat import FlatParams
from jaxpomdp.models.full_gaussian import FullGaussian
from jaxpomdp.numerics import NEG

LEAST_PROBABILITY = 1e-6
"""No entry starts below this: a zero would be structural, and stay."""


@dataclass(frozen=True)
class Real:
    """A channel of real vectors."""

    dimension: int
    """How many coordinates a vector has."""
    full: bool = False
    """Any covariance, instead of independent coordinates."""


def random_params(
    key: Array,
    states: int,
    actions: int,
    observations: int | Real | tuple[int | Real, ...],
    *,
    batch: TrialBatch | None = None,
    by_action: bool = False,
    concentration: float = 1.0,
    capacity: int | None = None,
) -> FlatParams:
    """Draw a flat model: every row of probabilities from a symmetric Dirichlet distribution.

    Args:
        key: a JAX random key; map over keys for many models.
        states: how many states.
        actions: how many actions.
        observations: what is seen: a number of symbols, or ``Real(dimension)``; a tuple for several channels.
        batch: if given, Gaussian means are drawn from its observations; widths and returns are the data's.
        by_action: model returns by state and action, not by state.
        concentration: the Dirichlet's parameter; large is nearly even.
        capacity: room for states to come; ``states`` if None. The draw does not depend on it.

    Returns:
        FlatParams: one model.

    Raises:
        ValueError: a size is below one.

    Example:
        >>> params = random_params(jax.random.key(0), states=3, actions=2, observations=4, capacity=8)
        >>> print(params.log_trans.shape, params.alive.sum())
        (2, 8, 8) 3
    """
    channels = _checked(states, actions, observations, concentration)
    keys = iter(jax.random.split(key, 3 + len(channels)))
    return _model(
        log_init=_random_rows(next(keys), concentration, (states,)),
        log_trans=_random_rows(next(keys), concentration, (actions, states, states)),
        returns=_random_returns(next(keys), states, actions if by_action else 1, batch),
        emissions=tuple(
            _random_channel(next(keys), states, channel, concentration, _seen(batch, i))
            for i, channel in enumerate(channels)
        ),
        capacity=capacity,
    )


def observation_seeded(
    key: Array,
    states: int,
    actions: int,
    observations: int | Real | tuple[int | Real, ...],
    *,
    batch: TrialBatch | None = None,
    by_action: bool = False,
    peak: float = 0.9,
    concentration: float = 10.0,
    capacity: int | None = None,
) -> FlatParams:
    """Start each state peaked on one observation; spare states, and transitions, are random.

    A state shows its symbol of the first channel with probability ``peak``; states beyond the symbols draw
    their rows. Symbols are taken in order, or by their frequency in ``batch``. If the first channel is real,
    each state starts on one of the batch's observations (without a batch: at random) with a narrow width.

    Args:
        key: a JAX random key.
        states: how many states.
        actions: how many actions.
        observations: as in ``random_params``; the first channel seeds the states.
        batch: data to take frequencies, means and widths from.
        by_action: model returns by state and action, not by state.
        peak: the probability of a state's own symbol; a real channel starts with ``1 - peak`` of the data's
            variance.
        concentration: of the Dirichlet distribution of transitions and spare rows.
        capacity: room for states to come; ``states`` if None.

    Returns:
        FlatParams: one model.

    Raises:
        ValueError: a size is below one, or ``peak`` is not in 0..1.
    """
    if not 0 < peak < 1:
        raise ValueError(f"peak must be between 0 and 1, got {peak}")
    channels = _checked(states, actions, observations, concentration)
    keys = iter(jax.random.split(key, 3 + len(channels)))
    log_init = _random_rows(next(keys), concentration, (states,))
    log_trans = _random_rows(next(keys), concentration, (actions, states, states))
    returns = _random_returns(next(keys), states, actions if by_action else 1, batch)
    first = _seeded_channel(next(keys), states, channels[0], concentration, peak, _seen(batch, 0))
    others = tuple(
        _random_channel(next(keys), states, channel, concentration, _seen(batch, i))
        for i, channel in enumerate(channels[1:], start=1)
    )
    return _model(log_init, log_trans, (first, *others), returns, capacity)


def _checked(states: int, actions: int, observations: Any, concentration: float) -> tuple[int | Real, ...]:
    channels = observations if isinstance(observations, tuple) else (observations,)
    sizes = [("states", states), ("actions", actions), ("concentration", math.ceil(concentration))]
    sizes += [("observations", c.dimension if isinstance(c, Real) else c) for c in channels]
    for name, size in sizes:
        if size < 1:
            raise ValueError(f"{name} must be positive, got {size}")
    if not channels:
        raise ValueError("observations must hold at least one channel, got none")
    return channels


def _random_rows(key: Array, concentration: float, shape: tuple[int, ...]) -> Array:
    """Return log rows ``[..., K]``, no entry of which is zero."""
    rows = jax.random.dirichlet(key, jnp.full(shape[-1], concentration, float), shape[:-1])
    rows = jnp.maximum(rows, LEAST_PROBABILITY)
    return jnp.log(rows / jnp.sum(rows, axis=-1, keepdims=True))


def _seen(batch: TrialBatch | None, channel: int) -> tuple[Array, Array] | None:
    """Return all steps of a channel as rows, and which of them are there."""
    if batch is None:
        return None
    mask = batch.observed & batch.valid
    x = batch.observations[channel]
    return x.reshape(-1, *x.shape[mask.ndim :]), mask.reshape(-1)


def _random_channel(key: Array, states: int, channel: int | Real, concentration: float, seen: Any) -> Any:
    if isinstance(channel, Real):
        return _gaussian(key, states, channel, seen, 1.0)
    return Categorical(_random_rows(key, concentration, (states, channel)))


def _seeded_channel(
    key: Array, states: int, channel: int | Real, concentration: float, peak: float, seen: Any
) -> Any:
    if isinstance(channel, Real):
        return _gaussian(key, states, channel, seen, 1 - peak)
    spare = _random_rows(key, concentration, (states, channel))
    own = jnp.arange(channel) if seen is None else _by_frequency(*seen, channel)
    seeds = min(states, channel)
    rest = (1 - peak) / max(channel - 1, 1)
    peaked = jnp.where(own[:seeds, None] == jnp.arange(channel)[None, :], peak, rest)
    rows = jnp.log(peaked / jnp.sum(peaked, axis=-1, keepdims=True))
    return Categorical(jnp.concatenate([rows.astype(spare.dtype), spare[seeds:]]))


def _by_frequency(x: Array, mask: Array, symbols: int) -> Array:
    counts = jax.ops.segment_sum(mask.astype(jnp.int32), x, symbols)
    return jnp.argsort(-counts, stable=True)


def _gaussian(key: Array, states: int, channel: Real, seen: Any, width: float) -> Any:
    """Put the means on observations drawn without replacement; the variance is a share of the data's."""
    shape = (states, channel.dimension)
    if seen is None:
        mean, var = jax.random.normal(key, shape), jnp.full(shape, width, float)
    else:
        x, mask = seen
        chance = jnp.where(mask, jax.random.uniform(key, mask.shape), -1)
        picked = jnp.argsort(-chance)[jnp.arange(states) % jnp.maximum(jnp.sum(mask), 1)]
        pooled = estimates.pooled_variance(estimates.pooled_moments(x, mask))
        mean, var = x[picked], jnp.broadcast_to(width * pooled, shape)
    if not channel.full:
        return DiagonalGaussian(mean, var)
    return FullGaussian(mean, jnp.eye(channel.dimension, dtype=var.dtype)[None] * var[:, None, :])


def _random_returns(key: Array, states: int, columns: int, batch: TrialBatch | None) -> ReturnModel:
    """Put every state's return near the data's mean, with the data's variance (zero and one without data)."""
    mean, var = jnp.zeros((1, 1)), jnp.ones((1, 1))
    if batch is not None:
        pooled = estimates.pooled_moments(batch.returns[..., None], batch.has_return & batch.valid)
        mean, var = pooled.mean, estimates.pooled_variance(pooled)
    noise = 0.1 * jax.random.normal(key, (states, columns), mean.dtype)
    return ReturnModel(mean + jnp.sqrt(var) * noise, jnp.broadcast_to(var, noise.shape))


def _model(
    log_init: Array, log_trans: Array, emissions: tuple[Any, ...], returns: ReturnModel, capacity: int | None
) -> FlatParams:
    alive = jnp.ones(log_init.shape[0], bool)
    params = FlatParams(log_init, log_trans, emissions, returns, alive)
    return params if capacity is None else with_capacity(params, capacity)


def with_capacity(params: FlatParams, capacity: int) -> FlatParams:
    """Give one model room for ``capacity`` states; the new ones are absent.

    Raises:
        ValueError: there are more states than that already.
    """
    spare = capacity - params.alive.shape[0]
    if spare < 0:
        states = params.alive.shape[0]
        raise ValueError(f"capacity must be at least {states}, the states there are, got {capacity}")
    return FlatParams(
        estimates.pad_states(params.log_init, spare, NEG),
        estimates.pad_states(params.log_trans, spare, NEG, (1, 2)),
        tuple(channel.padded(spare) for channel in params.emissions),
        params.returns.padded(spare),
        estimates.pad_states(params.alive, spare, False),
    )
