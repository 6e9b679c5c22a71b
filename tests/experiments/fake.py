"""A small agent with the API of the real ones: its trials get shorter, its draws are keyed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp.experiments.config import RunConfig

LIMIT = 20


@dataclass(frozen=True)
class FakeConfig:
    """Settings of the fake."""

    trials_per_phase: int = 5
    speed: float = 0.02


@dataclass(frozen=True)
class FakeAgent:
    """Trials of up to 20 steps that succeed more and more often."""

    config: FakeConfig = field(default_factory=FakeConfig)
    log: list = field(default_factory=list)

    def init(self, seeds):
        count = len(seeds)
        return {
            "seed": np.asarray(seeds, np.int32),
            "skill": jnp.zeros(count),
            "trial": 0,
            "memory": np.zeros((count, 2), np.float32),
        }

    def run(self, state):
        count = self.config.trials_per_phase
        rows = _trials(state, 0, state["trial"], count)
        skill = np.asarray(state["skill"]) + np.float32(self.config.speed) * rows["success"].sum(axis=1)
        memory = np.concatenate([state["memory"], rows["reward"]], axis=1)
        state = {
            **state,
            "skill": jnp.asarray(skill, jnp.float32),
            "trial": state["trial"] + count,
            "memory": memory,
        }
        self.log.append({"seed_index": 0, "seed": 99, "phase": state["trial"], "gain": np.float32(skill[0])})
        once = {"states": np.full(len(skill), 7), "log_evidence": skill, "acting": np.full(len(skill), 0.5)}
        return state, rows | once

    def evaluate(self, state, trials, key):
        return _trials(state, int(jax.random.key_data(key)[-1]), 0, trials)

    def finish(self, state):
        return {**state, "skill": state["skill"] + 0.1}


def _trials(state, key, first, count):
    draws = [[[int(seed), t, key] for t in range(first, first + count)] for seed in state["seed"]]
    drawn = np.array([[np.random.default_rng(draw).random() for draw in row] for row in draws])
    steps = np.minimum(1 + (drawn * 40 / (1 + np.asarray(state["skill"])[:, None])).astype(int), LIMIT)
    success = steps < LIMIT
    reward = success.astype(np.float32)
    discounted = (reward * 0.95**steps).astype(np.float32)
    return {"steps": steps, "reward": reward, "discounted": discounted, "success": success}


def build_fake(config: RunConfig):
    """Stand in for ``runner.build``."""
    return None, FakeAgent(replace(FakeConfig(), **dict(config.settings)))
