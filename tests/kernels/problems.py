"""Small random problems for the kernels, as NumPy arrays, and their way into JAX."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Chain
from jaxpomdp.numerics import NEG

quick_jit = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""Compile in half the time: for small tests, where that is what takes long."""


class Problem(NamedTuple):
    """A model and a tape: ``log_init[N]``, ``log_trans[A, N, N]``, ``log_obs[T, N]``, the rest ``[T]``."""

    log_init: np.ndarray
    log_trans: np.ndarray
    log_obs: np.ndarray
    actions: np.ndarray
    start: np.ndarray
    valid: np.ndarray

    def jax(self, dtype: type = np.float64) -> tuple[Chain, jax.Array, jax.Array, jax.Array, jax.Array]:
        log_init, log_trans, log_obs = (jnp.asarray(x, dtype) for x in self[:3])
        rest = (jnp.asarray(self.actions, jnp.int32), jnp.asarray(self.start), jnp.asarray(self.valid))
        return Chain(log_init, log_trans), log_obs, *rest


def log_of(probability: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.maximum(np.log(probability), NEG)


def random_rows(rng: np.random.Generator, shape: tuple[int, ...], zeros: float) -> np.ndarray:
    """Draw rows of probabilities, some of them structural zeros, at least one positive."""
    weight = rng.dirichlet(np.ones(shape[-1]), shape[:-1])
    gone = rng.random(shape) < zeros
    gone[..., 0] &= ~gone.all(axis=-1)
    weight = np.where(gone, 0, weight)
    return weight / weight.sum(axis=-1, keepdims=True)


def random_problem(
    seed: int,
    *,
    states: int = 3,
    actions: int = 2,
    steps: int = 6,
    scale: float = 1.0,
    zeros: float = 0.0,
    starts: float = 0.0,
    missing: float = 0.0,
    padding: int = 0,
) -> Problem:
    """Draw a problem; ``zeros``, ``starts``, ``missing`` are shares, ``scale`` is of the log-likelihoods."""
    rng = np.random.default_rng(seed)
    log_init = log_of(random_rows(rng, (states,), zeros))
    log_trans = log_of(random_rows(rng, (actions, states, states), zeros))
    log_obs = scale * rng.normal(size=(steps, states))
    log_obs[rng.random(steps) < missing] = 0
    start = rng.random(steps) < starts
    start[0] = True
    valid = np.arange(steps) < steps - padding
    return Problem(log_init, log_trans, log_obs, rng.integers(0, actions, steps), start & valid, valid)


def stack(problems: list[list[Problem]], dtype: type = np.float64) -> tuple[Chain, *tuple[jax.Array, ...]]:
    """Stack ``problems[S][B]`` of equal shapes, the model of each row taken from its first tape."""
    rows = [[problem.jax(dtype) for problem in row] for row in problems]
    chains = jax.tree.map(lambda *x: jnp.stack(x), *(row[0][0] for row in rows))
    tapes = jax.tree.map(lambda *x: jnp.stack(x), *(self_stack([p[1:] for p in row]) for row in rows))
    return chains, *tapes


def self_stack(tapes: list[tuple[jax.Array, ...]]) -> tuple[jax.Array, ...]:
    return jax.tree.map(lambda *x: jnp.stack(x), *tapes)


def with_tape(problem: Problem, seed: int, **options: float) -> Problem:
    """Give a model another random tape of the same shape."""
    states, actions, steps = problem.log_obs.shape[1], len(problem.log_trans), len(problem.log_obs)
    other = random_problem(seed, states=states, actions=actions, steps=steps, **options)
    return Problem(problem.log_init, problem.log_trans, *other[2:])
