"""Splits of coupled models: rows stay rows, origins are onto, limits hold, cloning changes no evidence."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp._types import TrialBatch
from jaxpomdp.coupled_packing import pack_coupled
from jaxpomdp.models.coupled import COUPLED_MIXTURE, COUPLED_PRODUCT
from jaxpomdp.models.em import EMConfig, e_step
from jaxpomdp.structure.coupled_edits import (
    COUPLED_SPLIT,
    CoupledSplitConfig,
    add_return_states,
    clone_acting,
)
from jaxpomdp.structure.coupled_spec import CoupledSpec, StrandSpec, validate
from jaxpomdp.structure.edits import Allowance, Shares
from jaxpomdp.structure.evidence import ReturnEvidence
from jaxpomdp.structure.policy import PolicyConfig, revise
from jaxpomdp.structure.splits import SplitConfig
from tests.structure.worlds import evidence_of, random_coupled

SPLIT = SplitConfig(minimum_weight=20.0, jitter=0.5)
EXACT = EMConfig(iterations=1, theta=0.0, plan="scan")


def planted(states: int = 4) -> ReturnEvidence:
    """Return evidence in which state 1 has two clearly different returns, and the others one."""
    rng = np.random.default_rng(0)
    samples = [rng.normal(size=200) for _ in range(states)]
    samples[1] = np.concatenate([rng.normal(-6, 1, 100), rng.normal(6, 1, 100)])
    return evidence_of(samples)


def evidence(spec: CoupledSpec) -> float:
    """Return the exact log-evidence of some actions and observations."""
    rng = np.random.default_rng(5)
    steps, family = 12, COUPLED_PRODUCT if spec.log_weights is None else COUPLED_MIXTURE
    seen, actions = rng.integers(0, 3, (1, 1, steps)), rng.integers(0, 2, (1, 1, steps))
    zero, true = jnp.zeros((1, 1, steps)), jnp.ones((1, 1, steps), bool)
    start = ~true.at[..., 0].set(False)
    batch = TrialBatch(
        (jnp.asarray(seen),), jnp.asarray(actions), zero, zero, true, start, ~true, true, ~true
    )
    return float(e_step(family, pack_coupled([spec], spec.sizes), batch, EXACT).log_evidence.sum())


def uneven(spec: CoupledSpec, seed: int) -> Shares:
    rng, a, n = np.random.default_rng(seed), spec.num_actions, spec.num_states
    return Shares(*(rng.dirichlet(np.ones(3), shape) for shape in ((), (a, n), (a, 3))))


@pytest.mark.parametrize("mixture", [False, True])
def test_cloning_without_jitter_leaves_the_evidence(x64: None, mixture: bool) -> None:
    spec = random_coupled(3, (4, 2), mixture)
    cloned = clone_acting(spec, 2, uneven(spec, 0))
    validate(cloned)
    assert cloned.sizes == (6, 2)
    assert evidence(cloned) == pytest.approx(evidence(spec), abs=1e-9)
    tilted = clone_acting(spec, 2, uneven(spec, 0), 1.0, np.random.default_rng(0))
    assert abs(evidence(tilted) - evidence(spec)) < 0.5


@pytest.mark.parametrize("mixture", [False, True])
def test_a_return_state_hardly_reached_leaves_the_evidence(x64: None, mixture: bool) -> None:
    spec = random_coupled(3, (4, 2), mixture)
    grown = add_return_states(spec, np.ones((1, 1)), np.ones((1, 1)), 10.0, np.random.default_rng(0))
    validate(grown)
    assert grown.sizes == (4, 3)
    pairs = ((grown.log_pairs[0]), tuple(shut(pair) for pair in grown.log_pairs[1]))
    first = replace(grown.strands[1], log_init=shut(grown.strands[1].log_init))
    closed = replace(grown, log_pairs=pairs, strands=(grown.strands[0], first))
    assert evidence(closed) == pytest.approx(evidence(spec), abs=1e-9)


def shut(log_rows: np.ndarray) -> np.ndarray:
    """Close the last column, and give what it had to the others."""
    rows = np.exp(log_rows[..., :-1])
    shut_rows = np.log(rows / rows.sum(-1, keepdims=True))
    return np.concatenate([shut_rows, np.full((*log_rows.shape[:-1], 1), -1e30)], axis=-1)


@given(
    st.integers(0, 1000),
    st.tuples(st.integers(2, 6), st.integers(1, 4)),
    st.booleans(),
    st.sampled_from(["none", "state", "components"]),
    st.integers(1, 5),
)
@settings(max_examples=40, deadline=None)
def test_revisions_keep_the_laws(
    seed: int, sizes: tuple[int, int], mixture: bool, added: str, room: int
) -> None:
    spec = random_coupled(seed, sizes, mixture)
    config = CoupledSplitConfig(SPLIT, added, return_cap=5)
    policy = PolicyConfig(node_cap=sizes[0] + room)
    revision = revise(
        spec,
        planted(sizes[0]),
        phase=0,
        policy=policy,
        operators=((COUPLED_SPLIT, config),),
        rng=np.random.default_rng(seed),
    )
    new = revision.spec
    validate(new)
    assert sizes[0] < new.num_states == len(revision.origin) == len(revision.rest) <= policy.node_cap
    assert set(revision.origin.tolist()) == set(range(sizes[0]))
    gained = {"none": 0, "state": 1, "components": new.num_states - sizes[0] + 1}[added]
    assert new.sizes[1] == min(sizes[1] + gained, 5)
    assert revision.rows[0]["node"] == 1
    assert revision.rows[0]["added"] == added
    channel = "log_prob"
    old_rows = spec.strands[0].emissions[0].values[channel][revision.origin]
    np.testing.assert_array_equal(new.strands[0].emissions[0].values[channel], old_rows)


def test_new_return_states_have_the_returns_of_what_was_split() -> None:
    spec, found = random_coupled(0, (4, 2), False), planted()
    for added, wanted in (("state", [[0.0]]), ("components", [[-6.0], [6.0]])):
        edits = COUPLED_SPLIT.propose(
            spec, found, CoupledSplitConfig(SPLIT, added), Allowance(rng=np.random.default_rng(0))
        )
        paid = COUPLED_SPLIT.apply(spec, edits[0]).strands[1]
        np.testing.assert_allclose(np.sort(paid.return_mean[2:], axis=0), wanted, atol=0.5)
        assert (paid.return_var[2:] > 20).all() == (added == "state")


def test_returns_by_action_fill_every_column() -> None:
    spec, found = random_coupled(0, (4, 2), True, columns=2), planted()
    edit = COUPLED_SPLIT.propose(spec, found, CoupledSplitConfig(SPLIT))[0]
    paid = COUPLED_SPLIT.apply(spec, edit).strands[1]
    assert paid.return_mean.shape == (3, 2)
    np.testing.assert_allclose(paid.return_mean[2], found.mean[1, 0])


def test_errors_name_what_is_wrong() -> None:
    spec, found = random_coupled(0, (4, 2), True), planted()
    edit = COUPLED_SPLIT.propose(spec, found, CoupledSplitConfig(SPLIT))[0]
    with pytest.raises(ValueError, match=r"edit must be of kind 'coupled state' for 4 states, got .* for 5"):
        COUPLED_SPLIT.apply(spec, edit.moved(5))
    with pytest.raises(ValueError, match="evidence must have 4 states, got 5"):
        COUPLED_SPLIT.propose(spec, planted(5), CoupledSplitConfig(SPLIT))
    unpaid = replace(spec, strands=(spec.strands[0], StrandSpec(spec.strands[1].log_init)))
    with pytest.raises(ValueError, match="must emit returns"):
        COUPLED_SPLIT.propose(unpaid, found, CoupledSplitConfig(SPLIT))
    for settings_ in ({"added": "two"}, {"return_cap": 0}, {"concentration": 0.0}, {"coupling_jitter": -1.0}):
        with pytest.raises(ValueError, match=next(iter(settings_))):
            CoupledSplitConfig(**settings_)
