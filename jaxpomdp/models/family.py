"""The contract between a model and inference: ``Family``, a tuple of functions, one per kind of model.

Every function is written for ONE model; batches of trials are leading axes of the data, and batches of
models (``S``) are a ``vmap`` at the call site (``models/em.py``). Inference sees only what ``acting`` or
``learning`` give, and ``posterior`` turns that into what ``statistics`` takes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from jaxpomdp._types import Array, Chain
from jaxpomdp.kernels.posterior import posterior

PARTS = ("init", "transitions", "emissions", "returns")
"""The names that ``Prior.freeze`` takes."""


@dataclass(frozen=True)
class Prior:
    """What is believed of the parameters before any data; EM maximises evidence plus its log density (MAP).

    A pseudo-count ``c`` is absolute and per entry: the mode of a row is ``(count + c) / sum(count + c)``, a
    Dirichlet prior with parameters ``1 + c``. It reaches only entries that are possible at all: entries of
    probability zero (structural zeros) and absent states stay at zero.

    Raises:
        ValueError: a strength is negative, or ``freeze`` holds an unknown name.
    """

    transition: float = 0.01
    """Pseudo-count of every possible entry of every transition row."""
    initial: float = 0.01
    """Pseudo-count of every possible first state."""
    observation: float = 0.001
    """Pseudo-count of every possible observation in every state."""
    variance_floor: float = 0.001
    """Least variance of a state, in units of the variance of all the data (never less than 1e-9)."""
    variance_strength: float = 0.0
    """Pseudo-observations that say a state varies as much as all the data (an inverse gamma prior)."""
    freeze: tuple[str, ...] = ()
    """Parts that learning leaves alone, among init, transitions, emissions and returns."""

    def __post_init__(self) -> None:
        """Refuse strengths and names that mean nothing."""
        for name in ("transition", "initial", "observation", "variance_floor", "variance_strength"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        unknown = sorted(set(self.freeze) - set(PARTS))
        if unknown:
            raise ValueError(f"freeze must hold names among {PARTS}, got {unknown}")


class Family(NamedTuple):
    """The functions that make a parameter pytree a model. All are pure, and all are for one model.

    The pytree has a leaf ``alive``: bool ``[N]``, the state exists.

    Attributes:
        name: what the family is called in stored files.
        acting: ``params -> Chain``; what an agent uses while it acts, without returns.
        log_obs: ``(params, observations, observed[...]) -> [..., N]``; log density of each step's
            observations in each state. A missing step is a row of zeros; an absent state is ``NEG``.
        learning: ``(params, batch, theta) -> (Chain, log_obs[..., N])``; as above with ``theta`` times the
            log density of the return added wherever the batch has one.
        feasible: ``(params, batch, prior, carry) -> params``; the nearest parameters that respect the limits
            which the data set (variance floors). ``carry`` is None or statistics that count as data.
        statistics: ``(params, batch, posterior) -> statistics``; expected sufficient statistics of the batch.
            ``add_statistics`` adds them up.
        m_step: ``(params, statistics, prior) -> params``; the parameters that maximise ``expected`` plus
            ``log_prior``. A part that no data reached keeps its old value.
        log_prior: ``(params, statistics, prior, theta) -> []``; log density of the prior, up to a constant.
        expected: ``(params, statistics, theta) -> []``; expected complete-data log-likelihood of statistics;
            it makes carried statistics a prior.
        to_free: ``params -> pytree`` of unconstrained arrays (logits, log variances), for gradients.
        from_free: ``(params, free, prior) -> params``; the way back. Structural zeros and frozen parts are
            those of ``params``.
        count_free: ``(params, prior, theta) -> []``; how many numbers the data decide (for BIC).
        check: ``(params, batch) -> None``; raises a ``ValueError`` that names what does not fit. Host side,
            leading axes allowed.
        posterior: ``(chains, log_obs, actions, start, valid, plan) -> Posterior``; inference itself, for
            ``S`` models at once. The default serves every family that is a chain of ``N`` states.
    """

    name: str
    acting: Callable[[Any], Chain]
    log_obs: Callable[[Any, tuple[Array, ...], Array], Array]
    learning: Callable[..., tuple[Any, Any]]
    feasible: Callable[..., Any]
    statistics: Callable[..., Any]
    m_step: Callable[..., Any]
    log_prior: Callable[..., Array]
    expected: Callable[..., Array]
    to_free: Callable[[Any], Any]
    from_free: Callable[..., Any]
    count_free: Callable[..., Array]
    check: Callable[..., None]
    posterior: Callable[..., Any] = posterior
