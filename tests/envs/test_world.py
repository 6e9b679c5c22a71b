"""Laws that every world keeps, and the draws against the tables."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from jaxpomdp.envs.build import assemble, merge, tabulate
from jaxpomdp.envs.host import HostWorld
from jaxpomdp.envs.registry import make, names
from jaxpomdp.envs.world import World, model_of, reset, reset_key, running_sum, step, step_key

EAST = 1
SIZE = 200
step_many = jax.jit(jax.vmap(step, (None, 0, 0, 0)))
step_often = jax.jit(jax.vmap(step, (None, None, None, 0)))
reset_many = jax.jit(jax.vmap(reset, (None, 0)))
EVERY = ("tmaze-1", *names(), "hallway-noise", "maze89-noise")


@pytest.fixture(scope="module", params=EVERY)
def world(request: pytest.FixtureRequest) -> World:
    return make(request.param)


def test_rows_are_probabilities(world: World) -> None:
    model = model_of(world)
    for table in (model.trans, model.obs, model.start, model.first):
        assert np.all(np.asarray(table) >= 0)
        np.testing.assert_allclose(np.asarray(table).sum(axis=-1), 1, atol=1e-6)
    assert model.trans.shape == (world.num_actions, world.num_states, world.num_states)
    assert model.obs.shape == (1, world.num_states, world.num_observations)
    assert not np.any(np.asarray(model.start)[np.asarray(model.terminal)])


def test_cdfs_follow_the_probabilities_and_end_in_one(world: World) -> None:
    pairs = [
        (world.transition_prob, world.transition_cdf),
        (world.observation_prob, world.observation_cdf),
        (world.first_observation_prob, world.first_observation_cdf),
        (world.start_prob, world.start_cdf),
    ]
    for prob, cdf in pairs:
        np.testing.assert_allclose(np.cumsum(np.asarray(prob, np.float64), -1), cdf, atol=1e-6)
        assert np.all(np.asarray(cdf)[..., -1] == 1)


def test_terminal_observations_are_reserved(world: World) -> None:
    shown = np.asarray(world.observation_prob)[0] > 0
    terminal = np.asarray(world.terminal)
    assert not np.any(shown[terminal].any(axis=0) & shown[~terminal].any(axis=0))


def test_names_fit_the_tables(world: World) -> None:
    assert len(world.action_names) == world.num_actions
    assert len(world.observation_names) == world.num_observations == len(set(world.observation_names))
    assert world.layout is not None
    assert len(world.layout.cells) == len(world.layout.headings) == world.num_states


def _moments(world: World) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states, actions and numbers to step with; every terminal state is among the states."""
    rng = np.random.default_rng(3)
    states = rng.integers(world.num_states, size=SIZE)
    ends = np.flatnonzero(world.terminal)
    states[: ends.size] = ends
    return states, rng.integers(world.num_actions, size=SIZE), rng.random((SIZE, 3), np.float32)


def test_host_and_device_do_the_same(world: World) -> None:
    states, actions, uniforms = _moments(world)
    device = step_many(world, states, actions, uniforms)
    host = HostWorld(world)
    for i in range(SIZE):
        here = host.step(int(states[i]), int(actions[i]), uniforms[i])
        expected = tuple(int(x[i]) for x in (device.state, device.observation, device.terminated))
        assert (here.state, here.observation, here.terminated) == expected
        assert here.reward == pytest.approx(float(device.reward[i]), abs=1e-6)
    first = reset_many(world, uniforms[:, :2])
    assert [host.reset(u) for u in uniforms[:, :2]] == list(zip(*(x.tolist() for x in first), strict=True))
    kinds = [x.dtype for x in (*device, *first)]
    assert kinds == [jnp.int32, jnp.int32, jnp.float32, bool, jnp.int32, jnp.int32]


def test_terminal_states_keep_the_agent_for_nothing(world: World) -> None:
    states, actions, uniforms = _moments(world)
    ended = np.asarray(world.terminal)[states]
    after = step_many(world, states, actions, uniforms)
    assert np.any(ended)
    np.testing.assert_array_equal(np.asarray(after.state)[ended], states[ended])
    assert np.all(np.asarray(after.reward)[ended] == 0)
    assert np.all(np.asarray(after.terminated)[ended])


@pytest.mark.parametrize("name", ["maze89", "hallway-noise"])
def test_frequencies_match_the_tables(name: str) -> None:
    world, size = make(name), 20_000
    model = model_of(world)
    state, action = 5, 1
    uniforms = np.random.default_rng(5).random((size, 3), np.float32)
    after = step_often(world, state, action, uniforms)
    expected = np.asarray(model.trans)[action, state].astype(np.float64)
    assert _chi_square(np.asarray(after.state), expected) > 1e-3
    assert _chi_square(np.asarray(after.observation), expected @ np.asarray(model.obs, np.float64)[0]) > 1e-3
    spread = float(world.reward_noise)
    assert np.mean(after.reward) == pytest.approx(float(model.reward[action, state]), abs=0.03)
    mean = np.asarray(world.reward)[action, state]
    assert np.all(np.abs(np.asarray(after.reward)[:, None] - mean[None, :]).min(axis=1) <= spread + 1e-6)


def test_frequencies_notice_a_wrong_table() -> None:
    world, size = make("maze89"), 20_000
    uniforms = np.random.default_rng(5).random((size, 3), np.float32)
    broken = replace(world, transition_cdf=world.transition_cdf * 0.9)
    after = step_often(broken, 5, 1, uniforms)
    assert _chi_square(np.asarray(after.state), np.asarray(model_of(world).trans)[1, 5]) < 1e-6


