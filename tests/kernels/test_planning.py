"""Planning against values by enumeration: bounds on both sides, backups by loops, sweeps that never lose."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.kernels import planning
from jaxpomdp.kernels.planning import Vectors
from tests.oracles.pomdp_values import bracket, one_step

TIGER = (
    np.array([np.eye(2), np.full((2, 2), 0.5), np.full((2, 2), 0.5)]),
    np.array([[[0.85, 0.15], [0.15, 0.85]], np.full((2, 2), 0.5), np.full((2, 2), 0.5)]),
    np.array([[-1.0, -1.0], [-100.0, 10.0], [10.0, -100.0]]),
)
SEGMENT = np.stack([np.linspace(0, 1, 41), np.linspace(1, 0, 41)], axis=1)


def random_model(seed, states=3, actions=2, observations=2, shared=False):
    rng = np.random.default_rng(seed)
    trans = rng.dirichlet(np.ones(states), (actions, states))
    obs = rng.dirichlet(np.ones(observations), (1 if shared else actions, states))
    return trans, obs, rng.normal(size=(actions, states))


def vectors_of(table, actions=None, capacity=None):
    table = jnp.asarray(table)
    capacity = capacity or len(table)
    actions = jnp.arange(len(table)) if actions is None else jnp.asarray(actions)
    extra = capacity - len(table)
    return Vectors(jnp.pad(table, ((0, extra), (0, 0))), jnp.pad(actions, (0, extra)), jnp.int32(len(table)))


def solve(key, beliefs, model, discount, sweeps=60, capacity=64):
    trans, obs, reward = map(jnp.asarray, model)
    blind = vectors_of(planning.blind_values(trans, reward, discount), capacity=capacity)
    return planning.perseus(key, jnp.asarray(beliefs), blind, trans, obs, reward, discount, sweeps, 0.0, 1e-9)


def value(vectors, belief):
    return float(planning.value_at(jnp.asarray(belief)[None], vectors)[0][0])


MODELS = {"tiger": TIGER, "random": random_model(0), "shared": random_model(1, shared=True)}


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_bounds_hold_on_both_sides_of_the_value_by_enumeration(x64, model):
    discount, horizon = 0.5, 5
    grid = np.random.default_rng(0).dirichlet(np.ones(model[0].shape[-1]), 6)
    trans, obs, reward = map(jnp.asarray, model)
    qmdp = planning.value_iteration(trans, reward, discount, 1e-9)
    informed = planning.informed_bound(trans, obs, reward, discount, 1e-9)
    vectors, _, full = solve(jax.random.key(0), grid, model, discount)
    assert not full
    for belief in grid:
        low, high = bracket(belief, *model, discount, horizon)
        point_based, fib, mdp = value(vectors, belief), np.max(informed @ belief), np.max(qmdp @ belief)
        assert point_based <= high + 1e-6
        assert low - 1e-6 <= fib <= mdp + 1e-6
        assert point_based <= fib + 1e-6


def test_the_bracket_tells_a_bound_that_forgot_the_discount(x64):
    belief = np.array([0.5, 0.5])
    _, high = bracket(belief, *TIGER, 0.5, 5)
    broken, _, _ = solve(jax.random.key(0), SEGMENT, TIGER, 0.95)
    assert value(broken, belief) > high


def test_perseus_finds_the_known_value_of_tiger(x64):
    vectors, _, full = solve(jax.random.key(1), SEGMENT, TIGER, 0.95, sweeps=300)
    assert not full
    assert value(vectors, [0.5, 0.5]) == pytest.approx(19.3714, abs=0.02)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.booleans())
def test_a_backup_is_the_best_of_one_step_by_loops(seed, shared):
    model = random_model(seed, shared=shared)
    rng = np.random.default_rng(seed)
    belief, table = rng.dirichlet(np.ones(3)), rng.normal(size=(4, 3))
    alpha, action = planning.backup(
        jnp.asarray(belief, jnp.float32),
        vectors_of(table, np.zeros(4, int), 7),
        *map(jnp.asarray, model),
        0.9,
    )
    best, best_action = one_step(belief, table, *model, 0.9)
    assert float(alpha @ belief) == pytest.approx(best, abs=1e-4)
    assert action == best_action


def test_the_loops_tell_a_backup_with_the_transitions_transposed():
    trans, obs, reward = random_model(3)
    belief, table = np.array([0.7, 0.2, 0.1]), np.random.default_rng(3).normal(size=(4, 3))
    broken = planning.backup(
        jnp.asarray(belief), vectors_of(table, np.zeros(4, int)), jnp.asarray(trans).mT, obs, reward, 0.9
    )
    right, _ = one_step(belief, table, trans, obs, reward, 0.9)
    assert float(broken[0] @ belief) != pytest.approx(right, abs=1e-3)


def test_a_sweep_loses_no_belief_and_keeps_only_plans(x64):
    trans, _, reward = model = random_model(4, states=4, actions=3, observations=3)
    beliefs = jnp.asarray(np.random.default_rng(4).dirichlet(np.ones(4), 30))
    current = vectors_of(planning.blind_values(*map(jnp.asarray, (trans, reward)), 0.9), capacity=60)
    sweep = jax.jit(planning.sweep)
    for i in range(6):
        new = sweep(jax.random.key(i), beliefs, current, *map(jnp.asarray, model), 0.9)
        before, after = (planning.value_at(beliefs, v)[0] for v in (current, new))
        assert np.all(after >= before - 1e-12)
        assert new.count <= 60
        current = new


def test_a_full_buffer_is_reported_and_nothing_is_lost(x64):
    vectors, left, full = solve(jax.random.key(1), SEGMENT, TIGER, 0.95, sweeps=50, capacity=4)
    assert full
    assert left < 50
    assert 0 < vectors.count < 4


def test_value_iteration_solves_the_equation(x64):
    trans, _, reward = map(jnp.asarray, random_model(5, states=6))
    q = planning.value_iteration(trans, reward, 0.9, 1e-10)
    np.testing.assert_allclose(q, reward + 0.9 * trans @ q.max(0), atol=1e-8)


def test_blind_values_are_what_one_action_for_ever_earns(x64):
    trans, _, reward = random_model(6)
    power = np.linalg.matrix_power
    earned = [sum(0.8**t * power(trans[a], t) @ reward[a] for t in range(200)) for a in range(2)]
    blind = planning.blind_values(*map(jnp.asarray, (trans, reward)), 0.8)
    np.testing.assert_allclose(blind, earned, atol=1e-9)


def test_terminal_states_are_worth_nothing():
    trans, _, reward = random_model(7)
    terminal = jnp.array([False, True, False])
    ended = planning.end_trials(jnp.asarray(trans), jnp.asarray(reward), terminal)
    q = planning.value_iteration(*ended, 0.9)
    np.testing.assert_array_equal(q[:, 1], 0)
    np.testing.assert_array_equal(ended[0][:, 1], [[0, 1, 0]] * 2)
    np.testing.assert_allclose(ended[0][:, 0], trans[:, 0], rtol=1e-6)


def test_spread_takes_the_corners_first():
    middle = np.full((20, 3), 1 / 3) + np.random.default_rng(0).normal(scale=0.01, size=(20, 3))
    candidates = jnp.asarray(np.concatenate([middle, np.eye(3)]))
    chosen = planning.spread(jax.random.key(0), candidates, 4)
    assert set(np.asarray(chosen).tolist()) >= {20, 21, 22}


def test_an_update_is_bayes_rule_and_ignores_the_impossible():
    trans, obs, _ = map(jnp.asarray, random_model(8))
    belief = jnp.array([0.2, 0.3, 0.5])
    joint = (belief @ trans[1]) * obs[1, :, 0]
    np.testing.assert_allclose(planning.update(belief, 1, 0, trans, obs), joint / joint.sum(), rtol=1e-5)
    never = jnp.zeros_like(obs).at[..., 1].set(1)
    np.testing.assert_allclose(planning.update(belief, 1, 0, trans, never), belief @ trans[1], rtol=1e-5)
