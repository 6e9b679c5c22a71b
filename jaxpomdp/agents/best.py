"""The best policy so far: what is kept of it, and when an agent goes back to it.

Policies are judged by the discounted reward of the trials that they were used in, exploration included: by
the average over a window of the latest trials or over its latest part, whichever is less. A long average
alone would still praise a policy that was spoilt a few trials ago. Two averages differ clearly when they are
further apart than some standard errors.

Most of those trials were its predecessors': where luck decides, one that was spoilt just now may still seem
the best ever. With a probation a policy waits until its successors have made some of the trials as well.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array

SURE = 3.0
"""Standard errors beyond which an agent goes back while it still learns."""

ALIKE = 0.01
"""Averages closer than this share of the best are alike: where nothing is left to chance, errors are zero."""


class Best(NamedTuple):
    """The best policy so far, for ``S`` seeds: its models and values, and how well it did.

    ``score[S]`` is its average discounted reward (-inf: none yet), ``error[S]`` the standard error, and
    ``age[S]`` the number of trials since then. ``waiting`` are the models and values on probation, for
    ``served[S]`` trials so far (None: there is no probation).
    """

    params: Any
    q: Array
    score: np.ndarray
    error: np.ndarray
    age: np.ndarray
    waiting: tuple[Any, Array] | None
    served: np.ndarray


def none_yet(params: Any, q: Array, probation: int = 0) -> Best:
    """Return what is kept before the first trial."""
    none = np.zeros(len(q), np.int64)
    waiting = (params, q) if probation else None
    return Best(params, q, np.full(len(q), -np.inf), np.zeros(len(q)), none, waiting, none)


def select(mask: Array, yes: Any, no: Any) -> Any:
    """Take each model (leading ``S``) from ``yes`` where ``mask[S]``, else from ``no``."""
    mask = jnp.asarray(mask)
    return jax.tree.map(lambda x, y: jnp.where(mask.reshape(-1, *(1,) * (x.ndim - 1)), x, y), yes, no)


LATEST = 4
"""The latest part of a window is one in so many of its trials."""


def standing(recent: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how well each seed does now and the standard error of a window's mean, NaN where it is not full.

    ``min(mean(last K), mean(last K / 4))`` of ``recent[S, K]``, newest last.
    """
    width = recent.shape[1]
    latest = recent[:, -max(width // LATEST, 1) :]
    return np.minimum(recent.mean(axis=1), latest.mean(axis=1)), recent.std(axis=1) / np.sqrt(width)


def judged(best: Best, recent: np.ndarray, params: Any, q: Array, trials: int, probation: int = 0) -> Best:
    """Keep the policy of now where it stands better after the ``recent[S, K]`` trials than any did so far.

    With a probation it is the waiting one that is judged, as soon as it was so many trials ago that it was
    the one of now, and the one of now waits next.
    """
    average, error = standing(recent)
    served = best.served + trials
    ripe = served >= probation
    better = ripe & (np.where(np.isnan(average), -np.inf, average) > best.score)
    kept, values = select(better, best.waiting or (params, q), (best.params, best.q))
    score, error = (np.where(better, x, y) for x, y in ((average, best.score), (error, best.error)))
    age = np.where(better, 0, best.age + trials)
    waiting = best.waiting and select(ripe, (params, q), best.waiting)
    return Best(kept, values, score, error, age, waiting, np.where(ripe, 0, served))


def waiting_anew(best: Best, mask: np.ndarray, params: Any, q: Array) -> Best:
    """Where ``mask[S]`` an agent begins again: let its new policy wait, not one that was given up."""
    waiting = best.waiting and select(mask, (params, q), best.waiting)
    return best._replace(waiting=waiting, served=np.where(mask, 0, best.served))


def given_up(best: Best, recent: np.ndarray, margin: float) -> np.ndarray:
    """Say which agents end with the best policy, not with the one of now, which never served a probation."""
    return np.isfinite(best.score) if best.waiting else clearly_worse(best, recent, margin)


def clearly_worse(best: Best, recent: np.ndarray, margin: float) -> np.ndarray:
    """Say where the average of now is below the best one by more than ``margin`` standard errors.

    Where too few trials were made since a new start, now counts as worse than any best there is.
    """
    now, error = standing(recent)
    further = best.score - now > np.maximum(margin * np.hypot(error, best.error), ALIKE * np.abs(best.score))
    return np.where(np.isnan(now), np.isfinite(best.score), further)
