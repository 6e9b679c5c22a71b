"""Pictures of one agent: its learned model as a graph, and its belief as it walks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxpomdp.envs.text import describe_observation
from jaxpomdp.experiments.layout import spread
from jaxpomdp.experiments.plots import COLOURS, INK, PALE, Panel, camera, new_figure, save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PatchCollection
    from matplotlib.figure import Figure

    from jaxpomdp.envs.world import World
    from jaxpomdp.experiments.walk import Walk

LEAST_EDGE = 0.1
NODE = 0.04
SIDES = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))
"""Where a sensed wall is drawn on a node: ahead or north, right or east, behind or south, left or west."""


class ModelGraph(NamedTuple):
    """What is drawn of a learned model of ``N`` states.

    Attributes:
        trans: ``[A, N, N]``, transition probabilities.
        observation: ``[N, O]``, observation probabilities.
        value: ``[N]``, mean return, the colour.
        action: int ``[N]``, the best action, whose transitions are drawn.
        occupancy: ``[N]``, share of the time spent in the state, the size.
    """

    trans: np.ndarray
    observation: np.ndarray
    value: np.ndarray
    action: np.ndarray
    occupancy: np.ndarray


def model_graph(graph: ModelGraph, world: World, path: Path, *, title: str) -> Path:
    """Draw a learned model: nodes coloured by mean return, marked with their likeliest observation.

    Arrows are the transitions of each state's best action, as thick as they are likely. Where observations
    are walls that are sensed, they are bars in the node (up: ahead or north); else a node bears its name.
    """
    following = graph.trans[graph.action, np.arange(len(graph.action))]
    place = spread(graph.trans.max(axis=0), apart=2.6 * NODE)
    figure, ax = new_figure(9.5, float(np.clip(1.2 + 4.2 * np.ptp(place[:, 1]), 3.2, 8)))
    ax.set_axis_off()
    ax.set_aspect("equal")
    size = NODE * np.clip(0.6 + 3 * np.sqrt(graph.occupancy), 0.7, 1.6)
    _draw_arrows(ax, graph, following, place, size)
    colour = _draw_nodes(ax, graph, place, size)
    _draw_observations(ax, graph, world, place, size)
    figure.colorbar(colour, ax=ax, label="mean return", shrink=0.6, pad=0.01)
    _action_legend(figure, world, graph.action)
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return save(figure, path)


def _draw_arrows(
    ax: Axes, graph: ModelGraph, following: np.ndarray, place: np.ndarray, size: np.ndarray
) -> None:
    from matplotlib.patches import FancyArrowPatch

    points = 72 * 8.4 / 2
    for i, j in np.argwhere(following >= LEAST_EDGE):
        if i == j:
            continue
        arrow = FancyArrowPatch(
            (float(place[i, 0]), float(place[i, 1])),
            (float(place[j, 0]), float(place[j, 1])),
            connectionstyle="arc3,rad=0.14",
            arrowstyle="-|>,head_width=2.4,head_length=4",
            shrinkA=float(size[i]) * points,
            shrinkB=float(size[j]) * points,
            linewidth=2.4 * float(following[i, j]),
            color=COLOURS[graph.action[i] % len(COLOURS)],
            alpha=0.25 + 0.6 * float(following[i, j]),
        )
        ax.add_patch(arrow)


def _draw_nodes(ax: Axes, graph: ModelGraph, place: np.ndarray, size: np.ndarray) -> PatchCollection:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle

    circles = [Circle((x, y), radius) for (x, y), radius in zip(place, size, strict=True)]
    nodes = PatchCollection(circles, cmap="YlGnBu", edgecolor=PALE, linewidth=0.8, zorder=3)
    nodes.set_array(graph.value)
    ax.add_collection(nodes)
    ax.autoscale_view()
    return nodes


def _draw_observations(
    ax: Axes, graph: ModelGraph, world: World, place: np.ndarray, size: np.ndarray
) -> None:
    bright = graph.value <= (graph.value.min() + graph.value.max()) / 2
    for state, observation in enumerate(graph.observation.argmax(axis=1)):
        ink = INK if bright[state] else "white"
        sides = sensed_sides(world, int(observation))
        if sides is None:
            name = world.observation_names[observation].replace(" ", "\n")
            x, y = place[state]
            ax.text(x, y, name, ha="center", va="center", fontsize=6, color=ink, zorder=5)
        for side in sides or ():
            ends = _bar(place[state], size[state], SIDES[side])
            ax.plot(*ends, color=ink, linewidth=2.2, solid_capstyle="butt", zorder=4)


def _bar(centre: np.ndarray, radius: float, side: tuple[float, float]) -> tuple[list[float], list[float]]:
    (x, y), (dx, dy) = centre, side
    reach, half = 0.55 * radius, 0.6 * radius
    return (
        [x + reach * dx - half * dy, x + reach * dx + half * dy],
        [y + reach * dy - half * dx, y + reach * dy + half * dx],
    )


def sensed_sides(world: World, observation: int) -> list[int] | None:
    """Return which of a world's senses report a wall; None where the observation is not made of wall bits."""
    count = len(world.senses)
    if not count or observation >= 1 << count:
        return None
    return [side for side in range(count) if observation >> (count - 1 - side) & 1]


