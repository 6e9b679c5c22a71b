from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp._types import Posterior, last_steps
from jaxpomdp.models.em import EMConfig, em_fit, em_step, fit
from jaxpomdp.models.emission import Categorical
from jaxpomdp.models.estimates import add_statistics, scale_statistics
from jaxpomdp.models.family import Prior
from jaxpomdp.models.flat import FLAT
from jaxpomdp.numerics import NEG
from tests.models.problems import (
    LIGHT,
    SCALED,
    batch,
    model,
    models,
    rich_model,
    rich_trials,
    stack,
    to_batch,
    to_params,
)
from tests.oracles import em as oracle


def even_posterior(params, tapes) -> Posterior:
    """States and transitions all equally likely at every step: the start of statistics to carry."""
    models, states = params.alive.shape
    steps = jnp.where(tapes.valid[..., None], 1 / states, 0) * jnp.ones(states)[None, None, None]
    return Posterior(jnp.zeros(models), steps, jnp.exp(params.log_trans), jnp.exp(params.log_init))


PRIOR = Prior(transition=0.1, initial=0.2, observation=0.05, variance_floor=0.0)


def step_errors(family, full: bool, columns: int = 2) -> dict[str, float]:
    """Largest difference from the brute-force step, by part."""
    made, experience = rich_model(columns=columns, full=full), rich_trials()
    expected, evidence = oracle.em_step(made, experience, 0.3, PRIOR)
    config = EMConfig(theta=0.3, prior=PRIOR)
    params, info = em_step(family, stack(to_params(made, full=full)), stack(to_batch(experience)), config)
    vector = params.emissions[1]
    spread = vector.cov if full else vector.var
    wanted = expected["cov"] if full else np.diagonal(expected["cov"], axis1=1, axis2=2)
    pairs = {
        "init": (jnp.exp(params.log_init), expected["init"]),
        "trans": (jnp.exp(params.log_trans), expected["trans"]),
        "symbols": (jnp.exp(params.emissions[0].log_prob), expected["symbols"]),
        "mean": (vector.mean, expected["mean"]),
        "spread": (spread, wanted),
        "return_mean": (params.returns.mean, expected["return_mean"]),
        "return_var": (params.returns.var, expected["return_var"]),
        "evidence": (info.log_evidence.sum(axis=1), evidence),
    }
    return {name: float(np.abs(np.asarray(got)[0] - want).max()) for name, (got, want) in pairs.items()}


@pytest.mark.usefixtures("x64")
def test_a_step_equals_brute_force() -> None:
    """Symbols, vectors with any covariance, returns by action, missing steps, a structural zero, a prior."""
    assert max(step_errors(FLAT, full=True).values()) < 1e-10


@pytest.mark.usefixtures("x64")
def test_a_step_equals_brute_force_with_independent_coordinates_and_returns_by_state() -> None:
    assert max(step_errors(SCALED, full=False, columns=1).values()) < 1e-10


@pytest.mark.usefixtures("x64")
def test_brute_force_notices_a_broken_step() -> None:
    """Returns credited to the action before, and transitions transposed."""

    def statistics(params, tapes, seen):
        shifted = replace(tapes, actions=jnp.roll(tapes.actions, 1, axis=-1))
        return FLAT.statistics(params, shifted, seen._replace(xi=jnp.swapaxes(seen.xi, 1, 2)))

    errors = step_errors(SCALED._replace(statistics=statistics), full=False)
    assert errors["return_mean"] > 0.01
    assert errors["trans"] > 0.01
    assert errors["init"] < 1e-10


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("theta", [0.0, 0.2, 1.0])
def test_the_objective_never_falls(theta: float) -> None:
    """Priors, floors and carried statistics included; 60 steps of three models."""
    prior = Prior(variance_strength=1.0, variance_floor=0.2)
    config = EMConfig(iterations=60, tolerance=0.0, theta=theta, prior=prior)
    tapes, params = stack(batch(), 3), models(3)
    before = jax.vmap(SCALED.statistics)(params, tapes, even_posterior(params, tapes))
    report = em_fit(SCALED, params, tapes, config, scale_statistics(before, 0.5))[1]
    assert not report.fell.any()
    assert float(report.drop.max()) < 1e-10
    assert (report.trace[:, -1] > report.trace[:, 0] + 1).all()


CONFIG = EMConfig(iterations=200, tolerance=1e-4)


def test_a_fall_is_reported() -> None:
    """An M-step that throws away what was learnt."""
    good, report = fit(LIGHT, model(), batch(), CONFIG)
    assert not report.fell
    spoiled = LIGHT._replace(m_step=lambda params, statistics, prior: model(seed=3))
    _, report = fit(spoiled, good, batch(), CONFIG)
    assert report.fell
    assert float(report.drop) > 0.1


