"""Small random chains with a memory, as NumPy arrays, and their way into JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp.kernels.memory import MemoryChain
from tests.kernels.problems import log_of, random_problem, random_rows


class MemoryProblem(NamedTuple):
    """A model, each part in logarithms, and a tape."""

    chain: MemoryChain
    tape: tuple[np.ndarray, ...]

    def jax(self, dtype: type = np.float64) -> tuple[MemoryChain, tuple[jax.Array, ...]]:
        rows, actions, start, valid = self.tape
        tape = jnp.asarray(rows, dtype), jnp.asarray(actions, jnp.int32), jnp.asarray(start)
        return MemoryChain(*(jnp.asarray(x, dtype) for x in self.chain)), (*tape, jnp.asarray(valid))


def random_memory(seed: int, *, states: int = 3, zeros: float = 0.0, **options: float) -> MemoryProblem:
    """Draw a model and a tape (options as ``random_problem``)."""
    flat = random_problem(seed, states=states, zeros=zeros, **options)
    rng = np.random.default_rng((seed, 2))
    actions = len(flat.log_trans)
    parts = (random_rows(rng, shape, zeros) for shape in ((actions, states, states), *[(states, 2)] * 2))
    return MemoryProblem(MemoryChain(flat.log_init, flat.log_trans, *map(log_of, parts)), flat[2:])
