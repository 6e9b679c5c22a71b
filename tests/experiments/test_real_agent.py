"""The same promises with the agent itself: killed and resumed it ends bit for bit as if it had not been."""

from __future__ import annotations

import numpy as np
import pytest

from jaxpomdp.agents.agent import Agent
from jaxpomdp.experiments import runner
from jaxpomdp.experiments.arrays import load_arrays
from jaxpomdp.experiments.config import RunConfig

SETTINGS = (("states", 4), ("node_cap", 8), ("window", 10), ("gate", 0.0), ("em_iterations", 1))
CONFIG = RunConfig(
    "tmaze-2",
    "udhmm-tmaze",
    (1, 2),
    25,
    evaluate_every=10,
    evaluation_trials=3,
    final_trials=4,
    settings=SETTINGS,
)


class KilledError(Exception):
    """Stands for the end of the process."""


@pytest.mark.slow
def test_killed_and_resumed_it_ends_the_same(tmp_path, monkeypatch):
    whole = runner.run(CONFIG, tmp_path / "whole", progress="none")
    calls = iter(range(1, 100))
    original = Agent.run

    def dying(self, state):
        if next(calls) == 4:
            raise KilledError
        return original(self, state)

    with monkeypatch.context() as patch:
        patch.setattr(Agent, "run", dying)
        with pytest.raises(KilledError):
            runner.run(CONFIG, tmp_path / "killed", progress="none", save_seconds=0.0)
    resumed = runner.run(CONFIG, tmp_path / "killed", progress="none")
    for name in ("trials.csv", "phases.csv", "evaluations.csv", "final.csv", "edits.jsonl"):
        left, right = whole / name, resumed / name
        assert left.exists() == right.exists()
        assert not left.exists() or left.read_bytes() == right.read_bytes(), name
    one, other = load_arrays(whole / "model.npz")[0], load_arrays(resumed / "model.npz")[0]
    assert one.keys() == other.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)
