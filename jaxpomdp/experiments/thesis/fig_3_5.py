"""Figure 3.5: the hallway with and without noise, and by the coupled UDHMM."""

from __future__ import annotations

from jaxpomdp.experiments.experiment import Experiment, Row
from jaxpomdp.experiments.thesis import coupled, hallway

TARGETS = {"successes_held": 14}
"""Section 3.5.1: the coupled UDHMM fails in 7 of 21 runs."""

EXPERIMENT = Experiment(
    name="fig-3.5",
    title="Figure 3.5: the hallway, without and with noise",
    source="thesis, Figure 3.5 and section 3.5.1 (the curves' points are in no public text)",
    rows=(
        Row("standard", hallway.run(0.2)),
        Row("noise, θ = 0.1", hallway.noisy_run(0.1)),
        Row("noise, θ = 0", hallway.noisy_run(0.0)),
        Row("noise, θ = 0.2", hallway.noisy_run(0.2)),
        Row("noise, θ = 0.4", hallway.noisy_run(0.4)),
        Row("coupled, no noise", coupled.coupled_run(hallway.run(0.2), "cudhmm", "product"), TARGETS),
    ),
    columns=hallway.COLUMNS,
    plot=hallway.plot,
    criterion=hallway.CRITERION,
    notes=hallway.NOTES,
)
