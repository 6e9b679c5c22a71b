"""The commands, each a frozen dataclass: fields are flags, the docstring is the help, ``run`` does it.

Libraries are imported when a command runs, so that help and mistakes are answered at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from jaxpomdp.experiments.config import RunConfig

Progress = Literal["auto", "lines", "none"]


@dataclass(frozen=True)
class Train:
    """Train an agent; the same command resumes a run that was stopped.

    Everything lands in the run directory: configuration, versions, rows, checkpoint, final model. Seeds learn
    together, as one batch. Kill it at any moment: the same command goes on, to exactly the same result.

    Examples:
      jaxpomdp train --env maze89 --agent udhmm --seeds 5 --trials 300 --out runs/maze
      jaxpomdp train --env tmaze-10 --agent udhmm --set theta=0.4 --trials 1500 --out runs/tmaze
      jaxpomdp train --env my.POMDP --agent memoryless --out runs/mine
    """

    out: Path
    """The run directory."""
    env: str = "maze89"
    """maze89, maze57, tiger-grid, hallway, tmaze-N, each also with -noise behind it; or a .POMDP file."""
    agent: str = "udhmm"
    """Name of the agent; a wrong one is answered with all of them."""
    seeds: int = 5
    """How many seeds learn together."""
    first_seed: int = 0
    """The first of them; the others follow."""
    trials: int = 1000
    """Training trials per seed."""
    evaluate_every: int = 250
    """Trials between greedy evaluations on the way (0: none)."""
    evaluation_trials: int = 100
    """Greedy trials per seed in each of them."""
    final_trials: int = 251
    """Greedy trials per seed of the agent as it ends."""
    set: tuple[str, ...] = ()
    """Settings of the agent, name=value ...; a wrong name is answered with all of them."""
    progress: Progress = "auto"
    """A bar on a terminal and lines elsewhere, always lines, or nothing."""
    track: bool = False
    """Write events for TensorBoard into the run directory."""

    def run(self) -> None:
        """Train, and print how the agents ended."""
        from jaxpomdp.experiments import runner
        from jaxpomdp.experiments.report import run_report

        runner.run(self.config(), self.out, progress=self.progress, track=self.track)
        print(run_report(self.out))

    def config(self) -> RunConfig:
        """Return the run that is asked for."""
        from jaxpomdp.experiments.config import RunConfig, seed_range
        from jaxpomdp.experiments.grid import parse_settings

        return RunConfig(
            self.env,
            self.agent,
            seed_range(self.first_seed, self.seeds),
            self.trials,
            self.evaluate_every,
            self.evaluation_trials,
            self.final_trials,
            parse_settings(self.set),
        )


@dataclass(frozen=True)
class Evaluate:
    """Judge a trained agent greedily, on trials it has not met.

    Examples:
      jaxpomdp evaluate runs/maze --trials 1000
    """

    directory: Path
    """The run directory."""
    trials: int = 251
    """Greedy trials per seed."""
    seed: int = 1
    """Of the trials' chance."""

    def run(self) -> None:
        """Print what each seed scores."""
        import jax
        import numpy as np

        from jaxpomdp.experiments.report import score_report
        from jaxpomdp.experiments.restore import restore

        found = restore(self.directory)
        judged = found.agent.evaluate(found.state, self.trials, jax.random.key(self.seed))
        columns = {name: np.asarray(x) for name, x in judged.items()}
        ended = "as it ended" if found.complete else "as it was at the last commit"
        print(f"{self.trials} greedy trials per seed, {ended}:")
        print(score_report(found.config.seeds, columns))


