"""Operators on coupled hierarchies: both chains are edited alike, and the cousin split writes the memory."""

from __future__ import annotations

import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.hierarchy.planted import simulate, world
from jaxpomdp._types import TrialBatch
from jaxpomdp.coupled_packing import pack_coupled_trees
from jaxpomdp.models.coupled_tree import COUPLED_TREE
from jaxpomdp.models.em import EMConfig, e_step
from jaxpomdp.structure.coupled_tree import CoupledTreeSpec, coupled_tree, validate_coupled_tree
from jaxpomdp.structure.coupled_tree_edits import (
    COUPLED_TREE_OPERATORS,
    CousinSplitConfig,
    follow,
    propose_cousin,
    write_memory,
)
from jaxpomdp.structure.edits import Allowance
from jaxpomdp.structure.policy import PolicyConfig, revise
from jaxpomdp.structure.tree_edits import branch_leaves, clone_branch, new_level
from jaxpomdp.structure.tree_forms import flatten_tree
from jaxpomdp.structure.tree_tests import TreeSplitConfig, cousins
from tests.structure.coupled_trees import coupled_trees, over
from tests.structure.trees import make_tree, thesis_tree
from tests.structure.worlds import log_evidence

EAGER = TreeSplitConfig(significance=0.5, correction="none", minimum_weight=8)
KINDS = tuple(COUPLED_TREE_OPERATORS)


def config_of(kind: str, tests: TreeSplitConfig = EAGER):
    return CousinSplitConfig(tests) if kind == "cousin" else tests


def eager(seed: int, kind: str):
    """Edits found in planted data by tests that ask for little."""
    spec = over(world(seed), seed, zeros=0.5)
    evidence = simulate(spec.tree, seed, 3000, kind, leaf=seed % 9, shift=3.0)
    return spec, COUPLED_TREE_OPERATORS[kind].propose(spec, evidence, config_of(kind))


def evidence_of(spec: CoupledTreeSpec) -> float:
    """Return the exact log-evidence of some actions and observations, returns not looked at."""
    rng, shape = np.random.default_rng(5), (1, 1, 12)
    zero, true = jnp.zeros(shape), jnp.ones(shape, bool)
    start, actions = ~true.at[..., 0].set(False), jnp.asarray(rng.integers(0, 2, shape))
    seen = (jnp.asarray(rng.integers(0, 3, shape)),)
    batch = TrialBatch(seen, actions, zero, zero, true, start, ~true, true, ~true)
    params = pack_coupled_trees([spec], spec.num_states)
    return float(e_step(COUPLED_TREE, params, batch, EMConfig()).log_evidence.sum())


