"""Packing: exact both ways, blind to capacity and to the order of states; values follow an edit's origin."""

from __future__ import annotations

import time
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp import numerics
from jaxpomdp._types import TrialBatch
from jaxpomdp.kernels.filtering import filter_tape
from jaxpomdp.models.flat import FLAT, FlatParams
from jaxpomdp.packing import carry, pack, slots_of, unpack, unpack_all
from jaxpomdp.structure import spec as spec_module
from jaxpomdp.structure.edits import Shares, clone_state
from jaxpomdp.structure.spec import Channel, FlatSpec
from tests.structure.worlds import random_spec as any_random_spec

random_spec = partial(any_random_spec, dtype=np.float32)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=4), st.integers(0, 5), st.booleans())
@settings(max_examples=30, deadline=None)
def test_unpack_undoes_pack_exactly(sizes: list[int], spare: int, per_action: bool) -> None:
    specs = [random_spec(i, n, per_action=per_action) for i, n in enumerate(sizes)]
    params = pack(specs, max(sizes) + spare)
    assert unpack_all(params) == specs
    assert [unpack(params, s) for s in range(len(specs))] == specs


def test_float64_survives_where_the_device_has_it(x64: None) -> None:
    spec = random_spec(0, 5, dtype=np.float64)
    assert unpack(pack([spec], 8), 0) == spec


def test_the_two_stand_ins_for_log_zero_agree() -> None:
    assert spec_module.NEG == numerics.NEG


def test_spare_slots_have_no_probability_and_valid_parameters() -> None:
    params = jax.device_get(pack([random_spec(0, 3), random_spec(1, 5)], 6))
    dead = ~params.alive
    assert (np.exp(params.log_init)[dead] == 0).all()
    probability = np.exp(params.log_trans)
    wanted = np.broadcast_to(params.alive[:, None], (2, 2, 6))
    np.testing.assert_allclose(probability.sum(-1), wanted, atol=1e-6)
    assert (params.returns.var > 0).all()
    np.testing.assert_allclose(np.exp(params.emissions[0].log_prob).sum(-1), 1, rtol=1e-6)


def test_slots_after_an_unpack_of_scattered_states() -> None:
    params = pack([random_spec(0, 4)], 6)
    shuffled = np.array([5, 0, 4, 1, 2, 3])
    moved = jax.tree.map(lambda x: x[:, shuffled] if x.ndim < 4 else x[:, :, shuffled][..., shuffled], params)
    order = [k for k in shuffled if k < 4]
    expected = random_spec(0, 4)
    assert np.array_equal(unpack(moved, 0).log_init, expected.log_init[order])
    assert np.array_equal(unpack(moved, 0).log_trans, expected.log_trans[:, order][:, :, order])


def test_values_follow_the_origin_into_any_capacity() -> None:
    q = np.arange(2 * 3 * 2, dtype=np.float32).reshape(2, 3, 2) + 1
    moved = np.asarray(carry(q, [np.array([0, 1, 2, 1]), np.array([0, 1])], 5))
    np.testing.assert_array_equal(moved[0], [*q[0], q[0][1], [0, 0]])
    np.testing.assert_array_equal(moved[1], [*q[1][:2], [0, 0], [0, 0], [0, 0]])


def test_carry_takes_trees_and_other_axes() -> None:
    tree = {"a": np.ones((1, 4, 3)), "b": np.arange(24.0, dtype=np.float32).reshape(1, 2, 3, 4)}
    moved = carry(tree, [np.array([2, 0])], 2, axis=2)
    np.testing.assert_array_equal(moved["b"][0, :, 1], tree["b"][0, :, 0])
    assert moved["a"].shape == (1, 4, 2)


def test_a_cloned_model_packs_with_its_q_values() -> None:
    spec = random_spec(0, 3)
    even = np.full(2, 0.5)
    clone = clone_state(spec, 1, Shares(even, np.tile(even, (1, 3, 1)), np.tile(even, (1, 2, 1))))
    assert unpack(pack([clone, spec], 8), 0) == clone


