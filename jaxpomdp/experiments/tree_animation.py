"""Films of a tree: how it grew, and belief that flows through it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxpomdp.experiments.layout import hang
from jaxpomdp.experiments.plots import INK, PALE, Panel, camera
from jaxpomdp.experiments.tree_drawing import (
    NODE,
    activated,
    draw_lines,
    draw_nodes,
    empty_figure,
    symbol_names,
    width_for,
    write_names,
)
from jaxpomdp.structure.topology import parents_of
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_growth import Shape

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NEW = "#ff922b"


def growth_animation(
    shapes: Sequence[Shape | TreeSpec],
    titles: Sequence[str],
    path: Path,
    *,
    names: Sequence[str] | None = None,
) -> Path:
    """Draw a tree as it grew: a frame for the start and for each edit, what is new in another colour.

    Nodes keep their place through all frames, which is theirs in the last tree.

    Args:
        shapes: trees (or their shapes), each what an edit made of the one before (``replayed`` gives them).
        titles: of the frames.
        path: the GIF.
        names: written below the leaves of the last tree; numbers of leaves if None.

    Raises:
        ValueError: there is no tree, not a title for each, or a tree that did not grow from the one before.
    """
    from jaxpomdp.envs.drawing import save_gif

    if not shapes or len(titles) != len(shapes):
        raise ValueError(f"titles must be one for each shape, got {len(titles)} for {len(shapes)} shapes")
    for before, after in pairwise(shapes):
        _check_grown(before, after)
    frames = list(_growth_frames(shapes, titles, names))
    path.parent.mkdir(parents=True, exist_ok=True)
    save_gif(path, [*frames, *frames[-1:] * 3], frames_per_second=1)
    return path


def _check_grown(before: Shape | TreeSpec, after: Shape | TreeSpec) -> None:
    for name in ("leaf_parent", "node_parent"):
        old, new = getattr(before, name), getattr(after, name)
        if not np.array_equal(old, new[: len(old)]):
            raise ValueError(
                f"shapes must grow from one another, got {name} {new.tolist()} after {old.tolist()}"
            )


def _growth_frames(
    shapes: Sequence[Shape | TreeSpec], titles: Sequence[str], names: Sequence[str] | None
) -> Iterator[np.ndarray]:
    last = shapes[-1]
    leaves = len(last.leaf_parent)
    parent = parents_of(last.leaf_parent, last.node_parent)
    place, inches = hang(parent, leaves), width_for(leaves)
    figure, ax = empty_figure(inches, 1.5 + 0.6 * float(np.ptp(place[:, 1])))
    lines = draw_lines(ax, parent, place, 1.5, PALE)
    internal, circles = draw_nodes(ax, place, leaves, inches)
    write_names(ax, place, [str(n) for n in range(leaves)] if names is None else names)
    figure.suptitle(max(titles, key=len), x=0.01, ha="left", fontsize=10)
    grab = camera(figure)
    born = _births(shapes)
    for t, title in enumerate(titles):
        shades = np.array([_shade(int(b), t) for b in born])
        circles.set(facecolors=shades[:leaves], edgecolors=_edges(born[:leaves] <= t))
        internal.set(facecolors=shades[leaves:], edgecolors=_edges(born[leaves:] <= t))
        lines.set_color(_edges(born[parent >= 0] <= t))
        for text, there in zip(ax.texts, born[:leaves] <= t, strict=True):
            text.set_visible(bool(there))
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        yield grab()


def _births(shapes: Sequence[Shape | TreeSpec]) -> np.ndarray:
    """Return ``[M]`` of the last shape: the first shape that has each node."""
    parts = []
    for name in ("leaf_parent", "node_parent"):
        sizes = np.array([len(getattr(shape, name)) for shape in shapes])
        parts.append(np.searchsorted(sizes, np.arange(sizes[-1]), side="right"))
    return np.concatenate(parts)


def _shade(born: int, t: int) -> tuple[float, ...]:
    from matplotlib.colors import to_rgba

    return to_rgba(NEW if born == t > 0 else NODE, float(born <= t))


def _edges(there: np.ndarray) -> list[tuple[float, ...]]:
    from matplotlib.colors import to_rgba

    return [to_rgba(INK, 0.7 * float(seen)) for seen in there]


def edit_title(row: Mapping[str, Any]) -> str:
    """Say in a line what an edit did, from its row in the log.

    >>> row = {"operator": "uncle", "node": 3, "top": "i2", "conditions": ["i1", "s4"], "p_value": 0.00012}
    >>> edit_title(row | {"trial": 50, "states_after": 24})
    'trial 50: uncle split of i2, as s3 differs after i1 and s4 (p = 0.00012): 24 leaves'
    """
    when = f"trial {row['trial']}: " if "trial" in row else ""
    after = " and ".join(row.get("conditions", ()))
    why = f"as s{row['node']} differs{after and ' after '}{after} (p = {row['p_value']:.2g})"
    return f"{when}{row['operator']} split of {row['top']}, {why}: {row['states_after']} leaves"


def tree_panel(spec: TreeSpec, beliefs: np.ndarray, names: Sequence[str] | None = None) -> Panel:
    """Return a panel that shows how much each node is believed to be active at each step.

    Args:
        spec: the tree.
        beliefs: ``[T, M]``, of nodes (``spec.below`` sums those of leaves).
        names: of the symbols.

    Raises:
        ValueError: the beliefs are of another number of nodes.
    """
    if beliefs.ndim != 2 or beliefs.shape[1] != spec.num_nodes:
        raise ValueError(f"beliefs must have shape (T, {spec.num_nodes}), got {beliefs.shape}")
    inches = float(np.clip(0.22 * spec.num_states + 1.5, 5, 12))

    def draw(ax: Axes) -> Callable[[int], None]:
        from matplotlib import colormaps

        ax.set_axis_off()
        place = hang(spec.parent, spec.num_states)
        lines = draw_lines(ax, spec.parent, place, 1 + 4 * activated(spec), PALE)
        internal, leaves = draw_nodes(ax, place, spec.num_states, inches)
        write_names(ax, place, symbol_names(spec, names))
        shades, child = colormaps["Oranges"], spec.parent >= 0

        def update(t: int) -> None:
            colours = shades(beliefs[t].clip(0, 1))
            leaves.set_facecolor(colours[: spec.num_states])
            internal.set_facecolor(colours[spec.num_states :])
            flow = np.asarray(shades(0.15 + 0.85 * beliefs[t].clip(0, 1)))[child]
            lines.set_color(flow)

        return update

    return Panel(draw, inches)


def tree_belief_animation(
    spec: TreeSpec,
    beliefs: np.ndarray,
    captions: Sequence[str],
    path: Path,
    *,
    names: Sequence[str] | None = None,
    most_frames: int = 80,
) -> Path:
    """Draw belief flowing through a tree, a frame a step, with what is seen above.

    Args:
        spec: the tree.
        beliefs: ``[T, M]``, of nodes (``models.hierarchical.beliefs_of_nodes``).
        captions: what is seen (and done) at each step.
        path: the GIF.
        names: of the symbols.
        most_frames: a longer sequence is cut.

    Raises:
        ValueError: the beliefs are of another number of nodes, or captions of another number of steps.
    """
    from jaxpomdp.envs.drawing import save_gif

    if len(captions) != len(beliefs):
        raise ValueError(f"captions must be one for each of {len(beliefs)} steps, got {len(captions)}")
    panel = tree_panel(spec, beliefs, names)
    figure, ax = empty_figure(panel.width, 1.6 + 0.8 * int(spec.depth.max()))
    update, grab, frames = panel.draw(ax), camera(figure), []
    for t in range(min(len(beliefs), most_frames)):
        ax.set_title(captions[t], fontsize=10, loc="left")
        update(t)
        frames.append(grab())
    path.parent.mkdir(parents=True, exist_ok=True)
    save_gif(path, [*frames, *frames[-1:] * 4], frames_per_second=2)
    return path
