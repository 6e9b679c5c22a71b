from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.models.em import EMConfig, fit
from jaxpomdp.models.family import Prior
from jaxpomdp.models.init import random_params
from jaxpomdp.models.selection import bic, fit_restarts, free_parameters, held_out, log_evidence
from tests.models.problems import (
    LIGHT,
    batch,
    model,
    models,
    rich_model,
    rich_trials,
    to_batch,
    to_params,
)
from tests.oracles import em as oracle


def test_evidence_equals_brute_force() -> None:
    made, experience = rich_model(), rich_trials()
    for theta in (0.0, 0.3):
        want = oracle.expected(made, experience, theta)[0]
        got = log_evidence(LIGHT, to_params(made), to_batch(experience), theta=theta)
        assert got.shape == (3,)
        assert float(got.sum()) == pytest.approx(want, rel=1e-5)


def test_free_parameters_by_hand() -> None:
    """Three states, two actions, four symbols, vectors with covariance, returns by action, one zero."""
    params = to_params(rich_model())
    chain, symbols, vectors, returns = 2 + (6 * 2 - 1), 3 * 3, 3 * (2 + 3), 3 * 4
    assert int(free_parameters(LIGHT, params)) == chain + symbols + vectors
    with_returns = EMConfig(theta=0.2)
    assert int(free_parameters(LIGHT, params, with_returns)) == chain + symbols + vectors + returns
    frozen = EMConfig(prior=Prior(freeze=("transitions", "emissions")))
    assert int(free_parameters(LIGHT, params, frozen)) == 2
    assert free_parameters(LIGHT, models(2, capacity=5)).tolist() == [2 + 12 + 9] * 2


def test_bic_and_held_out_score() -> None:
    params, tapes = model(), batch()
    evidence = float(log_evidence(LIGHT, params, tapes).sum())
    assert float(bic(LIGHT, params, tapes)) == pytest.approx(-2 * evidence + 23 * np.log(13), rel=1e-5)
    assert float(held_out(LIGHT, params, tapes)) == pytest.approx(evidence / 13, rel=1e-5)
    many = held_out(LIGHT, models(2), tapes)
    assert many.shape == (2,)


def test_the_best_restart_is_kept() -> None:
    key, config = jax.random.key(0), EMConfig(iterations=20)

    best, report = fit_restarts(LIGHT, model_from, batch(), config, key=key, restarts=4)
    assert report.trace.shape == (4, 21)
    height = float(report.trace[:, -1].max())
    again = fit(LIGHT, best, batch(), replace(config, iterations=1, tolerance=0.0))[1]
    assert float(again.trace[0]) == pytest.approx(height, rel=1e-5)
    fewer = fit_restarts(LIGHT, model_from, batch(), config, key=key, restarts=2)[1]
    np.testing.assert_allclose(fewer.trace, report.trace[:2], rtol=1e-4)
    with pytest.raises(ValueError, match="restarts must be at least 1"):
        fit_restarts(LIGHT, model_from, batch(), key=key, restarts=0)


def model_from(key):
    return random_params(key, 3, 2, 4)


def test_scores_refuse_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="channels"):
        log_evidence(LIGHT, to_params(rich_model()), batch())
    assert jnp.isfinite(held_out(LIGHT, model(), batch()))
