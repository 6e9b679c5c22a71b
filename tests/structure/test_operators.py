"""The tree's operators: the laws of edits, what they find when it is there, and that they keep quiet else."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.hierarchy.planted import KINDS, draw, known, simulate, world
from jaxpomdp.structure.edits import Allowance
from jaxpomdp.structure.operators import TREE_SPLITS, propose
from jaxpomdp.structure.policy import PolicyConfig, revise
from jaxpomdp.structure.significance import two_sample
from jaxpomdp.structure.spec import Channel
from jaxpomdp.structure.tree import TreeSpec, validate_tree
from jaxpomdp.structure.tree_evidence import conditioned, effective
from jaxpomdp.structure.tree_forms import starting_over
from jaxpomdp.structure.tree_tests import TreeSplitConfig, activations, brothers, uncles
from tests.structure.trees import make_tree, thesis_tree

OPERATORS = {operator.kind: operator for operator, _ in TREE_SPLITS}


def eager(seed: int, kind: str):
    """Edits found in planted data by tests that ask for little."""
    spec = world(seed)
    evidence = simulate(spec, seed, 3000, kind, leaf=seed % 9, shift=3.0)
    return spec, propose(kind, spec, evidence, TreeSplitConfig(significance=0.5, correction="none"))


@pytest.mark.parametrize("kind", KINDS)
def test_edits_keep_the_laws(kind: str) -> None:
    """Rows stay stochastic, the origin is onto and of the right length, the log row is JSON."""
    made = 0
    for seed in range(8):
        spec, edits = eager(seed, kind)
        for edit in edits:
            grown = OPERATORS[kind].apply(spec, edit)
            validate_tree(grown)
            assert len(edit.origin) == grown.num_states
            assert set(edit.origin.tolist()) == set(range(spec.num_states))
            assert grown.leaf_parent[: spec.num_states].tolist() == spec.leaf_parent.tolist()
            assert json.loads(json.dumps(edit.row()))["operator"] == kind
            assert OPERATORS[kind].shrink(edit, len(edit.copied) - 1) is None
            made += 1
    assert made > 5


def test_each_operator_grows_what_it_should() -> None:
    for kind, leaves, internal, deeper in (
        ("observation", 1, 0, 0),
        ("brother", 1, 0, 0),
        ("uncle", 3, 1, 0),
        ("parent", 3, 1, 1),
    ):
        spec, edits = next((s, e) for s, e in (eager(seed, kind) for seed in range(20)) if e)
        grown = OPERATORS[kind].apply(spec, edits[0])
        sizes = grown.num_states - 9, grown.num_internal - 4, grown.depth.max() - 2
        assert sizes == (leaves, internal, deeper), kind


@pytest.mark.parametrize("kind", KINDS)
def test_a_planted_inconsistency_is_found_where_it_is(kind: str) -> None:
    spec = world(3)
    hits = []
    for leaf in range(9):
        edits = propose(kind, spec, simulate(spec, leaf, 20_000, kind, leaf, shift=3.0))
        hits.append(bool(edits) and edits[0].node == leaf)
    assert sum(hits) >= (3 if kind == "parent" else 6), hits


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_planted_nothing_found(kind: str) -> None:
    """At a level of 5 %, corrected: at most 5 of 30 by more than a slip (chance of more: under 1 %)."""
    config = TreeSplitConfig(significance=0.05)
    fired = 0
    for seed in range(30):
        spec = world(seed)
        fired += bool(propose(kind, spec, simulate(spec, seed, 2000), config))
    assert fired <= 5


def test_conditions_are_sets_of_previous_leaves() -> None:
    """The last column is the start of a trial, which enters a leaf through its parent."""
    spec = thesis_tree()
    by_brother, by_uncle = brothers(spec, 0), uncles(spec, 0)
    assert by_brother.nodes.tolist() == [0, 1, -1]
    assert by_brother.groups.sum(0).tolist() == [1] * 6
    assert by_brother.groups[-1].tolist() == [0, 0, 1, 1, 1, 1]
    assert brothers(spec, 4).groups[-1].tolist() == [0, 0, 0, 0, 0, 1]
    assert by_uncle.nodes.tolist() == [4, 7]
    assert by_uncle.groups.astype(int).tolist() == [[0, 0, 0, 0, 1, 0], [0, 0, 1, 1, 0, 0]]
    assert len(uncles(spec, 4).nodes) == 0


def test_activations_weigh_how_probable_it_is_that_the_parent_started_over() -> None:
    spec = make_tree(0, 9, 3)
    leaf, over = 4, starting_over(spec)
    transitions = np.random.default_rng(0).uniform(size=(2, 9, 9))
    own, other = activations(spec, over, leaf, transitions).groups
    inside = spec.below[spec.parent[leaf]]
    assert other[:9].tolist() == (~inside).tolist()
    assert (own[9], other[9]) == (0, 1)
    for k in range(9):
        weight = transitions[:, k, leaf]
        assert own[k] == pytest.approx(over[:, k, leaf] @ weight / weight.sum())


def test_the_root_of_one_level_splits_where_a_start_makes_a_difference() -> None:
    spec = world(0, levels=1)
    evidence = simulate(spec, 0, 20_000, "parent", 2, shift=3.0, length=10, group=1)
    edit = propose("parent", spec, evidence)[0]
    assert (edit.node, edit.details.conditions) == (2, ("i0", "entry"))
    assert sorted(edit.copied) == list(range(5))
    grown = OPERATORS["parent"].apply(spec, edit)
    validate_tree(grown)
    assert (grown.depth.max(), grown.num_states, grown.num_internal) == (2, 10, 2)
    assert np.exp(grown.log_vertical[0, 0, -1]) == pytest.approx(edit.details.strong)


def test_a_weighted_histogram_is_worth_its_effective_number() -> None:
    """Kish: even weights count every observation once, and sets of leaves are left as they are."""
    table = np.zeros((3, 1, 1, 4))
    table[:, 0, 0] = [[1, 2, 3, 4], [4, 3, 2, 1], [5, 5, 5, 5]]
    even, half, hard = effective(table, 0, np.array([[0.2, 0.2, 0.2], [0.5, 0.5, 0], [0, 1, 1]]))[:, 0]
    np.testing.assert_allclose(even, table.sum(0)[0, 0])
    np.testing.assert_allclose(half, table[:2].sum(0)[0, 0])
    np.testing.assert_allclose(hard, table[1:].sum(0)[0, 0])
    uneven = effective(table, 0, np.array([[1.0, 0.1, 0.0]]))[0, 0]
    assert uneven.sum() == pytest.approx((10 + 1) ** 2 / (10 + 0.1))


def test_soft_labels_that_mean_nothing_are_found_no_more_often_than_the_level() -> None:
    """A thousand tests of weighted histograms against unweighted ones; unscaled ones are far too careful."""
    rng = np.random.default_rng(0)
    groups = np.array([[0.05, 0.3, 0.6, 0.0], [0, 0, 0, 1]])
    rejected = np.zeros(2)
    for _ in range(1000):
        table = rng.multinomial(300, np.full(8, 1 / 8), 4)[:, None, None].astype(float)
        for i, gather in enumerate((effective, conditioned)):
            left, right = gather(table, 0, groups)
            rejected[i] += two_sample(left[0], right[0]).p_value < 0.05
    assert 30 <= rejected[0] <= 75
    assert rejected[1] < 20


def test_a_phase_of_edits_holds_the_cap_and_composes() -> None:
    """All four operators at once, many edits: no two of one branch, and an origin that is onto."""
    config = TreeSplitConfig(significance=0.9, correction="none", minimum_weight=5)
    operators = [(operator, config) for operator, _ in TREE_SPLITS]
    for seed in range(5):
        spec = world(seed)
        evidence = simulate(spec, seed, 3000, "uncle", 0, shift=3.0)
        policy = PolicyConfig(node_cap=16, edits_per_phase=5, cool_down=2)
        revision = revise(spec, evidence, phase=0, policy=policy, operators=operators)
        validate_tree(revision.spec)
        assert len(revision.rows) > 1
        assert revision.spec.num_states == len(revision.origin) <= 16
        assert set(revision.origin.tolist()) == set(range(9))


def test_allowances_and_wrong_arguments() -> None:
    spec, edits = eager(0, "uncle")
    evidence = simulate(spec, 0, 3000, "uncle", 0, shift=3.0)
    assert propose("uncle", spec, evidence, allowance=Allowance(room=0)) == []
    assert propose("uncle", spec, evidence, allowance=Allowance(room=2)) == []
    assert propose("uncle", spec, evidence, allowance=Allowance(resting=np.ones(9, bool))) == []
    with pytest.raises(ValueError, match=r"evidence.transitions must have shape \(2, 5, 5\)|\(1, 5, 5\)"):
        propose("uncle", thesis_tree(), evidence)
    with pytest.raises(ValueError, match="edit must be for 5 leaves, got 9"):
        OPERATORS["uncle"].apply(thesis_tree(), edits[0])
    with pytest.raises(ValueError, match="strong must be between 0 and 1"):
        TreeSplitConfig(strong=1.5)


def of_two_channels(spec: TreeSpec, second: int) -> TreeSpec:
    """The second channel says nothing at first: even rows."""
    even = Channel("Categorical", {"log_prob": np.full((spec.num_states, second), -np.log(second))})
    number = Channel("DiagonalGaussian", {"mean": np.zeros((spec.num_states, 1))})
    return replace(spec, emissions=(number, *spec.emissions, even))


def test_every_channel_that_symbols_code_is_told_apart() -> None:
    """Planted in the second channel; the first, which does not depend on what was before, stays as it is."""
    spec, leaf = world(0), 4
    tape = draw(spec, 0, 20_000)
    rng = np.random.default_rng(1)
    after = np.concatenate([np.full((len(tape.states), 1), 9), tape.states[:, :-1]], 1)
    brother = int(brothers(spec, leaf).nodes[0])
    marked = (tape.states == leaf) & (after == brother)
    second = np.where(marked & (rng.uniform(size=marked.shape) < 0.6), 2, rng.integers(3, size=marked.shape))
    both = of_two_channels(spec, 3)
    evidence = known(spec, tape._replace(symbols=tape.symbols * 3 + second), symbols=12)
    edit = propose("observation", both, evidence)[0]
    assert (edit.node, f"s{brother}" in edit.details.conditions) == (leaf, True)
    grown = OPERATORS["observation"].apply(both, edit)
    validate_tree(grown)
    first, other = (np.exp(c.values["log_prob"]) for c in grown.emissions[1:])
    fitting = other[[leaf, 9]][:, 2].argmax()
    assert other[[leaf, 9][fitting], 2] == pytest.approx(0.6 + 0.4 / 3, abs=0.1)
    row = np.exp(spec.emissions[0].values["log_prob"])[leaf]
    np.testing.assert_allclose(first[[leaf, 9]], np.stack([row, row]), atol=0.1)
    np.testing.assert_array_equal(other[:leaf], np.full((leaf, 3), 1 / 3))


def test_symbols_of_the_first_channel_leave_the_second_and_bins_leave_all() -> None:
    spec = world(0)
    both = of_two_channels(spec, 3)
    edit = eager(0, "observation")[1][0]
    old = both.emissions[1].values["log_prob"][edit.node]
    _, first, second = OPERATORS["observation"].apply(both, edit).emissions
    assert (first.values["log_prob"][edit.node] != old).any()
    np.testing.assert_array_equal(second.values["log_prob"], np.full((10, 3), -np.log(3)))
    bins = edit.details._replace(symbols=np.full((2, 7), 1 / 7))
    _, first, _ = OPERATORS["observation"].apply(both, replace(edit, details=bins)).emissions
    np.testing.assert_array_equal(first.values["log_prob"][[edit.node, 9]], np.stack([old, old]))
