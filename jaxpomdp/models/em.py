"""Baum-Welch (EM) for any family: batches of tapes, batches of models, maximum a posteriori.

The objective is ``sum_b log p(tape_b | params) + log prior(params)``, with emissions
``p(o | s) N(R; mu(s), var(s))^theta`` (thesis section 3.3). The tempered density need not integrate to one:
EM needs just Jensen's inequality and an M-step that maximises, so the objective never falls.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Posterior, TrialBatch
from jaxpomdp.models.estimates import add_statistics
from jaxpomdp.models.family import Family, Prior
from jaxpomdp.numerics import NEG


@dataclass(frozen=True)
class EMConfig:
    """How EM runs.

    Raises:
        ValueError: a number is out of its range.
    """

    iterations: int = 100
    """At most this many re-estimations."""
    tolerance: float = 1e-5
    """Stop when the objective gains less than this, in nats per step of data."""
    theta: float = 0.0
    """Exponent of the return's density in learning; 0 ignores returns (but still estimates their model)."""
    prior: Prior = field(default_factory=Prior)
    """What is believed of the parameters before any data."""
    plan: str = "auto"
    """How posteriors are computed (``kernels.posterior``)."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range."""
        if self.iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {self.iterations}")
        for name in ("tolerance", "theta"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")


class StepInfo(NamedTuple):
    """What one EM step saw of the parameters it was given.

    ``objective[S]`` (evidence plus log prior), ``log_evidence[S, B]``, and the expected
    ``statistics`` (leading ``S``).
    """

    objective: Array
    log_evidence: Array
    statistics: Any


class EMReport(NamedTuple):
    """How a fit went; a fit of one model has no axis ``S``.

    Attributes:
        trace: ``[S, iterations + 1]``, the objective before each re-estimation and at the end; after a model
            has converged its last value is repeated.
        converged: bool ``[S]``, the gain fell below the tolerance before the iterations ran out.
        fell: bool ``[S]``, the objective fell at some step by more than rounding explains. EM cannot do that.
        iterations: int ``[S]``, re-estimations done.
        drop: ``[S]``, the largest fall of the objective from one step to the next, in nats (0 if none).
    """

    trace: Array
    converged: Array
    fell: Array
    iterations: Array
    drop: Array


@partial(jax.jit, static_argnames=("family", "config"))
def e_step(family: Family, params: Any, batch: TrialBatch, config: EMConfig) -> Posterior:
    """Return the posterior of every tape under every model, returns included as ``config.theta`` says.

    Args:
        family: the kind of model.
        params: parameters with leading axis ``S``.
        batch: tapes ``[S, B, T]``.
        config: theta and the plan.

    Returns:
        Posterior: ``log_evidence[S, B]``, ``gamma[S, B, T, N]``, ``xi[S, A, N, N]`` and ``initial[S, N]``.
    """
    chains, log_obs = jax.vmap(partial(family.learning, theta=config.theta))(params, batch)
    return family.posterior(chains, log_obs, batch.actions, batch.start, batch.valid, plan=config.plan)


@partial(jax.jit, static_argnames=("family", "config"))
def em_step(
    family: Family, params: Any, batch: TrialBatch, config: EMConfig, carry: Any = None
) -> tuple[Any, StepInfo]:
    """Re-estimate once: expected statistics of the batch, then the parameters that maximise them.

    Args:
        family: the kind of model.
        params: parameters with leading axis ``S``.
        batch: tapes ``[S, B, T]``.
        config: theta, the prior and the plan.
        carry: statistics (leading ``S``) that count besides the batch's own: decayed ones of earlier batches,
            or those of an old model as its prior. Their expected log-likelihood is part of the objective.

    Returns:
        The new parameters, and what was seen under the old ones (``StepInfo``).
    """
    lift = partial(family.feasible, prior=config.prior)
    params = jax.vmap(lambda model, tapes, extra: lift(model, tapes, carry=extra))(params, batch, carry)
    smoothed = e_step(family, params, batch, config)

    def one(model: Any, tapes: TrialBatch, seen: Posterior, extra: Any) -> tuple[Any, StepInfo]:
        statistics = family.statistics(model, tapes, seen)
        total = statistics if extra is None else add_statistics(extra, statistics)
        objective = jnp.sum(seen.log_evidence) + family.log_prior(model, total, config.prior, config.theta)
        if extra is not None:
            objective = objective + family.expected(model, extra, config.theta)
        return family.m_step(model, total, config.prior), StepInfo(objective, seen.log_evidence, statistics)

    return jax.vmap(one)(params, batch, smoothed, carry)


class _Fit(NamedTuple):
    """The loop's state: ``moving[S]`` models have not converged; ``done`` counts the turns."""

    params: Any
    trace: Array
    moving: Array
    converged: Array
    iterations: Array
    done: Array


def _started(params: Any, batch: TrialBatch, config: EMConfig) -> _Fit:
    models = batch.valid.shape[0]
    dtype = jnp.result_type(*(x for x in jax.tree.leaves(params) if jnp.issubdtype(x.dtype, jnp.floating)))
    none, all_of = jnp.zeros(models, bool), jnp.ones(models, bool)
    trace = jnp.full((config.iterations + 1, models), NEG, dtype)
    return _Fit(params, trace, all_of, none, jnp.zeros(models, jnp.int32), jnp.zeros((), jnp.int32))


def _turn(family: Family, batch: TrialBatch, config: EMConfig, carry: Any, fit: _Fit) -> _Fit:
    """Look at all models and re-estimate those that still move, unless the iterations are used up."""
    new, info = em_step(family, fit.params, batch, config, carry)
    last = fit.trace[jnp.maximum(fit.done - 1, 0)]
    objective = jnp.where(fit.moving, info.objective, last)
    steps = jnp.sum(batch.valid, axis=(1, 2)).astype(objective.dtype)
    settled = (fit.done > 0) & (objective - last < config.tolerance * steps) & (objective > NEG / 2)
    moving = fit.moving & ~settled
    go = moving & (fit.done < config.iterations)

    def take(x: Array, y: Array) -> Array:
        return jnp.where(go.reshape(-1, *(1,) * (x.ndim - 1)), y, x)

    return _Fit(
        jax.tree.map(take, fit.params, new),
        fit.trace.at[fit.done].set(objective),
        moving,
        fit.converged | (fit.moving & settled),
        fit.iterations + go,
        fit.done + 1,
    )


def _report(fit: _Fit) -> EMReport:
    row = jnp.minimum(jnp.arange(fit.trace.shape[0]), fit.done - 1)
    trace = fit.trace[row].T
    change = trace[:, 1:] - trace[:, :-1]
    # Rounding: a sum over many steps, each exact to a few units in the last place of the whole.
    rounding = 64 * jnp.finfo(trace.dtype).eps * (jnp.abs(trace[:, 1:]) + 1)
    fell = jnp.any(change < -rounding, axis=1)
    return EMReport(trace, fit.converged, fell, fit.iterations, jnp.max(jnp.maximum(-change, 0), axis=1))


@partial(jax.jit, static_argnames=("family", "config"))
def em_fit(
    family: Family, params: Any, batch: TrialBatch, config: EMConfig, carry: Any = None
) -> tuple[Any, EMReport]:
    """Re-estimate until every model has converged or the iterations are used up: one loop on the device.

    A model that has converged stays as it is, so a batch of models gives what each alone would give.
    Arguments as ``em_step``; nothing is checked here (``fit`` does).
    """
    lift = partial(family.feasible, prior=config.prior)
    params = jax.vmap(lambda model, tapes, extra: lift(model, tapes, carry=extra))(params, batch, carry)
    end = jax.lax.while_loop(
        lambda fit: jnp.any(fit.moving) & (fit.done <= config.iterations),
        partial(_turn, family, batch, config, carry),
        _started(params, batch, config),
    )
    return end.params, _report(end)


def as_models(params: Any, batch: TrialBatch) -> tuple[Any, TrialBatch, bool]:
    """Give parameters a leading ``S`` and a batch the axes ``[S, B, T]``; say whether there was one model.

    Raises:
        ValueError: the batch has other axes than ``[T]``, ``[B, T]`` or ``[S, B, T]``.
    """
    single = params.alive.ndim == 1
    if single:
        params = jax.tree.map(lambda x: x[None], params)
    models, axes = params.alive.shape[0], batch.valid.ndim
    if axes not in (1, 2, 3) or (axes == 3 and batch.valid.shape[0] != models):
        shape = tuple(batch.valid.shape)
        raise ValueError(f"batch must have axes [T], [B, T] or [{models}, B, T], got {shape}")

    def spread(x: Array) -> Array:
        x = jnp.asarray(x)
        missing = (None,) * (2 - axes) if axes < 3 else ()
        return x if axes == 3 else jnp.broadcast_to(x[missing], (models, *x[missing].shape))

    return params, jax.tree.map(spread, batch), single


def fit(
    family: Family, params: Any, batch: TrialBatch, config: EMConfig | None = None, carry: Any = None
) -> tuple[Any, EMReport]:
    """Fit one model, or many at once, to a batch of trials by EM.

    Args:
        family: the kind of model, as ``FLAT``.
        params: where to start; with a leading axis ``S`` these are ``S`` models, fitted side by side.
        batch: trials ``[T]``, ``[B, T]``, or ``[S, B, T]`` when each model has its own (see ``trial_batch``).
        config: iterations, tolerance, theta, prior; ``EMConfig()`` if None.
        carry: statistics that count besides the batch's own, as in ``em_step``; leading axis as ``params``.

    Returns:
        The parameters, and an ``EMReport``.

    Raises:
        ValueError: something does not fit; the message names the argument, what was expected and what came.
    """
    config = EMConfig() if config is None else config
    params, batch, single = as_models(params, batch)
    family.check(params, batch)
    if single and carry is not None:
        carry = jax.tree.map(lambda x: x[None], carry)
    fitted = em_fit(family, params, batch, config, carry)
    return jax.tree.map(lambda x: x[0], fitted) if single else fitted
