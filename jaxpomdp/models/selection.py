"""Which model to take: evidence, held-out score, BIC, and restarts."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, TrialBatch
from jaxpomdp.models.em import EMConfig, EMReport, as_models, e_step, em_fit
from jaxpomdp.models.family import Family
from jaxpomdp.models.init import stack_models


def log_evidence(
    family: Family, params: Any, batch: TrialBatch, *, theta: float = 0.0, plan: str = "auto"
) -> Array:
    """Return ``log p(tape | params)`` of every tape, ``[S, B]`` (``[B]`` for one model).

    Args:
        family: the kind of model.
        params: one model, or many with a leading axis ``S``.
        batch: trials ``[T]``, ``[B, T]`` or ``[S, B, T]``.
        theta: exponent of the return's density; 0 scores the observations alone.
        plan: how posteriors are computed.

    Raises:
        ValueError: parameters and batch do not fit.
    """
    params, batch, single = as_models(params, batch)
    family.check(params, batch)
    evidence = e_step(family, params, batch, EMConfig(theta=theta, plan=plan)).log_evidence
    return evidence[0] if single else evidence


def _observed_steps(batch: TrialBatch) -> Array:
    """Return the number of observations of each model's batch ``[S]``."""
    return jnp.sum(batch.observed & batch.valid, axis=(-2, -1))


def held_out(family: Family, params: Any, batch: TrialBatch, *, theta: float = 0.0) -> Array:
    """Return log-evidence in nats per observation on trials that the fit has not seen, ``[S]`` or a scalar.

    Arguments as ``log_evidence``.
    """
    evidence = jnp.sum(log_evidence(family, params, batch, theta=theta), axis=-1)
    _, spread, single = as_models(params, batch)
    steps = _observed_steps(spread)
    return evidence / jnp.maximum(steps[0] if single else steps, 1)


def free_parameters(family: Family, params: Any, config: EMConfig | None = None) -> Array:
    """Return how many numbers a fit of this model decides, ``[S]`` or a scalar.

    Structural zeros, absent states, sums to one and frozen parts do not count; returns do if ``theta > 0``.
    """
    config = EMConfig() if config is None else config
    count = partial(family.count_free, prior=config.prior, theta=config.theta)
    return count(params) if params.alive.ndim == 1 else jax.vmap(count)(params)


def bic(family: Family, params: Any, batch: TrialBatch, config: EMConfig | None = None) -> Array:
    """Return the Bayesian information criterion, ``-2 log p(batch) + k log n``: lower is better.

    ``k`` counts the free parameters, ``n`` the observations. ``config`` says theta and what was frozen.
    Source: Schwarz (1978).
    """
    config = EMConfig() if config is None else config
    evidence = jnp.sum(log_evidence(family, params, batch, theta=config.theta, plan=config.plan), axis=-1)
    _, spread, single = as_models(params, batch)
    steps = _observed_steps(spread)
    number = jnp.maximum(steps[0] if single else steps, 1)
    return -2 * evidence + free_parameters(family, params, config) * jnp.log(number.astype(evidence.dtype))


def fit_restarts(
    family: Family,
    initialise: Callable[[Array], Any],
    batch: TrialBatch,
    config: EMConfig | None = None,
    *,
    key: Array,
    restarts: int = 10,
) -> tuple[Any, EMReport]:
    """Fit one model from several starts side by side and keep the one of highest objective.

    Args:
        family: the kind of model.
        initialise: ``key -> params``, as ``lambda key: random_params(key, 5, 2, 4)``.
        batch: trials ``[T]`` or ``[B, T]``.
        config: as in ``fit``.
        key: a JAX random key; restart ``i`` uses ``fold_in(key, i)``, so more restarts keep the earlier ones.
        restarts: how many.

    Returns:
        The best parameters, and the report of all restarts (leading axis ``restarts``); the best is
        ``argmax(report.trace[:, -1])``.

    Raises:
        ValueError: ``restarts`` is below one, or the start does not fit the batch.
    """
    if restarts < 1:
        raise ValueError(f"restarts must be at least 1, got {restarts}")
    config = EMConfig() if config is None else config
    starts = [initialise(jax.random.fold_in(key, i)) for i in range(restarts)]
    params, batch, _ = as_models(stack_models(starts), batch)
    family.check(params, batch)
    fitted, report = em_fit(family, params, batch, config)
    best = jnp.argmax(report.trace[:, -1])
    return jax.tree.map(lambda x: x[best], fitted), report
