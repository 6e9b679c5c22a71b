"""Pictures are made, hold what they should, and the numbers behind them are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from jaxpomdp.envs.registry import make
from jaxpomdp.envs.world import model_of
from jaxpomdp.experiments.drawing import ModelGraph, belief_animation, model_graph, sensed_sides
from jaxpomdp.experiments.layout import hang, spread
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
from jaxpomdp.experiments.tree_animation import growth_animation, tree_belief_animation
from jaxpomdp.experiments.tree_drawing import activated, tree_picture
from jaxpomdp.experiments.walk import Mind, meaning, walk
from jaxpomdp.structure.tree_edits import shape_of
from jaxpomdp.structure.tree_growth import branch_copied
from jaxpomdp.structure.tree_init import random_tree

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


def colours_in(path) -> set[tuple[int, ...]]:
    return {tuple(pixel) for pixel in np.unique(drawn(path).reshape(-1, 3), axis=0).tolist()}


def test_a_tree_is_drawn_by_what_its_leaves_show_return_or_are_given(tmp_path):
    tree = random_tree(0, 8, 2, 3)
    seen = tree_picture(tree, tmp_path / "seen.png", names=["a", "b", "c"], title="t")
    paid = tree_picture(tree, tmp_path / "paid.png", colour="return")
    given = tree_picture(tree, tmp_path / "given.png", colour=np.arange(8.0), label="number")
    assert len(colours_in(given)) > len(colours_in(seen))
    assert (drawn(paid) != drawn(given)).any()
    for colour, message in (("blue", "got 'blue'"), (np.zeros(7), r"shape \(8,\), got \(7,\)")):
        with pytest.raises(ValueError, match=message):
            tree_picture(tree, tmp_path / "x.png", colour=colour)
    with pytest.raises(ValueError, match="where nothing is a symbol"):
        tree_picture(replace(tree, emissions=()), tmp_path / "x.png")


def test_lines_down_are_as_thick_as_children_are_likely():
    tree = random_tree(1, 9, 2, 3, vertical_by_action=True)
    share = activated(tree)
    for node in range(tree.root, tree.num_nodes):
        assert share[tree.children(node)].sum() == pytest.approx(1)
    assert share[tree.root] == 0


def test_a_tree_hangs_with_parents_above_their_children():
    tree = random_tree(2, 12, 1, 2)
    place = hang(tree.parent, 12)
    assert sorted(place[:12, 0].tolist()) == list(range(12))
    np.testing.assert_array_equal(place[:, 1], -tree.depth)
    for node in range(12, tree.num_nodes):
        under = place[:12, 0][tree.below[node]]
        assert under.max() - under.min() == len(under) - 1, "a branch's leaves are side by side"
        assert under.min() <= place[node, 0] <= under.max()


def test_growth_has_a_frame_for_each_tree_and_refuses_what_did_not_grow(tmp_path):
    first = shape_of(random_tree(0, 6, 1, 2))
    second = branch_copied(first, 2).shape
    path = growth_animation([first, second], ["start", "copied"], tmp_path / "growth.gif")
    with Image.open(path) as film:
        frames = []
        for k in range(2):
            film.seek(k)
            frames.append(np.asarray(film.convert("RGB")).astype(int))
    orange = [((x[..., 0] - x[..., 2]) > 120).sum() for x in frames]
    assert orange[0] == 0 < orange[1]
    with pytest.raises(ValueError, match="shapes must grow"):
        growth_animation([second, first], ["a", "b"], path)
    with pytest.raises(ValueError, match="one for each shape, got 1 for 2"):
        growth_animation([first, second], ["a"], path)


def test_belief_flows_through_a_tree(tmp_path):
    tree = random_tree(0, 6, 1, 2)
    beliefs = np.random.default_rng(0).dirichlet(np.ones(6), 4) @ tree.below.T
    path = tree_belief_animation(tree, beliefs, ["a", "b", "c", "d"], tmp_path / "flow.gif", most_frames=3)
    with Image.open(path) as film:
        assert film.n_frames >= 3
    with pytest.raises(ValueError, match=r"beliefs must have shape \(T, "):
        tree_belief_animation(tree, beliefs[:, :-1], ["a", "b", "c", "d"], path)
    with pytest.raises(ValueError, match="one for each of 4 steps, got 1"):
        tree_belief_animation(tree, beliefs, ["a"], path)
