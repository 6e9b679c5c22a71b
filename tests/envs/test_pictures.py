"""Pictures, maps as text and observations in words."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from jaxpomdp.envs.build import assemble, tabulate
from jaxpomdp.envs.drawing import draw, save_gif
from jaxpomdp.envs.picture import AGENT, GOAL, SENSED, frame, heat_map, layout_of, sensed_walls
from jaxpomdp.envs.registry import make, names
from jaxpomdp.envs.text import ansi, describe_observation
from jaxpomdp.envs.world import World


@pytest.fixture
def without_map() -> World:
    tables = tabulate([[{(min(s + 1, 4), 0.0): 1.0} for s in range(5)]])
    ends = np.arange(5) == 4
    static = {"action_names": ("on",), "observation_names": tuple("abcde")}
    return assemble(tables, np.eye(5)[None], np.eye(5)[0], ends, **static)


def _count(image: np.ndarray, colour: tuple[int, ...]) -> int:
    return int(np.all(image == colour, axis=-1).sum())


@pytest.mark.parametrize("name", names())
def test_frames_of_a_world_have_one_size_and_show_the_agent(name: str) -> None:
    world = make(name)
    sizes = set()
    for state in range(0, world.num_states, 3):
        image = frame(world, state, observation=0, cell_pixels=16)
        assert image.dtype == np.uint8
        assert _count(image, AGENT) > 10
        sizes.add(image.shape)
    assert sizes == {frame(world, cell_pixels=16).shape}
    assert _count(frame(world), AGENT) == 0
    assert _count(frame(world), GOAL) > 100


def test_the_agent_points_where_it_faces() -> None:
    world, middle = make("maze89"), 16
    for heading, (down, right) in enumerate([(-1, 0), (0, 1), (1, 0), (0, -1)]):
        image = frame(world, heading, cell_pixels=32)
        rows, columns = np.nonzero(np.all(image == AGENT, axis=-1))
        cell_row, cell_column = (part * 32 for part in (1, 2))
        ahead = (rows - cell_row - middle) * down + (columns - cell_column - middle) * right
        aside = np.abs((rows - cell_row - middle) * right + (columns - cell_column - middle) * down)
        tip, tail = aside[ahead > 4].max(), aside[ahead < -4].max()
        assert tip < tail


def test_sensed_walls_turn_with_the_agent() -> None:
    world = make("maze89")
    assert sensed_walls(world, 0, 0b1000) == (0,)
    assert sensed_walls(world, 1, 0b1000) == (1,)
    assert sensed_walls(world, 3, 0b0101) == (0, 2)
    assert sensed_walls(world, 3, 16) == ()
    assert sensed_walls(make("hallway"), 3, 0b0011) == (2, 3)
    assert _count(frame(world, 1, observation=0b1111), SENSED) > _count(
        frame(world, 1, observation=0b1000), SENSED
    )


def test_observations_without_walls_light_a_strip() -> None:
    world = make("tmaze-3")
    lit = [np.nonzero(np.all(frame(world, 2, observation=o) == SENSED, axis=-1))[1].mean() for o in range(6)]
    assert np.all(np.diff(lit) > 0)


def test_heat_sums_over_headings() -> None:
    world = make("maze89")
    heat = heat_map(world, np.arange(92.0))
    assert heat.shape == (5, 7)
    assert heat.sum() == pytest.approx(np.arange(92.0).sum())
    assert heat[0, 1] == 0 + 1 + 2 + 3
    with pytest.raises(ValueError, match=r"weights must have shape \(92,\), got \(3,\)"):
        heat_map(world, np.ones(3))


def test_heat_colours_the_likely_cell_most() -> None:
    world = make("hallway")
    image = frame(world, heat=np.eye(world.num_states)[2], cell_pixels=16).astype(int)
    plain = frame(world, cell_pixels=16).astype(int)
    changed = np.argwhere(np.abs(image - plain).sum(axis=-1) > 0) // 16
    assert np.unique(changed, axis=0).tolist() == [[1, 3]]


def test_worlds_without_a_map_lie_in_a_square(without_map: World) -> None:
    layout = layout_of(without_map)
    assert layout.rows == ("***", "*+ ")
    assert frame(without_map, 4, observation=4).ndim == 3
    assert ansi(without_map, 3, observation=2, colour=False) == "···\n@G█\nc"


def test_frames_refuse_tiny_cells() -> None:
    with pytest.raises(ValueError, match="cell_pixels must be at least 8, got 2"):
        frame(make("hallway"), cell_pixels=2)


def test_text_shows_map_agent_and_observation() -> None:
    world = make("maze89")
    lines = ansi(world, 1, observation=9, colour=False).split("\n")
    assert lines[:5] == ["█>····█", "··█·█··", "█·█·█·█", "··█·█·G", "█·····█"]
    assert lines[5] == "wall ahead, open right, open behind, wall left"
    assert "\x1b[1;34m>\x1b[0m" in ansi(world, 1)


def test_text_shades_a_belief() -> None:
    world = make("hallway")
    shaded = ansi(world, heat=np.eye(world.num_states)[3])
    assert shaded.count("48;5;") == 1
    assert "48;5;" not in ansi(world)


def test_observations_in_words() -> None:
    assert describe_observation(make("hallway"), 0b1001) == "wall north, open east, open south, wall west"
    assert describe_observation(make("hallway"), 16) == "goal"
    assert describe_observation(make("maze57"), 17) == "landmark 2"
    assert describe_observation(make("tmaze-4"), 3) == "junction"
    with pytest.raises(ValueError, match=r"observation must be in 0\.\.16, got 17"):
        describe_observation(make("hallway"), 17)


@pytest.mark.parametrize("name", ["maze89", "hallway", "tmaze-4"])
def test_drawings(name: str, tmp_path: Path) -> None:
    world = make(name)
    belief = np.full(world.num_states, 1 / world.num_states)
    ax = draw(world, state=1, observation=3, heat=belief, numbers=True, title="here")
    ax.figure.savefig(tmp_path / "maze.png", dpi=40)
    assert (tmp_path / "maze.png").stat().st_size > 1000
    assert ax.get_title() == "here"
    again = draw(world, ax, heat=heat_map(world, belief))
    assert again is ax
    assert not ax.lines


def test_drawings_refuse_other_shapes(without_map: World) -> None:
    draw(without_map, state=2)
    with pytest.raises(ValueError, match=r"heat must have shape \(5,\) or \(2, 3\), got \(4,\)"):
        draw(without_map, heat=np.ones(4))


def test_animations(tmp_path: Path) -> None:
    from PIL import Image

    world = make("tmaze-3")
    save_gif(tmp_path / "run.gif", [frame(world, s, cell_pixels=8) for s in (0, 2, 4)], frames_per_second=5)
    with Image.open(tmp_path / "run.gif") as image:
        assert (image.n_frames, image.info["duration"]) == (3, 200)
    for frames, message in (([], "at least one"), ([frame(world), frame(make("hallway"))], "of one size")):
        with pytest.raises(ValueError, match=message):
            save_gif(tmp_path / "bad.gif", frames)
    with pytest.raises(ValueError, match=r"must be in \(0, 50\], got 99"):
        save_gif(tmp_path / "bad.gif", [frame(world)], frames_per_second=99)
