"""Trees: what is refused, what is printed, and that every form comes to the same flat model."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.structure.spec import FlatSpec, safe_log, validate
from jaxpomdp.structure.topology import check_topology, nested
from jaxpomdp.structure.tree import TreeSpec, validate_tree
from jaxpomdp.structure.tree_forms import (
    closed,
    flatten_tree,
    maximal,
    minimal,
    one_level,
    opened,
    self_share,
    starting_over,
)
from jaxpomdp.structure.tree_init import random_shape, random_tree
from tests.oracles import tree as oracle
from tests.structure.trees import make_tree, thesis_tree, trees
from tests.structure.worlds import random_spec


def error_of(spec: TreeSpec, flat) -> float:
    init, trans = oracle.flat_of(spec)
    return max(np.abs(np.exp(flat.log_init) - init).max(), np.abs(np.exp(flat.log_trans) - trans).max())


@given(trees())
@settings(max_examples=60, deadline=None)
def test_the_flat_model_is_the_flow_of_activity(spec: TreeSpec) -> None:
    validate_tree(spec)
    flat = flatten_tree(spec)
    validate(flat)
    assert error_of(spec, flat) < 1e-12


def test_the_flow_of_activity_notices_a_broken_product() -> None:
    """Ends and entries forgotten, as if a branch were left and entered for nothing."""
    spec = make_tree(0, 8, 3)
    blunt = spec.log_horizontal.copy()
    blunt[:, : spec.num_states, -1] = np.log(0.5)
    assert error_of(spec, flatten_tree(replace(spec, log_horizontal=blunt))) > 0.01


def test_the_example_of_the_thesis() -> None:
    """Section 5.3: T*(s1, s3) = 0.7 x 0.3 x 0.4."""
    flat = flatten_tree(thesis_tree())
    assert np.exp(flat.log_trans[0, 0, 2]) == pytest.approx(0.084, abs=1e-12)


@given(trees())
@settings(max_examples=60, deadline=None)
def test_self_reference_is_another_form_of_the_same_model(spec: TreeSpec) -> None:
    most = maximal(spec)
    validate_tree(most, self_referential=True)
    assert error_of(most, flatten_tree(spec)) < 1e-10
    back = minimal(most)
    validate_tree(back)
    np.testing.assert_allclose(np.exp(back.log_horizontal), np.exp(spec.log_horizontal), atol=1e-10)
    assert flatten_tree(most) == flatten_tree(back)


def test_maximal_means_that_no_more_is_left_to_move() -> None:
    """Some child's way to a sibling is used up under each action, so a larger share would be negative."""
    spec = maximal(random_tree(3, 12, 2, 3, levels=2))
    for node in range(spec.root + 1, spec.num_nodes):
        children = spec.children(node)
        assert (self_share(spec, node) > 0).all()
        rows = np.exp(spec.log_horizontal[:, children[:, None], children[None]])
        assert (rows.min((1, 2)) == 0).all()


def test_an_internal_state_that_only_follows_itself_is_never_left() -> None:
    spec = thesis_tree()
    stuck = spec.log_horizontal.copy()
    stuck[0, 6], stuck[0, 6, 6] = safe_log(np.zeros(9)), 0.0
    kept = replace(spec, log_horizontal=stuck)
    least = minimal(kept)
    validate_tree(least)
    assert error_of(kept, flatten_tree(least)) < 1e-12


@given(st.integers(0, 1000), st.integers(1, 7))
@settings(max_examples=20, deadline=None)
def test_one_level_is_the_flat_model(seed: int, states: int) -> None:
    flat = random_spec(seed, states, per_action=seed % 2 == 0)
    tree = one_level(flat)
    validate_tree(tree)
    again = flatten_tree(tree)
    np.testing.assert_allclose(np.exp(again.log_trans), np.exp(flat.log_trans), atol=1e-15)
    assert replace(again, log_init=flat.log_init, log_trans=flat.log_trans) == flat


