"""A trained agent in pictures: its belief over one trial, the model it has learned, and how a tree grew."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp import packing
from jaxpomdp.agents.trial import first_belief, memory_of, next_belief
from jaxpomdp.experiments.drawing import ModelGraph, belief_animation, model_graph
from jaxpomdp.experiments.record import RunDirectoryError, read_lines
from jaxpomdp.experiments.restore import Restored, restore
from jaxpomdp.experiments.results import load_run, score
from jaxpomdp.experiments.runner import Build, build
from jaxpomdp.experiments.stats import median_run
from jaxpomdp.experiments.tree_animation import edit_title, growth_animation, tree_panel
from jaxpomdp.experiments.tree_drawing import symbol_names, tree_picture
from jaxpomdp.experiments.walk import Mind, meaning, walk
from jaxpomdp.models.family import Family
from jaxpomdp.models.hierarchical import TreeParams
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_edits import shape_of
from jaxpomdp.structure.tree_growth import grown_to

WALKS = 60
"""Trials from which it is learned what each state of the model stands for."""
CHANCE = 7


def show(path: Path, out: Path, *, seed: int | None = None, trial: int = 0, make: Build = build) -> list[str]:
    """Draw ``belief.gif`` and ``model.png`` for one seed of a run, and return what to tell about them.

    Of a hierarchical model also ``tree.png`` and ``growth.gif``, and the belief flows through its tree.

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
    tree = packing.unpack(found.state.params, index) if isinstance(params, TreeParams) else None
    name = f"{found.config.env}, {found.config.agent}, seed {found.config.seeds[index]}"
    occupancy = np.concatenate([w.beliefs for w in walks]).mean(axis=0)
    graph = graph_of(family, params, q, occupancy, found.world.num_observations)
    ended = "reaches the goal" if chosen.rewards[-1] > found.world.success_above else "ends"
    names = found.world.observation_names
    panel = None if tree is None else tree_panel(tree, nodes_of(tree, params, chosen.beliefs), names)
    film = belief_animation(found.world, chosen, heat, out / "belief.gif", panel=panel)
    picture = model_graph(graph, found.world, out / "model.png", title=name)
    return [
        f"{film}: {name}, {ended} after {len(chosen.actions)} steps",
        f"{picture}: its {len(graph.value)} states",
        *([] if tree is None else show_tree(path, found, index, tree, out, name)),
    ]


def nodes_of(tree: TreeSpec, params: TreeParams, beliefs: np.ndarray) -> np.ndarray:
    """Return the belief over nodes ``[T, M]`` of one over leaves ``[T, capacity]``, without spare slots."""
    return beliefs[:, np.flatnonzero(np.asarray(params.alive))] @ tree.below.T


def show_tree(path: Path, found: Restored, index: int, tree: TreeSpec, out: Path, title: str) -> list[str]:
    """Draw one seed's tree and how it grew, and return what to tell about them."""
    seeds, names = found.config.seeds, found.world.observation_names
    picture = tree_picture(tree, out / "tree.png", colour="return", names=names, title=title)
    lines = [f"{picture}: its {tree.num_states} leaves and {tree.num_internal} internal states"]
    first = packing.unpack(found.agent.init(np.asarray(seeds)).params, index)
    rows = [row for row in read_lines(path / "edits.jsonl") if row["seed"] == seeds[index]]
    try:
        steps = grown_to(shape_of(first), shape_of(tree), rows)
    except ValueError as error:
        return [*lines, f"no growth.gif: {error} (did it begin again on the way?)"]
    titles = [
        edit_title(step.row) if step.row else f"at the start: {first.num_states} leaves" for step in steps
    ]
    shapes = [step.shape for step in steps]
    film = growth_animation(shapes, titles, out / "growth.gif", names=symbol_names(tree, names))
    return [*lines, f"{film}: its {len(shapes) - 1} edits"]


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