@dataclass(frozen=True)
class Play:
    """Play yourself, seeing only what the agent sees.

    The human of the thesis always reaches the goal of the 89-state maze, in 29 steps (median).

    Examples:
      jaxpomdp play                                   the 89-state maze
      jaxpomdp play --env tmaze-10 --trials 5 --out played.csv
    """

    env: str = "maze89"
    """As for train."""
    trials: int = 251
    """At most so many; q stops."""
    seed: int = 0
    """The same seed gives the same game."""
    out: Path | None = None
    """A table of the finished trials, as CSV."""

    def run(self) -> None:
        """Play, keep score and write it down."""
        from jaxpomdp.experiments.play import play, save_played, score_line
        from jaxpomdp.experiments.runner import load_world

        played = []
        for trial in play(load_world(self.env), seed=self.seed, trials=self.trials):
            played.append(trial)
            print(score_line(played))
            if self.out is not None:
                save_played(played, self.out)
        if self.out is not None and played:
            print(f"written to {self.out}")


@dataclass(frozen=True)
class Show:
    """Draw a trained agent: its belief over one trial as an animation, and its model, and a tree's growth.

    Examples:
      jaxpomdp show runs/maze            writes runs/maze/figures/belief.gif and model.png
      jaxpomdp show runs/maze --seed 3 --trial 7
    """

    directory: Path
    """The run directory."""
    seed: int | None = None
    """Which of its seeds; by default the median one."""
    trial: int = 0
    """Which of many possible trials is walked."""
    out: Path | None = None
    """Where the pictures go; by default figures/ in the run directory."""

    def run(self) -> None:
        """Draw, and print where the pictures are."""
        from jaxpomdp.experiments.show import show

        out = self.directory / "figures" if self.out is None else self.out
        for line in show(self.directory, out, seed=self.seed, trial=self.trial):
            print(line)


@dataclass(frozen=True)
class Plot:
    """Draw learning curves: the median run and the middle half of the runs, as in Figures 3.9 and 3.10.

    Runs that differ in their seeds alone become one curve.

    Examples:
      jaxpomdp plot runs/maze
      jaxpomdp plot runs/sweep --out sweep.png
    """

    directories: tuple[Path, ...]
    """Run directories, or directories that hold some."""
    out: Path = Path("learning.png")
    """The picture."""
    title: str = ""
    """Over the picture."""

    def run(self) -> None:
        """Draw, and print where the picture is."""
        from jaxpomdp.experiments.report import plot_runs

        print(plot_runs(self.directories, self.out, self.title))


@dataclass(frozen=True)
class Sweep:
    """Train every combination of environments, agents and settings, in fixed chunks of seeds; resumable.

    Examples:
      jaxpomdp sweep --env tmaze-5 tmaze-10 --agent udhmm --vary theta=0,0.2,0.4 --out runs/theta --workers 2
      jaxpomdp plot runs/theta
    """

    out: Path
    """Holds a run directory for each combination and chunk."""
    env: tuple[str, ...] = ("maze89",)
    """Environments, as for train."""
    agent: tuple[str, ...] = ("udhmm",)
    """Agents."""
    vary: tuple[str, ...] = ()
    """Settings with their values, name=value,value ...; all combinations are run."""
    set: tuple[str, ...] = ()
    """Settings that all share, name=value ..."""
    seeds: int = 21
    """Seeds of each combination."""
    first_seed: int = 0
    """The first of them."""
    chunk: int = 0
    """Seeds that learn together in one run (0: all)."""
    trials: int = 1000
    """Training trials per seed."""
    evaluate_every: int = 250
    """Trials between greedy evaluations."""
    workers: int = 1
    """Runs at a time."""
    backend: Literal["process", "ray"] = "process"
    """Workers on this machine, or on a Ray cluster."""
    progress: Progress = "auto"
    """As for train."""

    def run(self) -> None:
        """Run what is missing, and print how each combination ended."""
        from jaxpomdp.experiments.config import RunConfig, seed_range
        from jaxpomdp.experiments.grid import grid, parse_settings
        from jaxpomdp.experiments.report import sweep_report
        from jaxpomdp.experiments.sweep import plan, run_jobs

        seeds, shared = seed_range(self.first_seed, self.seeds), parse_settings(self.set)
        base = RunConfig(seeds=seeds, trials=self.trials, evaluate_every=self.evaluate_every, settings=shared)
        configs = grid(base, self.env, self.agent, self.vary)
        jobs = [job for row in plan(configs, self.out, chunk=self.chunk) for job in row]
        run_jobs(jobs, workers=self.workers, backend=self.backend, progress=self.progress)
        print(sweep_report([job.path for job in jobs]))


