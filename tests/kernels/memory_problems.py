"""Small random chains with a memory, as NumPy arrays, and their way into JAX."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp.kernels.memory import MemoryChain
from tests.kernels.problems import log_of, random_problem, random_rows, self_stack


class MemoryProblem(NamedTuple):
    """A model, each part in logarithms, and a tape."""

    chain: MemoryChain
    tape: tuple[np.ndarray, ...]

    def jax(self, dtype: type = np.float64) -> tuple[MemoryChain, tuple[jax.Array, ...]]:
        rows, actions, start, valid = self.tape
        tape = jnp.asarray(rows, dtype), jnp.asarray(actions, jnp.int32), jnp.asarray(start)
        return MemoryChain(*(jnp.asarray(x, dtype) for x in self.chain)), (*tape, jnp.asarray(valid))


def random_memory(
    seed: int,
    *,
    states: int = 3,
    actions: int = 2,
    zeros: float = 0.0,
    awake: int | None = None,
    model: int | None = None,
    **options: float,
) -> MemoryProblem:
    """Draw a model and a tape (options as ``random_problem``).

    ``awake`` says how many states are ever kept, by default as chance has it; ``model`` seeds the model apart
    from the tape.
    """
    tape = random_problem(seed, states=states, actions=actions, zeros=zeros, **options)
    drawn = seed if model is None else model
    flat = random_problem(drawn, states=states, actions=actions, zeros=zeros)
    rng = np.random.default_rng((drawn, 2))
    shapes = ((actions, states, states), *[(states, 2)] * 2)
    lead, heed, note = (random_rows(rng, shape, zeros) for shape in shapes)
    if awake is not None:
        note = np.where((note > 0).all(axis=1, keepdims=True), note, 0.5)
        note[rng.permutation(states)[awake:]] = 1, 0
    return MemoryProblem(
        MemoryChain(flat.log_init, flat.log_trans, *map(log_of, (lead, heed, note))), tape[2:]
    )


def stack_memory(problems: list[list[MemoryProblem]], dtype: type = np.float64) -> tuple:
    """Stack ``problems[S][B]`` of equal shapes, the model of each row taken from its first tape."""
    rows = [[problem.jax(dtype) for problem in row] for row in problems]
    chains = jax.tree.map(lambda *x: jnp.stack(x), *(row[0][0] for row in rows))
    tapes = [self_stack([tape for _, tape in row]) for row in rows]
    return chains, *self_stack(tapes)
