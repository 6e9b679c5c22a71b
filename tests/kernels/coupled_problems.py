"""Small random problems of coupled chains, as NumPy arrays, and their way into JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp.kernels.coupled import CoupledChain
from tests.kernels.problems import log_of, random_rows


class CoupledProblem(NamedTuple):
    """As ``problems.Problem``; ``log_init``, ``log_trans`` and ``log_obs`` have an entry per chain."""

    log_init: tuple[np.ndarray, ...]
    log_trans: tuple[np.ndarray, ...]
    log_obs: tuple[np.ndarray, ...]
    actions: np.ndarray
    start: np.ndarray
    valid: np.ndarray

    def jax(self, dtype: type = np.float64) -> tuple[CoupledChain, tuple, jax.Array, jax.Array, jax.Array]:
        init, trans, rows = (tuple(jnp.asarray(x, dtype) for x in part) for part in self[:3])
        rest = (jnp.asarray(self.actions, jnp.int32), jnp.asarray(self.start), jnp.asarray(self.valid))
        return CoupledChain(init, trans), rows, *rest


def random_coupled(
    seed: int,
    *,
    sizes: tuple[int, ...] = (3, 2),
    actions: int = 2,
    steps: int = 5,
    scale: float = 1.0,
    zeros: float = 0.0,
    starts: float = 0.0,
    missing: float = 0.0,
    padding: int = 0,
    model: int | None = None,
) -> CoupledProblem:
    """Draw a problem with tables of moves of no special form; ``model`` seeds them apart from the tape."""
    drawn = np.random.default_rng(seed if model is None else model)
    init = tuple(log_of(random_rows(drawn, (n,), zeros)) for n in sizes)
    trans = tuple(log_of(random_rows(drawn, (actions, *sizes, n), zeros)) for n in sizes)
    rng = np.random.default_rng((seed, 1))
    rows = tuple(scale * rng.normal(size=(steps, n)) for n in sizes)
    for row in rows:
        row[rng.random(steps) < missing] = 0
    start = rng.random(steps) < starts
    start[0] = True
    valid = np.arange(steps) < steps - padding
    return CoupledProblem(init, trans, rows, rng.integers(0, actions, steps), start & valid, valid)


def stack_coupled(problems: list[list[CoupledProblem]], dtype: type = np.float64) -> tuple:
    """Stack ``problems[S][B]`` of equal shapes, the model of each row taken from its first tape."""
    rows = [[problem.jax(dtype) for problem in row] for row in problems]
    chains = jax.tree.map(lambda *x: jnp.stack(x), *(row[0][0] for row in rows))
    tapes = [jax.tree.map(lambda *x: jnp.stack(x), *(p[1:] for p in row)) for row in rows]
    return chains, *jax.tree.map(lambda *x: jnp.stack(x), *tapes)
