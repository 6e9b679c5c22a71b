"""Coupled trees as values: equality, print, and mistakes that are named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jaxpomdp.structure.coupled_tree import coupled_tree, validate_coupled_tree
from jaxpomdp.structure.tree_forms import flatten_tree
from tests.structure.coupled_trees import over
from tests.structure.trees import make_tree, thesis_tree


def test_a_tree_alone_is_a_valid_coupled_tree() -> None:
    for seed in range(5):
        tree = make_tree(seed, 6, 3)
        spec = coupled_tree(tree)
        validate_coupled_tree(spec)
        assert not spec.heeded.any()
        np.testing.assert_array_equal(spec.log_alone, flatten_tree(tree).log_trans)
        assert (spec.num_states, spec.num_actions) == (6, 2)


def test_specs_are_equal_when_every_number_is() -> None:
    tree = make_tree(0, 5, 2)
    spec = over(tree, 0)
    assert spec == over(make_tree(0, 5, 2), 0)
    assert spec != over(tree, 1)
    assert spec != replace(spec, tree=make_tree(1, 5, 2))
    assert spec != tree


def test_what_is_written_is_printed() -> None:
    text = str(over(thesis_tree(), 3, zeros=0.5))
    assert "TreeSpec of 5 leaves" in text
    assert "nodes of the memory heeded" in text
    assert "remembered: heeded 0." in text


def test_mistakes_are_named() -> None:
    spec = over(make_tree(0, 5, 2), 0)
    with pytest.raises(ValueError, match=r"log_heed must have shape"):
        replace(spec, log_heed=spec.log_heed[:4])
    with pytest.raises(ValueError, match=r"log_lead: probabilities must sum to 1, got 1.1"):
        validate_coupled_tree(replace(spec, log_lead=spec.log_lead + np.log(1.1)))
    with pytest.raises(ValueError, match="log_note must be finite, got NaN or infinity at"):
        validate_coupled_tree(replace(spec, log_note=spec.log_note - np.inf))
