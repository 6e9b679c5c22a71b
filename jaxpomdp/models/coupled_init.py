"""Where coupled models start: two or more flat models, coupled at random or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array
from jaxpomdp.models import estimates
from jaxpomdp.models.coupled import CoupledParams, Strand
from jaxpomdp.models.flat import FlatParams
from jaxpomdp.models.init import LEAST_PROBABILITY, _generator
from jaxpomdp.numerics import NEG

COUPLINGS = ("mixture", "product")
"""Names of the rules."""


def couple(
    key: Array | int,
    models: Sequence[FlatParams],
    coupling: str = "mixture",
    *,
    paid: Sequence[bool] | None = None,
    own_weight: float = 0.8,
    concentration: float = 10.0,
) -> CoupledParams:
    """Couple flat models: each keeps its own transitions and its channels, and heeds the others a little.

    Rows from one strand to another are drawn from a symmetric Dirichlet distribution: with a large
    ``concentration`` they are even, and in a product an even row changes nothing.

    Args:
        key: a JAX random key, or an integer.
        models: one flat model per strand (one model each, no leading axis); the first is the one that acts.
        coupling: "mixture" or "product".
        paid: which strands emit the return; the last alone if None.
        own_weight: in a mixture, how much a strand heeds itself; the others share the rest.
        concentration: of the rows between strands.

    Returns:
        CoupledParams: one model. A strand without observations of its own: use ``silent``.

    Raises:
        ValueError: there are fewer than two models, or an argument is out of range.

    Example:
        >>> from jaxpomdp.models.init import random_params
        >>> seen, valued = random_params(0, 4, 2, 3), silent(random_params(1, 2, 2, 1))
        >>> params = couple(0, (seen, valued), "product")
        >>> [pair.shape for pairs in params.log_pairs for pair in pairs]
        [(2, 4, 4), (2, 2, 4), (2, 4, 2), (2, 2, 2)]
    """
    _check(models, coupling, own_weight, concentration)
    earns = [c == len(models) - 1 for c in range(len(models))] if paid is None else list(paid)
    if len(earns) != len(models):
        raise ValueError(f"paid must have {len(models)} entries, one per model, got {len(earns)}")
    strands = tuple(
        Strand(model.log_init, model.emissions, model.returns if pays else None, model.alive)
        for model, pays in zip(models, earns, strict=True)
    )
    rng, chains = _generator(key), range(len(models))
    pairs = tuple(
        tuple(
            models[c].log_trans if c == k else _drawn(rng, models[k], models[c], concentration)
            for k in chains
        )
        for c in chains
    )
    weights = _weights(len(models), own_weight, models[0].log_init) if coupling == "mixture" else None
    return CoupledParams(strands, pairs, weights, models[0].log_trans)


def silent(model: FlatParams) -> FlatParams:
    """Return a flat model without channels: as a strand, it emits returns alone."""
    return replace(model, emissions=())


def _check(models: Sequence[FlatParams], coupling: str, own_weight: float, concentration: float) -> None:
    if len(models) < 2:
        raise ValueError(f"models must be at least two, got {len(models)}")
    if coupling not in COUPLINGS:
        raise ValueError(f"coupling must be one of {COUPLINGS}, got {coupling!r}")
    if not 0 < own_weight <= 1:
        raise ValueError(f"own_weight must be in 0..1 and not 0, got {own_weight}")
    if not concentration > 0:
        raise ValueError(f"concentration must be positive, got {concentration}")
    actions = {model.log_trans.shape[0] for model in models}
    if any(model.alive.ndim != 1 for model in models) or len(actions) > 1:
        raise ValueError(f"models must be single ones with equal actions, got {sorted(actions)} actions")


def _drawn(rng: np.random.Generator, old: FlatParams, new: FlatParams, concentration: float) -> Array:
    """Draw rows between the states that exist, ``[A, N_old, N_new]``; ``NEG`` elsewhere."""
    here, there = (np.flatnonzero(np.asarray(model.alive)) for model in (old, new))
    actions = old.log_trans.shape[0]
    rows = rng.dirichlet(np.full(len(there), concentration), (actions, len(here)))
    rows = np.maximum(rows, LEAST_PROBABILITY)
    table = np.full((actions, old.alive.shape[0], new.alive.shape[0]), NEG)
    table[np.ix_(np.arange(actions), here, there)] = np.log(rows / rows.sum(axis=-1, keepdims=True))
    return jnp.asarray(table, old.log_trans.dtype)


def _weights(chains: int, own: float, like: Array) -> Array:
    rest = (1 - own) / (chains - 1)
    weights = np.full((chains, chains), rest) + (own - rest) * np.eye(chains)
    with np.errstate(divide="ignore"):
        return jnp.asarray(np.maximum(np.log(weights), NEG), like.dtype)


def with_capacities(params: CoupledParams, capacities: Sequence[int]) -> CoupledParams:
    """Give the strands of one model room for so many states; the new ones are absent.

    Raises:
        ValueError: there are more states than that already, or not one number per strand.
    """
    sizes = [strand.alive.shape[0] for strand in params.strands]
    if len(capacities) != len(sizes) or any(
        more < size for more, size in zip(capacities, sizes, strict=True)
    ):
        raise ValueError(f"capacities must be at least {sizes}, the states there are, got {list(capacities)}")
    spare = [more - size for more, size in zip(capacities, sizes, strict=True)]

    def widened(pair: Array, old: int, new: int) -> Array:
        return jnp.pad(pair, ((0, 0), (0, spare[old]), (0, spare[new])), constant_values=NEG)

    chains = range(len(sizes))
    return CoupledParams(
        tuple(_padded(strand, more) for strand, more in zip(params.strands, spare, strict=True)),
        tuple(tuple(widened(params.log_pairs[c][k], k, c) for k in chains) for c in chains),
        params.log_weights,
        widened(params.log_alone, 0, 0),
    )


def _padded(strand: Strand, spare: int) -> Strand:
    returns: Any = None if strand.returns is None else strand.returns.padded(spare)
    return Strand(
        estimates.pad_states(strand.log_init, spare, NEG),
        tuple(channel.padded(spare) for channel in strand.emissions),
        returns,
        estimates.pad_states(strand.alive, spare, False),
    )
