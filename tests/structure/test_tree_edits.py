"""Copying branches and adding levels: the model stays the same, whatever the shares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.structure.tree import TreeSpec, validate_tree
from jaxpomdp.structure.tree_edits import branch_leaves, clone_branch, new_level
from jaxpomdp.structure.tree_forms import flatten_tree
from tests.structure.trees import make_tree, thesis_tree, trees
from tests.structure.worlds import log_evidence


def assert_same_model(before: TreeSpec, after: TreeSpec, origin: np.ndarray, seed: int = 0) -> None:
    """Copies lumped together give the old chain back, and sequences are as likely as they were."""
    old, new = flatten_tree(before), flatten_tree(after)
    lump = np.eye(before.num_states)[origin]
    assert set(origin.tolist()) == set(range(before.num_states))
    np.testing.assert_allclose(np.exp(new.log_trans) @ lump, lump @ np.exp(old.log_trans), atol=1e-10)
    np.testing.assert_allclose(np.exp(new.log_init) @ lump, np.exp(old.log_init), atol=1e-10)
    rng = np.random.default_rng(seed)
    data = rng.integers(0, 3, 30), rng.integers(0, before.num_actions, 29)
    np.testing.assert_allclose(log_evidence(old, *data), log_evidence(new, *data), rtol=1e-10)


@given(trees(), st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_a_copied_branch_changes_nothing(spec: TreeSpec, seed: int) -> None:
    rng = np.random.default_rng(seed)
    node = int(rng.choice(np.setdiff1d(np.arange(spec.num_nodes), spec.root)))
    grown = clone_branch(spec, node, rng.uniform(size=spec.num_nodes + 1))
    validate_tree(grown)
    copied = branch_leaves(spec, node)
    origin = np.concatenate([np.arange(spec.num_states), copied])
    assert grown.num_states == len(origin)
    assert grown.leaf_parent[: spec.num_states].tolist() == spec.leaf_parent.tolist()
    assert_same_model(spec, grown, origin, seed)


@given(trees(), st.integers(0, 1000), st.floats(0.5, 0.99))
@settings(max_examples=40, deadline=None)
def test_a_new_level_changes_nothing(spec: TreeSpec, seed: int, strong: float) -> None:
    node = int(np.random.default_rng(seed).integers(spec.root, spec.num_nodes))
    grown = new_level(spec, node, strong)
    validate_tree(grown)
    copied = branch_leaves(spec, node)
    assert_same_model(spec, grown, np.concatenate([np.arange(spec.num_states), copied]), seed)
    deepest = spec.depth[copied].max() + 1
    assert grown.depth[spec.num_states : grown.num_states].max() == deepest


@given(trees(most=6), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_edits_one_after_the_other_change_nothing(spec: TreeSpec, seed: int) -> None:
    rng, first, origin = np.random.default_rng(seed), spec, np.arange(spec.num_states)
    for turn in range(3):
        internal = np.arange(spec.root, spec.num_nodes)
        if turn == 1:
            node = int(rng.choice(internal))
            grown = new_level(spec, node, 0.95)
        else:
            node = int(rng.choice(np.setdiff1d(np.arange(spec.num_nodes), spec.root)))
            grown = clone_branch(spec, node, rng.uniform(size=spec.num_nodes + 1))
        origin, spec = np.concatenate([origin, origin[branch_leaves(spec, node)]]), grown
    validate_tree(spec)
    assert_same_model(first, spec, origin, seed)


def test_the_comparison_notices_copies_that_differ() -> None:
    spec = make_tree(0, 6, 3)
    grown = clone_branch(spec, 0, np.full(spec.num_nodes + 1, 0.3))
    other = make_tree(1, 6, 3)
    with pytest.raises(AssertionError):
        assert_same_model(other, grown, np.append(np.arange(6), 0))


def test_shares_go_where_they_should() -> None:
    spec, shares = thesis_tree(), np.full(9, 0.5)
    shares[[0, 1, -1]] = 0.9, 0.2, 0.7
    old, new = np.exp(spec.log_horizontal[0]), np.exp(clone_branch(spec, 1, shares).log_horizontal[0])
    np.testing.assert_allclose(new[0, [1, 5]], old[0, 1] * np.array([0.1, 0.9]))
    np.testing.assert_allclose(new[1, [1, 5]], old[1, 1] * np.array([0.8, 0.2]))
    np.testing.assert_allclose(new[5, [1, 5]], old[1, 1] * np.array([0.8, 0.2]))
    down = np.exp(clone_branch(spec, 1, shares).log_vertical[0, 1])
    np.testing.assert_allclose(down[[1, 5]], 0.2 * np.array([0.3, 0.7]))


def test_wrong_arguments_are_named() -> None:
    spec = thesis_tree()
    with pytest.raises(ValueError, match="and not the root, got 5"):
        clone_branch(spec, 5, np.full(9, 0.5))
    with pytest.raises(ValueError, match=r"shares must be \[9\] between 0 and 1"):
        clone_branch(spec, 0, np.full(9, 1.5))
    with pytest.raises(ValueError, match="must be an internal state, got 4"):
        new_level(spec, 4, 0.9)
