from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp.models.carry import averaged_transitions, model_as_data
from jaxpomdp.models.em import EMConfig, em_step
from jaxpomdp.models.family import Prior
from tests.models.problems import (
    LIGHT,
    assert_trees_close,
    batch,
    model,
    rich_model,
    rich_trials,
    stack,
    to_batch,
    to_params,
)

BARE = EMConfig(theta=0.2, prior=Prior(transition=0.0, initial=0.0, observation=0.0))


def test_a_model_counted_very_often_does_not_move() -> None:
    """Every channel: the estimate from a model's own statistics is that model."""
    params = to_params(rich_model())
    tapes = to_batch(rich_trials())
    strong, weak = (jax.vmap(model_as_data, (0, None))(stack(params), s) for s in (1e6, 1e-6))
    held, _ = em_step(LIGHT, stack(params), stack(tapes), BARE, strong)
    assert_trees_close(held, stack(params), atol=2e-3)
    free, _ = em_step(LIGHT, stack(params), stack(tapes), BARE, weak)
    assert float(jnp.abs(free.returns.mean[0] - params.returns.mean).max()) > 0.1


def test_an_untried_action_does_what_the_others_do() -> None:
    params, tapes = model(), batch()
    tapes = replace(tapes, actions=jnp.zeros_like(tapes.actions))
    _, info = em_step(LIGHT, stack(params), stack(tapes), BARE)
    statistics = jax.tree.map(lambda x: x[0], info.statistics)
    carry = averaged_transitions(statistics, 3.0)
    np.testing.assert_allclose(carry.transitions.sum(axis=-1), 3.0, rtol=1e-5)
    new, _ = em_step(LIGHT, stack(params), stack(tapes), BARE, stack(carry))
    np.testing.assert_allclose(new.log_trans[0, 1], new.log_trans[0, 0], atol=1e-4)
    np.testing.assert_array_equal(carry.initial, 0)


def test_a_state_never_left_counts_nothing() -> None:
    nothing = jax.tree.map(jnp.zeros_like, model_as_data(model(), 1.0))
    assert_trees_close(averaged_transitions(nothing, 2.0), nothing, atol=0)