def lumps(rows: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Add up what goes to copies of one leaf."""
    return np.exp(rows) @ np.eye(origin.max() + 1)[origin]


@pytest.mark.parametrize("seed", range(4))
def test_unweighted_copies_change_no_evidence(x64: None, seed: int) -> None:
    """A branch, a leaf or a level copied with any shares: evidence as before, by pairs on the device."""
    spec = over(make_tree(seed, 5, 3), seed)
    tree, rng = spec.tree, np.random.default_rng(seed)
    node = int(rng.choice(np.setdiff1d(np.arange(tree.num_nodes), tree.root)))
    edits = [(clone_branch(tree, node, rng.uniform(size=tree.num_nodes + 1)), node)]
    if node > tree.root:
        edits.append((new_level(tree, node, 0.9), node))
    for grown, top in edits:
        origin = np.concatenate([np.arange(5), branch_leaves(tree, top)])
        after = follow(spec, grown, origin)
        validate_coupled_tree(after)
        assert evidence_of(after) == pytest.approx(evidence_of(spec), abs=1e-9)


@given(coupled_trees(), st.integers(0, 1000))
@settings(max_examples=60, deadline=None)
def test_the_flat_chain_follows_the_tree(spec: CoupledTreeSpec, seed: int) -> None:
    """Copies lumped give the old rows back; a chain that acted as the tree acts as the edited tree."""
    tree, rng = spec.tree, np.random.default_rng(seed)
    node = int(rng.choice(np.setdiff1d(np.arange(tree.num_nodes), tree.root)))
    grown = clone_branch(tree, node, rng.uniform(size=tree.num_nodes + 1))
    origin = np.concatenate([np.arange(spec.num_states), branch_leaves(tree, node)])
    after = follow(spec, grown, origin)
    validate_coupled_tree(after)
    for name in ("log_lead", "log_alone"):
        want = np.exp(getattr(spec, name))[:, origin]
        np.testing.assert_allclose(lumps(getattr(after, name), origin), want, atol=1e-12)
    np.testing.assert_array_equal(after.log_heed, spec.log_heed[origin])
    plain = follow(coupled_tree(tree), grown, origin)
    np.testing.assert_allclose(np.exp(plain.log_alone), np.exp(flatten_tree(grown).log_trans), atol=1e-12)


def test_the_law_notices_a_chain_that_does_not_follow(x64: None) -> None:
    """Copies that are led to in full besides their originals, then made rows again."""
    spec = over(make_tree(0, 5, 3), 0)
    grown = clone_branch(spec.tree, 0, np.full(spec.tree.num_nodes + 1, 0.3))
    origin = np.append(np.arange(5), 0)
    after = follow(spec, grown, origin)
    lead = np.exp(spec.log_lead)[:, origin][:, :, origin]
    broken = replace(after, log_lead=np.log(lead / lead.sum(-1, keepdims=True)))
    assert evidence_of(broken) != pytest.approx(evidence_of(spec), abs=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_edits_keep_the_laws(kind: str) -> None:
    """Rows stay stochastic, the origin is onto and of the right length, the log row is JSON."""
    made = 0
    for seed in range(6):
        spec, edits = eager(seed, kind)
        operator = COUPLED_TREE_OPERATORS[kind]
        for edit in edits:
            grown = operator.apply(spec, edit)
            validate_coupled_tree(grown)
            assert edit.kind == kind
            assert grown.num_states == len(edit.origin)
            assert set(edit.origin.tolist()) == set(range(spec.num_states))
            assert json.loads(json.dumps(edit.row()))["operator"] == kind
            assert operator.shrink(edit, len(edit.copied) - 1) is None
            if kind != "cousin":
                assert grown.heeded.sum() == spec.heeded[edit.origin].sum()
            made += 1
    assert made > 5


def test_a_phase_of_edits_holds_the_cap_and_composes() -> None:
    operators = [(operator, config_of(kind)) for kind, operator in COUPLED_TREE_OPERATORS.items()]
    for seed in range(5):
        spec = coupled_tree(world(seed))
        evidence = simulate(spec.tree, seed, 3000, "cousin", 0, shift=3.0)
        policy = PolicyConfig(node_cap=18, edits_per_phase=6, cool_down=2)
        revision = revise(spec, evidence, phase=0, policy=policy, operators=operators[::-1])
        validate_coupled_tree(revision.spec)
        assert len(revision.rows) > 1
        assert revision.spec.num_states == len(revision.origin) <= 18
        assert set(revision.origin.tolist()) == set(range(9))


def planted_cousins(seed: int = 3, leaf: int = 0):
    """A clear plant, and the best edit for it."""
    spec = coupled_tree(world(seed))
    evidence = simulate(spec.tree, seed, 20_000, "cousin", leaf, shift=3.0)
    return spec, evidence, propose_cousin(spec, evidence)


def test_cousins_are_told_apart_by_the_flat_chain_alone() -> None:
    """Either cousin leads to branch or copy as often as before, but mostly to the one that fits."""
    spec, _, edits = planted_cousins()
    edit = edits[0]
    assert edit.node == 0
    grown, tree = COUPLED_TREE_OPERATORS["cousin"].apply(spec, edit), spec.tree
    left, right = (int(name[1:]) for name in edit.details.split.conditions)
    assert tree.parent[left] == tree.parent[right] != tree.parent[0]
    old, copies = np.array(edit.copied), np.arange(9, grown.num_states)
    for table in (grown.log_alone, grown.log_lead):
        rows = np.exp(table)
        for node, share in ((left, 0.05), (right, 0.95)):
            to_copies = rows[:, node][:, copies].sum(-1)
            both = to_copies + rows[:, node][:, old].sum(-1)
            np.testing.assert_allclose(to_copies / both, share, atol=1e-6)
            np.testing.assert_allclose(both, np.exp(spec.log_alone)[:, node][:, old].sum(-1), atol=1e-6)
    assert np.flatnonzero(grown.heeded).tolist() == sorted([left, right])
    np.testing.assert_allclose(np.exp(grown.log_heed[left]), [0.05, 0.95])
    np.testing.assert_allclose(np.exp(grown.log_note[left]), [0.9, 0.1])
    hierarchy = np.exp(flatten_tree(grown.tree).log_trans)
    shares = [
        hierarchy[0, n, copies].sum() / hierarchy[0, n, np.append(old, copies)].sum() for n in (left, right)
    ]
    assert shares[0] == pytest.approx(shares[1])


def test_the_plant_is_found_where_it_is_and_nothing_else() -> None:
    hits = []
    for leaf in range(9):
        edits = planted_cousins(3, leaf)[2]
        hits.append(bool(edits) and edits[0].node == leaf)
    assert sum(hits) >= 6, hits
    config = CousinSplitConfig(TreeSplitConfig(significance=0.05, minimum_weight=10))
    fired = [
        bool(propose_cousin(coupled_tree(world(seed)), simulate(world(seed), seed, 4000), config))
        for seed in range(30)
    ]
    assert sum(fired) <= 5


def test_cousins_are_children_of_one_uncle() -> None:
    spec = thesis_tree()
    found = cousins(spec, 0)
    assert (found.nodes.tolist(), found.kin.tolist()) == ([2, 3], [7, 7])
    assert found.groups.astype(int).tolist() == [[0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 0, 0]]
    assert len(cousins(spec, 4).nodes) == 0
    deep = make_tree(3, 9, 4)
    for leaf in range(9):
        found = cousins(deep, leaf)
        for node, uncle in zip(found.nodes, found.kin, strict=True):
            assert deep.parent[node] == uncle
            assert deep.parent[uncle] == deep.parent[deep.parent[leaf]] != deep.parent[leaf]


def test_what_was_written_before_is_only_shared_anew() -> None:
    spec = over(make_tree(0, 5, 3), 0)
    nodes, pairs = np.array([1]), (np.array([0]), np.array([3]))
    after = write_memory(spec, nodes, pairs, 0.75, 0.9, 0.2)
    np.testing.assert_array_equal(after.log_heed, spec.log_heed)
    np.testing.assert_array_equal(after.log_note, spec.log_note)
    old, new = np.exp(spec.log_lead[:, 1]), np.exp(after.log_lead[:, 1])
    np.testing.assert_allclose(new[:, 3], 0.75 * (old[:, 0] + old[:, 3]))
    np.testing.assert_allclose(new[:, [1, 2, 4]], old[:, [1, 2, 4]])
    deaf = write_memory(over(spec.tree, 0, deaf=True), nodes, pairs, 0.5, 0.9, 0.0)
    np.testing.assert_allclose(np.exp(deaf.log_heed[1]), [0.1, 0.9])
    np.testing.assert_allclose(np.exp(deaf.log_note[1]), [1, 0])
    assert deaf.heeded.tolist() == [False, True, False, False, False]


def test_allowances_and_wrong_arguments() -> None:
    spec, evidence, edits = planted_cousins()
    assert propose_cousin(spec, evidence, allowance=Allowance(room=0)) == []
    assert propose_cousin(spec, evidence, allowance=Allowance(resting=np.ones(9, bool))) == []
    with pytest.raises(ValueError, match="keep must be between 0 and 1"):
        CousinSplitConfig(keep=1.5)
    with pytest.raises(ValueError, match="edit must be for 5 leaves, got 9"):
        COUPLED_TREE_OPERATORS["cousin"].apply(coupled_tree(thesis_tree()), edits[0])


def test_what_the_chain_acts_by_says_the_same_of_sequences() -> None:
    """After a copy with any shares the acting chain finds sequences as likely as before."""
    spec = over(make_tree(1, 5, 3), 1)
    grown = clone_branch(spec.tree, 2, np.random.default_rng(0).uniform(size=spec.tree.num_nodes + 1))
    after = follow(spec, grown, np.append(np.arange(5), 2))
    rng = np.random.default_rng(2)
    data = rng.integers(0, 3, 30), rng.integers(0, 2, 29)
    flat = [replace(flatten_tree(x.tree), log_trans=x.log_alone) for x in (spec, after)]
    assert log_evidence(flat[0], *data) == pytest.approx(log_evidence(flat[1], *data))
