"""Gradient ascent on what EM maximises: a second way, by automatic differentiation of the forward pass."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Posterior, TrialBatch
from jaxpomdp.kernels.filtering import filter_tape
from jaxpomdp.models.em import as_models
from jaxpomdp.models.family import Family, Prior


@dataclass(frozen=True)
class GradientConfig:
    """How gradient fitting runs.

    Raises:
        ValueError: a number is out of its range.
    """

    iterations: int = 500
    """Gradient steps."""
    learning_rate: float = 0.05
    """Adam's step at the start; it falls to zero along a cosine."""
    theta: float = 0.0
    """Exponent of the return's density, as in EM."""
    prior: Prior = field(default_factory=Prior)
    """As in EM: the same objective."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        if self.iterations < 1 or not self.learning_rate > 0 or not self.theta >= 0:
            raise ValueError(f"iterations, learning_rate and theta must be positive, got {self}")


class _Ascent(NamedTuple):
    free: Any
    state: Any
    best: Any
    highest: Array


def objective(
    family: Family, params: Any, batch: TrialBatch, statistics: Any, theta: float, prior: Prior
) -> Array:
    """Return one model's evidence of ``[B, T]`` plus its log prior, by the forward pass alone.

    Differentiable. ``statistics`` of the same batch give the prior the data's variances.
    """
    chain, log_obs = family.learning(params, batch, theta)
    forward = jax.vmap(partial(filter_tape, chain))
    evidence = jnp.sum(forward(log_obs, batch.actions, batch.start, batch.valid).log_norm)
    return evidence + family.log_prior(params, statistics, prior, theta)


def _adam(config: GradientConfig) -> Any:
    import optax

    return optax.adam(optax.cosine_decay_schedule(config.learning_rate, config.iterations))


def _ascend_one(
    family: Family, config: GradientConfig, optimiser: Any, params: Any, batch: TrialBatch, statistics: Any
) -> tuple[Any, Array]:
    optimiser = _adam(config) if optimiser is None else optimiser

    def loss(free: Any) -> Array:
        model = family.from_free(params, free, config.prior)
        return -objective(family, model, batch, statistics, config.theta, config.prior)

    def project(free: Any) -> Any:
        model = family.from_free(params, free, config.prior)
        return family.to_free(family.feasible(model, batch, config.prior, None))

    def step(now: _Ascent, _: None) -> tuple[_Ascent, Array]:
        value, gradient = jax.value_and_grad(loss)(now.free)
        better = -value > now.highest
        best = jax.tree.map(partial(jnp.where, better), now.free, now.best)
        updates, state = optimiser.update(gradient, now.state, now.free)
        free = project(jax.tree.map(jnp.add, now.free, updates))
        return _Ascent(free, state, best, jnp.maximum(-value, now.highest)), -value

    free = project(family.to_free(params))
    begin = _Ascent(free, optimiser.init(free), free, jnp.full((), -jnp.inf, jax.tree.leaves(free)[0].dtype))
    end, trace = jax.lax.scan(step, begin, None, config.iterations)
    return family.from_free(params, end.best, config.prior), trace


def _no_posterior(family: Family, params: Any, batch: TrialBatch) -> Posterior:
    """Return a posterior without weight: its statistics say what the data are like, nothing of states."""
    chain = family.acting(params)
    gamma = jnp.zeros((*batch.valid.shape, chain.log_init.shape[-1]), chain.log_init.dtype)
    nothing = jax.tree.map(jnp.zeros_like, chain)
    return Posterior(gamma[..., 0, 0], gamma, nothing.log_trans, nothing.log_init)


@partial(jax.jit, static_argnames=("family", "config", "optimiser"))
def _ascend(
    family: Family, params: Any, batch: TrialBatch, config: GradientConfig, optimiser: Any
) -> tuple[Any, Array]:
    def one(model: Any, tapes: TrialBatch) -> tuple[Any, Array]:
        statistics = family.statistics(model, tapes, _no_posterior(family, model, tapes))
        return _ascend_one(family, config, optimiser, model, tapes, statistics)

    return jax.vmap(one)(params, batch)


def fit_gradient(
    family: Family,
    params: Any,
    batch: TrialBatch,
    config: GradientConfig | None = None,
    optimiser: Any = None,
) -> tuple[Any, Array]:
    """Maximise evidence plus log prior by gradient steps on unconstrained parameters (logits, log variances).

    Needs optax. For families whose inference is a chain of states.

    Args:
        family: the kind of model.
        params: where to start; one model, or many with a leading axis ``S``.
        batch: trials ``[T]``, ``[B, T]`` or ``[S, B, T]``.
        config: steps, learning rate, theta, prior.
        optimiser: an optax ``GradientTransformation`` to use instead of Adam with a cosine schedule.

    Returns:
        The best parameters met, and the objective before each step ``[S, iterations]`` (one model: no ``S``).

    Raises:
        ValueError: something does not fit; the message names the argument.
        ImportError: optax is not installed.
    """
    config = GradientConfig() if config is None else config
    params, batch, single = as_models(params, batch)
    family.check(params, batch)
    fitted = _ascend(family, params, batch, config, optimiser)
    return jax.tree.map(lambda x: x[0], fitted) if single else fitted
