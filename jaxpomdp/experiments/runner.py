"""One run, from configuration to directory: train by phases, judge greedily on the way and at the end."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxpomdp.experiments.config import EVALUATION_SEED, RunConfig, describe, did_you_mean
from jaxpomdp.experiments.progress import Progress
from jaxpomdp.experiments.record import RunDirectory, changed_versions, open_run
from jaxpomdp.experiments.results import (
    edit_row,
    evaluation_rows,
    judged_edits,
    load_run,
    phase_rows,
    score,
    trial_rows,
)
from jaxpomdp.experiments.stopwatch import Stopwatch
from jaxpomdp.experiments.track import Tracker

if TYPE_CHECKING:
    from jaxpomdp.envs.world import World

Build = Callable[[RunConfig], tuple[Any, Any]]
SAVE_SECONDS = 15.0
RECENT_TRIALS = 100
FINAL = 1 << 30


def load_world(name: str) -> World:
    """Return the world of a name, or of a .POMDP or .pomdpx file.

    Raises:
        ValueError: the name is unknown, or the file is refused.
        FileNotFoundError: there is no such file.
    """
    from jaxpomdp.envs import registry

    try:
        return registry.make(name)
    except ValueError as error:
        raise ValueError(f"env: {error}{did_you_mean(name, registry.names())}") from None


def build(config: RunConfig) -> tuple[Any, Any]:
    """Return the world and the agent of a configuration.

    Raises:
        ValueError: the environment, the agent or a setting is unknown.
    """
    world = load_world(config.env)
    return world, named_agent(config.agent, world, dict(config.settings))


def named_agent(name: str, world: World, settings: Mapping[str, Any]) -> Any:
    """Return an agent or a reference by name.

    Raises:
        ValueError: the name or a setting is unknown.
    """
    from jaxpomdp.agents import baselines, presets

    if name in baselines.names():
        return baselines.make(name, world, settings)
    if name in presets.names():
        return presets.make(name, world, settings)
    known = sorted({*presets.names(), *baselines.names()})
    raise ValueError(f"agent must be one of {', '.join(known)}, got {name!r}{did_you_mean(name, known)}")


def run(
    config: RunConfig,
    path: Path,
    *,
    make: Build = build,
    progress: str = "auto",
    save_seconds: float = SAVE_SECONDS,
    track: bool = False,
) -> Path:
    """Do a run, or the rest of it, in ``path``; a finished run is left as it is.

    Args:
        config: what to run.
        path: the run directory.
        make: gives world and agent of a configuration.
        progress: ``"auto"``, ``"lines"`` or ``"none"``.
        save_seconds: time between commits; a kill loses what was done since the last one.
        track: write events for TensorBoard under ``path/events``.

    Returns:
        ``path``.

    Raises:
        RunDirectoryError: the directory holds another run, is damaged, or is in use.
    """
    _, agent = make(config)
    settings = (f"{name}={value}" for name, value in config.settings)
    bar = Progress(" ".join([config.env, config.agent, *settings]), config.trials, progress)
    with open_run(path, describe(config, agent)) as record, bar:
        if (path / "summary.json").exists():
            bar.say(f"{path} is complete")
        else:
            session = _Session(config, agent, record, bar, save_seconds)
            session.tracker = Tracker(path / "events" if track else None)
            with session.watch.counting_compilation():
                session.complete()
    return path


class _Session:
    """A run in one process: the agent's state, how far it is, and the rows since the last commit."""

    def __init__(
        self, config: RunConfig, agent: Any, record: RunDirectory, bar: Progress, save_seconds: float
    ) -> None:
        self.config, self.agent, self.record = config, agent, record
        self.bar, self.tracker, self.save_seconds = bar, Tracker(None), save_seconds
        self.pending: dict[str, list] = {}
        self.recent: deque = deque(maxlen=RECENT_TRIALS)
        fresh = agent.init(np.asarray(config.seeds))
        found = record.restore(fresh)
        self.state, progress = found or (fresh, {"trial": 0, "spent": {}})
        self.trial: int = progress["trial"]
        self.watch = Stopwatch(progress["spent"])
        self.edits = 0
        self.greedy = ""
        self.saved = time.monotonic()
        if record.resumed:
            self._say_where_it_goes_on()

    def _say_where_it_goes_on(self) -> None:
        self.bar.say(f"resuming {self.record.path} at trial {self.trial} of {self.config.trials}")
        changed = changed_versions(self.record.path)
        if changed:
            self.bar.say(f"note: results may differ in the last bits, versions changed: {'; '.join(changed)}")

    def complete(self) -> None:
        """Train to the last trial, judge the agent as it ends, and write what came of it."""
        while self.trial < self.config.trials:
            self._phase()
        self._commit()
        self._finish()
        self.tracker.close()

    def _phase(self) -> None:
        before = self.trial
        state, rows = self.agent.run(self.state)
        trials, phase = _split(rows)
        after = before + trials["steps"].shape[1]
        due = _due(before, after, self.config.evaluate_every)
        ending = self.agent.finish(state) if due else None
        judged = self._judge(ending, after, self.config.evaluation_trials) if due else None
        self.state, self.trial = state, after
        self._note(before, trials, phase)
        if judged is not None:
            self._add("evaluations", evaluation_rows(self.config.seeds, after, judged))
            self.tracker.write("greedy", after, score(judged))
            self.greedy = f"; greedy {np.median(score(judged)['goal_percent']):.0f} %"
        self.bar.update(min(after, self.config.trials), self._live())
        if time.monotonic() - self.saved >= self.save_seconds:
            self._commit()

    def _judge(self, state: Any, trial: int, count: int) -> Mapping[str, np.ndarray]:
        key = jax.random.fold_in(jax.random.key(EVALUATION_SEED), trial)
        with self.watch.measuring("evaluating"):
            return {name: np.asarray(x) for name, x in self.agent.evaluate(state, count, key).items()}

    def _note(self, before: int, trials: Mapping[str, np.ndarray], phase: Mapping[str, np.ndarray]) -> None:
        self.tracker.write("training", self.trial, {**trials, **phase})
        self.recent.extend(np.asarray(trials["success"]).T)
        self._add("trials", trial_rows(self.config.seeds, before, trials))
        self._add("phases", phase_rows(self.config.seeds, self.trial, phase))
        self.watch.add_phase(phase)
        log = getattr(self.agent, "log", [])
        self._add("edits", [edit_row(self.config.seeds, self.trial, edit) for edit in log[self.edits :]])
        self.edits = len(log)

    def _live(self) -> str:
        percent = 100 * float(np.median(np.mean(np.stack(self.recent), axis=0)))
        return f"goal {percent:.0f} % in the last {len(self.recent)} trials{self.greedy} (median seed)"

    def _add(self, table: str, rows: list) -> None:
        self.pending.setdefault(table, []).extend(rows)

    def _commit(self) -> None:
        pending, self.pending = self.pending, {}
        self.record.commit(self.state, {"trial": self.trial, "spent": self.watch.total()}, pending)
        self.saved = time.monotonic()

    def _finish(self) -> None:
        final = self.agent.finish(self.state)
        judged = self._judge(final, FINAL, self.config.final_trials)
        summary = {"seeds": list(self.config.seeds), "trials": self.trial}
        summary |= {name: [float(x) for x in values] for name, values in score(judged).items()}
        rows = trial_rows(self.config.seeds, 0, judged)
        edits = judged_edits(load_run(self.record.path))
        self.record.finish(final, rows, summary | {"seconds": self.watch.total()}, edits)


def _due(before: int, after: int, every: int) -> bool:
    return bool(every) and before // every < after // every


def _split(rows: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return the columns with a value per trial ``[S, trials]``, and those with one per phase ``[S]``."""
    arrays = {name: np.asarray(x) for name, x in rows.items()}
    trials = {name: x for name, x in arrays.items() if x.ndim == 2}
    return trials, {name: x for name, x in arrays.items() if x.ndim == 1}
