"""The flat model's split on the leaves of a tree."""

from __future__ import annotations

import numpy as np
import pytest

from jaxpomdp.structure.leaf_split import LEAF_SPLIT, returns_of_leaves
from jaxpomdp.structure.splits import SplitConfig
from jaxpomdp.structure.tree import validate_tree
from jaxpomdp.structure.tree_evidence import tree_evidence
from jaxpomdp.structure.tree_forms import flatten_tree
from jaxpomdp.structure.tree_init import random_tree

LEAVES, ACTIONS, STEPS = 6, 2, 4000
CONFIG = SplitConfig(stay=0.9, jitter=0.0)


def evidence(seed: int, *, two_modes: bool):
    """A known path of leaves; the return of leaf 2 has two modes, or one, and all others have one."""
    rng = np.random.default_rng(seed)
    path, actions = rng.integers(LEAVES, size=STEPS), rng.integers(ACTIONS, size=STEPS)
    returns = rng.normal(size=STEPS)
    returns += np.where((path == 2) & (rng.random(STEPS) < 0.5), 8.0 * two_modes, 0.0)
    pairs = np.zeros((STEPS, LEAVES + 1, LEAVES))
    pairs[np.arange(STEPS), np.roll(path, 1), path] = 1
    edges = np.linspace(returns.min(), returns.max() + 1e-6, 65)
    counts = {"num_actions": ACTIONS, "num_symbols": 2}
    found = tree_evidence(pairs, actions, np.zeros(STEPS, int), returns, edges, **counts)
    return found, path, actions, returns


def test_returns_are_those_of_the_leaves():
    found, path, actions, returns = evidence(0, two_modes=True)
    of_leaves = returns_of_leaves(found, ACTIONS)
    for leaf in range(LEAVES):
        for action in range(ACTIONS):
            mine = returns[(path == leaf) & (actions == action)]
            assert of_leaves.mean[leaf, action] == pytest.approx(mine.mean())
            assert of_leaves.var[leaf, action] == pytest.approx(mine.var())
            assert of_leaves.weight[leaf, action] == len(mine)
    assert returns_of_leaves(found, 1).mean[3, 0] == pytest.approx(returns[path == 3].mean())


def test_a_leaf_of_two_modes_is_split_and_no_other():
    spec = random_tree(0, LEAVES, ACTIONS)
    edits = LEAF_SPLIT.propose(spec, evidence(1, two_modes=True)[0], CONFIG)
    assert [edit.node for edit in edits] == [2]
    grown = LEAF_SPLIT.apply(spec, edits[0])
    validate_tree(grown)
    assert grown.num_states == LEAVES + 1
    np.testing.assert_array_equal(edits[0].origin, [0, 1, 2, 3, 4, 5, 2])
    np.testing.assert_allclose(sorted(grown.return_mean[[2, LEAVES], 0]), [0, 8], atol=0.5)
    assert not LEAF_SPLIT.propose(spec, evidence(1, two_modes=False)[0], CONFIG)


def test_the_copies_together_are_the_leaf():
    """What leads to the two adds up to what led to the one, and both lead on as it did."""
    spec = random_tree(3, LEAVES, ACTIONS)
    edit = LEAF_SPLIT.propose(spec, evidence(1, two_modes=True)[0], CONFIG)[0]
    before = np.exp(flatten_tree(spec).log_trans)
    after = np.exp(flatten_tree(LEAF_SPLIT.apply(spec, edit)).log_trans)
    joined = after[:, :, :LEAVES].copy()
    joined[:, :, 2] += after[:, :, LEAVES]
    np.testing.assert_allclose(joined[:, :LEAVES], before, atol=1e-12)
    np.testing.assert_allclose(joined[:, LEAVES], before[:, 2], atol=1e-12)


def test_a_copy_stays_itself():
    spec = random_tree(0, LEAVES, ACTIONS)
    edit = LEAF_SPLIT.propose(spec, evidence(1, two_modes=True)[0], CONFIG)[0]
    across = np.exp(LEAF_SPLIT.apply(spec, edit).log_horizontal)
    for one, other in ((2, LEAVES), (LEAVES, 2)):
        np.testing.assert_allclose(across[:, one, one], 9 * across[:, one, other], rtol=1e-6)


def test_an_edit_of_another_tree_is_refused():
    spec = random_tree(0, LEAVES, ACTIONS)
    edit = LEAF_SPLIT.propose(spec, evidence(1, two_modes=True)[0], CONFIG)[0]
    with pytest.raises(ValueError, match="7 states"):
        LEAF_SPLIT.apply(random_tree(0, LEAVES + 1, ACTIONS), edit)
    with pytest.raises(ValueError, match=r"evidence\.transitions"):
        LEAF_SPLIT.propose(random_tree(0, LEAVES + 1, ACTIONS), evidence(1, two_modes=True)[0], CONFIG)
