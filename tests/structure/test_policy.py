"""The policy: budget, cap, rest, order; edits of one phase made one after the other; their log."""

from __future__ import annotations

import json

import numpy as np
import pytest

from jaxpomdp.structure.policy import PolicyConfig, revise
from jaxpomdp.structure.spec import validate
from jaxpomdp.structure.splits import STATE_SPLIT, SplitConfig
from tests.structure.worlds import evidence_of, log_evidence, random_spec


def lumpy(states: int, lumps: int = 2, count: int = 400) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.normal(8.0 * rng.integers(0, lumps, count), 1.0) for _ in range(states)]


def test_several_splits_in_one_phase() -> None:
    spec, evidence = random_spec(0, 4), evidence_of(lumpy(4))
    policy = PolicyConfig(edits_per_phase=3)
    new, origin, rest, rows = revise(spec, evidence, phase=0, policy=policy, rng=np.random.default_rng(0))
    validate(new)
    assert new.num_states == len(origin) == len(rest) == 7
    assert len({row["node"] for row in rows}) == 3
    assert origin.tolist() == [0, 1, 2, 3] + [row["node"] for row in rows]
    assert [row["states_after"] for row in rows] == [5, 6, 7]
    rng = np.random.default_rng(1)
    data = rng.integers(0, 3, 20), rng.integers(0, 2, 19)
    np.testing.assert_allclose(log_evidence(new, *data), log_evidence(spec, *data), rtol=1e-10)
    json.dumps(rows)


def test_the_cap_is_never_passed() -> None:
    spec, evidence = random_spec(0, 3), evidence_of(lumpy(3, lumps=4))
    for cap in range(3, 10):
        policy = PolicyConfig(node_cap=cap, edits_per_phase=9)
        new = revise(spec, evidence, phase=0, policy=policy).spec
        assert new.num_states <= cap
        assert new.num_states == cap or cap > 6
    with pytest.raises(ValueError, match="at most node_cap=2 states, got 3"):
        revise(spec, evidence, phase=0, policy=PolicyConfig(node_cap=2))


def test_edited_states_rest() -> None:
    spec, evidence = random_spec(0, 1), evidence_of(lumpy(1))
    policy = PolicyConfig(cool_down=2)
    new, _, rest, _ = revise(spec, evidence, phase=0, policy=policy)
    assert rest.tolist() == [2, 2]
    evidence = evidence_of(lumpy(2))
    for phase, wanted in ((1, [1, 1]), (2, [0, 0])):
        same, origin, rest, rows = revise(new, evidence, phase=phase, rest=rest, policy=policy)
        assert same is new
        assert origin.tolist() == [0, 1]
        assert rest.tolist() == wanted
        assert rows == []
    assert revise(new, evidence, phase=3, rest=rest, policy=policy).spec.num_states == 3


def test_phases_without_edits() -> None:
    spec, evidence = random_spec(0, 1), evidence_of(lumpy(1))
    policy = PolicyConfig(first_phase=2, every=3)
    edited = [p for p in range(9) if revise(spec, evidence, phase=p, policy=policy).spec is not spec]
    assert edited == [2, 5, 8]


def test_operators_share_the_budget_and_leave_each_others_states_alone() -> None:
    spec, evidence = random_spec(0, 4), evidence_of(lumpy(4))
    picky = (STATE_SPLIT, SplitConfig(minimum_effect=100))
    loose = (STATE_SPLIT._replace(kind="state"), SplitConfig())
    policy = PolicyConfig(edits_per_phase=3)
    rows = revise(spec, evidence, phase=0, policy=policy, operators=(picky, loose, loose)).rows
    assert len({row["node"] for row in rows}) == len(rows) == 3


def test_the_same_seed_gives_the_same_model() -> None:
    spec, evidence = random_spec(0, 2), evidence_of(lumpy(2))
    one, two, three = (
        revise(spec, evidence, phase=0, rng=np.random.default_rng(seed)).spec for seed in (0, 0, 1)
    )
    assert one == two
    assert one != three


def test_rest_of_another_length_is_named() -> None:
    with pytest.raises(ValueError, match=r"rest must have shape \(2,\), got \(3,\)"):
        revise(random_spec(0, 2), evidence_of(lumpy(2)), phase=0, rest=np.zeros(3, int))


@pytest.mark.parametrize("name", ["node_cap", "edits_per_phase", "every", "first_phase", "cool_down"])
def test_settings_out_of_range_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} must be at least"):
        PolicyConfig(**{name: -1})
