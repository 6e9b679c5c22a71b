"""The contract between a model and inference: ``Family``, a tuple of functions, one per kind of model.

Every function is written for ONE model; batches of trials are leading axes of the data, and batches of models
(``S``) are a ``vmap`` at the call site (``models/em.py``). Inference sees only a ``Chain`` and ``log_obs``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from jaxpomdp._types import Array, Chain

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
    """Least variance of a state, in units of the variance of all the data."""
    variance_strength: float = 0.0
    """Pseudo-observations that say a state varies as much as all the data (an inverse gamma prior)."""
    freeze: tuple[str, ...] = ()
    """Parts that EM leaves alone, among init, transitions, emissions and returns."""

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

    Attributes:
        name: what the family is called in stored files.
        acting: ``params -> Chain``; what an agent uses while it acts, without returns.
        log_obs: ``(params, observations, observed[...]) -> [..., N]``; log density of each step's
            observations in each state. A missing step is a row of zeros; an absent state is ``NEG``.
        learning: ``(params, batch, theta) -> (Chain, log_obs[..., N])``; as above with ``theta`` times the
            log density of the return added wherever the batch has one.
        constrain: ``(params, batch, prior) -> params``; the nearest parameters that respect the limits which
            the data set (variance floors). EM starts there, and is monotone from there on.
        statistics: ``(params, batch, posterior) -> statistics``; expected sufficient statistics of the batch.
            ``add_statistics`` adds them up.
        m_step: ``(params, statistics, prior) -> params``; the parameters that maximise ``expected`` plus
            ``log_prior``. A part that no data reached keeps its old value.
        log_prior: ``(params, statistics, prior, theta) -> []``; log density of the prior, up to a constant.
        expected: ``(params, statistics, theta) -> []``; expected complete-data log-likelihood of statistics;
            it makes carried statistics a prior.
    """

    name: str
    acting: Callable[[Any], Chain]
    log_obs: Callable[[Any, tuple[Array, ...], Array], Array]
    learning: Callable[..., tuple[Chain, Array]]
    constrain: Callable[..., Any]
    statistics: Callable[..., Any]
    m_step: Callable[..., Any]
    log_prior: Callable[..., Array]
    expected: Callable[..., Array]
