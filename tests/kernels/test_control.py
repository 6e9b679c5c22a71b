"""Control on beliefs: choices against frequencies, learning from a tape against a slow account of it."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.kernels import control
from jaxpomdp.kernels.control import ReplayData

ALPHA, GAMMA, LAM = 0.1, 0.9, 0.8
LENGTHS = (4, 1, 3, 5)
TERMINATED = (True, True, False, True)
N, A = 3, 2


def slow_replay(q, trials, *, rule="sarsa", replacing=False):
    """SARSA(lambda) or Q(lambda), trial by trial, with a loop for every sum; trials as plain dicts."""
    q = np.array(q, np.float64)

    def value(belief, a):
        return sum(belief[n] * q[n, a] for n in range(len(belief)))

    for trial in trials:
        trace = np.zeros_like(q)
        length = len(trial["actions"])
        for t in range(length - 1):
            b, a, after = trial["beliefs"][t], trial["actions"][t], trial["beliefs"][t + 1]
            best = max(value(after, k) for k in range(q.shape[1]))
            if t + 1 == length - 1:
                following = 0.0 if trial["terminated"] else best
            else:
                following = best if rule == "q" else value(after, trial["actions"][t + 1])
            delta = trial["rewards"][t] + GAMMA * following - value(b, a)
            trace *= GAMMA * LAM
            for n in range(len(b)):
                trace[n, a] = max(trace[n, a], b[n]) if replacing else trace[n, a] + b[n]
            q += ALPHA * delta * trace
    return q


def random_trials(rng):
    return [
        {
            "beliefs": rng.dirichlet(np.ones(N), n),
            "actions": rng.integers(0, A, n),
            "rewards": rng.normal(size=n),
            "terminated": over,
        }
        for n, over in zip(LENGTHS, TERMINATED, strict=True)
    ]


def tape_of(trials, *, padding=0, junk=0.0):
    """Lay trials end to end; padding holds junk that must not count."""
    size = sum(LENGTHS)
    data = ReplayData(
        np.full((size + padding, N), junk),
        np.ones(size + padding, np.int32),
        np.full(size + padding, junk),
        *(np.zeros(size + padding, bool) for _ in range(3)),
    )
    t = 0
    for trial in trials:
        n = len(trial["actions"])
        data.beliefs[t : t + n], data.rewards[t : t + n] = trial["beliefs"], trial["rewards"]
        data.actions[t : t + n] = trial["actions"]
        data.start[t], data.valid[t : t + n], data.terminated[t + n - 1] = True, True, trial["terminated"]
        t += n
    return jax.tree.map(jnp.asarray, data)


def replayed(q, data, **options):
    return control.replay_tape(jnp.asarray(q), data, ALPHA, GAMMA, LAM, **options)


@pytest.fixture
def trials():
    return random_trials(np.random.default_rng(3))


Q = np.random.default_rng(4).normal(size=(N, A))


def test_values_are_weighted_by_belief():
    q = jnp.array([[1.0, 2.0], [3.0, -4.0]])
    np.testing.assert_allclose(control.action_values(q, jnp.array([0.25, 0.75])), [2.5, -2.5])


def test_the_first_of_equally_good_actions_is_greedy():
    assert int(control.greedy(jnp.array([1.0, 3.0, 3.0]))) == 1


def test_mark_accumulates_or_replaces(x64):
    trace = jnp.array([[0.4, 1.0], [1.0, 0.2]])
    belief = jnp.array([0.5, 0.25])
    added = control.mark(trace, belief, jnp.int32(0), 0.5)
    np.testing.assert_allclose(added, [[0.7, 0.5], [0.75, 0.1]], atol=1e-15)
    replaced = control.mark(trace, belief, jnp.int32(0), 0.5, replacing=True)
    np.testing.assert_allclose(replaced, [[0.5, 0.5], [0.5, 0.1]], atol=1e-15)


def grid(count):
    return (jnp.arange(count) + 0.5) / count


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_epsilon_greedy_explores_as_often_as_it_says(epsilon):
    values = jnp.array([0.0, 2.0, 1.0])
    pairs = jnp.stack(jnp.meshgrid(grid(10), grid(30)), axis=-1).reshape(-1, 2)
    actions = jax.vmap(lambda u: control.epsilon_greedy(values, epsilon, u))(pairs)
    expected = np.full(3, epsilon / 3) + (1 - epsilon) * np.array([0, 1, 0])
    np.testing.assert_allclose(np.bincount(actions, minlength=3) / len(pairs), expected, atol=1e-6)


def test_boltzmann_draws_in_proportion_to_exponentials():
    values, temperature = np.array([0.0, 1.0, 0.5]), 0.5
    actions = jax.vmap(lambda u: control.boltzmann(jnp.asarray(values), temperature, u))(grid(10_000))
    weights = np.exp(values / temperature)
    shares = np.bincount(actions, minlength=3) / 10_000
    np.testing.assert_allclose(shares, weights / weights.sum(), atol=2e-4)


def test_boltzmann_without_temperature_is_greedy_and_stays_in_range():
    values = jnp.array([0.0, 1.0, 0.5])
    actions = jax.vmap(lambda u: control.boltzmann(values, 0.0, u))(jnp.array([0.0, 0.5, 0.99999994]))
    np.testing.assert_array_equal(actions, 1)


def test_one_step_by_hand(x64):
    data = ReplayData(
        jnp.array([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]]),
        jnp.array([0, 1, 0]),
        jnp.array([1.0, 2.0, 99.0]),
        jnp.array([True, False, False]),
        jnp.ones(3, bool),
        jnp.array([False, False, True]),
    )
    q = control.replay_tape(jnp.zeros((2, 2)), data, 0.5, 0.5, 0.5)
    # t=0: delta 1, trace (0,0)=1.       t=1: delta 2, trace (0,0)=.25, (0,1)=(1,1)=.5.
    np.testing.assert_allclose(q, [[0.5 + 0.25, 0.5], [0.0, 0.5]], atol=1e-15)


@pytest.mark.parametrize("replacing", [False, True])
@pytest.mark.parametrize("rule", ["sarsa", "q"])
def test_a_tape_of_several_trials_equals_the_slow_account(x64, trials, rule, replacing):
    options = {"rule": rule, "replacing": replacing}
    expected = slow_replay(Q, trials, **options)
    np.testing.assert_allclose(replayed(Q, tape_of(trials), **options), expected, atol=1e-12)


def test_a_trial_that_was_cut_off_has_a_future(x64, trials):
    ended = [trial | {"terminated": True} for trial in trials]
    expected = slow_replay(Q, ended)
    np.testing.assert_allclose(replayed(Q, tape_of(ended)), expected, atol=1e-12)
    assert np.abs(expected - slow_replay(Q, trials)).max() > 1e-3


def test_padding_changes_nothing(x64, trials):
    padded = replayed(Q, tape_of(trials, padding=5, junk=7.0))
    np.testing.assert_array_equal(padded, replayed(Q, tape_of(trials)))


def broken_marks():
    def forgets_decay(trace, belief, action, decay, *, replacing=False):
        return trace + belief[:, None] * (jnp.arange(trace.shape[-1]) == action)[None, :]

    def other_action(trace, belief, action, decay, *, replacing=False):
        return decay * trace + belief[:, None] * (jnp.arange(trace.shape[-1]) != action)[None, :]

    return [forgets_decay, other_action]


@pytest.mark.parametrize("broken", broken_marks(), ids=lambda f: f.__name__)
def test_the_slow_account_would_notice_a_broken_trace(x64, trials, monkeypatch, broken):
    monkeypatch.setattr(control, "mark", broken)
    assert np.abs(np.asarray(replayed(Q, tape_of(trials))) - slow_replay(Q, trials)).max() > 1e-3


@pytest.mark.parametrize("field", ["start", "terminated"])
def test_the_slow_account_would_notice_lost_flags(x64, trials, field):
    tape = tape_of(trials)
    tape = tape._replace(**{field: jnp.zeros_like(getattr(tape, field)).at[0].set(field == "start")})
    assert np.abs(np.asarray(replayed(Q, tape)) - slow_replay(Q, trials)).max() > 1e-3


@pytest.mark.parametrize("rule", ["sarsa", "q"])
def test_native_replay_agrees(trials, rule):
    from jaxpomdp.kernels import native

    if not native.available():
        pytest.skip("needs the native kernels, for which no compiler was found")
    tape = tape_of(trials, padding=2)
    tape = tape._replace(beliefs=tape.beliefs.astype(jnp.float32), rewards=tape.rewards.astype(jnp.float32))
    rows = jax.tree.map(lambda x: x[None, None], tape)
    q = jnp.asarray(Q, jnp.float32)
    options = {"alpha": ALPHA, "gamma": GAMMA, "lam": LAM, "rule": rule}
    found = native.sarsa_replay(q[None], *rows, **options)[0]
    np.testing.assert_allclose(found, replayed(q, tape, rule=rule), atol=1e-5)
