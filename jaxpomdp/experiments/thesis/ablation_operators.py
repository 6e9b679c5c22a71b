"""Section 6.3: what each operator is worth, from a diverse first tree and from a sober one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from jaxpomdp.agents.tree_kind import HMO
from jaxpomdp.experiments.config import RunConfig
from jaxpomdp.experiments.experiment import Experiment, Row
from jaxpomdp.experiments.thesis import fig_6_7, maze89
from jaxpomdp.experiments.thesis.worlds import COLUMNS, picture_of


def _without(name: str) -> tuple[str, ...]:
    return tuple(operator for operator in HMO if operator != name)


SOBER = {"form": "sober"}
DIVERSE = {"form": "diverse", "operators": HMO}
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "all operators": DIVERSE,
    **{f"without {name} split": DIVERSE | {"operators": _without(name)} for name in HMO},
    "no operator": DIVERSE | {"edits_per_phase": 0},
    "sober tree": DIVERSE | SOBER,
    "sober tree, without parent split": DIVERSE | SOBER | {"operators": _without("parent")},
}
"""Settings of the hierarchical agent; the first tree is diverse where not said otherwise."""

UNAIDED = {"rehearsals": 0, "probation": 0}
"""What is to be compared is structure: policies are judged as those of the flat agent are."""

WORLDS = {
    "T-maze, N = 10": (
        replace(fig_6_7.run(10, "hudhmm-tmaze", **fig_6_7.AS_THE_THESIS, **UNAIDED), trials=1000),
        "udhmm-tmaze",
        fig_6_7.EXPERIMENT.criterion,
        60,
    ),
    "89-state maze": (maze89.run("hudhmm", 1000, theta=0.0), "udhmm", maze89.CRITERION, 100),
}
"""A run of the hierarchical agent, the flat agent for that world, what a success is, and states at most."""
FLAT = "flat, as many states"


def _rows(world: str) -> list[Row]:
    base, agent, criterion, most = WORLDS[world]
    runs = {
        name: replace(base, settings=tuple((dict(base.settings) | dict(settings)).items()))
        for name, settings in VARIANTS.items()
    }
    runs[FLAT] = flat_control(base, agent, most)
    return [Row(f"{world}, {name}", run, criterion=criterion) for name, run in runs.items()]


def flat_control(base: RunConfig, agent: str, most: int) -> RunConfig:
    """Return the run of a flat agent that may grow to as many states, as fast, with the same theta."""
    same = {"states": 20, "node_cap": most, "edits_per_phase": 2}
    shared = {name: value for name, value in base.settings if name in ("theta", "every")}
    return replace(base, agent=agent, settings=tuple((same | shared).items()))


EXPERIMENT = Experiment(
    name="ablation-operators",
    title="The Hierarchical Model Operators, one left out at a time",
    source="thesis, section 6.3, in words",
    rows=tuple(row for world in WORLDS for row in _rows(world)),
    columns=COLUMNS,
    plot=picture_of((*VARIANTS, FLAT), tuple(WORLDS)),
    notes=(
        "The thesis says that results are poor without the observation, brother or uncle split, and that the "
        "parent split helps only from a sober tree. No agent here has rehearsals or a probation, so runs may "
        "be lost in the T-maze that hold in Figure 6.7. A run holds when its last two greedy evaluations "
        "reach the right arm in 95 % of trials (T-maze), or the goal in 92 % (maze, after 1,000 trials)."
    ),
)
