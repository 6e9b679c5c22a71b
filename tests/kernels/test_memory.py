"""A chain with a memory: against brute force, against the written-out pair, and the laws of inference."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import Chain
from jaxpomdp.kernels import memory
from jaxpomdp.kernels.decoding import viterbi
from jaxpomdp.kernels.memory import MemoryChain, pair_chain, smooth_pairs
from jaxpomdp.kernels.sampling import sample_path
from jaxpomdp.kernels.smoothing import smooth
from jaxpomdp.numerics import NEG
from tests.kernels.memory_problems import random_memory
from tests.oracles.memory import enumerate_memory

NAMES = ("log_evidence", "gamma", "held", "xi", "initial", "chain", "lead", "heed", "note")


def errors(problem, kernel=smooth_pairs) -> dict[str, float]:
    """Largest differences from brute force, in float64."""
    chain, tape = problem.jax()
    got, want = kernel(chain, *tape), enumerate_memory(problem.chain, *problem.tape)
    whole = got._asdict() | got.counts._asdict()
    return {name: float(np.abs(np.asarray(whole[name]) - getattr(want, name)).max()) for name in NAMES}


PROBLEMS = [
    random_memory(0, steps=4),
    random_memory(1, steps=5, states=2, missing=0.3),
    random_memory(2, steps=6, states=2, starts=0.4, padding=1),
    random_memory(3, steps=4, zeros=0.4),
    random_memory(4, steps=4, scale=5.0),
]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("problem", PROBLEMS)
def test_everything_equals_brute_force(problem) -> None:
    assert max(errors(problem).values()) < 1e-10


@pytest.mark.usefixtures("x64")
def test_brute_force_notices_broken_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """A memory that never notes on the way forward; and one that is heeded for what it held before."""
    with monkeypatch.context() as patch:
        patch.setattr(memory, "remember", lambda belief, note: belief)
        assert errors(PROBLEMS[0])["log_evidence"] > 1e-3
    with monkeypatch.context() as patch:
        plain = memory.move
        patch.setattr(memory, "move", lambda pairs, model, action: plain(pairs.T, model, action))
        assert errors(PROBLEMS[0])["gamma"] > 1e-3
    swapped = errors(PROBLEMS[0], lambda *x: _swapped(smooth_pairs(*x)))
    assert swapped["note"] > 0.1
    assert swapped["gamma"] < 1e-10


def _swapped(seen):
    return seen._replace(counts=seen.counts._replace(note=seen.counts.note[:, ::-1]))


@pytest.mark.usefixtures("x64")
def test_the_pair_written_out_says_the_same() -> None:
    """Longer tapes than can be listed: the dense chain of pairs, smoothed by another kernel."""
    problem = random_memory(5, steps=60, states=4, starts=0.1, missing=0.2, padding=3)
    chain, (rows, *rest) = problem.jax()
    seen = smooth_pairs(chain, rows, *rest)
    dense = smooth(pair_chain(chain), jnp.repeat(rows, 4, axis=-1), *rest)
    np.testing.assert_allclose(seen.log_evidence, dense.log_evidence, rtol=1e-12)
    joint = dense.gamma.reshape(-1, 4, 4)
    np.testing.assert_allclose(seen.gamma, joint.sum(2), atol=1e-10)
    np.testing.assert_allclose(seen.held, joint.sum(1), atol=1e-10)
    xi = dense.xi.reshape(-1, 4, 4, 4, 4).sum((2, 4))
    np.testing.assert_allclose(seen.xi, xi, atol=1e-10)


@pytest.mark.usefixtures("x64")
def test_a_memory_that_is_not_heeded_leaves_the_chain() -> None:
    chain, tape = random_memory(6, steps=40, states=4, starts=0.1).jax()
    deaf = chain._replace(log_heed=jnp.tile(jnp.array([0.0, NEG]), (4, 1)))
    seen, plain = smooth_pairs(deaf, *tape), smooth(Chain(chain.log_init, chain.log_trans), *tape)
    np.testing.assert_allclose(seen.log_evidence, plain.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(seen.gamma, plain.gamma, atol=1e-12)
    np.testing.assert_allclose(seen.counts.chain, plain.xi, atol=1e-12)
    assert (seen.counts.lead == 0).all()


@pytest.mark.usefixtures("x64")
def test_a_memory_that_always_notes_is_a_second_flat_chain() -> None:
    """Then a move by the memory is one by a row of the state that is left."""
    chain, tape = random_memory(7, steps=40, states=4).jax()
    noting = chain._replace(log_note=jnp.tile(jnp.array([0.0, NEG]), (4, 1)))
    heed = jnp.exp(chain.log_heed)[None, :, :, None]
    rows = heed[:, :, 0] * jnp.exp(chain.log_trans) + heed[:, :, 1] * jnp.exp(chain.log_lead)
    seen, plain = smooth_pairs(noting, *tape), smooth(Chain(chain.log_init, jnp.log(rows)), *tape)
    np.testing.assert_allclose(seen.log_evidence, plain.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(seen.xi, plain.xi, atol=1e-10)


@pytest.mark.usefixtures("x64")
def test_impossible_steps_and_spare_states_give_numbers() -> None:
    """An observation that no state can make is a missing one; absent states get nothing."""
    problem = random_memory(8, steps=8, states=3)
    chain, (rows, *rest) = problem.jax()
    blank, gone = rows.at[4].set(0.0), rows.at[4].set(NEG)
    seen, missing = smooth_pairs(chain, gone, *rest), smooth_pairs(chain, blank, *rest)
    np.testing.assert_allclose(seen.gamma, missing.gamma, atol=1e-12)
    assert float(seen.log_evidence) == pytest.approx(float(missing.log_evidence) + NEG)
    wide = MemoryChain(*(_padded(x) for x in chain))
    padded = smooth_pairs(wide, jnp.pad(rows, ((0, 0), (0, 2)), constant_values=NEG), *rest)
    plain = smooth_pairs(chain, rows, *rest)
    np.testing.assert_allclose(padded.log_evidence, plain.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(padded.xi[:, :3, :3], plain.xi, atol=1e-12)
    assert (padded.gamma[:, 3:] == 0).all()


def _padded(x: jax.Array) -> jax.Array:
    widths = [(0, 2 if size == 3 else 0) for size in x.shape]
    return jnp.pad(x, widths, constant_values=NEG)


def test_tapes_too_unlikely_for_float32_stay_finite() -> None:
    chain, tape = random_memory(9, steps=30, scale=300.0).jax(np.float32)
    seen = smooth_pairs(chain, *tape)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(seen))
    np.testing.assert_allclose(seen.gamma.sum(-1), 1, rtol=1e-4)


@pytest.mark.usefixtures("x64")
def test_best_and_random_paths_come_from_the_pair() -> None:
    """The best path is the likeliest of those listed; drawn ones remember what they should."""
    problem = random_memory(0, steps=4)
    chain, (rows, *rest) = problem.jax()
    pairs = pair_chain(chain)
    best = viterbi(pairs, jnp.repeat(rows, 3, axis=-1), *rest)
    dense = smooth(pairs, jnp.repeat(rows, 3, axis=-1), *rest)
    assert float(best.log_prob) < float(dense.log_evidence)
    keeping = chain._replace(log_note=jnp.tile(jnp.array([NEG, 0.0]), (3, 1)))
    drawn = sample_path(jax.random.key(0), pair_chain(keeping), *rest)
    active, held = np.divmod(np.asarray(drawn), 3)
    assert (held == active[0]).all()
