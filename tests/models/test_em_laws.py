"""What must not matter to EM: order of states, spare capacity, company, padding; and what must stay."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import TrialBatch
from jaxpomdp.models.em import EMConfig, em_step, fit
from jaxpomdp.models.emission import Categorical
from jaxpomdp.models.family import PARTS, Prior
from jaxpomdp.models.init import with_capacity
from jaxpomdp.numerics import NEG
from tests.models.problems import LIGHT, assert_trees_close, batch, model, models, permuted, stack

CONFIG = EMConfig(iterations=4, tolerance=0.0, theta=0.2)


def after(params, tapes: TrialBatch, config: EMConfig = CONFIG):
    return fit(LIGHT, params, tapes, config)


def test_the_order_of_states_does_not_matter() -> None:
    params, order = model(), [2, 0, 1]
    plain, report = after(params, batch())
    shuffled, other = after(permuted(params, order), batch())
    assert_trees_close(permuted(plain, order), shuffled, atol=1e-4)
    np.testing.assert_allclose(report.trace, other.trace, rtol=1e-5)


def test_spare_capacity_does_not_matter_and_stays_absent() -> None:
    params = model()
    plain, report = after(params, batch())
    roomy, other = after(with_capacity(params, 6), batch())
    assert_trees_close(with_capacity(plain, 6), roomy, atol=1e-4)
    np.testing.assert_allclose(report.trace, other.trace, rtol=1e-5)
    assert (roomy.log_trans[:, 3:] == NEG).all()
    assert (roomy.log_trans[:, :, 3:] == NEG).all()


def test_company_does_not_matter() -> None:
    """Models side by side, each with its own trials, end where each alone ends; one stops earlier."""
    params = models(2)
    tapes = jax.tree.map(lambda x, y: jnp.stack([x, y]), batch(0), batch(1))
    config = EMConfig(iterations=60, tolerance=3e-3, theta=0.2)
    together, report = after(params, tapes, config)
    assert report.iterations[0] != report.iterations[1]
    for i in range(2):
        alone, lone = after(*jax.tree.map(lambda x, i=i: x[i], (params, tapes)), config)
        assert_trees_close(jax.tree.map(lambda x, i=i: x[i], together), alone, atol=1e-4)
        assert int(lone.iterations) == int(report.iterations[i])


def test_padding_and_packing_do_not_matter() -> None:
    params = model()
    plain, report = after(params, batch())
    for tapes in (batch(length=9), batch(pack=True, length=14)):
        same, other = after(params, tapes)
        assert_trees_close(plain, same, atol=1e-4)
        np.testing.assert_allclose(report.trace, other.trace, rtol=1e-5)
    garbage = batch(length=9)
    wild = replace(
        garbage,
        returns=jnp.where(garbage.valid, garbage.returns, jnp.nan),
        observations=(jnp.where(garbage.valid, garbage.observations[0], 3),),
        has_return=garbage.has_return | ~garbage.valid,
        observed=garbage.observed | ~garbage.valid,
    )
    assert_trees_close(plain, after(params, wild)[0], atol=1e-4)


FIELDS = {"init": "log_init", "transitions": "log_trans", "emissions": "emissions", "returns": "returns"}


def test_frozen_parts_stay_and_the_rest_moves() -> None:
    params = model()
    for frozen in (("transitions", "returns"), ("init", "emissions")):
        config = replace(CONFIG, prior=Prior(freeze=frozen))
        new, report = after(params, batch(), config)
        assert not report.fell
        for part in PARTS:
            before, now = (jax.tree.leaves(getattr(at, FIELDS[part])) for at in (params, new))
            same = all(bool((x == y).all()) for x, y in zip(before, now, strict=True))
            assert same == (part in frozen), part


def test_structural_zeros_stay_zero() -> None:
    params = model()
    trans = jnp.log(jnp.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]) + 0.0)
    trans = jnp.maximum(trans, NEG)
    symbols = params.emissions[0].log_prob.at[0].set(jnp.array([NEG, np.log(0.5), np.log(0.5), NEG]))
    zeros = replace(params, log_trans=jnp.stack([trans, trans]), emissions=(Categorical(symbols),))
    new, report = after(zeros, batch())
    assert ((new.log_trans == NEG) == (zeros.log_trans == NEG)).all()
    assert ((new.emissions[0].log_prob == NEG) == (symbols == NEG)).all()
    assert not report.fell


def test_unvisited_rows_keep_their_values_without_a_prior() -> None:
    """Action 1 is never taken; with pseudo-counts its rows would become even."""
    params, tapes = model(), batch()
    tapes = replace(tapes, actions=jnp.zeros_like(tapes.actions), has_return=jnp.zeros_like(tapes.has_return))
    bare = EMConfig(prior=Prior(transition=0.0, initial=0.0, observation=0.0))
    new, _ = em_step(LIGHT, stack(params), stack(tapes), bare)
    np.testing.assert_allclose(new.log_trans[0, 1], params.log_trans[1], rtol=1e-6)
    np.testing.assert_array_equal(new.returns.mean[0], params.returns.mean)
    assert not np.allclose(new.log_trans[0, 0], params.log_trans[0])
    smooth, _ = em_step(LIGHT, stack(params), stack(tapes), replace(bare, prior=Prior()))
    np.testing.assert_allclose(smooth.log_trans[0, 1], np.log(1 / 3), rtol=1e-5)


def test_variances_respect_the_floor() -> None:
    """Returns that a state explains perfectly: its variance is the floor, a share of that of all returns."""
    tapes = batch()
    tapes = replace(tapes, returns=jnp.where(tapes.returns > 0, 5.0, -5.0))
    prior = Prior(variance_floor=0.04)
    new, _ = after(model(), tapes, EMConfig(iterations=60, theta=1.0, prior=prior))
    kept = np.asarray(tapes.returns)[np.asarray(tapes.has_return)]
    assert float(new.returns.var.min()) == pytest.approx(0.04 * kept.var(), rel=1e-4)
