"""Numbers: one finite stand-in for log 0, safe logarithms, and the capacities that arrays may have."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array

NEG = -1e30
"""The logarithm of an absent thing: finite, so gradients stay finite; ``exp(NEG)`` is exactly zero."""


def safe_log(x: Array) -> Array:
    """Return ``log x``, and ``NEG`` where ``x`` is zero, with a zero gradient there."""
    positive = x > 0
    return jnp.where(positive, jnp.log(jnp.where(positive, x, 1)), NEG)


def log_sum_exp(x: Array, axis: int = -1) -> Array:
    """Return ``log sum exp x`` along ``axis``; a row of nothing but ``NEG`` gives ``NEG``."""
    peak = jnp.max(x, axis=axis, keepdims=True)
    total = jnp.sum(jnp.exp(x - peak), axis=axis)
    return jnp.maximum(jnp.squeeze(peak, axis) + jnp.log(total), NEG)


def log_normalise(x: Array, axis: int = -1) -> Array:
    """Scale ``exp x`` to sum to one along ``axis``; a row that is ``NEG`` throughout stays so."""
    total = jnp.expand_dims(log_sum_exp(x, axis), axis)
    return jnp.where(x > NEG / 2, x - total, NEG)


def normalise(x: Array, fallback: Array, axis: int = -1) -> Array:
    """Scale ``x >= 0`` to sum to one along ``axis``; where the sum is zero keep ``fallback``."""
    total = jnp.sum(x, axis=axis, keepdims=True)
    some = total > 0
    return jnp.where(some, x / jnp.where(some, total, 1), fallback)


def bucket(size: int, *, cap: int | None = None, step: float = 1.5, least: int = 8) -> int:
    """Return the smallest capacity that holds ``size``: ``least``, then growing by ``step``, at most ``cap``.

    Shapes drawn from few capacities make a whole run compile each kernel a handful of times.

    Raises:
        ValueError: ``size`` is over ``cap``.
    """
    if cap is not None and size > cap:
        raise ValueError(f"size must be at most cap={cap}, got {size}")
    capacity = least
    while capacity < size:
        capacity = 8 * math.ceil(capacity * step / 8)
    return capacity if cap is None else min(capacity, cap)


def stop_if_not_finite(name: str, tree: object) -> None:
    """Raise if an array of ``tree`` holds NaN or infinity (host side, at public edges).

    Raises:
        ValueError: naming the argument and the first offending leaf.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        if jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating) and not bool(jnp.all(jnp.isfinite(leaf))):
            raise ValueError(f"{name}{jax.tree_util.keystr(path)} must be finite, got NaN or infinity")
