"""A person plays, and sees only what an agent sees: observations in words, and what was paid."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxpomdp.envs.host import HostWorld
from jaxpomdp.envs.text import describe_observation
from jaxpomdp.envs.world import UNIFORMS_PER_RESET, UNIFORMS_PER_STEP, World
from jaxpomdp.experiments.record import FINAL_COLUMNS, table_text, write_atomically

Ask = Callable[[str], str]
Say = Callable[[str], None]


class Played(NamedTuple):
    """One finished trial, with the columns of a table of trials."""

    seed: int
    trial: int
    steps: int
    reward: float
    discounted: float
    success: bool


class _QuitError(Exception):
    """The person has had enough."""


def play(world: World, *, seed: int, trials: int, ask: Ask = input, say: Say = print) -> Iterator[Played]:
    """Let a person play, trial by trial, until they quit or their input ends; yields each finished trial.

    Args:
        world: nothing of it is shown but the names of its actions and the current observation.
        seed: chance depends on it, the trial and the step, so a game can be played again.
        trials: at most so many.
        ask: shows a prompt and returns a line.
        say: shows a line.
    """
    say(_rules(world))
    host = HostWorld(world)
    for trial in range(1, trials + 1):
        say(f"\nTrial {trial}.")
        try:
            played = _trial(host, seed, trial, ask, say)
        except (_QuitError, EOFError):
            say("Stopped; the trial that was begun does not count.")
            return
        yield played


def _rules(world: World) -> str:
    actions = "   ".join(f"{i} {name}" for i, name in enumerate(world.action_names))
    return (
        f"You are in {world.name}. You see only what the agent sees.\n"
        f"Actions: {actions}   (a number, or a name or its beginning; q to stop)\n"
        f"A trial ends at the goal, or after {world.step_limit} actions."
    )


def _draw(seed: int, trial: int, step: int, count: int) -> np.ndarray:
    return np.random.default_rng((seed, trial, step)).random(count)


def _trial(host: HostWorld, seed: int, trial: int, ask: Ask, say: Say) -> Played:
    world = host.world
    state, observation = host.reset(_draw(seed, trial, 0, UNIFORMS_PER_RESET))
    total = discounted = 0.0
    for step in range(1, world.step_limit + 1):
        action = _choose(world, f"{step:3d}  {describe_observation(world, observation)} > ", ask, say)
        state, observation, reward, over = host.step(
            state, action, _draw(seed, trial, step, UNIFORMS_PER_STEP)
        )
        total, discounted = total + reward, discounted + world.discount ** (step - 1) * reward
        if reward:
            say(f"     reward {reward:g}")
        if over:
            success = reward > world.success_above
            say(f"     {describe_observation(world, observation)}, after {step} actions.")
            return Played(seed, trial, step, total, discounted, success)
    say(f"     no goal in {world.step_limit} actions.")
    return Played(seed, trial, world.step_limit, total, discounted, False)


def _choose(world: World, prompt: str, ask: Ask, say: Say) -> int:
    while True:
        text = ask(prompt).strip().lower()
        if text in ("q", "quit"):
            raise _QuitError
        found = matching_actions(world.action_names, text)
        if len(found) == 1:
            return found[0]
        names = world.action_names if not found else [world.action_names[i] for i in found]
        say(f"     {'which one' if found else 'no such action'}: {', '.join(names)}?")


def matching_actions(names: tuple[str, ...], text: str) -> list[int]:
    """Return the actions that a text may mean: by number, by name, or by how the name begins.

    >>> matching_actions(("no-op", "forward", "turn right"), "f"), matching_actions(("up", "down"), "1")
    ([1], [1])
    """
    if text.isdigit():
        return [int(text)] if int(text) < len(names) else []
    if text in names:
        return [names.index(text)]
    return [i for i, name in enumerate(names) if text and name.startswith(text)]


def score_line(played: list[Played]) -> str:
    """Return the score so far in a line."""
    goals = sum(trial.success for trial in played)
    median = float(np.median([trial.steps for trial in played]))
    count = f"{len(played)} trial{'s' if len(played) > 1 else ''}"
    return f"{count}: goal {100 * goals / len(played):.0f} %, median {median:g} steps"


def save_played(played: list[Played], path: Path) -> Path:
    """Write the finished trials as a table of trials."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, table_text([FINAL_COLUMNS, *played]).encode())
    return path
