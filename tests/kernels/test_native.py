from __future__ import annotations

import os
import stat
import subprocess
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import Chain, Posterior
from jaxpomdp.kernels import native
from jaxpomdp.kernels.control import ReplayData, replay_tape
from jaxpomdp.kernels.filtering import filter_tape
from jaxpomdp.kernels.native import build
from jaxpomdp.kernels.smoothing import smooth
from jaxpomdp.numerics import NEG, safe_log

needs_native = pytest.mark.skipif(
    not native.available(), reason="needs a C++ compiler for the native kernels"
)
SINGLE = {"rtol": 2e-5, "atol": 2e-6}


class Tapes(NamedTuple):
    init: np.ndarray
    trans: np.ndarray
    log_obs: np.ndarray
    actions: np.ndarray
    start: np.ndarray
    valid: np.ndarray


def draw(
    models: int, rows: int, steps: int, states: int, actions: int, *, scale: float = 1.0, zeros: float = 0.0
) -> Tapes:
    """Draw probabilities, some of them zero, and tapes of several trials with padding and holes."""
    rng = np.random.default_rng([models, rows, steps, states, actions])

    def distributions(*shape: int) -> np.ndarray:
        weight = rng.dirichlet(np.ones(states), shape)
        weight *= (rng.random(weight.shape) >= zeros) | (weight == weight.max(axis=-1, keepdims=True))
        return (weight / weight.sum(axis=-1, keepdims=True)).astype(np.float32)

    tape = (models, rows, steps)
    valid = (np.arange(steps) < rng.integers(1, steps + 1, (models, rows, 1))) & (rng.random(tape) < 0.98)
    start = rng.random(tape) < 0.1
    log_obs = (scale * rng.normal(size=(*tape, states))).astype(np.float32)
    played = rng.integers(0, actions, tape).astype(np.int32)
    return Tapes(distributions(models), distributions(models, actions, states), log_obs, played, start, valid)


@jax.jit
def by_scan(tapes: Tapes) -> Posterior:
    def of_model(init: jax.Array, trans: jax.Array, *rows: jax.Array) -> Posterior:
        each = jax.vmap(lambda *row: smooth(Chain(safe_log(init), safe_log(trans)), *row))(*rows)
        return each._replace(xi=each.xi.sum(axis=0), initial=each.initial.sum(axis=0))

    return jax.vmap(of_model)(*tapes)


def by_numpy(tapes: Tapes) -> Posterior:
    """Do it in float64 logarithms, one row and one step after the other."""
    models, rows, steps, states = tapes.log_obs.shape
    got = Posterior(
        np.zeros((models, rows)),
        np.zeros((models, rows, steps, states)),
        np.zeros(tapes.trans.shape),
        np.zeros((models, states)),
    )
    for s in range(models):
        with np.errstate(divide="ignore"):
            log_init, log_trans = np.log(tapes.init[s].astype(float)), np.log(tapes.trans[s].astype(float))
        for b in range(rows):
            for trial in trials_of(tapes.start[s, b], tapes.valid[s, b]):
                log_obs, actions = tapes.log_obs[s, b, trial].astype(float), tapes.actions[s, b, trial]
                evidence, gamma, xi = numpy_trial(log_init, log_trans, log_obs, actions)
                got.log_evidence[s, b] += evidence
                got.gamma[s, b, trial] = gamma
                got.xi[s] += xi
                got.initial[s] += gamma[0]
    return got


def trials_of(start: np.ndarray, valid: np.ndarray) -> list[list[int]]:
    trials: list[list[int]] = []
    for t in np.flatnonzero(valid):
        if t == 0 or start[t] or not valid[t - 1]:
            trials.append([])
        trials[-1].append(t)
    return trials


