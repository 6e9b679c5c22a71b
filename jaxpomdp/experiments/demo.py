"""Three minutes: agents learn the 89-state maze before your eyes, then stand beside the thesis."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxpomdp.experiments.config import RunConfig, seed_range
from jaxpomdp.experiments.experiment import summarise
from jaxpomdp.experiments.plots import Line
from jaxpomdp.experiments.report import plot_runs, text_table
from jaxpomdp.experiments.results import RunData, load_run, score
from jaxpomdp.experiments.runner import Build, build, run
from jaxpomdp.experiments.stats import Interval, format_interval
from jaxpomdp.experiments.thesis.table_3_1 import TARGETS

MEMORYLESS = {"goal_percent": 91.9, "median_steps": 67}
"""The best policy without memory that a search over policies found on the true model."""


def demo_config(seeds: int, first_seed: int, trials: int) -> RunConfig:
    """Return the run of the demo."""
    return RunConfig("maze89", "udhmm", seed_range(first_seed, seeds), trials, 200, 50)


def demo(config: RunConfig, out: Path, *, progress: str = "auto", make: Build = build) -> str:
    """Run the demo in ``out``, draw ``out/figures/learning.png``, and return the table.

    A demo that was stopped goes on where it was.
    """
    run(config, out, progress=progress, make=make)
    data = load_run(out)
    lines = {"goal_percent": Line("thesis 92", 92), "median_steps": Line("thesis 62", 62)}
    title = f"UDHMM learning the 89-state maze, {len(config.seeds)} seeds"
    picture = plot_runs([out], out / "figures" / "learning.png", title, lines)
    past = "past" if is_past_memoryless(data) else "not yet past"
    verdict = f"In {data.seconds:.0f} s the median agent is {past} the best policy without memory."
    return f"\n{comparison_table(data)}\n\n{verdict}\nPicture: {picture}"


def comparison_table(data: RunData) -> str:
    """Return the thesis's Table 3.1 with what was just measured below it."""
    rows: list[tuple[str, ...]] = [("89-state maze, 251 steps at most", "goal %", "median steps")]
    rows += [
        (f"thesis: {name}", str(t["goal_percent"]), str(t["median_steps"])) for name, t in TARGETS.items()
    ]
    rows.append(("best policy without memory", *(str(x) for x in MEMORYLESS.values())))
    metrics = summarise(score(data.final))
    trials = int(data.trials["trial"][0, -1])
    here = f"here: UDHMM, {trials} trials, median of {len(data.seeds)} seeds"
    return text_table([*rows, (here, *_cells(metrics))])


def _cells(metrics: dict[str, Interval]) -> list[str]:
    return [format_interval(metrics[name]) for name in MEMORYLESS]


def is_past_memoryless(data: RunData) -> bool:
    """Say whether the median seed reaches the goal more often or sooner than any policy without memory."""
    per_seed = score(data.final)
    better = np.median(per_seed["goal_percent"]) > MEMORYLESS["goal_percent"]
    return bool(better or np.median(per_seed["median_steps"]) < MEMORYLESS["median_steps"])
