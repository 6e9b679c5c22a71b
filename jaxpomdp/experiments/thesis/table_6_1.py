"""Table 6.1: what each algorithm reaches in the 89-state maze, the hierarchical agent among them."""

from __future__ import annotations

from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Published, Row
from jaxpomdp.experiments.thesis import maze89, table_3_1

TARGETS: dict[str, Published] = table_3_1.TARGETS | {
    "HMO-HUDHMM, θ = 0.2": {"goal_percent": 93, "median_steps": 59},
    "HMO-HUDHMM, θ = 0": {"goal_percent": 93, "median_steps": 60},
}
"""Thesis, Table 6.1."""

HIERARCHICAL_TRIALS = 4000
"""Fewer than the flat agents make: a hierarchy is as good sooner."""

_FLAT = (*table_3_1.TARGETS, "UDHMM, θ = 0", "UDHMM at its best")
SETTINGS: dict[str, RunConfig | None] = {name: table_3_1.SETTINGS[name] for name in _FLAT} | {
    "HMO-HUDHMM, θ = 0.2": maze89.run("hudhmm", HIERARCHICAL_TRIALS, theta=0.2),
    "HMO-HUDHMM, θ = 0": maze89.run("hudhmm", HIERARCHICAL_TRIALS, theta=0.0),
}

EXPERIMENT = Experiment(
    name="table-6.1",
    title="Table 6.1: the 89-state maze, with hierarchies",
    source="thesis, Table 6.1",
    rows=tuple(Row(name, run, TARGETS.get(name, {})) for name, run in SETTINGS.items()),
    columns=table_3_1.EXPERIMENT.columns,
    plot=table_3_1.plot,
    notes=(
        "The hierarchical agents start from a random tree of 20 production states in two levels. "
        "`jaxpomdp play` is how the human row is made. RL-LSTM is Bakker's (2004), as published; it is not "
        "run here."
    ),
)
