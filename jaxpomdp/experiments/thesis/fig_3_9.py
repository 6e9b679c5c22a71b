"""Figure 3.9: tests that reach the goal while learning, 89-state maze."""

from __future__ import annotations

from jaxpomdp.experiments.experiment import Experiment, Row
from jaxpomdp.experiments.thesis import maze89

TARGETS = {"goal_percent": 92}
"""The end of the curve as Table 3.1 gives it; the figure's own points are in no public text."""

EXPERIMENT = Experiment(
    name="fig-3.9",
    title="Figure 3.9: the 89-state maze, tests that reach the goal",
    source=maze89.SOURCE,
    rows=(
        Row("UDHMM, θ = 0.2", maze89.THETA_02, TARGETS),
        Row("UDHMM, θ = 0", maze89.THETA_0),
        Row("UDHMM at its best", maze89.BEST),
    ),
    columns={"goal_percent": "goal %", "mean_goal_percent": "goal %, mean of seeds"},
    plot=maze89.plot_goal,
)
