"""Coupled specs: shapes and numbers are checked, with names; equality, immutability, and how they print."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jaxpomdp.structure.coupled_spec import CoupledSpec, StrandSpec, validate
from tests.structure.worlds import random_coupled


@pytest.fixture(params=[False, True], ids=["product", "mixture"])
def spec(request: pytest.FixtureRequest) -> CoupledSpec:
    return random_coupled(0, (4, 2), request.param)


def test_a_random_spec_is_valid_and_equal_to_itself_alone(spec: CoupledSpec) -> None:
    validate(spec)
    assert spec == random_coupled(0, (4, 2), spec.log_weights is not None)
    assert spec != random_coupled(1, (4, 2), spec.log_weights is not None)
    assert spec != random_coupled(0, (4, 2), spec.log_weights is None)
    assert (spec.num_states, spec.num_actions, spec.sizes) == (4, 2, (4, 2))


def test_arrays_are_read_only(spec: CoupledSpec) -> None:
    for _, array in spec.arrays():
        assert not array.flags.writeable


def test_it_prints_every_state(spec: CoupledSpec) -> None:
    lines = str(spec).splitlines()
    rule = "product" if spec.log_weights is None else "mixture"
    assert lines[0] == f"CoupledSpec of strands of 4 and 2 states, 2 actions, {rule} coupling"
    assert len([line for line in lines if "starts" in line]) == 6
    assert ("heeds" in lines[1]) == (rule == "mixture")


def test_shapes_that_disagree_are_named(spec: CoupledSpec) -> None:
    pairs = spec.log_pairs
    with pytest.raises(ValueError, match=r"log_pairs\[0\]\[1\] must have shape \(2, 2, 4\)"):
        replace(spec, log_pairs=((pairs[0][0], pairs[1][0]), pairs[1]))
    with pytest.raises(ValueError, match="log_pairs must be 2 by 2"):
        replace(spec, log_pairs=pairs[:1])
    with pytest.raises(ValueError, match="strands must be at least two"):
        replace(spec, strands=spec.strands[:1])
    with pytest.raises(ValueError, match="columns, got 3"):
        replace(
            spec, strands=(spec.strands[0], StrandSpec(np.zeros(2), (), np.ones((2, 3)), np.ones((2, 3))))
        )
    with pytest.raises(ValueError, match="log_weights must have shape"):
        replace(spec, log_weights=np.zeros((3, 3)))
    with pytest.raises(ValueError, match="must both be given"):
        StrandSpec(np.zeros(2), (), np.ones((2, 1)))
    with pytest.raises(ValueError, match="at least one state"):
        StrandSpec(np.zeros(0))


def test_numbers_that_make_no_sense_are_named(spec: CoupledSpec) -> None:
    with pytest.raises(ValueError, match="log_alone must be finite"):
        validate(replace(spec, log_alone=spec.log_alone * np.nan))
    with pytest.raises(ValueError, match="log_alone: probabilities must sum to 1"):
        validate(replace(spec, log_alone=spec.log_alone + 1))
    paid = replace(spec.strands[1], return_var=np.zeros((2, 1)))
    with pytest.raises(ValueError, match=r"strands\[1\].return_var must be positive"):
        validate(replace(spec, strands=(spec.strands[0], paid)))