@dataclass(frozen=True)
class Reproduce:
    """Run a table or figure of the thesis with 21 seeds, and write it beside what was published.

    Each writes NAME.json, NAME.csv, NAME.md and NAME.png. Stopped, the same command goes on where it was.

    Examples:
      jaxpomdp reproduce table-3.1
      jaxpomdp reproduce fig-3.4 fig-3.5 --workers 2
      jaxpomdp reproduce all --quick --out quick --work quick/runs   a smoke test
    """

    names: tuple[str, ...]
    """table-3.1, table-6.1, fig-3.4, fig-3.5, fig-3.7, fig-3.9, fig-3.10, fig-6.7, ablation-operators,
    coupled, coupled-hierarchy, one-theta, or all."""
    seeds: int = 21
    """Runs of each row."""
    first_seed: int = 1000
    """Their seeds count up from here; settings were chosen on other seeds."""
    trials: int | None = None
    """Training trials of every row that trains; by default each row's own."""
    quick: bool = False
    """A smoke test of few seeds and trials; its figures mean nothing."""
    workers: int = 1
    """Runs at a time, each in its own process."""
    chunk: int = 0
    """Seeds that learn together in one run (0: all)."""
    out: Path = Path("benchmarks/results")
    """Where results are written."""
    work: Path = Path("benchmarks/runs")
    """Where run directories lie."""
    progress: Progress = "auto"
    """As for train."""

    def run(self) -> None:
        """Reproduce each name in turn, and print the tables."""
        from jaxpomdp.experiments import thesis
        from jaxpomdp.experiments.reproduce import Effort, markdown_table, reproduce

        known = thesis.experiments()
        if not self.names:
            raise ValueError(f"names must be given, among {', '.join(known)}, or all")
        chosen = known.values() if "all" in self.names else [thesis.find(name) for name in self.names]
        settings = {name: getattr(self, name) for name in Effort.__dataclass_fields__}
        for experiment in chosen:
            result = reproduce(experiment, Effort(**settings), command=self._command(experiment.name))
            table = markdown_table(experiment, result)
            print(f"\n{experiment.title}\n\n{table}\n\n{self.out / experiment.name}.*")

    def _command(self, name: str) -> str:
        words = ["jaxpomdp reproduce", name]
        for field in ("seeds", "first_seed", "trials", "chunk"):
            value = getattr(self, field)
            if value != getattr(Reproduce, field):
                words.append(f"--{field.replace('_', '-')} {value}")
        return " ".join([*words, *(["--quick"] if self.quick else [])])


@dataclass(frozen=True)
class Demo:
    """Under three minutes: agents learn the 89-state maze, then a table against the thesis and a picture.

    Examples:
      jaxpomdp demo
    """

    out: Path = Path("demo")
    """Where everything lands."""
    seeds: int = 5
    """How many agents learn."""
    first_seed: int = 1000
    """The first of their seeds."""
    trials: int = 1500
    """Training trials of each."""
    progress: Progress = "auto"
    """As for train."""

    def run(self) -> None:
        """Learn, compare, draw."""
        from jaxpomdp.experiments.demo import demo, demo_config

        config = demo_config(self.seeds, self.first_seed, self.trials)
        print(demo(config, self.out, progress=self.progress))


COMMANDS = {
    "train": Train,
    "evaluate": Evaluate,
    "play": Play,
    "show": Show,
    "plot": Plot,
    "sweep": Sweep,
    "reproduce": Reproduce,
    "demo": Demo,
}
