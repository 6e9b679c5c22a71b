"""The agent: the online phase, the offline phase, and what is carried between them.

``make_agent`` builds one by name; ``run`` does one round of trials and learning for all seeds at once.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp import packing
from jaxpomdp._types import Array
from jaxpomdp.agents import best as keeping
from jaxpomdp.agents import experience, learner
from jaxpomdp.agents.best import Best
from jaxpomdp.agents.clock import Clock
from jaxpomdp.agents.control import ControlConfig, settled
from jaxpomdp.agents.experience import Experience, Trials
from jaxpomdp.agents.kinds import FlatModel, Room, Sizes, roomier, started
from jaxpomdp.agents.learner import LearnerConfig
from jaxpomdp.agents.outcomes import summarise
from jaxpomdp.agents.trial import Actor, run_trials
from jaxpomdp.envs.world import World
from jaxpomdp.structure.policy import revise


@dataclass(frozen=True)
class AgentConfig:
    """All settings of an agent; ``learner`` None means that its model stays as it is given."""

    control: ControlConfig = field(default_factory=ControlConfig)
    """How actions are chosen and valued."""
    learner: LearnerConfig | None = field(default_factory=LearnerConfig)
    """How the model is learned."""
    model: Any = field(default_factory=FlatModel)
    """What kind of model it is, with the settings of that kind."""


class AgentState(NamedTuple):
    """Everything an agent carries, with leading axis ``S``; a pytree of arrays, so it can be stored.

    ``rest[S, N]`` counts the phases for which a state is not split again; ``recent[S, K]`` holds the
    discounted reward of the latest trials, newest last (NaN where there was none).
    """

    params: Any
    actor: Actor
    experience: Experience
    rest: np.ndarray
    recent: np.ndarray
    best: Best


class Agent:
    """An agent in a tabular world: many seeds at once, each with a model, values and chance of its own.

    Args:
        world: where it acts.
        config: its settings; ``config.model`` says which kind of model.
        fixed: ``(seeds) -> (params, q)`` with leading ``S``: a model that is given, and where values start;
            by default the model is learned from nothing.

    Raises:
        ValueError: neither a learner nor a model is given.
    """

    def __init__(self, world: World, config: AgentConfig, fixed: Any = None) -> None:
        if config.learner is None and fixed is None:
            raise ValueError("config.learner must be given where no fixed model is, got None")
        self.world, self.config, self.fixed = world, config, fixed
        self.kind = config.model.kind()
        self.family = self.kind.family
        self.log: list[dict[str, Any]] = []
        """A row for every structure edit made by this object."""

    def init(self, seeds: Any) -> AgentState:
        """Return the state before the first trial.

        Args:
            seeds: ints ``[S]``; equal seeds give equal runs in equal company.
        """
        seeds = np.asarray(seeds, np.int64)
        params, q = self._start(seeds)
        keys = jax.vmap(lambda seed: jax.random.key_data(jax.random.key(seed)))(
            jnp.asarray(seeds, jnp.uint32)
        )
        zero = jnp.zeros(len(seeds), jnp.int32)
        window = self.config.learner.window if self.config.learner else 1
        store = experience.no_experience(len(seeds), window, (np.int32(0),))
        kept = (self.config.learner.keep_best if self.config.learner else 0) or 1
        return AgentState(
            params,
            Actor(keys, q, zero, zero),
            store,
            np.zeros(params.alive.shape, np.int64),
            np.full((len(seeds), kept), np.nan),
            keeping.none_yet(params, q, self.config.learner.probation if self.config.learner else 0),
        )

    def _start(self, seeds: np.ndarray, least: Room | None = None) -> tuple[Any, Array]:
        if self.fixed is not None:
            return self.fixed(seeds)
        sizes = Sizes(self.world.num_actions, self.world.num_observations)
        params = started(self.kind, seeds, sizes, self.config.learner, least=least)
        shape = (*params.alive.shape, self.world.num_actions)
        return params, jnp.full(shape, self.config.control.optimism, jnp.float32)

    def run(self, state: AgentState) -> tuple[AgentState, dict[str, np.ndarray]]:
        """Do one round: a phase of trials, then what is learned from them.

        Returns:
            The new state, and rows: ``steps``, ``reward``, ``discounted``, ``success``, ``[S, trials]`` each;
            per seed ``states``, ``log_evidence``, ``epsilon`` and seconds spent ``acting``, ``fitting``,
            ``structure``, ``replaying`` (the same for all seeds).
        """
        clock = Clock()
        actor, new = self._act(state)
        rows = summarise(new, self.world)
        clock.lap("acting")
        state = self._noted(state._replace(actor=actor), rows["discounted"])
        state = self._judge(state, rows["discounted"].shape[1])
        evidence = np.zeros(len(state.recent))
        if self.config.learner:
            state = state._replace(experience=experience.remember(state.experience, new))
            state, evidence = self._learn(state, clock)
        return state, rows | self._phase_rows(state, evidence, clock)

    def _act(self, state: AgentState) -> tuple[Actor, list[Trials]]:
        """Run the trials of a phase: those that explore, then the rehearsals if there are any."""
        settings, control = self.config.learner, self.config.control
        rehearsals = settings.rehearsals if settings else 0
        trials = (settings.trials_per_phase if settings else 50) - rehearsals
        actor, new = self._trials(state.params, state.actor, control, trials)
        if rehearsals:
            actor, last = self._trials(state.params, actor, settled(control), rehearsals)
            new = list(map(experience.chained, new, last))
        return actor, new

    def _trials(
        self, params: Any, actor: Actor, control: ControlConfig, trials: int
    ) -> tuple[Actor, list[Trials]]:
        """Run trials of all seeds under some control settings."""
        actor, log, count = run_trials(self.family, control, self.world, params, actor, trials=trials)
        return actor, experience.split_log(log, int(count))

    def _phase_rows(self, state: AgentState, evidence: np.ndarray, clock: Clock) -> dict[str, np.ndarray]:
        level = self.config.control.schedule.function()(state.actor.steps)
        seconds = {name: np.full(len(evidence), spent) for name, spent in clock.spent.items()}
        return {
            "states": np.asarray(jnp.sum(state.params.alive, axis=-1)),
            "log_evidence": evidence,
            "epsilon": np.broadcast_to(np.asarray(level), evidence.shape),
        } | seconds

    def _noted(self, state: AgentState, discounted: np.ndarray) -> AgentState:
        """Note how the latest trials went."""
        width = state.recent.shape[1]
        return state._replace(recent=np.concatenate([state.recent, discounted], axis=1)[:, -width:])

    def _judge(self, state: AgentState, trials: int) -> AgentState:
        """Keep a copy of the policy that did best on average, ``trials`` after it was judged last."""
        settings = self.config.learner
        if not (settings and settings.keep_best):
            return state
        now = (state.params, state.actor.q)
        best = keeping.judged(state.best, state.recent, *now, trials, settings.probation)
        return state._replace(best=best)

    def _learn(self, state: AgentState, clock: Clock) -> tuple[AgentState, np.ndarray]:
        settings = self.config.learner
        tapes = experience.tapes_of(state.experience)
        batch = jax.device_put(tapes.batch)
        options = {"gamma": settings.return_gamma, "bootstrap": settings.bootstrap}
        batch = learner.with_returns(batch, jnp.asarray(tapes.tail), **options)
        held = self._held(state)
        refit = partial(learner.refit, self.family, config=learner.em_config(settings))
        state = self._restarted(state, held)
        params, evidence = state.params, np.zeros(len(held))
        if settings.em_iterations and not held.all():
            params, found = refit(params, batch, jnp.asarray(held), iterations=settings.em_iterations)
            evidence = np.asarray(found)
        clock.lap("fitting")
        edits = len(self.log)
        state, grew = self._split(state._replace(params=params), batch, tapes.trial, held)
        clock.lap("structure")
        if grew.any() and settings.split_iterations:
            params, found = refit(
                state.params, batch, jnp.asarray(~grew), iterations=settings.split_iterations
            )
            state = state._replace(params=params)
            _note_evidence(self.log[edits:], evidence, np.asarray(found))
        clock.lap("fitting", after=state.params)
        return self._replay(state, batch, clock), evidence

    def _restarted(self, state: AgentState, held: np.ndarray) -> AgentState:
        """Where the best policy is old go back to it, or, where it is no better than now, begin again."""
        patience, best = self.config.learner.patience, state.best
        age = np.where(held, 0, best.age)
        stale = (age >= patience) & bool(patience)
        if not stale.any():
            return state._replace(best=best._replace(age=age))
        lost = keeping.clearly_worse(best, state.recent, keeping.SURE)
        again = zip(np.asarray(state.actor.keys[:, -1]), np.asarray(state.actor.trials), strict=True)
        seeds = np.array([np.random.SeedSequence(pair).generate_state(1)[0] for pair in again])
        fresh = self._start(seeds, self.kind.room_of(state.params))
        onward = keeping.select(lost, (best.params, best.q), fresh)
        params, q = keeping.select(stale, onward, (state.params, state.actor.q))
        return state._replace(
            params=params,
            actor=replace(state.actor, q=q),
            rest=np.where(stale[:, None], 0, state.rest),
            recent=np.where(stale[:, None], np.nan, state.recent),
            best=keeping.waiting_anew(best, stale, params, q)._replace(age=np.where(stale, 0, age)),
        )

    def _held(self, state: AgentState) -> np.ndarray:
        """Say which seeds do too well to touch their model: ``std / |mean|`` of start returns is low."""
        settings = self.config.learner
        if not settings.gate:
            return np.zeros(len(state.recent), bool)
        latest = experience.start_returns(
            state.experience, settings.return_gamma, latest=settings.gate_trials
        )
        return np.array([len(r) > 1 and r.mean() > 0 and r.std() < settings.gate * r.mean() for r in latest])

    def _split(
        self, state: AgentState, batch: Any, trial: np.ndarray, held: np.ndarray
    ) -> tuple[AgentState, np.ndarray]:
        settings = self.config.learner
        policy = settings.policy
        phase = int(np.max(np.asarray(state.actor.trials))) // settings.trials_per_phase - 1
        due = phase >= policy.first_phase and (phase - policy.first_phase) % policy.every == 0
        skipped = held | (np.asarray(state.params.alive).sum(-1) >= policy.node_cap)
        if not due or not policy.edits_per_phase or skipped.all():
            return state, np.zeros(len(held), bool)
        batch = learner.hidden(batch, jnp.asarray(skipped))
        arrays = jax.device_get(self.kind.gather(state.params, batch, jnp.asarray(trial), settings))
        specs, origins, rests = self.kind.unpack(state.params), [], []
        for s, spec in enumerate(specs):
            rest = state.rest[s, : spec.num_states]
            if skipped[s]:
                origins.append(np.arange(spec.num_states))
                rests.append(rest)
                continue
            rng = np.random.default_rng((int(np.asarray(state.actor.keys)[s, -1]), phase))
            revision = revise(
                spec,
                self.kind.evidence(arrays, s, spec),
                phase=phase,
                rest=rest,
                policy=policy,
                operators=self.kind.operators(settings),
                rng=rng,
            )
            specs[s] = revision.spec
            origins.append(revision.origin)
            rests.append(revision.rest)
            self.log += [{"seed_index": s} | row for row in revision.rows]
        return self._repacked(state, specs, origins, rests)

    def _repacked(
        self, state: AgentState, specs: list[Any], origins: list[np.ndarray], rests: list[np.ndarray]
    ) -> tuple[AgentState, np.ndarray]:
        before = np.asarray(jnp.sum(state.params.alive, axis=-1))
        grew = np.array([len(origin) for origin in origins]) > before
        if not grew.any():
            return state, grew
        room = roomier(self.kind.room(self.config.learner, specs), self.kind.room_of(state.params))
        params = self.kind.pack(specs, room)
        q = packing.carry(state.actor.q, origins, room[0])
        rest = np.zeros((len(rests), room[0]), np.int64)
        for row, kept in zip(rest, rests, strict=True):
            row[: len(kept)] = kept
        kept = self._with_room(state.best.params, state.best.q, room)
        waiting = state.best.waiting and self._with_room(*state.best.waiting, room)
        best = state.best._replace(params=kept[0], q=kept[1], waiting=waiting)
        return state._replace(params=params, actor=replace(state.actor, q=q), rest=rest, best=best), grew

    def _with_room(self, params: Any, q: Array, room: Room) -> tuple[Any, Array]:
        """Return models and values with room for more states."""
        if room == self.kind.room_of(params):
            return params, q
        specs = self.kind.unpack(params)
        same = [np.arange(spec.num_states) for spec in specs]
        return self.kind.pack(specs, room), packing.carry(q, same, room[0])

    def _replay(self, state: AgentState, batch: Any, clock: Clock) -> AgentState:
        settings, control = self.config.learner, self.config.control
        if not settings.replay_passes:
            return state
        lam = control.lam if settings.replay_lam is None else settings.replay_lam
        q = learner.replay(
            self.family, state.params, batch, state.actor.q, control, settings.replay_passes, lam
        )
        clock.lap("replaying", after=q)
        return state._replace(actor=replace(state.actor, q=q))

    def evaluate(self, state: AgentState, trials: int, key: Array) -> dict[str, np.ndarray]:
        """Act greedily, not learning: ``steps``, ``reward``, ``discounted`` and ``success`` ``[S, trials]``.

        Args:
            state: the agent.
            trials: for each seed.
            key: of the chance in these trials, the same for any ``state``.
        """
        of_seed = jax.vmap(lambda seed: jax.random.key_data(jax.random.fold_in(key, seed)))
        keys = of_seed(jnp.asarray(state.actor.keys)[:, -1])
        zero = jnp.zeros(len(keys), jnp.int32)
        actor = Actor(keys, state.actor.q, zero, zero)
        _, new = self._trials(state.params, actor, settled(self.config.control), trials)
        return summarise(new, self.world)

    def finish(self, state: AgentState) -> AgentState:
        """Return the agent as it ends: where an earlier policy is to be preferred, that one."""
        settings = self.config.learner
        if not (settings and settings.keep_best):
            return state
        back = keeping.given_up(state.best, state.recent, settings.revert_margin)
        kept = (state.best.params, state.best.q)
        params, q = keeping.select(back, kept, (state.params, state.actor.q))
        return state._replace(params=params, actor=replace(state.actor, q=q))


def _note_evidence(edits: list[dict[str, Any]], before: np.ndarray, after: np.ndarray) -> None:
    """Add to each edit's row the log-evidence of its seed's window before the phase's edits and after."""
    for row in edits:
        s = row["seed_index"]
        row |= {"log_evidence_before": float(before[s]), "log_evidence_after": float(after[s])}


def make_agent(name: str, world: World, **settings: Any) -> Agent:
    """Return an agent by name, with some settings changed.

    Args:
        name: one of ``agents.presets.names()``.
        world: where it will act.
        **settings: by name, such as ``theta=0.2`` or ``**{"learner.split.stay": 0.9}``.

    Raises:
        ValueError: the agent or a setting is unknown.
    """
    from jaxpomdp.agents import presets

    return presets.make(name, world, settings)
