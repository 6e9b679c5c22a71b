"""How an agent chooses and learns values: settings, and one step of acting as pure functions.

The settings are static; what is carried is a ``Lane``: one agent in one world, lifted over seeds by ``vmap``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax.numpy as jnp

from jaxpomdp._types import Array, pytree
from jaxpomdp.kernels import control as rules

SCHEDULES = ("constant", "linear", "exponential", "cosine")
UNIFORMS_PER_CHOICE = 3
"""How many numbers one choice of action consumes: whether to explore, where to, whether to repeat."""


@dataclass(frozen=True)
class Schedule:
    """A number that changes with the count of actions taken so far.

    Raises:
        ValueError: the kind is unknown, or ``steps`` is below 1.
    """

    start: float = 0.2
    """Value at the first action."""
    end: float = 0.0
    """Value from ``steps`` actions on."""
    steps: int = 250_000
    """Actions over which it changes."""
    kind: str = "linear"
    """``constant``, ``linear``, ``exponential`` or ``cosine``."""

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        if self.kind not in SCHEDULES:
            raise ValueError(f"kind must be one of {SCHEDULES}, got {self.kind!r}")
        if self.steps < 1:
            raise ValueError(f"steps must be at least 1, got {self.steps}")
        if self.kind == "exponential" and not (self.start > 0 and self.end > 0):
            raise ValueError(
                f"an exponential schedule needs start and end above 0, got {self.start}, {self.end}"
            )

    def function(self) -> Callable[[Array], Any]:
        """Return the schedule as an optax function of the step count."""
        import optax

        if self.kind == "constant":
            return optax.constant_schedule(self.start)
        if self.kind == "linear":
            return optax.linear_schedule(self.start, self.end, self.steps)
        if self.kind == "exponential":
            rate = self.end / self.start
            return optax.exponential_decay(self.start, self.steps, rate, end_value=self.end)
        return optax.cosine_decay_schedule(self.start, self.steps, alpha=self.end / max(self.start, 1e-12))


@dataclass(frozen=True)
class ControlConfig:
    """How actions are chosen and their values learned (thesis sections 2.3 and 3.3).

    Raises:
        ValueError: a number is out of its range, or a name is unknown.
    """

    alpha: float = 0.03
    """Learning rate of SARSA(lambda)."""
    gamma: float = 0.95
    """Discount of control."""
    lam: float = 0.95
    """Lambda: decay of eligibility beside the discount."""
    rule: str = "sarsa"
    """``sarsa`` or ``q`` (Watkins: traces are cut where the agent explored)."""
    replacing: bool = False
    """Replacing instead of accumulating traces."""
    exploration: str = "epsilon"
    """``epsilon`` (greedy) or ``boltzmann``."""
    schedule: Schedule = Schedule()
    """Epsilon, or the temperature, against actions taken."""
    sticky: float = 0.0
    """Chance that an exploratory action repeats the last one: crosses long corridors."""
    optimism: float = 0.0
    """Where values start."""

    def __post_init__(self) -> None:
        """Refuse numbers and names that mean nothing."""
        for name in ("alpha", "gamma", "lam", "sticky"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if self.rule not in ("sarsa", "q"):
            raise ValueError(f"rule must be 'sarsa' or 'q', got {self.rule!r}")
        if self.exploration not in ("epsilon", "boltzmann"):
            raise ValueError(f"exploration must be 'epsilon' or 'boltzmann', got {self.exploration!r}")


GREEDY = Schedule(0.0, 0.0, 1, "constant")
"""Exploration while an agent is judged."""


def settled(control: ControlConfig) -> ControlConfig:
    """Return the settings of an agent that acts as it will in the end: greedily, and its values stay."""
    return replace(control, schedule=GREEDY, exploration="epsilon", alpha=0.0)


@pytree
class Memory:
    """What an agent remembers by while it acts: a chain in probabilities, and what its states emit.

    Attributes:
        init: ``[N]``.
        trans: ``[A, N, N]``.
        params: the model, for ``Family.log_obs``.
    """

    init: Array
    trans: Array
    params: Any


class Lane(NamedTuple):
    """One agent in the middle of a trial; a scalar unless a shape is given.

    ``q[N, A]`` and ``trace[N, A]``; ``belief[N]`` over states now and the ``action`` chosen there;
    ``steps`` counts all actions ever taken, and drives the schedule.
    """

    q: Array
    trace: Array
    belief: Array
    action: Array
    explored: Array
    steps: Array


def choose(
    config: ControlConfig, values: Array, last: Array, steps: Array, uniforms: Array
) -> tuple[Array, Array]:
    """Choose an action: ``(action, explored)`` from values ``[A]`` and three uniform numbers."""
    level = config.schedule.function()(steps)
    if config.exploration == "boltzmann":
        action = rules.boltzmann(values, level, uniforms[1])
        return action, action != rules.greedy(values)
    action = rules.epsilon_greedy(values, level, uniforms[:2])
    explored = uniforms[0] < level
    if config.sticky == 0:
        return action, explored
    return jnp.where(explored & (uniforms[2] < config.sticky) & (last >= 0), last, action), explored


def begin(config: ControlConfig, lane: Lane, belief: Array, uniforms: Array) -> Lane:
    """Begin a trial at a belief: traces are cleared and the first action is chosen."""
    values = rules.action_values(lane.q, belief)
    action, explored = choose(config, values, jnp.full((), -1, jnp.int32), lane.steps, uniforms)
    return lane._replace(trace=jnp.zeros_like(lane.trace), belief=belief, action=action, explored=explored)


def learn(
    config: ControlConfig,
    lane: Lane,
    belief: Array,
    reward: Array,
    terminated: Array,
    ended: Array,
    uniforms: Array,
    rate: Array,
) -> tuple[Lane, Array]:
    """Take in one outcome and choose the next action: SARSA(lambda) or Q(lambda) on beliefs.

    ``delta = r + gamma Q(b', a') - Q(b, a)``, with ``Q(b', .) = 0`` after a terminal step and the best value
    after a trial was cut off; then ``q := q + alpha delta e``.

    Args:
        config: the settings.
        lane: the agent before the outcome.
        belief: ``[N]`` after it.
        reward: paid for ``lane.action``.
        terminated: the world ended the trial.
        ended: the trial is over, by the world or by its limit.
        uniforms: ``[3]``.
        rate: learning rate (0 to leave ``q`` alone).

    Returns:
        The lane after it, and the best value at the new belief (0 after a terminal step).
    """
    gamma = config.gamma
    values = rules.action_values(lane.q, belief)
    best = jnp.where(terminated, 0, jnp.max(values))
    action, explored = choose(config, values, lane.action, lane.steps + 1, uniforms)
    chosen = best if config.rule == "q" else values[action]
    following = jnp.where(ended, best, chosen)
    delta = reward + gamma * following - rules.action_values(lane.q, lane.belief)[lane.action]
    keep = jnp.where(lane.explored, 0, gamma * config.lam) if config.rule == "q" else gamma * config.lam
    trace = rules.mark(lane.trace, lane.belief, lane.action, keep, replacing=config.replacing)
    q = lane.q + (rate * delta) * trace
    return Lane(q, trace, belief, action, explored, lane.steps + 1), best
