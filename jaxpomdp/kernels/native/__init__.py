"""Kernels in C++ behind JAX's foreign function interface: for the CPU, float32, and only where a compiler is found.

``available()`` says whether they can be used; the first call compiles them, once per machine (some seconds).
The other functions work under ``jit``, ``vmap`` and inside loops like any JAX function, but have no derivatives.
They use the cores that the process may run on, or as many threads as the environment variable
``JAXPOMDP_THREADS`` says. ``JAXPOMDP_NATIVE=0`` turns all of it off.

Shapes: ``S`` models, ``B`` rows, ``T`` steps, ``N`` states, ``A`` actions.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxpomdp._types import Array, Posterior
from jaxpomdp.kernels.native.build import loaded

__all__ = ["available", "estep", "filter_tapes"]


def available() -> bool:
    """Say whether the native kernels can be used here: JAX computes on the CPU and the library compiles."""
    return jax.default_backend() == "cpu" and loaded()


def _checked(init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array) -> tuple[Array, ...]:
    """Check shapes and dtypes, since C++ would trust them."""
    models, states = jnp.shape(init)
    rows, steps = jnp.shape(log_obs)[1:3]
    tape = (models, rows, steps)
    square = (models, jnp.shape(trans)[1], states, states)
    expected = {
        "init": (init, (models, states), jnp.float32),
        "trans": (trans, square, jnp.float32),
        "log_obs": (log_obs, (*tape, states), jnp.float32),
        "actions": (actions, tape, jnp.int32),
        "start": (start, tape, jnp.bool_),
        "valid": (valid, tape, jnp.bool_),
    }
    for name, (value, shape, dtype) in expected.items():
        check_argument(name, value, shape, dtype)
    return init, trans, log_obs, actions, start, valid


def check_argument(name: str, value: Array, shape: tuple[int, ...], dtype: jnp.dtype) -> None:
    """Raise if an array has not the shape and dtype that the native kernel will take it to have.

    Raises:
        ValueError: naming the argument, what was expected and what came.
    """
    if jnp.shape(value) != shape or value.dtype != dtype:
        came = f"{value.dtype}{list(jnp.shape(value))}"
        raise ValueError(f"{name} must be {jnp.dtype(dtype).name}{list(shape)}, got {came}")


def estep(init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array) -> Posterior:
    """Smooth all rows of all models: ``kernels.smoothing.smooth`` over rows and models, counts summed over rows.

    Args:
        init: probabilities float32 ``[S, N]``.
        trans: probabilities float32 ``[S, A, N, N]`` (row: from, column: to).
        log_obs: float32 ``[S, B, T, N]``; a missing step is a row of zeros.
        actions: int32 ``[S, B, T]``; the last of a trial is ignored.
        start: bool ``[S, B, T]``, first step of a trial.
        valid: bool ``[S, B, T]``, False at padding.

    Returns:
        ``Posterior`` with ``log_evidence[S, B]``, ``gamma[S, B, T, N]``, ``xi[S, A, N, N]``, ``initial[S, N]``.

    Raises:
        ValueError: an argument of another shape or dtype.

    Source: Rabiner (1989); thesis section 3.3.
    """
    arguments = _checked(init, trans, log_obs, actions, start, valid)
    shapes = (jnp.shape(actions)[:2], jnp.shape(log_obs), jnp.shape(trans), jnp.shape(init))
    results = tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)
    return Posterior(*jax.ffi.ffi_call("jaxpomdp_estep", results, vmap_method="broadcast_all")(*arguments))


def filter_tapes(
    init: Array, trans: Array, log_obs: Array, actions: Array, start: Array, valid: Array
) -> tuple[Array, Array]:
    """Filter all rows of all models: ``kernels.filtering.filter_tape`` over rows and models.

    Args:
        init, trans, log_obs, actions, start, valid: as ``estep``.

    Returns:
        ``belief[S, B, T, N]`` and ``log_norm[S, B, T]``, both zero at padding.

    Raises:
        ValueError: an argument of another shape or dtype.
    """
    arguments = _checked(init, trans, log_obs, actions, start, valid)
    shapes = (jnp.shape(log_obs), jnp.shape(actions))
    results = tuple(jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes)
    return tuple(jax.ffi.ffi_call("jaxpomdp_filter", results, vmap_method="broadcast_all")(*arguments))