def test_trees_are_equal_by_value_and_cannot_be_changed() -> None:
    assert make_tree(1, 6, 3) == make_tree(1, 6, 3)
    assert make_tree(1, 6, 3) != make_tree(2, 6, 3)
    assert make_tree(1, 6, 3) != "a tree"
    for name in ("leaf_parent", "log_vertical", "log_horizontal"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(make_tree(1, 6, 3), name)[0] = 0


def test_a_tree_prints_as_a_tree() -> None:
    lines = str(thesis_tree()).splitlines()
    assert lines[0] == "TreeSpec of 5 leaves and 3 internal states, 2 levels, 1 actions"
    shape = [(len(line) - len(line.lstrip()), line.split()[0]) for line in lines[1:]]
    wanted = [(2, "i0"), (4, "s4"), (4, "i1"), (6, "s0"), (6, "s1"), (4, "i2"), (6, "s2"), (6, "s3")]
    assert shape == wanted
    assert "a0 -> s1 (0.30) end (0.70)" in lines[4]


@pytest.mark.parametrize(
    ("parents", "message"),
    [
        (([0], [0]), r"node_parent\[0\] must be -1"),
        (([], [-1]), "a leaf and a root"),
        (([0, 3], [-1, 0]), r"leaf_parent must be internal states 0 \.\. 1, got 3"),
        (([0, 0], [-1, -1]), r"node_parent\[1:\] must be internal states 0 \.\. 1, got -1"),
        (([0, 1], [-1, 2, 1]), "a cycle above internal state 1"),
        (([0, 0], [-1, 0]), "none below internal state 1"),
        (([1, 1], [-1, 0]), "internal state 1 as the only child of 0"),
    ],
)
def test_what_is_no_tree_is_refused(parents: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_topology(*(np.array(p, int) for p in parents))


def test_shapes_are_written_as_nested_lists() -> None:
    assert [x.tolist() for x in nested([0, [1, [2, 3]], 4])] == [[0, 1, 2, 2, 0], [-1, 0, 1]]
    with pytest.raises(ValueError, match="got 1 twice"):
        nested([0, 1, [1]])
    with pytest.raises(ValueError, match=r"leaves 0 \.\. 1, got \[0, 2\]"):
        nested([0, 2])


def changed(table: str, place: tuple, value: float) -> TreeSpec:
    spec = thesis_tree()
    array = getattr(spec, table).copy()
    array[place] = value
    return replace(spec, **{table: array})


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (lambda: changed("log_vertical", (0, 1, 2), -1.0), "log_vertical: s2 is no child of i1"),
        (lambda: changed("log_vertical", (0, 1, 0), 0.0), "log_vertical: .* sum to 1, got 1.2 at i1"),
        (lambda: changed("log_horizontal", (0, 0, 2), -1.0), "s0 leads to s2, but is no sibling"),
        (lambda: changed("log_horizontal", (0, 6, 6), -1.0), "internal state i1 must not follow itself"),
        (lambda: changed("log_horizontal", (0, 4, 8), -1.0), "s4 leads to an end, but has none"),
        (lambda: changed("log_horizontal", (0, 2, 3), 0.0), "log_horizontal: .* sum to 1, got 1.1 at s2"),
        (lambda: changed("return_var", (0, 0), 0.0), "return_var must be positive"),
        (lambda: changed("log_vertical", (0, 0, 0), np.nan), "log_vertical must be finite"),
    ],
)
def test_wrong_numbers_are_named(spec, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        validate_tree(spec())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"leaf_parent": np.zeros(5)}, "leaf_parent must be a row of integers"),
        ({"log_horizontal": np.zeros((1, 8, 8))}, r"log_horizontal must have shape \(any, 8, 9\)"),
        ({"log_vertical": np.zeros((3, 3, 8))}, "must have 1 table, or 2"),
        ({"return_mean": np.zeros((5, 2)), "return_var": np.ones((5, 2))}, "1 or 1 columns, got 2"),
    ],
)
def test_wrong_shapes_are_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(thesis_tree(), **change)


@pytest.mark.parametrize("states", [1, 2, 7, 20])
def test_random_shapes_are_trees_of_so_many_leaves(states: int) -> None:
    for form in ("diverse", "sober"):
        for levels in (1, 2, 3, 4):
            for seed in range(5):
                shape = random_shape(np.random.default_rng(seed), states, levels, form)
                leaf_parent, node_parent = nested(shape)
                check_topology(leaf_parent, node_parent)
                assert len(leaf_parent) == states
    with pytest.raises(ValueError, match="form must be"):
        random_tree(0, form="tall")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="states must be at least 1, got 0"):
        random_tree(0, 0)


