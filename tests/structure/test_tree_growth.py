"""The log of edits replayed gives the shape that the edits made, step by step."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.hierarchy.planted import simulate, world
from jaxpomdp.structure.operators import TREE_SPLITS
from jaxpomdp.structure.policy import PolicyConfig, revise
from jaxpomdp.structure.tree_edits import shape_of
from jaxpomdp.structure.tree_growth import Shape, grown_to, replayed
from jaxpomdp.structure.tree_tests import TreeSplitConfig

EAGER = TreeSplitConfig(significance=0.9, correction="none", minimum_weight=5)


def grown(seed: int, phases: int = 4):
    """The tree before and after some phases of all four operators, and the rows of the log, through JSON."""
    spec, rows = world(seed), []
    first = spec
    for phase in range(phases):
        evidence = simulate(spec, seed + phase, 3000, "uncle", 0, shift=3.0)
        policy = PolicyConfig(node_cap=60, edits_per_phase=4)
        operators = [(operator, EAGER) for operator, _ in np.roll(np.array(TREE_SPLITS, object), phase, 0)]
        revision = revise(spec, evidence, phase=phase, policy=policy, operators=operators)
        spec, rows = revision.spec, rows + revision.rows
    return first, spec, [json.loads(json.dumps(row)) for row in rows]


@pytest.mark.parametrize("seed", range(4))
def test_the_log_replayed_on_the_first_tree_gives_the_last(seed: int) -> None:
    first, last, rows = grown(seed)
    shapes = replayed(shape_of(first), rows)
    assert len(shapes) == len(rows) + 1
    for got, wanted in zip(shapes[-1], shape_of(last), strict=True):
        np.testing.assert_array_equal(got, wanted)
    assert [len(shape.leaf_parent) for shape in shapes[1:]] == [row["states_after"] for row in rows]
    middle = len(rows) // 2
    steps = grown_to(shape_of(first), shapes[middle], rows)
    assert [step.row for step in steps] == [None, *rows[:middle]]


def test_edits_of_trees_that_were_given_up_are_left_out() -> None:
    """The agent goes back to the tree after two edits, and grows that one by others."""
    first, _, rows = grown(0)
    shapes = replayed(shape_of(first), rows)
    back = shapes[2]
    again = {"operator": "brother", "top": "s0", "states_before": len(back.leaf_parent)}
    again["states_after"] = again["states_before"] + 1
    last = replayed(back, [again])[-1]
    steps = grown_to(shape_of(first), last, [*rows, again])
    assert [step.row for step in steps] == [None, *rows[:2], again]
    given_up = grown_to(shape_of(first), shapes[-1], [*rows, again])
    assert len(given_up) == len(rows) + 1, "and the tree before going back is found as well"


def test_all_operators_are_among_those_replayed() -> None:
    kinds = {row["operator"] for seed in range(4) for row in grown(seed)[2]}
    assert kinds == {"observation", "brother", "uncle", "parent"}


def test_another_log_does_not_lead_there() -> None:
    first, last, rows = grown(0)
    with pytest.raises(ValueError, match="do not lead from the first tree"):
        grown_to(shape_of(first), Shape(last.leaf_parent[::-1], last.node_parent), rows)
    with pytest.raises(ValueError, match="of s0 fits no tree before it"):
        grown_to(shape_of(first), shape_of(last), [rows[0] | {"top": "s0", "states_before": 50}])
    with pytest.raises(ValueError, match="must fit a tree of 9 leaves"):
        replayed(shape_of(first), rows[1:])
    with pytest.raises(ValueError, match=r"must make \d+ leaves, got"):
        replayed(shape_of(first), [rows[0] | {"states_after": 99}])
    with pytest.raises(ValueError, match="operator must be one of"):
        replayed(shape_of(first), [rows[0] | {"operator": "state"}])
