"""Where a fit starts: at random, or with every state peaked on one observation.

Draws are made on the host: they are few, and JAX's samplers take seconds to compile for each new shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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
    key: Array | int,
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
        key: a JAX random key, or an integer; one key, one model (see ``stack_models``).
        states: how many states.
        actions: how many actions.
        observations: what is seen: a number of symbols, or ``Real(dimension)``; a tuple for several channels.
        batch: if given, Gaussian means are drawn from its observations; widths and returns are the data's.
        by_action: model returns by state and action, not by state.
        concentration: the Dirichlet's parameter; 1 is uniform over all rows, large is nearly even.
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
    rng = _generator(key)
    return _model(
        log_init=_random_rows(rng, concentration, (states,)),
        log_trans=_random_rows(rng, concentration, (actions, states, states)),
        returns=_random_returns(rng, states, actions if by_action else 1, batch),
        emissions=tuple(
            _random_channel(rng, states, channel, concentration, _seen(batch, i))
            for i, channel in enumerate(channels)
        ),
        capacity=capacity,
    )


def observation_seeded(
    key: Array | int,
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
        key: a JAX random key, or an integer.
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
    rng = _generator(key)
    log_init = _random_rows(rng, concentration, (states,))
    log_trans = _random_rows(rng, concentration, (actions, states, states))
    returns = _random_returns(rng, states, actions if by_action else 1, batch)
    first = _seeded_channel(rng, states, channels[0], concentration, peak, _seen(batch, 0))
    others = tuple(
        _random_channel(rng, states, channel, concentration, _seen(batch, i))
        for i, channel in enumerate(channels[1:], start=1)
    )
    return _model(log_init, log_trans, (first, *others), returns, capacity)


def _generator(key: Array | int) -> np.random.Generator:
    if isinstance(key, (int, np.integer)):
        return np.random.default_rng(int(key))
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    words = np.asarray(jax.random.key_data(key) if typed else key)
    if words.ndim != 1:
        raise ValueError(f"key must be one key (one call per model), got keys of shape {words.shape[:-1]}")
    return np.random.default_rng(words)


def _checked(states: int, actions: int, observations: Any, concentration: float) -> tuple[int | Real, ...]:
    channels = observations if isinstance(observations, tuple) else (observations,)
    sizes = [("states", states), ("actions", actions)]
    sizes += [("observations", c.dimension if isinstance(c, Real) else c) for c in channels]
    for name, size in sizes:
        if size < 1:
            raise ValueError(f"{name} must be positive, got {size}")
    if not concentration > 0:
        raise ValueError(f"concentration must be positive, got {concentration}")
    if not channels:
        raise ValueError("observations must hold at least one channel, got none")
    return channels


def _random_rows(rng: np.random.Generator, concentration: float, shape: tuple[int, ...]) -> np.ndarray:
    """Return log rows ``[..., K]``, no entry of which is zero."""
    rows = np.maximum(rng.dirichlet(np.full(shape[-1], concentration), shape[:-1]), LEAST_PROBABILITY)
    return np.log(rows / rows.sum(axis=-1, keepdims=True))


def _seen(batch: TrialBatch | None, channel: int) -> np.ndarray | None:
    """Return all observations of a channel that are there, one a row."""
    if batch is None:
        return None
    return np.asarray(batch.observations[channel])[np.asarray(batch.observed & batch.valid)]


def _width(x: np.ndarray) -> np.ndarray:
    """Return the variance of rows, as EM counts it: never zero."""
    return np.maximum(x.var(axis=0), 1e-6 * x.mean(axis=0) ** 2 + 1e-12)


def _random_channel(
    rng: np.random.Generator, states: int, channel: int | Real, concentration: float, seen: np.ndarray | None
) -> Any:
    if isinstance(channel, Real):
        return _gaussian(rng, states, channel, seen, 1.0)
    return Categorical(jnp.asarray(_random_rows(rng, concentration, (states, channel))))


def _seeded_channel(
    rng: np.random.Generator,
    states: int,
    channel: int | Real,
    concentration: float,
    peak: float,
    seen: np.ndarray | None,
) -> Any:
    if isinstance(channel, Real):
        return _gaussian(rng, states, channel, seen, 1 - peak)
    rows = np.exp(_random_rows(rng, concentration, (states, channel)))
    counts = np.zeros(channel) if seen is None else np.bincount(seen, minlength=channel)
    own = np.argsort(-counts, kind="stable")[:states]
    rows[: len(own)] = (1 - peak) / max(channel - 1, 1)
    rows[np.arange(len(own)), own] = peak
    return Categorical(jnp.asarray(np.log(rows / rows.sum(axis=-1, keepdims=True))))


def _gaussian(
    rng: np.random.Generator, states: int, channel: Real, seen: np.ndarray | None, share: float
) -> Any:
    """Put the means on observations drawn without replacement; the variance is a share of the data's."""
    shape = (states, channel.dimension)
    if seen is None or len(seen) == 0:
        mean, var = rng.normal(size=shape), np.full(shape, share)
    else:
        mean = seen[rng.permutation(len(seen))[np.arange(states) % len(seen)]]
        var = np.broadcast_to(share * _width(seen), shape)
    if not channel.full:
        return DiagonalGaussian(jnp.asarray(mean), jnp.asarray(var))
    return FullGaussian(jnp.asarray(mean), jnp.asarray(np.eye(channel.dimension) * var[:, None, :]))


def _random_returns(
    rng: np.random.Generator, states: int, columns: int, batch: TrialBatch | None
) -> ReturnModel:
    """Put every state's return near the data's mean, with the data's variance (zero and one without data)."""
    mean, var = 0.0, 1.0
    if batch is not None and bool((batch.has_return & batch.valid).any()):
        modelled = np.asarray(batch.returns)[np.asarray(batch.has_return & batch.valid)]
        mean, var = modelled.mean(), float(_width(modelled))
    noise = 0.1 * np.sqrt(var) * rng.normal(size=(states, columns))
    return ReturnModel(jnp.asarray(mean + noise), jnp.asarray(np.full((states, columns), var)))


def _model(
    log_init: np.ndarray,
    log_trans: np.ndarray,
    emissions: tuple[Any, ...],
    returns: ReturnModel,
    capacity: int | None,
) -> FlatParams:
    alive = jnp.asarray(np.ones(len(log_init), bool))
    params = FlatParams(jnp.asarray(log_init), jnp.asarray(log_trans), emissions, returns, alive)
    return params if capacity is None else with_capacity(params, capacity)


def stack_models(models: Sequence[Any]) -> Any:
    """Put models of equal shapes side by side: every leaf gets a leading axis ``S``.

    Raises:
        ValueError: there is none, or their shapes differ.
    """
    if not models:
        raise ValueError("models must hold at least one, got none")
    shapes = [jax.tree.map(jnp.shape, model) for model in models]
    if any(shape != shapes[0] for shape in shapes):
        raise ValueError("models must have equal shapes (see with_capacity), got different ones")
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *models)


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
