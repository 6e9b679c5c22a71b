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

from jaxpomdp._types import Array, Posterior, TrialBatch
from jaxpomdp.kernels.posterior import posterior
from jaxpomdp.models.estimates import add_statistics
from jaxpomdp.models.family import Family, Prior


@dataclass(frozen=True)
class EMConfig:
    """How EM runs.

    Raises:
        ValueError: a number is out of its range.
    """

    iterations: int = 100
    """At most this many re-estimations."""
    tolerance: float = 1e-6
    """Stop when the objective gains less than this, per step of data."""
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
    return posterior(chains, log_obs, batch.actions, batch.start, batch.valid, plan=config.plan)


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
    smoothed = e_step(family, params, batch, config)

    def one(model: Any, tapes: TrialBatch, seen: Posterior, extra: Any) -> tuple[Any, StepInfo]:
        statistics = family.statistics(model, tapes, seen)
        total = statistics if extra is None else add_statistics(extra, statistics)
        objective = seen.log_evidence.sum() + family.log_prior(model, total, config.prior, config.theta)
        if extra is not None:
            objective = objective + family.expected(model, extra, config.theta)
        return family.m_step(model, total, config.prior), StepInfo(objective, seen.log_evidence, statistics)

    return jax.vmap(one)(params, batch, smoothed, carry)
