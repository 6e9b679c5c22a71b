"""Figure 3.4: the hallway for several values of theta."""

from __future__ import annotations

from jaxpomdp.experiments.experiment import Experiment, Published, Row
from jaxpomdp.experiments.thesis import hallway

SETTINGS = {f"θ = {theta:g}": hallway.run(theta) for theta in (0.0, 0.2, 0.4)}
TARGETS: dict[str, Published] = {
    "θ = 0": {"successes_ever": "fewer than half, in 100 trials"},
    "θ = 0.4": {"successes_ever": 21},
}
"""Section 3.5.1: with theta 0 most runs fail within 100 trials; with 0.4 all succeed, later than with 0.2."""

EXPERIMENT = Experiment(
    name="fig-3.4",
    title="Figure 3.4: the hallway, UDHMM for several θ",
    source="thesis, Figure 3.4 and section 3.5.1 (the curves' points are in no public text)",
    rows=tuple(Row(name, run, TARGETS.get(name, {})) for name, run in SETTINGS.items()),
    columns=hallway.COLUMNS,
    plot=hallway.plot,
    criterion=hallway.CRITERION,
    notes=hallway.NOTES,
)
