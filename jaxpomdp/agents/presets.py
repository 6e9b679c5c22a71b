"""Agents by name: the thesis's settings, ours, and the references."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from jaxpomdp.agents.agent import Agent, AgentConfig
from jaxpomdp.agents.control import ControlConfig, Schedule
from jaxpomdp.agents.coupled_kind import CoupledModel
from jaxpomdp.agents.coupled_tree_kind import CoupledTreeModel
from jaxpomdp.agents.learner import LearnerConfig
from jaxpomdp.agents.settings import with_settings
from jaxpomdp.agents.tree_kind import HierarchicalModel
from jaxpomdp.envs.world import World
from jaxpomdp.structure.policy import PolicyConfig
from jaxpomdp.structure.splits import SplitConfig
from jaxpomdp.structure.tree_tests import TreeSplitConfig

UDHMM = AgentConfig(
    ControlConfig(alpha=0.03, gamma=0.95, lam=0.95, schedule=Schedule(0.2, 0.0, 250_000)),
    LearnerConfig(theta=0.0, replay_passes=2, policy=PolicyConfig(node_cap=70, edits_per_phase=1)),
)
"""The 89-state maze at its best: 25 to 70 states, a window of 200 trials, two replay passes."""

THESIS = AgentConfig(
    ControlConfig(alpha=0.01, gamma=0.95, lam=0.95, schedule=Schedule(0.2, 0.0, 350_000)),
    LearnerConfig(
        theta=0.2,
        bootstrap=False,
        window=50,
        trials_per_phase=10,
        em_iterations=1,
        replay_passes=0,
        keep_best=0,
        policy=PolicyConfig(node_cap=70, edits_per_phase=1, every=5),
    ),
)
"""As thesis section 3.5.3 says, with Loch and Singh's alpha and epsilon, and a lambda just above theirs."""

TMAZE = AgentConfig(
    ControlConfig(alpha=0.03, gamma=0.98, lam=0.98, schedule=Schedule(0.2, 0.05, 20_000), sticky=0.9),
    LearnerConfig(
        states=8,
        theta=0.2,
        return_gamma=0.999,
        return_by_action=True,
        window=100,
        trials_per_phase=5,
        em_iterations=1,
        replay_passes=1,
        gate=0.3,
        keep_best=60,
        revert_margin=0.0,
        patience=100,
        split=SplitConfig(stay=0.9),
        policy=PolicyConfig(node_cap=20, edits_per_phase=1),
    ),
)
"""The T-maze: returns by action with a discount of their own, a gate, and the best policy always restored."""

HALLWAY = AgentConfig(
    ControlConfig(alpha=0.03, gamma=0.9, lam=0.7, schedule=Schedule(0.1, 0.1, 1, "constant"), optimism=2.0),
    LearnerConfig(
        states=17,
        theta=0.2,
        return_gamma=0.9,
        return_by_action=True,
        window=100,
        trials_per_phase=5,
        em_iterations=2,
        replay_passes=3,
        gate=0.3,
        keep_best=50,
        patience=100,
        split=SplitConfig(rank="spread"),
        policy=PolicyConfig(node_cap=40, edits_per_phase=1),
    ),
)
"""The hallway: optimistic values, three replay passes, splits where returns spread most, a gate."""

NOISY_HALLWAY = AgentConfig(
    replace(HALLWAY.control, alpha=0.01, lam=0.9),
    replace(
        HALLWAY.learner,
        theta=0.1,
        window=400,
        trials_per_phase=10,
        em_iterations=1,
        gate=0.0,
        keep_best=100,
        patience=0,
    ),
)
"""The hallway with the noise of section 3.5.1: slower values, a longer memory, and no gate."""


def coupled(base: AgentConfig, *, node_cap: int, **settings: Any) -> AgentConfig:
    """Return the coupled agent (thesis 3.4) with the settings of a flat one, and fewer states of strand 0."""
    policy = replace(base.learner.policy, node_cap=node_cap)
    return replace(
        base, learner=replace(base.learner, theta=0.2, policy=policy), model=CoupledModel(**settings)
    )


CUDHMM = coupled(HALLWAY, node_cap=30, return_cap=8)
"""The coupled agent in the hallway."""

HUDHMM = AgentConfig(
    UDHMM.control,
    replace(
        UDHMM.learner,
        states=20,
        return_by_action=True,
        policy=PolicyConfig(node_cap=100, edits_per_phase=2, order="rotate"),
    ),
    HierarchicalModel(form="sober", vertical_by_action=True),
)
"""The hierarchical agent in the 89-state maze (thesis 6.4.2): 20 to 100 states, operators in turn."""

HUDHMM_TMAZE = AgentConfig(
    TMAZE.control,
    replace(
        TMAZE.learner,
        rehearsals=1,
        probation=15,
        policy=PolicyConfig(node_cap=20, edits_per_phase=1, order="rotate"),
    ),
    HierarchicalModel(
        levels=1,
        vertical_by_action=True,
        operators=("leaf", "uncle", "parent", "brother"),
        return_bins=32,
        tests=TreeSplitConfig(stay=0.9),
    ),
)
"""The hierarchical agent in the T-maze (thesis 6.4.1): one level at first, leaves also split as flat ones; it
rehearses, and keeps no policy as its best before a probation."""


def with_memory(base: AgentConfig) -> AgentConfig:
    """Return a hierarchical agent with a flat chain coupled to its tree (thesis 6.3.5)."""
    return replace(base, model=CoupledTreeModel(base.model))


LEARNERS: Mapping[str, AgentConfig] = {
    "hudhmm": HUDHMM,
    "hudhmm-coupled": with_memory(HUDHMM),
    "hudhmm-coupled-tmaze": with_memory(HUDHMM_TMAZE),
    "hudhmm-tmaze": HUDHMM_TMAZE,
    "cudhmm": CUDHMM,
    "cudhmm-mixture": coupled(HALLWAY, node_cap=30, return_cap=8, coupling="mixture", added="components"),
    "cudhmm-maze89": coupled(UDHMM, node_cap=50, return_cap=8),
    "cudhmm-tmaze": coupled(TMAZE, node_cap=20, return_cap=8),
    "udhmm": UDHMM,
    "udhmm-thesis": THESIS,
    "udhmm-tmaze": TMAZE,
    "udhmm-hallway": HALLWAY,
    "udhmm-hallway-noise": NOISY_HALLWAY,
    "pda": replace(
        UDHMM, learner=replace(UDHMM.learner, theta=0.0, policy=PolicyConfig(node_cap=70, edits_per_phase=0))
    ),
}
"""Agents that learn a model; ``pda`` is the Perceptual Distinctions Approach (Chrisman, 1992)."""


def names() -> tuple[str, ...]:
    """Return the names that :func:`make` knows."""
    return tuple(sorted(LEARNERS))


def make(name: str, world: World, settings: Mapping[str, Any]) -> Agent:
    """Return an agent by name; see ``make_agent``.

    Raises:
        ValueError: the agent or a setting is unknown.
    """
    if name not in LEARNERS:
        raise ValueError(f"agent must be one of {', '.join(names())}, got {name!r}")
    return Agent(world, with_settings(LEARNERS[name], settings))