def test_it_stops_when_it_has_converged_or_at_the_limit() -> None:
    params, report = fit(LIGHT, model(), batch(), CONFIG)
    done = int(report.iterations)
    assert report.converged
    assert 1 < done < 200
    assert report.trace.shape == (201,)
    assert (report.trace[done:] == report.trace[done]).all()
    _, again = fit(LIGHT, params, batch(), CONFIG)
    assert int(again.iterations) <= 1
    np.testing.assert_allclose(again.trace[0], report.trace[-1], rtol=1e-5)
    short = fit(LIGHT, model(), batch(), EMConfig(iterations=2, tolerance=0.0))[1]
    assert not short.converged
    assert int(short.iterations) == 2
    np.testing.assert_allclose(short.trace, report.trace[:3], rtol=1e-4)


def test_one_compilation_serves_every_call() -> None:
    """The loop is traced once however long it runs, and steps of the same shapes share one program."""
    traced = []

    def learning(params, tapes, theta):
        traced.append(1)
        return FLAT.learning(params, tapes, theta)

    family = LIGHT._replace(learning=learning)
    for seed in range(3):
        params, _ = fit(family, model(seed), batch(seed), CONFIG)
    assert len(traced) == 1
    for _ in range(3):
        params, _ = em_step(family, stack(params), stack(batch()), CONFIG)
        params = jax.tree.map(lambda x: x[0], params)
    assert len(traced) == 1


def test_carried_statistics_are_data_seen_before() -> None:
    """A step with carried statistics is the M-step of both batches' statistics."""
    config = CONFIG
    first, second = stack(batch(seed=1)), stack(batch(seed=2))
    params = stack(model())
    _, seen = em_step(LIGHT, params, first, config)
    together, info = em_step(LIGHT, params, second, config, seen.statistics)
    pooled = jax.vmap(add_statistics)(seen.statistics, info.statistics)
    by_hand = jax.vmap(partial(FLAT.m_step, prior=config.prior))(params, pooled)
    for x, y in zip(jax.tree.leaves(together), jax.tree.leaves(by_hand), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-5)


def test_impossible_observations_do_no_harm() -> None:
    """A symbol that no state can show: the step counts as missing, the evidence says so, nothing is NaN."""
    params = model()
    never = params.emissions[0].log_prob.at[:, 1].set(NEG)
    spoiled = replace(params, emissions=(Categorical(never),))
    config = EMConfig(iterations=5, theta=0.2)
    tapes = batch()
    new, info = em_step(FLAT, stack(spoiled), stack(tapes), config)
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves((new, info)))
    assert float(info.objective[0]) < NEG / 2
    assert (new.emissions[0].log_prob[0, :, 1] < NEG / 2).all()
    rows = jnp.exp(new.log_trans[0]).sum(axis=-1)
    np.testing.assert_allclose(rows, 1, rtol=1e-5)


def test_last_steps_have_no_return_to_model() -> None:
    tapes = batch(pack=True)
    assert not (tapes.has_return & last_steps(tapes.valid, tapes.start)).any()


def test_errors_name_the_argument() -> None:
    params, tapes = model(), batch()
    with pytest.raises(ValueError, match=r"batch.actions must be in 0\.\.1, got 2"):
        fit(FLAT, params, replace(tapes, actions=tapes.actions + 1))
    symbols = (tapes.observations[0] + 9,)
    with pytest.raises(ValueError, match=r"batch.observations\[0\] must be in 0\.\.3"):
        fit(FLAT, params, replace(tapes, observations=symbols))
    with pytest.raises(ValueError, match=r"batch must hold at least one step"):
        fit(FLAT, params, replace(tapes, valid=jnp.zeros_like(tapes.valid)))
    with pytest.raises(ValueError, match=r"params.log_trans must have rows that sum to one"):
        fit(FLAT, replace(params, log_trans=params.log_trans + 1), tapes)
    with pytest.raises(ValueError, match=r"params.log_init must be finite|params.*must be finite"):
        fit(FLAT, replace(params, log_init=params.log_init * jnp.nan), tapes)
    with pytest.raises(ValueError, match=r"batch must have axes"):
        fit(FLAT, stack(params, 2), stack(tapes, 3))
    flat_rows = replace(params, emissions=(Categorical(params.emissions[0].log_prob - 1),))
    with pytest.raises(ValueError, match=r"params.emissions\[0\].log_prob must have rows that sum to one"):
        fit(FLAT, flat_rows, tapes)
    returns = replace(params.returns, var=params.returns.var * 0)
    with pytest.raises(ValueError, match=r"params.returns.var must be positive, got 0"):
        fit(FLAT, replace(params, returns=returns), tapes)
    with pytest.raises(ValueError, match="iterations must be at least 1"):
        EMConfig(iterations=0)
    with pytest.raises(ValueError, match="freeze must hold names among"):
        Prior(freeze=("everything",))
    with pytest.raises(ValueError, match="transition must be at least 0"):
        Prior(transition=-1.0)