def _chi_square(drawn: np.ndarray, expected: np.ndarray) -> float:
    counts = np.bincount(drawn, minlength=expected.size)
    assert counts[expected == 0].sum() == 0
    possible = expected > 0
    share = expected[possible].astype(np.float64)
    share /= share.sum()
    return float(stats.chisquare(counts[possible], share * counts.sum()).pvalue)


def test_draws_do_not_depend_on_the_position_in_a_batch() -> None:
    world = make("maze89-noise")
    moments = _moments(world)
    many = step_many(world, *moments)
    order = np.random.default_rng(0).permutation(SIZE)
    again = step_many(world, *(x[order] for x in moments))
    for before, after in zip(many, again, strict=True):
        np.testing.assert_array_equal(before[order], after)
    alone = step(world, *(x[7] for x in moments))
    assert [float(x) for x in alone] == [float(x[7]) for x in many]


def test_a_whole_walk_is_one_program_over_seeds() -> None:
    world = make("tmaze-noise", length=3)

    def walk(key: jax.Array) -> jax.Array:
        state, _ = reset_key(world, key)

        def go(state: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
            after = step_key(world, state, jnp.int32(EAST), key)
            return after.state, after.terminated

        return jax.lax.scan(go, state, jax.random.split(key, 40))[1]

    ended = jax.jit(jax.vmap(walk))(jax.random.split(jax.random.key(1), 200))
    assert ended.shape == (200, 40)
    assert np.all(np.diff(np.asarray(ended, int), axis=1) >= 0)
    assert 0 < np.mean(ended[:, -1]) < 1


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(0, 5), min_size=1, max_size=6).filter(any),
    st.floats(0, 1, exclude_max=True, width=32),
)
def test_a_draw_inverts_the_running_sum(weights: list[int], uniform: float) -> None:
    prob = np.array(weights) / sum(weights)
    cdf = running_sum(prob)
    drawn = int(np.count_nonzero(uniform >= cdf))
    assert prob[drawn] > 0
    below = cdf[drawn - 1] if drawn else 0
    assert below <= uniform < cdf[drawn]


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 3), st.integers(2, 4), st.data())
def test_tables_of_any_outcomes_keep_the_model(
    num_actions: int, num_states: int, data: st.DataObject
) -> None:
    chance = st.lists(st.integers(0, 4), min_size=num_states, max_size=num_states).filter(any)
    counts = np.array(
        data.draw(st.lists(chance, min_size=num_actions * num_states, max_size=num_actions * num_states))
    )
    trans = (counts / counts.sum(axis=1, keepdims=True)).reshape(num_actions, num_states, num_states)
    reward = np.arange(trans.size, dtype=float).reshape(trans.shape)
    outcomes = [
        [{(t, reward[a, s, t]): trans[a, s, t] for t in range(num_states)} for s in range(num_states)]
        for a in range(num_actions)
    ]
    world = _tiny(tabulate(outcomes), num_states, num_actions)
    model = model_of(world)
    np.testing.assert_allclose(model.trans, trans, atol=1e-6)
    np.testing.assert_allclose(model.reward, (trans * reward).sum(axis=-1), rtol=1e-5, atol=1e-5)


def _tiny(tables, num_states: int, num_actions: int, **changed) -> World:
    given = {
        "observation": np.eye(num_states)[None],
        "start": np.eye(num_states)[0],
        "terminal": np.zeros(num_states, bool),
        "action_names": tuple(map(str, range(num_actions))),
        "observation_names": tuple(map(str, range(num_states))),
    } | changed
    return assemble(tables, **given)


def test_observations_may_depend_on_the_action() -> None:
    stay = tabulate([[{(s, 0.0): 1.0} for s in range(2)] for _ in range(2)])
    eye = np.eye(2)
    world = _tiny(stay, 2, 2, observation=np.stack([eye, eye[::-1]]), first_observation=eye)
    seen = [int(step(world, 0, action, jnp.full(3, 0.5)).observation) for action in (0, 1)]
    assert seen == [0, 1]
    host = HostWorld(world)
    assert [host.step(0, action, np.full(3, 0.5)).observation for action in (0, 1)] == [0, 1]


STAY = tabulate([[{(s, 0.0): 1.0} for s in range(2)]])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"start": np.array([0.5, 0.4])}, r"start\[\] must be probabilities that sum to 1"),
        ({"observation": np.array([[[1.0, 0], [0.7, 0.2]]])}, r"observation\[0, 1\] must be probabilities"),
        ({"observation": np.array([[[1.0, 0], [np.nan, 1]]])}, r"observation\[0, 1\] must be probabilities"),
        ({"terminal": np.zeros(3, bool)}, r"terminal must have shape \(2,\).*got \(3,\)"),
        ({"action_names": ("a", "b")}, "action_names must hold 1 names, got 2"),
        ({"observation": np.stack([np.eye(2)] * 2), "first_observation": np.eye(2)}, "1 or 1 tables, got 2"),
        ({"observation": np.stack([np.eye(2)] * 2)}, "first_observation must be given"),
    ],
)
def test_bad_tables_are_refused(changed: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _tiny(STAY, 2, 1, **changed)


def test_bad_transitions_are_refused() -> None:
    with pytest.raises(ValueError, match=r"transitions\[0, 1\] must be probabilities"):
        _tiny(tabulate([[{(0, 0.0): 1.0}, {(1, 0.0): 0.8}]]), 2, 1)


def test_merging_adds_what_agrees_and_keeps_rewards_apart() -> None:
    merged = merge([(0.5, {(1, 0.0): 1.0}), (0.5, {(1, 0.0): 0.4, (1, 2.0): 0.6})])
    assert merged == {(1, 0.0): pytest.approx(0.7), (1, 2.0): pytest.approx(0.3)}
