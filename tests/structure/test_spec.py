"""Specs: immutable, equal by value, printable, and clear about what is wrong."""

from __future__ import annotations

import ast
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxpomdp.structure import spec as spec_module
from jaxpomdp.structure.spec import NEG, Channel, FlatSpec, safe_log, validate
from tests.structure.worlds import random_spec


def test_specs_are_equal_by_value() -> None:
    assert random_spec(0, 4) == random_spec(0, 4)
    assert random_spec(0, 4) != random_spec(1, 4)
    assert random_spec(0, 4) != "a model"
    assert random_spec(0, 4).emissions[0] != "a channel"
    changed = dict(random_spec(0, 4).emissions[1].values) | {"mean": np.zeros((4, 2))}
    other = (random_spec(0, 4).emissions[0], Channel("DiagonalGaussian", changed))
    assert replace(random_spec(0, 4), emissions=other) != random_spec(0, 4)


def test_specs_cannot_be_changed() -> None:
    spec = random_spec(0, 3)
    for array in (spec.log_init, spec.log_trans, spec.return_mean, spec.emissions[0].values["log_prob"]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(TypeError):
        spec.emissions[0].values["log_prob"] = np.zeros(3)  # type: ignore[index]


def test_a_zero_stays_zero() -> None:
    assert safe_log(np.array([0.0, 1.0], np.float32)).dtype == np.float32
    assert np.exp(safe_log(np.array([0.0]))) == 0
    assert random_spec(0, 6).log_trans.min() == NEG


def test_print_shows_each_state() -> None:
    text = str(random_spec(3, 4, per_action=True))
    assert text.splitlines()[0] == (
        "FlatSpec of 4 states, 2 actions, channels Categorical[3], DiagonalGaussian[2], "
        "a return per state and action"
    )
    assert [line.split(":")[0].strip() for line in text.splitlines()[1:]] == [f"state {n}" for n in range(4)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log_init": np.zeros((2, 2))}, r"log_init must have shape \(any\), got \(2, 2\)"),
        ({"log_init": np.zeros(0)}, r"at least one state"),
        ({"log_trans": np.zeros((2, 3, 4))}, r"log_trans must have shape \(any, 3, 3\), got \(2, 3, 4\)"),
        ({"return_mean": np.zeros((2, 1))}, r"return_mean must have shape \(3, any\)"),
        ({"return_var": np.ones((3, 2))}, r"return_var must have shape \(3, 1\), got \(3, 2\)"),
        ({"return_mean": np.zeros((3, 5)), "return_var": np.ones((3, 5))}, "1 or 2 columns .* got 5"),
        (
            {"emissions": (Channel("Categorical", {"log_prob": np.zeros((2, 3))}),)},
            r"emissions\[0\].log_prob",
        ),
    ],
)
def test_wrong_shapes_are_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(random_spec(0, 3), **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log_init": np.full(3, np.nan)}, r"log_init must be finite, got NaN or infinity at \(0,\)"),
        ({"log_trans": np.zeros((2, 3, 3))}, r"log_trans: .* sum to 1, got 3 in row \(0, 0\)"),
        ({"return_var": np.zeros((3, 1))}, "return_var must be positive, got 0"),
        ({"emissions": (Channel("Categorical", {"log_prob": np.zeros((3, 2))}),)}, "sum to 1, got 2"),
    ],
)
def test_wrong_numbers_are_named(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        validate(replace(random_spec(0, 3), **change))


def test_words_are_no_numbers() -> None:
    with pytest.raises(TypeError, match="init must be an array of numbers, got list"):
        FlatSpec.from_probabilities(["a"], np.ones((1, 1, 1)))


def test_structure_does_not_need_jax() -> None:
    """Read the sources, since the package above may load JAX anyway."""
    allowed = {"numpy", "scipy", "jaxpomdp.structure", "__future__", *sys.stdlib_module_names}
    for path in Path(spec_module.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                parts = name.split(".")
                assert parts[0] in allowed or ".".join(parts[:2]) in allowed, f"{path.name} imports {name}"
