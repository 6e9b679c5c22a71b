"""What is timed: the sizes W1 to W4, and data of those sizes."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Load(NamedTuple):
    """``S`` models, each with ``B`` trials of ``T`` steps; ``N`` states, ``A`` actions, ``O`` symbols."""

    models: int
    trials: int
    steps: int
    states: int
    actions: int
    symbols: int

    @property
    def flop(self) -> float:
        """What an E-step cannot do without: forward, backward and counts are each ``2 N^2`` a step."""
        return 6.0 * self.models * self.trials * self.steps * self.states**2

    @property
    def bytes(self) -> float:
        """What it must move in float32: likelihoods in, beliefs out and in, posteriors out; matrices."""
        rows = self.models * self.trials * self.steps * self.states
        return 4.0 * (4 * rows + 2 * self.models * self.actions * self.states**2)

    def __str__(self) -> str:
        return (
            f"{self.models} models x {self.trials} trials x T = {self.steps:,}, "
            f"N = {self.states}, A = {self.actions}, {self.symbols} observations"
        )


LOADS = {
    "W1": Load(21, 12, 64, 16, 4, 16),
    "W2": Load(21, 50, 251, 70, 5, 21),
    "W3": Load(1, 64, 1000, 256, 4, 64),
    "W4": Load(1, 1, 100_000, 32, 4, 32),
}


AGENT = Load(models=1, trials=1, steps=1, states=70, actions=5, symbols=21)
"""The size of an agent in the 89-state maze."""


class Cost(NamedTuple):
    """What one step of one agent cannot do without: floating-point operations, and bytes in float32."""

    flop: float
    bytes: float


def step_cost(*, own_model: bool) -> Cost:
    """Return the cost of a belief update, ``2 N^2``, and of SARSA(lambda) on it.

    Values and traces ``[N, A]`` are read and written; beliefs too, and a column of emissions read. The matrix
    of the action is read as well if each agent has its own; one that all share stays in the cache.
    """
    states, entries = AGENT.states, AGENT.states * AGENT.actions
    flop = 2.0 * states**2 + 5 * entries + 6 * states
    return Cost(flop, 4.0 * (4 * entries + 3 * states + (states**2 if own_model else 0)))


class Data(NamedTuple):
    """Host arrays: ``init[S, N]``, ``trans[S, A, N, N]``, ``emit[S, N, O]``; ``seen, actions [S, B, T]``."""

    init: np.ndarray
    trans: np.ndarray
    emit: np.ndarray
    seen: np.ndarray
    actions: np.ndarray


def draw(load: Load) -> Data:
    """Draw models with sparse rows, as learned ones are, and trials at random."""
    rng = np.random.default_rng(0)

    def rows(*shape: int) -> np.ndarray:
        weight = rng.gamma(0.5, size=shape) + 1e-6
        return (weight / weight.sum(-1, keepdims=True)).astype(np.float32)

    shape = (load.models, load.trials, load.steps)
    return Data(
        rows(load.models, load.states),
        rows(load.models, load.actions, load.states, load.states),
        rows(load.models, load.states, load.symbols),
        rng.integers(load.symbols, size=shape, dtype=np.int32),
        rng.integers(load.actions, size=shape, dtype=np.int32),
    )


def log_likelihood(emit: jax.Array, seen: jax.Array) -> jax.Array:
    """Return ``log p(o_t | i)``, ``[..., T, N]``, from ``emit[N, O]``."""
    return jnp.log(emit).T[seen]