def test_a_diverse_tree_has_leaves_at_many_depths() -> None:
    depths = [set(random_tree(seed).depth[:20].tolist()) for seed in range(20)]
    assert sum(len(d) > 1 for d in depths) > 15
    assert max(max(d) for d in depths) == 3
    sober = random_tree(0, form="sober")
    assert set(sober.depth[:20].tolist()) == {2}


def ways_by_turn(most: TreeSpec, k: int, leaf: int, action: int) -> dict[int, float]:
    """The ways from k to l in opened form by the node at which they turn round; -1: from child to child."""
    across = np.exp(most.log_horizontal[action])
    tables = np.exp(most.log_vertical)
    up, ends = [k], 1.0
    turns, down = {}, way_down(most, leaf)
    while up[-1] != most.root:
        node = up[-1]
        above = int(most.parent[node])
        if above in down:
            beside = down[down.index(above) + 1]
            if node != beside or node == leaf:
                turns[-1] = ends * across[node, beside] * entered(most, tables, down, beside, action)
            again = 1.0 if above == most.root else across[above, above]
            turns[above] = (
                ends * across[node, -1] * again * entered(most, tables, down, above, action, start=True)
            )
        ends *= across[node, -1]
        up.append(above)
    return turns


def way_down(most: TreeSpec, leaf: int) -> list[int]:
    nodes = [leaf]
    while nodes[0] != most.root:
        nodes.insert(0, int(most.parent[nodes[0]]))
    return nodes


def entered(most: TreeSpec, tables, down, top: int, action: int, start: bool = False) -> float:
    """The product of entries from a node down to the leaf; the root is entered as at a start."""
    total = 1.0
    for above, node in itertools.pairwise(down[down.index(top) :]):
        by_start = above == most.root and start
        table = tables[-1] if by_start or len(tables) == 1 else tables[action]
        total *= table[above - most.root, node]
    return total


@given(trees(most=8), st.integers(0, 1))
@settings(max_examples=40, deadline=None)
def test_ways_that_start_over_at_any_level_and_direct_ones_are_all(spec: TreeSpec, action: int) -> None:
    most, flat, over = opened(spec), flatten_tree(spec), starting_over(spec)
    np.testing.assert_allclose(
        np.exp(flatten_tree(closed(most)).log_trans), np.exp(flat.log_trans), atol=1e-10
    )
    for k, leaf in itertools.product(range(spec.num_states), repeat=2):
        turns = ways_by_turn(most, k, leaf, action)
        whole = np.exp(flat.log_trans[action, k, leaf])
        assert sum(turns.values()) == pytest.approx(whole, abs=1e-9)
        parent = int(spec.parent[leaf])
        if parent in turns:
            assert over[action, k, leaf] * whole == pytest.approx(turns[parent], abs=1e-9)
        else:
            assert over[action, k, leaf] == 0


def test_opening_a_tree_of_one_level_finds_its_restarts() -> None:
    """Rows of a third of a fresh start and two thirds of staying."""
    start = np.array([0.2, 0.3, 0.5])
    rows = np.eye(3) * 2 / 3 + start / 3
    spec = one_level(FlatSpec.from_probabilities(start, rows[None], (np.eye(3),)))
    np.testing.assert_allclose(np.exp(opened(spec).log_horizontal[0, :3, -1]), 1 / 3)
    np.testing.assert_allclose(starting_over(spec)[0], start / 3 / rows)


def test_a_random_tree_may_be_of_a_given_shape() -> None:
    spec = random_tree(0, 5, 2, 3, shape=[0, [1, [2, 3]], 4])
    validate_tree(spec)
    assert spec.leaf_parent.tolist() == [0, 1, 2, 2, 0]
    with pytest.raises(ValueError, match="shape must hold 6 leaves, got 5"):
        random_tree(0, 6, 2, 3, shape=[0, [1, [2, 3]], 4])
