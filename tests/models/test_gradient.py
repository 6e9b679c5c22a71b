from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.models.em import EMConfig, em_step, fit
from jaxpomdp.models.family import Prior
from jaxpomdp.models.flat import FLAT
from jaxpomdp.models.gradient import GradientConfig, fit_gradient, objective
from tests.models.problems import (
    SCALED,
    assert_trees_close,
    batch,
    model,
    rich_model,
    rich_trials,
    stack,
    to_batch,
    to_params,
)

pytest.importorskip("optax")


@pytest.mark.usefixtures("x64")
def test_the_gradient_is_that_of_the_expected_log_likelihood() -> None:
    """Fisher's identity: where EM's statistics were taken, evidence and expected log-likelihood rise alike.

    The one side differentiates the forward pass, the other uses the backward pass and no derivative of it.
    """
    params, tapes = to_params(rich_model(), full=False), to_batch(rich_trials())
    prior = Prior(variance_strength=2.0)
    _, info = em_step(SCALED, stack(params), stack(tapes), EMConfig(theta=0.3, prior=prior))
    statistics = jax.tree.map(lambda x: x[0], info.statistics)

    def expected(free):
        at = FLAT.from_free(params, free, prior)
        return FLAT.expected(at, statistics, 0.3) + FLAT.log_prior(at, statistics, prior, 0.3)

    def forward(free):
        return objective(FLAT, FLAT.from_free(params, free, prior), tapes, statistics, 0.3, prior)

    free = FLAT.to_free(params)
    value, gradient = jax.jit(jax.value_and_grad(forward))(free)
    np.testing.assert_allclose(value, info.objective[0], rtol=1e-10)
    assert_trees_close(gradient, jax.jit(jax.grad(expected))(free), atol=1e-9)


@pytest.mark.usefixtures("x64")
def test_gradient_and_em_reach_the_same_height() -> None:
    params, tapes = model(), batch()
    _, report = fit(SCALED, params, tapes, EMConfig(iterations=2000, tolerance=1e-10, theta=0.2))
    ascended, trace = fit_gradient(FLAT, params, tapes, GradientConfig(iterations=1500, theta=0.2))
    assert trace.shape == (1500,)
    np.testing.assert_allclose(trace[0], report.trace[0], rtol=1e-8)
    np.testing.assert_allclose(trace.max(), report.trace[-1], atol=3e-3)
    np.testing.assert_allclose(jnp.exp(ascended.log_trans).sum(axis=-1), 1, rtol=1e-9)


def test_frozen_parts_and_zeros_stay() -> None:
    import optax

    made = rich_model()
    params = stack(to_params(made, full=False), 2)
    config = GradientConfig(iterations=3, prior=Prior(freeze=("emissions",)))
    new, trace = fit_gradient(FLAT, params, to_batch(rich_trials()), config, optimiser=optax.sgd(1e-2))
    assert trace.shape == (2, 3)
    assert (trace[:, 1:] > trace[:, :-1]).all()
    assert_trees_close(new.emissions, params.emissions, atol=0)
    assert ((new.log_trans < -1e29) == (params.log_trans < -1e29)).all()


def test_free_parameters_go_there_and_back() -> None:
    params = to_params(rich_model())
    back = partial(FLAT.from_free, params, prior=Prior())(FLAT.to_free(params))
    assert_trees_close(back, params, rtol=1e-5, atol=1e-5)


def test_errors() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        GradientConfig(learning_rate=0.0)
