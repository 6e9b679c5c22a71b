"""A trained agent in two pictures: its belief over one trial, and the model it has learned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp.agents.trial import first_belief, memory_of, next_belief
from jaxpomdp.experiments.drawing import ModelGraph, belief_animation, model_graph
from jaxpomdp.experiments.record import RunDirectoryError
from jaxpomdp.experiments.restore import restore
from jaxpomdp.experiments.results import load_run, score
from jaxpomdp.experiments.runner import Build, build
from jaxpomdp.experiments.stats import median_run
from jaxpomdp.experiments.walk import Mind, meaning, walk
from jaxpomdp.models.family import Family

WALKS = 60
"""Trials from which it is learned what each state of the model stands for."""
CHANCE = 7


def show(path: Path, out: Path, *, seed: int | None = None, trial: int = 0, make: Build = build) -> list[str]:
    """Draw ``belief.gif`` and ``model.png`` for one seed of a run, and return what to tell about them.

    Args:
        path: the run directory.
        out: where the pictures go.
        seed: which seed; by default the median one, or the first of a run that is not complete.
        trial: which trial is walked.
        make: gives world and agent of a configuration.

    Raises:
        RunDirectoryError: the run has no such seed, or its agent has no model to draw.
    """
    found = restore(path, make)
    index = _index(path, found.config.seeds, seed, found.complete)
    family, params, q = learned(found.agent, found.state, index)
    mind = mind_of(family, params, q)
    walks = [walk(found.world, mind, CHANCE, k) for k in range(WALKS)]
    chosen = walk(found.world, mind, CHANCE, trial)
    heat = chosen.beliefs @ meaning(found.world, walks)
    name = f"{found.config.env}, {found.config.agent}, seed {found.config.seeds[index]}"
    occupancy = np.concatenate([w.beliefs for w in walks]).mean(axis=0)
    graph = graph_of(family, params, q, occupancy, found.world.num_observations)
    ended = "reaches the goal" if chosen.rewards[-1] > found.world.success_above else "ends"
    return [
        f"{belief_animation(found.world, chosen, heat, out / 'belief.gif')}: {name}, "
        f"{ended} after {len(chosen.actions)} steps",
        f"{model_graph(graph, found.world, out / 'model.png', title=name)}: its {len(graph.value)} states",
    ]


def _index(path: Path, seeds: tuple[int, ...], seed: int | None, complete: bool) -> int:
    if seed is not None:
        if seed not in seeds:
            raise RunDirectoryError(f"seed must be one of {', '.join(map(str, seeds))}, got {seed}")
        return seeds.index(seed)
    if not complete:
        return 0
    scores = score(load_run(path).final)
    return median_run(scores["goal_percent"], scores["median_steps"])


def learned(agent: Any, state: Any, index: int) -> tuple[Family, Any, np.ndarray]:
    """Return the family, one seed's parameters and its values ``[N, A]``.

    Raises:
        RunDirectoryError: the agent has no model.
    """
    family = getattr(agent, "family", None)
    if family is None or not hasattr(state, "params"):
        raise RunDirectoryError("this agent has no learned model to show")
    params = jax.tree.map(lambda x: jnp.asarray(x)[index], state.params)
    return family, params, np.asarray(state.actor.q[index])


def mind_of(family: Family, params: Any, q: np.ndarray) -> Mind:
    """Return a greedy mind: the belief of the model (thesis section 3.3), and ``argmax_a b . q[:, a]``."""
    memory = memory_of(family, params)
    begin = jax.jit(lambda seen: first_belief(family, memory, (seen,)))
    follow = jax.jit(lambda belief, did, seen: next_belief(family, memory, belief, did, (seen,)))
    return Mind(
        lambda seen: np.asarray(begin(seen)),
        lambda belief, did, seen: np.asarray(follow(belief, did, seen)),
        lambda belief: int(np.argmax(belief @ q)),
    )


def graph_of(family: Family, params: Any, q: np.ndarray, occupancy: np.ndarray, symbols: int) -> ModelGraph:
    """Return what is drawn of a model that sees one of so many symbols; absent states are left out."""
    alive = np.flatnonzero(np.asarray(params.alive))
    trans = np.exp(np.asarray(family.acting(params).log_trans))[:, alive][:, :, alive]
    density = jax.vmap(lambda seen: family.log_obs(params, (seen,), jnp.array(True)))(jnp.arange(symbols))
    observation = np.exp(np.asarray(density))[:, alive].T
    action = q.argmax(axis=1)[alive]
    mean = np.asarray(params.returns.mean)[alive]
    value = mean[np.arange(len(alive)), action if mean.shape[1] > 1 else 0]
    return ModelGraph(trans, observation, value, action, occupancy[alive])
