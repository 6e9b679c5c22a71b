"""Pictures are made, hold what they should, and the numbers behind them are right."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from jaxpomdp.envs.registry import make
from jaxpomdp.envs.world import model_of
from jaxpomdp.experiments.drawing import ModelGraph, belief_animation, model_graph, sensed_sides
from jaxpomdp.experiments.layout import spread
from jaxpomdp.experiments.plots import (
    Bars,
    Curve,
    Line,
    Point,
    bars,
    comparison,
    learning_curves,
    moving_average,
)
from jaxpomdp.experiments.stats import Interval, wilson
from jaxpomdp.experiments.walk import Mind, meaning, walk

WORLD = make("tmaze-2")
TRUE = model_of(WORLD)


def told_the_model() -> Mind:
    """A mind that knows the world's tables, believes exactly, and goes east, then north."""
    trans, obs = np.asarray(TRUE.trans), np.asarray(TRUE.obs[0])

    def normal(x):
        return x / x.sum()

    return Mind(
        lambda o: normal(np.asarray(TRUE.start) * np.asarray(TRUE.first)[:, o]),
        lambda belief, a, o: normal((belief @ trans[a]) * obs[:, o]),
        lambda belief: 0 if belief[6:8].sum() > 0.5 else 1,
    )


def drawn(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def test_moving_average_is_the_mean_of_the_window():
    values = np.random.default_rng(0).normal(size=(2, 9))
    found = moving_average(values, 4)
    for t in range(9):
        np.testing.assert_allclose(found[:, t], values[:, max(0, t - 3) : t + 1].mean(axis=1))
    np.testing.assert_allclose(moving_average(values, 20)[:, -1], values.mean(axis=1))


def test_learning_curves_draw_every_run(tmp_path):
    trial = np.arange(10.0)
    curves = [Curve(name, trial, np.ones((3, 10)) * level, 1) for name, level in (("a", 20), ("b", 80))]
    path = learning_curves([("goal %", curves, [Line("thesis", 92)])], tmp_path / "x" / "c.png", title="t")
    one = learning_curves([("goal %", curves[:1], [])], tmp_path / "d.png", title="t")
    assert drawn(path).shape != drawn(one).shape or (drawn(path) != drawn(one)).any()


def test_comparison_and_bars_take_rows_without_one_side(tmp_path):
    points = [
        Point("a", Interval(50, 40, 60), None),
        Point("b", None, 92.0),
        Point("c", Interval(1, 1, 1), 2.0),
    ]
    assert drawn(comparison([("goal %", points, 102.0)], tmp_path / "a.png", title="t", note="n")).std() > 1
    groups = [Bars(name, [wilson(k, 21) for k in (0, 21)]) for name in ("held", "ever")]
    path = bars(groups, ["4", "10"], tmp_path / "b.png", title="t", xlabel="N", ylabel="runs", top=21)
    assert drawn(path).std() > 1


def test_a_chain_is_laid_out_as_a_line():
    chain = np.diag(np.ones(5), 1)
    place = spread(chain)
    steps = np.diff(place[:, 0])
    np.testing.assert_allclose(np.abs(steps), 0.4, rtol=1e-3)
    assert np.abs(place[:, 1]).max() < 1e-3
    np.testing.assert_allclose([place[:, 0].min(), place[:, 0].max()], [-1, 1])


def test_nodes_that_nothing_joins_and_single_nodes_have_places_apart():
    place = spread(np.zeros((3, 3)), apart=0.3)
    assert np.isfinite(place).all()
    gaps = np.linalg.norm(place[:, None] - place[None, :], axis=-1)[np.triu_indices(3, 1)]
    assert gaps.min() > 0.25
    assert spread(np.zeros((1, 1))).tolist() == [[0, 0]]


@pytest.mark.parametrize(("env", "observation", "sides"), [("maze89", 9, [0, 3]), ("maze89", 16, None)])
def test_sensed_walls_are_read_from_the_bits(env, observation, sides):
    assert sensed_sides(make(env), observation) == sides


def test_model_graph_is_drawn(tmp_path):
    count = WORLD.num_states
    occupancy = np.full(count, 1 / count)
    graph = ModelGraph(
        np.asarray(TRUE.trans),
        np.asarray(TRUE.obs[0]),
        np.arange(count, dtype=float),
        np.ones(count, int),
        occupancy,
    )
    assert drawn(model_graph(graph, WORLD, tmp_path / "model.png", title="t")).std() > 1


def test_a_walk_keeps_its_beliefs_and_repeats_itself():
    found = walk(WORLD, told_the_model(), seed=1, trial=4)
    again = walk(WORLD, told_the_model(), seed=1, trial=4)
    np.testing.assert_array_equal(found.states, again.states)
    assert found.beliefs.shape == (len(found.states), WORLD.num_states)
    assert (found.beliefs[np.arange(len(found.states)), found.states] == 1).all()
    assert len(found.actions) == len(found.rewards) == len(found.states) - 1
    assert len(walk(WORLD, told_the_model(), seed=1, trial=4, limit=1).actions) == 1


def test_meaning_maps_states_of_the_model_to_the_world():
    walks = [walk(WORLD, told_the_model(), seed=1, trial=k) for k in range(8)]
    found = meaning(WORLD, walks)
    np.testing.assert_allclose(found.sum(axis=1), 1)
    visited = np.unique(np.concatenate([w.states for w in walks]))
    np.testing.assert_allclose(found[visited, visited], 1, atol=1e-6)


def test_the_animation_has_a_frame_for_each_step(tmp_path):
    found = walk(WORLD, told_the_model(), seed=1, trial=0)
    path = belief_animation(WORLD, found, found.beliefs, tmp_path / "belief.gif", most_frames=3)
    with Image.open(path) as animation:
        assert animation.n_frames >= 3
        assert animation.size[0] > animation.size[1]