def test_errors_name_what_is_wrong() -> None:
    spec = random_spec(0, 3)
    with pytest.raises(ValueError, match="at least one"):
        pack([], 3)
    with pytest.raises(ValueError, match=r"capacity must hold .* 3 states, got 2"):
        pack([spec], 2)
    with pytest.raises(ValueError, match=r"alike; .* 2 actions.* specs\[1\] has 3 actions"):
        pack([spec, random_spec(0, 3, a=3)], 3)
    odd = FlatSpec.from_probabilities([1.0], [[[1.0]]], [Channel("Poisson", {"rate": np.ones((1, 2))})])
    with pytest.raises(ValueError, match=r"kinds Categorical.*got Poisson"):
        pack([odd], 1)
    with pytest.raises(ValueError, match=r"s must be 0 \.\. 0, got 1"):
        unpack(pack([spec], 3), 1)
    with pytest.raises(ValueError, match="must have 2 models"):
        carry(np.zeros((1, 3, 2)), [np.arange(3)] * 2, 3)


def test_a_phase_of_21_models_of_70_states_packs_in_milliseconds() -> None:
    specs = [random_spec(s, 70, a=5) for s in range(21)]
    params = pack(specs, 72)
    seconds = []
    for _ in range(5):
        begun = time.perf_counter()
        jax.block_until_ready(pack(unpack_all(params), 72))
        seconds.append(time.perf_counter() - begun)
    assert min(seconds) < 0.15


def evidence_under(params: FlatParams, theta: float = 0.3) -> np.ndarray:
    """Return the log-evidence ``[S]`` of one made-up trial, returns included."""
    rng = np.random.default_rng(0)
    seen = np.ones(25, bool)
    batch = TrialBatch(
        observations=(rng.integers(0, 3, 25), rng.normal(size=(25, 2)).astype(np.float32)),
        actions=rng.integers(0, 2, 25),
        rewards=np.zeros(25, np.float32),
        returns=rng.normal(size=25).astype(np.float32),
        valid=seen,
        start=np.arange(25) == 0,
        terminated=np.arange(25) == 24,
        observed=seen,
        has_return=seen,
    )

    def one(model: FlatParams) -> jax.Array:
        chain, log_obs = FLAT.learning(model, jax.tree.map(jnp.asarray, batch), theta)
        return filter_tape(chain, log_obs, batch.actions, batch.start, batch.valid).log_norm.sum()

    return np.asarray(jax.jit(jax.vmap(one))(params))


def permuted(spec: FlatSpec, order: np.ndarray) -> FlatSpec:
    channels = tuple(channel.take(order) for channel in spec.emissions)
    log_trans = spec.log_trans[:, order][:, :, order]
    return FlatSpec(
        spec.log_init[order], log_trans, channels, spec.return_mean[order], spec.return_var[order]
    )


def test_results_do_not_depend_on_capacity_or_order() -> None:
    specs = [random_spec(0, 4, per_action=True), random_spec(1, 6, per_action=True)]
    tight, roomy = evidence_under(pack(specs, 6)), evidence_under(pack(specs, 11))
    shuffled = [permuted(spec, np.random.default_rng(2).permutation(spec.num_states)) for spec in specs]
    np.testing.assert_allclose(roomy, tight, rtol=1e-6)
    np.testing.assert_allclose(evidence_under(pack(shuffled, 11)), tight, rtol=1e-5)
    assert not np.allclose(evidence_under(pack(specs[::-1], 6)), tight, rtol=1e-3)


def test_a_split_leaves_the_evidence_of_observations_on_the_device() -> None:
    spec, shares = random_spec(3, 4), np.array([0.3, 0.7])
    clone = clone_state(spec, 2, Shares(shares, np.tile(shares, (1, 4, 1)), np.tile(np.eye(2), (1, 1, 1))))
    before, after = evidence_under(pack([spec, spec], 5), 0.0), evidence_under(pack([clone, spec], 5), 0.0)
    np.testing.assert_allclose(after, before, rtol=1e-5)


def test_slots_are_empty_for_no_models() -> None:
    slots, alive = slots_of([], 3)
    assert slots.shape == alive.shape == (0, 3)
