"""What C++ is handed, checked; and the shapes of what it hands back."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array


def check(name: str, value: Array, shape: tuple[int, ...], dtype: type) -> None:
    """Raise if an array has not the shape and dtype that C++ will take it to have."""
    if jnp.shape(value) != shape or value.dtype != dtype:
        came = f"{value.dtype}{list(jnp.shape(value))}"
        raise ValueError(f"{name} must be {jnp.dtype(dtype).name}{list(shape)}, got {came}")


def float32(*shapes: tuple[int, ...]) -> tuple[jax.ShapeDtypeStruct, ...]:
    """Return results of these shapes, for a foreign call."""
    return tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)
