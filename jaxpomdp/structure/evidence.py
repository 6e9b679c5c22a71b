"""What experience says about the return in each state: belief-weighted histograms over a common grid.

The device gathers it with the same formulas; ``return_evidence`` is their readable definition.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxpomdp.structure.spec import expect_shape, frozen


@dataclass(frozen=True, eq=False)
class ReturnEvidence:
    """Belief-weighted return distributions, per state (K = 1) or per state and action (K = A).

    Attributes:
        edges: ``[bins + 1]``, non-decreasing; bin b holds ``edges[b] <= R < edges[b + 1]``; the two outer
            bins also hold what lies beyond.
        centres: ``[bins]``, a value that stands for each bin: the mean of the returns in it, or its middle.
        hist: ``[N, K, bins]``, sum of the weights ``gamma[t, n]`` of the returns in the bin.
        mean: ``[N, K]``, weighted mean of the returns themselves (not of bins); anything where no weight is.
        var: ``[N, K]``, weighted variance.
        effective: ``[N, K]``, independent returns the weight is worth. Returns of one trial are nearly copies
            of each other, so this is ``(sum_b W_b)^2 / sum_b W_b^2`` over trials b with total weight ``W_b``
            (at most the number of trials).

    Raises:
        ValueError: shapes disagree, edges fall, or a number is negative or not finite.
    """

    edges: np.ndarray
    centres: np.ndarray
    hist: np.ndarray
    mean: np.ndarray
    var: np.ndarray
    effective: np.ndarray

    def __post_init__(self) -> None:
        for name in ("edges", "centres", "hist", "mean", "var", "effective"):
            array = np.asarray(frozen(name, getattr(self, name)), dtype=float)
            if not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite, got NaN or infinity")
            object.__setattr__(self, name, array)
        _check(self)

    @property
    def weight(self) -> np.ndarray:
        """Total weight ``[N, K]``: the expected number of steps spent in the state."""
        return self.hist.sum(-1)

    def pooled(self) -> tuple[float, float]:
        """Return mean and variance of all returns together, by weight; zeros where there is none."""
        weight = self.weight
        total = weight.sum()
        if total <= 0:
            return 0.0, 0.0
        mean = float((weight * self.mean).sum() / total)
        return mean, float((weight * (self.var + (self.mean - mean) ** 2)).sum() / total)

    def per_state(self) -> ReturnEvidence:
        """Return the evidence with actions pooled (K = 1)."""
        weight = self.weight
        total = weight.sum(-1, keepdims=True)
        share = weight / np.where(total > 0, total, 1)
        mean = (share * self.mean).sum(-1, keepdims=True)
        var = (share * (self.var + (self.mean - mean) ** 2)).sum(-1, keepdims=True)
        hist, effective = self.hist.sum(1, keepdims=True), self.effective.sum(-1, keepdims=True)
        return replace(self, hist=hist, mean=mean, var=var, effective=effective)


def return_evidence(
    returns: np.ndarray,
    beliefs: np.ndarray,
    edges: np.ndarray,
    *,
    actions: np.ndarray | None = None,
    num_actions: int = 1,
    trial: np.ndarray | None = None,
) -> ReturnEvidence:
    """Gather the evidence of ``returns[T]`` under ``beliefs[T, N]`` (smoothed; zero rows count for nothing).

    Args:
        returns: ``[T]``.
        beliefs: ``[T, N]``, the weights.
        edges: ``[bins + 1]``, see ``ReturnEvidence``.
        actions: ``[T]`` ints; given, the evidence is kept apart per action.
        num_actions: A, when actions are given.
        trial: ``[T]`` ints, the trial of each step; without it every step is a trial of its own.

    >>> evidence = return_evidence(np.array([0.0, 1.0, 1.0]), np.ones((3, 1)), np.array([0, 0.5, 1]))
    >>> evidence.hist.tolist(), evidence.effective.tolist()
    ([[[1.0, 2.0]]], [[3.0]])
    """
    returns, edges = np.asarray(returns, float), np.asarray(edges, float)
    bins = len(edges) - 1
    place = bin_of(returns, edges)
    chosen = np.zeros(len(returns), int) if actions is None else np.asarray(actions)
    weights = np.asarray(beliefs, float)[:, :, None] * np.eye(num_actions)[chosen][:, None, :]
    hist = np.einsum("tnk,tb->nkb", weights, np.eye(bins)[place])
    divisor = np.where(weights.sum(0) > 0, weights.sum(0), 1)
    mean = np.einsum("tnk,t->nk", weights, returns) / divisor
    var = np.einsum("tnk,tnk->nk", weights, (returns[:, None, None] - mean) ** 2) / divisor
    effective = _effective(weights, np.arange(len(returns)) if trial is None else np.asarray(trial))
    return ReturnEvidence(edges, bin_centres(returns, weights.sum((1, 2)), edges), hist, mean, var, effective)


def bin_of(returns: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the bin ``0 .. bins - 1`` of each return; what lies beyond the grid goes to the outer bins."""
    return np.clip(np.searchsorted(edges, returns, side="right") - 1, 0, len(edges) - 2)


def bin_centres(returns: np.ndarray, weights: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the weighted mean of the returns in each bin, ``[bins]``; the middle of a bin that has none."""
    bins = len(edges) - 1
    place = bin_of(returns, edges)
    mass = np.bincount(place, weights, bins)
    total = np.bincount(place, weights * returns, bins)
    return np.where(mass > 0, total / np.where(mass > 0, mass, 1), (edges[1:] + edges[:-1]) / 2)


def even_edges(low: float, high: float, bins: int) -> np.ndarray:
    """Return ``bins + 1`` even edges from ``low`` to ``high`` (a hair's width apart where they coincide)."""
    return np.linspace(low, max(high, np.nextafter(low, np.inf)), bins + 1)


def quantile_edges(returns: np.ndarray, bins: int) -> np.ndarray:
    """Return ``bins + 1`` edges at the quantiles of the returns: fine where returns are many.

    A value held by many returns makes bins of zero width, which stay empty and do no harm.
    """
    return np.quantile(np.asarray(returns, float), np.linspace(0, 1, bins + 1))


def _effective(weights: np.ndarray, trial: np.ndarray) -> np.ndarray:
    _, trial = np.unique(trial, return_inverse=True)
    per_trial = np.zeros((trial.max(initial=-1) + 1, *weights.shape[1:]))
    np.add.at(per_trial, trial, weights)
    squares = (per_trial**2).sum(0)
    return per_trial.sum(0) ** 2 / np.where(squares > 0, squares, 1)


def _check(evidence: ReturnEvidence) -> None:
    expect_shape("edges", evidence.edges, (None,))
    bins = len(evidence.edges) - 1
    expect_shape("hist", evidence.hist, (None, None, bins))
    expect_shape("centres", evidence.centres, (bins,))
    if (np.diff(evidence.edges) < 0).any():
        raise ValueError(f"edges must not fall, got {evidence.edges}")
    for name in ("mean", "var", "effective"):
        expect_shape(name, getattr(evidence, name), evidence.hist.shape[:2])
    for name in ("hist", "var", "effective"):
        if (getattr(evidence, name) < 0).any():
            raise ValueError(f"{name} must not be negative, got {getattr(evidence, name).min()}")