def _action_legend(figure: Figure, world: World, actions: np.ndarray) -> None:
    from matplotlib.lines import Line2D

    lines = [
        Line2D([], [], color=COLOURS[a % len(COLOURS)], linewidth=2, label=world.action_names[a])
        for a in np.unique(actions)
    ]
    if world.senses:
        bar = Line2D(
            [], [], color=INK, marker="_", linestyle="", label=f"wall sensed (up: {world.senses[0]})"
        )
        lines.append(bar)
    figure.legend(handles=lines, loc="outside lower center", ncols=min(len(lines), 6), frameon=False)


def belief_animation(
    world: World,
    walk: Walk,
    heat: np.ndarray,
    path: Path,
    *,
    panel: Panel | None = None,
    most_frames: int = 80,
) -> Path:
    """Draw a trial as an animation: where the agent is, what it sees, and where it believes to be.

    Args:
        world: where it walks.
        walk: the trial, of ``T`` observations.
        heat: ``[T, states of the world]``, the belief in terms of the world.
        path: the GIF.
        panel: what is beside the world; by default a bar for each state of the model.
        most_frames: a longer trial is cut.
    """
    from jaxpomdp.envs.drawing import save_gif

    beside = _bars_panel(walk.beliefs) if panel is None else panel
    frames = list(_belief_frames(world, walk, heat, beside, min(len(walk.states), most_frames)))
    path.parent.mkdir(parents=True, exist_ok=True)
    save_gif(path, [*frames, *frames[-1:] * 8], frames_per_second=5)
    return path


def _belief_frames(
    world: World, walk: Walk, heat: np.ndarray, panel: Panel, count: int
) -> Iterator[np.ndarray]:
    """Give the frames, uint8 ``[height, width, 3]``, all from one figure, which is laid out once."""
    from jaxpomdp.envs.drawing import draw

    figure, (left, right) = new_figure(5.5 + panel.width, 3.9, 1, 2, width_ratios=(5.5, panel.width))
    update, grab = panel.draw(right), camera(figure)
    for t in range(count):
        draw(world, left, state=int(walk.states[t]), observation=int(walk.observations[t]), heat=heat[t])
        left.set_title(step_caption(world, walk, t), fontsize=10, loc="left")
        update(t)
        yield grab()


def step_caption(world: World, walk: Walk, t: int) -> str:
    """Say what was done before a step, and what is seen."""
    did = f"step {t}: {world.action_names[walk.actions[t - 1]]}" if t else "the trial begins"
    return f"{did}\nsees {describe_observation(world, int(walk.observations[t]))}"


def _bars_panel(beliefs: np.ndarray) -> Panel:
    """Return a bar for each of the states that are believed in most during the trial, in a fixed order."""
    shown = np.sort(np.argsort(-beliefs.max(axis=0), kind="stable")[:12])

    def draw(ax: Axes) -> Callable[[int], None]:
        bars = ax.bar(np.arange(len(shown)), np.zeros(len(shown)), color="#ff922b")
        ax.set(ylim=(0, 1), xlabel="states of the learned model", ylabel="belief")
        ax.set_xticks(range(len(shown)), [str(n) for n in shown], fontsize=6.5)
        ax.grid(visible=False, axis="x")

        def update(t: int) -> None:
            for bar, n in zip(bars, shown.tolist(), strict=True):
                bar.set_height(beliefs[t, n])

        return update

    return Panel(draw, 3.7)