def numpy_trial(
    log_init: np.ndarray, log_trans: np.ndarray, log_obs: np.ndarray, actions: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    log_obs = np.where(log_obs < NEG / 2, -np.inf, log_obs)
    forward, evidence, rows = [], 0.0, []
    for t, row in enumerate(log_obs):
        reach = forward[-1][:, None] + log_trans[actions[t - 1]] if t else log_init[None]
        predicted = np.logaddexp.reduce(reach, axis=0)
        norm = np.logaddexp.reduce(predicted + row)
        evidence += norm if np.isfinite(norm) else NEG
        rows.append(row if np.isfinite(norm) else np.zeros_like(row))
        forward.append(predicted + rows[-1] - (norm if np.isfinite(norm) else 0))
    xi, gamma, after = np.zeros(log_trans.shape), np.zeros(log_obs.shape), np.zeros(len(log_init))
    for t in reversed(range(len(rows))):
        if t + 1 < len(rows):
            pair = forward[t][:, None] + log_trans[actions[t]] + (rows[t + 1] + after)[None]
            xi[actions[t]] += np.exp(pair - np.logaddexp.reduce(pair, axis=None))
            after = np.logaddexp.reduce(log_trans[actions[t]] + (rows[t + 1] + after)[None], axis=1)
        joint = forward[t] + after
        gamma[t] = np.exp(joint - np.logaddexp.reduce(joint))
    return evidence, gamma, xi


def by_threads(call: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return what a call gives with one thread, with two and with five."""
    results = []
    for threads in (1, 2, 5):
        monkeypatch.setenv("JAXPOMDP_THREADS", str(threads))
        results.append(call())
    return results


def assert_same(got: Posterior, want: Posterior, **close: float) -> None:
    for name, x, y in zip(got._fields, got, want, strict=True):
        np.testing.assert_allclose(x, y, err_msg=name, **(close or SINGLE))


SHAPES = [
    (2, 3, 12, 5, 2),
    (3, 12, 20, 16, 4),
    (2, 40, 9, 70, 5),
    (1, 2, 6, 33, 9),
    (1, 1, 30, 1, 1),
    (1, 70, 5, 7, 3),
]


@needs_native
def test_estep_equals_the_definition() -> None:
    tapes = draw(3, 5, 20, 16, 4)
    assert_same(native.estep(*tapes), by_scan(tapes))


@needs_native
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_estep_equals_numpy(shape: tuple[int, ...]) -> None:
    tapes = draw(*shape, zeros=0.4, scale=3.0)
    assert_same(native.estep(*tapes), by_numpy(tapes))


@needs_native
@pytest.mark.parametrize("scale", [1.0, 30.0, 300.0])
def test_estep_equals_numpy_however_sharp_the_observations(scale: float) -> None:
    tapes = draw(3, 6, 15, 6, 3, zeros=0.5, scale=scale)
    got = native.estep(*tapes)
    assert_same(got, by_numpy(tapes), rtol=2e-5, atol=2e-5)
    assert all(np.isfinite(leaf).all() for leaf in got)


@needs_native
def test_the_oracle_notices_an_action_that_comes_a_step_late() -> None:
    tapes = draw(2, 3, 12, 5, 2)
    late = tapes._replace(actions=np.roll(tapes.actions, 1, axis=-1))
    with pytest.raises(AssertionError):
        assert_same(native.estep(*late), by_numpy(tapes))


@needs_native
def test_what_lies_in_the_padding_does_not_matter() -> None:
    tapes = draw(2, 5, 12, 6, 3)
    spoilt = tapes._replace(
        log_obs=np.where(tapes.valid[..., None], tapes.log_obs, np.nan),
        actions=np.where(tapes.valid, tapes.actions, -7),
        start=tapes.start | ~tapes.valid,
    )
    got = native.estep(*spoilt)
    assert_same(got, native.estep(*tapes), rtol=0, atol=0)
    assert not got.gamma[~tapes.valid].any()


PER_STEP: dict[str, tuple[int, ...]] = {"log_obs": (6,), "actions": (), "start": (), "valid": ()}


@needs_native
def test_a_start_forgets_the_past() -> None:
    one = draw(1, 1, 16, 6, 3)._replace(
        start=np.arange(16)[None, None] % 8 == 0, valid=np.ones((1, 1, 16), bool)
    )
    halves = {name: getattr(one, name).reshape(1, 2, 8, *rest) for name, rest in PER_STEP.items()}
    two = one._replace(**halves)
    whole, parts = native.estep(*one), native.estep(*two)
    np.testing.assert_allclose(whole.log_evidence[0, 0], parts.log_evidence.sum(), rtol=1e-6)
    np.testing.assert_allclose(whole.gamma.reshape(parts.gamma.shape), parts.gamma, rtol=1e-6)
    np.testing.assert_allclose(whole.xi, parts.xi, rtol=1e-5, atol=1e-7)


@needs_native
def test_impossible_steps_are_ignored() -> None:
    tapes = draw(2, 4, 12, 6, 3)
    tapes = tapes._replace(valid=np.ones_like(tapes.valid))
    tapes.log_obs[:, :, 5] = NEG
    ignored = tapes._replace(log_obs=np.where(tapes.log_obs > NEG / 2, tapes.log_obs, 0))
    got, want = native.estep(*tapes), native.estep(*ignored)
    assert_same(got._replace(log_evidence=want.log_evidence), want)
    np.testing.assert_allclose(got.log_evidence, NEG)


def two_worlds(early: float, late: float, rows: int) -> Tapes:
    """Take two states that never meet: early steps speak for one, late ones for the other."""
    log_obs = np.zeros((1, rows, 8, 2), np.float32)
    log_obs[0, :, :4, 1], log_obs[0, :, 4:, 0] = -early, -late
    shape = (1, rows, 8)
    init, trans = np.full((1, 2), 0.5, np.float32), np.eye(2, dtype=np.float32)[None, None]
    return Tapes(init, trans, log_obs, np.zeros(shape, np.int32), np.zeros(shape, bool), np.ones(shape, bool))


@needs_native
@pytest.mark.parametrize(("early", "late"), [(100, 150), (10, 30), (28, 60)])
def test_what_underflow_lost_is_found_again(early: float, late: float) -> None:
    bad, good = two_worlds(early, late, 3), two_worlds(1, 2, 3)
    tapes = bad._replace(log_obs=np.concatenate([bad.log_obs[:, :2], good.log_obs[:, 2:]], axis=1))
    assert_same(native.estep(*tapes), by_numpy(tapes))


@needs_native
def test_filter_equals_the_definition() -> None:
    tapes = draw(3, 5, 20, 17, 4, zeros=0.3, scale=2.0)

    def of_model(init: jax.Array, trans: jax.Array, *rows: jax.Array) -> tuple[jax.Array, jax.Array]:
        filtered = jax.vmap(lambda *row: filter_tape(Chain(safe_log(init), safe_log(trans)), *row))(*rows)
        return filtered.belief, filtered.log_norm

    belief, log_norm = native.filter_tapes(*tapes)
    want = jax.jit(jax.vmap(of_model))(*tapes)
    np.testing.assert_allclose(belief, want[0], **SINGLE)
    np.testing.assert_allclose(log_norm, want[1], rtol=2e-5, atol=5e-6)


@needs_native
def test_filter_brings_back_a_state_that_no_float_holds() -> None:
    belief, log_norm = native.filter_tapes(*two_worlds(100, 150, 1))
    np.testing.assert_allclose(belief[0, 0, [0, 6, 7], 0], [1, 1 / (1 + np.exp(50)), 0], atol=1e-6)
    assert float(log_norm.sum()) == pytest.approx(np.log(0.5) - 400, rel=1e-5)


@needs_native
def test_it_works_inside_jit_vmap_and_loops() -> None:
    tapes = draw(2, 3, 12, 5, 2)
    want = native.estep(*tapes)

    def again(_: int, trans: jax.Array) -> jax.Array:
        return native.estep(tapes.init, trans, *tapes[2:]).xi + 0.1

    looped = jax.jit(lambda trans: jax.lax.fori_loop(0, 2, again, trans))(jnp.asarray(tapes.trans))
    by_hand = again(1, again(0, jnp.asarray(tapes.trans)))
    np.testing.assert_allclose(looped, by_hand, rtol=1e-5)
    mapped = jax.vmap(lambda x: native.estep(tapes.init, tapes.trans, x, *tapes[3:]))(
        jnp.stack([tapes.log_obs, -tapes.log_obs])
    )
    assert_same(jax.tree.map(lambda x: x[0], mapped), want)


@needs_native
def test_results_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    tapes = draw(3, 40, 30, 20, 4)
    one, *more = by_threads(lambda: native.estep(*tapes), monkeypatch)
    for other in more:
        assert_same(one, other, rtol=0, atol=0)


@needs_native
def test_empty_batches_give_empty_results() -> None:
    for shape in ((0, 2, 5, 3, 2), (2, 0, 5, 3, 2), (2, 2, 0, 3, 2)):
        models, rows, steps, states, actions = shape
        flags = np.ones((models, rows, steps), bool)
        got = native.estep(
            np.full((models, states), 1 / states, np.float32),
            np.full((models, actions, states, states), 1 / states, np.float32),
            np.zeros((models, rows, steps, states), np.float32),
            np.zeros((models, rows, steps), np.int32),
            flags,
            flags,
        )
        assert got.gamma.shape == (models, rows, steps, states)
        assert not any(np.any(leaf) for leaf in got)


def test_bad_arguments_are_named() -> None:
    tapes = draw(2, 3, 12, 5, 2)
    with pytest.raises(ValueError, match=r"actions must be int32\[2, 3, 12\], got int32\[2, 3, 11\]"):
        native.estep(*tapes._replace(actions=tapes.actions[..., 1:]))
    with pytest.raises(ValueError, match=r"log_obs must be float32.*, got float16"):
        native.estep(*tapes._replace(log_obs=tapes.log_obs.astype(np.float16)))
    with pytest.raises(ValueError, match="log_obs must have shape"):
        native.filter_tapes(*tapes._replace(log_obs=tapes.log_obs[0]))
    q, data = values(tapes), replay_data(tapes)
    with pytest.raises(ValueError, match="rule must be one of"):
        native.sarsa_replay(q, *data, alpha=0.1, gamma=0.9, lam=0.9, rule="dyna")
    with pytest.raises(ValueError, match=r"beliefs must have shape \[S, B, T, N\]"):
        native.sarsa_replay(q, data.beliefs[0], *data[1:], alpha=0.1, gamma=0.9, lam=0.9)


# ------------------------------------------------------------------ replay


def values(tapes: Tapes) -> np.ndarray:
    models, actions, states = tapes.trans.shape[:3]
    return np.random.default_rng(1).normal(size=(models, states, actions)).astype(np.float32)


def replay_data(tapes: Tapes) -> ReplayData:
    rng = np.random.default_rng(2)
    beliefs = rng.dirichlet(np.ones(tapes.init.shape[1]), tapes.valid.shape).astype(np.float32)
    beliefs = np.where(tapes.valid[..., None], beliefs, 0)
    rewards = rng.normal(size=tapes.valid.shape).astype(np.float32)
    terminated = rng.random(tapes.valid.shape) < 0.5
    return ReplayData(beliefs, tapes.actions, rewards, tapes.start, tapes.valid, terminated)


def numpy_replay(
    q: np.ndarray, data: ReplayData, alpha: float, gamma: float, lam: float, replacing: bool, rule: str
) -> np.ndarray:
    """Do it in float64 for one model, one trial and one step after the other."""
    q = q.astype(float)
    for beliefs, actions, rewards, start, valid, terminated in zip(*data, strict=True):
        for trial in trials_of(start, valid):
            trace = np.zeros_like(q)
            for t, following in pairwise(trial):
                values_tp1 = beliefs[following] @ q
                next_value = values_tp1.max() if rule == "q" else values_tp1[actions[following]]
                if following == trial[-1]:
                    next_value = 0 if terminated[following] else values_tp1.max()
                delta = rewards[t] + gamma * next_value - beliefs[t] @ q[:, actions[t]]
                trace *= gamma * lam
                mark = trace[:, actions[t]]
                trace[:, actions[t]] = np.maximum(mark, beliefs[t]) if replacing else mark + beliefs[t]
                q += alpha * delta * trace
    return q


@needs_native
@pytest.mark.parametrize("replacing", [False, True])
@pytest.mark.parametrize("rule", ["sarsa", "q"])
@pytest.mark.parametrize("shape", [(3, 4, 20, 5, 3), (2, 2, 30, 33, 6), (1, 1, 1, 1, 1)], ids=str)
def test_replay_equals_numpy(shape: tuple[int, ...], rule: str, replacing: bool) -> None:
    tapes = draw(*shape)
    q, data = values(tapes), replay_data(tapes)
    alpha = np.linspace(0.05, 0.1, shape[0])
    got = native.sarsa_replay(
        q, *data, alpha=alpha, gamma=0.9, lam=0.8, passes=2, replacing=replacing, rule=rule
    )
    for s in range(shape[0]):
        once, of_model = q[s], ReplayData(*(x[s] for x in data))
        for _ in range(2):
            once = numpy_replay(once, of_model, alpha[s], 0.9, 0.8, replacing, rule)
        np.testing.assert_allclose(got[s], once, rtol=2e-5, atol=2e-5)


@needs_native
@pytest.mark.parametrize("rule", ["sarsa", "q"])
def test_replay_equals_the_definition(rule: str) -> None:
    tapes = draw(2, 1, 40, 6, 3)
    tapes = tapes._replace(start=tapes.start | ~np.roll(tapes.valid, 1, axis=-1))
    q, data = values(tapes), replay_data(tapes)
    got = native.sarsa_replay(q, *data, alpha=0.1, gamma=0.9, lam=0.8, rule=rule)
    one_tape = ReplayData(*(x[:, 0] for x in data))
    want = jax.vmap(lambda q, tape: replay_tape(q, tape, 0.1, 0.9, 0.8, rule=rule))(q, one_tape)
    np.testing.assert_allclose(got, want, rtol=2e-5, atol=2e-5)


@needs_native
def test_the_replay_oracle_notices_a_reward_that_comes_a_step_late() -> None:
    tapes = draw(1, 2, 20, 5, 3)
    q, data = values(tapes), replay_data(tapes)
    late = data._replace(rewards=np.roll(data.rewards, 1, axis=-1))
    got = native.sarsa_replay(q, *late, alpha=0.1, gamma=0.9, lam=0.8)
    want = numpy_replay(q[0], ReplayData(*(x[0] for x in data)), 0.1, 0.9, 0.8, False, "sarsa")
    assert not np.allclose(got[0], want, atol=1e-3)


# ------------------------------------------------------------------ building


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Give an empty cache, and a process that has not tried to load yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(native, "loaded", build.loaded.__wrapped__)
    return tmp_path


def script(path: Path, text: str) -> str:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IEXEC)
    return str(path)


def test_it_can_be_turned_off(fresh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAXPOMDP_NATIVE", "0")
    assert not native.available()
    assert os.listdir(fresh) == []


def test_without_a_compiler_there_is_nothing_and_no_error(
    fresh: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build, "compiler", lambda: None)
    assert not native.available()
    assert os.listdir(fresh) == []


@pytest.mark.parametrize("does", ["exit 1", "[ $1 = --version ] || exit 1", ":"])
def test_a_compiler_that_fails_leaves_nothing(
    fresh: Path, monkeypatch: pytest.MonkeyPatch, does: str
) -> None:
    broken = script(fresh / "broken", does)
    monkeypatch.setattr(build, "compiler", lambda: broken)
    assert not native.available()
    assert list(fresh.rglob("*.so")) == []


def test_the_library_appears_whole_and_the_folder_stays_clean(fresh: Path) -> None:
    writes_last_argument = script(fresh / "cc", 'for last; do :; done; echo made > "$last"')
    path = fresh / "cache" / "native.so"
    build.build(writes_last_argument, path)
    build.build(writes_last_argument, path)
    assert path.read_text() == "made\n"
    assert [p.name for p in path.parent.iterdir()] == ["native.so"]
    with pytest.raises(subprocess.CalledProcessError):
        build.build(script(fresh / "cc2", "exit 3"), path)
    assert [p.name for p in path.parent.iterdir()] == ["native.so"]


def test_the_name_depends_on_compiler_and_processor(fresh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = build.library_path(script(fresh / "a", "echo 1"))
    second = build.library_path(script(fresh / "b", "echo 2"))
    monkeypatch.setattr(build, "processor", lambda: "another")
    assert len({first, second, build.library_path(str(fresh / "a"))}) == 3
