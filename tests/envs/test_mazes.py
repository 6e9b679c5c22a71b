"""The mazes by Littman, Cassandra and Kaelbling: every entry against the files, published figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from jaxpomdp.envs import grid as grids
from jaxpomdp.envs import maze89 as mazes
from jaxpomdp.envs.pomdp_file import read_pomdp
from jaxpomdp.envs.registry import make
from jaxpomdp.envs.world import model_of
from tests.envs.walks import share_ended

FILES = {"maze89": "hallway2", "maze57": "hallway", "tiger-grid": "tiger-grid"}
MAPS = {
    "maze89": (mazes.MAZE89_MAP, []),
    "maze57": (mazes.MAZE57_MAP, [10, 18, 26, 34]),
    "tiger-grid": (mazes.TIGER_GRID_MAP, []),
}


def _dense(ascii_map: str) -> tuple[np.ndarray, np.ndarray]:
    """Return transitions and expected rewards in float64, as the rules make them."""
    grid = grids.parse(ascii_map)
    size = 4 * len(grid.cells)
    trans, reward = np.zeros((5, size, size)), np.zeros((5, size))
    for action in range(5):
        for state in range(size):
            for (arrived, paid), prob in mazes.outcomes(grid, state, action).items():
                trans[action, state, arrived] += prob
                reward[action, state] += prob * paid
    return trans, reward


@pytest.mark.parametrize("name", FILES)
def test_every_entry_agrees_with_the_file(name: str, shared_dir: Path) -> None:
    parsed = read_pomdp(shared_dir / "data" / "pomdp" / f"{FILES[name]}.POMDP")
    ascii_map, landmarks = MAPS[name]
    trans, reward = _dense(ascii_map)
    goes_on = ~np.asarray(make(name).terminal)
    from_file = np.stack([matrix.toarray() for matrix in parsed.transitions])
    assert np.abs(trans - from_file)[:, goes_on].max() <= 4e-16
    assert np.abs(reward - parsed.expected_rewards())[:, goes_on].max() <= 4e-16
    # At the goal the file begins again; here the trial is over.
    assert np.abs(from_file[:, ~goes_on] - parsed.start).max() <= 1e-12
    shown = mazes.observation_table(grids.parse(ascii_map), landmarks)
    assert np.abs(shown - parsed.observation_probs[0].toarray()).max() <= 1.5e-5
    assert np.abs(np.asarray(make(name).start_prob) - parsed.start).max() <= 1e-4
    assert make(name).discount == parsed.discount


def test_a_wrong_entry_would_be_noticed(shared_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parsed = read_pomdp(shared_dir / "data" / "pomdp" / "hallway2.POMDP")
    monkeypatch.setattr(mazes, "FORWARD", (*mazes.FORWARD[:-1], (0.025, 2, 1)))
    trans, _ = _dense(mazes.MAZE89_MAP)
    from_file = np.stack([matrix.toarray() for matrix in parsed.transitions])
    assert np.abs(trans - from_file)[:, ~np.asarray(make("maze89").terminal)].max() > 0.02


@pytest.mark.parametrize(
    ("name", "without_no_op", "with_no_op"), [("maze89", 26.1, 22.0), ("maze57", 36.8, 31.8)]
)
def test_random_walks_end_as_often_as_published(name: str, without_no_op: float, with_no_op: float) -> None:
    world = make(name)
    assert 100 * share_ended(world, [1, 2, 3, 4], 251) == pytest.approx(without_no_op, abs=0.05)
    assert 100 * share_ended(world, range(5), 251) == pytest.approx(with_no_op, abs=0.05)


def test_maze89_is_as_the_thesis_says() -> None:
    world = make("maze89")
    assert np.flatnonzero(world.terminal).tolist() == [68, 69, 70, 71]
    assert np.count_nonzero(world.start_prob) == 88
    assert (world.num_actions, world.num_observations, world.step_limit) == (5, 17, 251)
    model = model_of(world)
    assert np.all(np.asarray(model.obs)[0, 68:72, 16] == 1)


def test_maze57_shows_its_landmarks_facing_south() -> None:
    shown = np.asarray(make("maze57").observation_prob)[0]
    assert [int(np.argmax(shown[state])) for state in (10, 18, 26, 34)] == [16, 17, 18, 19]
    assert np.all(shown[[10, 18, 26, 34], [16, 17, 18, 19]] == 1)


def test_tiger_grid_pays_for_costly_cells_also_while_standing() -> None:
    model = model_of(make("tiger-grid"))
    assert np.asarray(model.reward)[0, :4].tolist() == [-1] * 4
    assert np.flatnonzero(np.asarray(model.start)).tolist() == [24, 28]


def test_starts_must_not_be_goals() -> None:
    with pytest.raises(ValueError, match=r"starts must not be goals, got \[4\]"):
        mazes.heading_maze("*+", starts=[0, 4])
