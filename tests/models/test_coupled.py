from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.models import couplings
from jaxpomdp.models.coupled import (
    COUPLED_MIXTURE,
    COUPLED_MIXTURE_APPROXIMATE,
    COUPLED_PRODUCT,
    COUPLED_PRODUCT_APPROXIMATE,
    CoupledParams,
    Strand,
)
from jaxpomdp.models.coupled_init import couple, silent, with_capacities
from jaxpomdp.models.data import trial_batch
from jaxpomdp.models.em import EMConfig, e_step, em_fit, em_step, fit
from jaxpomdp.models.emission import Categorical, ReturnModel
from jaxpomdp.models.estimates import add_statistics, scale_statistics
from jaxpomdp.models.family import Prior
from jaxpomdp.models.flat import FLAT
from jaxpomdp.models.init import random_params, stack_models, with_capacity
from jaxpomdp.models.selection import bic, log_evidence
from jaxpomdp.models.store import load, save
from jaxpomdp.numerics import NEG
from tests.models.problems import batch, model, stack
from tests.oracles import coupled_em as oracle

FAMILIES = {"mixture": COUPLED_MIXTURE, "product": COUPLED_PRODUCT}
PRIOR = Prior(transition=0.1, initial=0.2, observation=0.05, variance_floor=0.0)


def start(coupling: str, seed: int = 0, **options) -> CoupledParams:
    """Three states that see and two that earn (a third is spare)."""
    valued = with_capacity(random_params(seed + 7, 2, 2, 1), 3)
    return couple(seed, (model(seed), silent(valued)), coupling, concentration=1.0, **options)


def leaves_close(x, y, **tolerance: float) -> None:
    for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True):
        np.testing.assert_allclose(a, b, **tolerance)


def random_mixture(seed: int) -> dict:
    rng = np.random.default_rng(seed)
    sizes = (2, 2)
    return {
        "init": [rng.dirichlet(np.ones(n)) for n in sizes],
        "pairs": [[rng.dirichlet(np.ones(new), (2, old)) for old in sizes] for new in sizes],
        "weights": rng.dirichlet(np.ones(2), 2),
        "symbols": rng.dirichlet(np.ones(3), 2),
        "return_mean": rng.normal(size=2),
        "return_var": rng.uniform(0.5, 2, size=2),
    }


def to_params(made: dict) -> CoupledParams:
    channel = Categorical(jnp.log(made["symbols"]))
    returns = ReturnModel(made["return_mean"][:, None], made["return_var"][:, None])
    there = jnp.ones(2, bool)
    strands = (
        Strand(jnp.log(made["init"][0]), (channel,), None, there),
        Strand(jnp.log(made["init"][1]), (), returns, there),
    )
    pairs = tuple(tuple(jnp.log(x) for x in row) for row in made["pairs"])
    return CoupledParams(strands, pairs, jnp.log(made["weights"]), pairs[0][0])


def small_trials() -> list[dict]:
    return [
        {"symbols": [0, None, 2, 1], "actions": [0, 1, 0, 0], "returns": [0.3, -1.0, 0.7, None]},
        {"symbols": [1, 1, 0], "actions": [1, 1, 0], "returns": [1.1, 0.2, None]},
    ]


def to_batch(trials: list[dict]):
    made = trial_batch([t["symbols"] for t in trials], [t["actions"][:-1] for t in trials])
    paid = np.zeros(made.valid.shape, bool)
    returns = np.zeros(made.valid.shape)
    for b, trial in enumerate(trials):
        for t, r in enumerate(trial["returns"]):
            paid[b, t], returns[b, t] = r is not None, r or 0.0
    return replace(made, returns=jnp.asarray(returns), has_return=jnp.asarray(paid))


def step_errors(family) -> dict[str, float]:
    made, trials = random_mixture(3), small_trials()
    want, evidence = oracle.mixture_step(made, trials, 0.4, PRIOR)
    config = EMConfig(theta=0.4, prior=PRIOR)
    new, info = em_step(family, stack(to_params(made)), stack(to_batch(trials)), config)
    seen, earned = new.strands
    pairs = {
        "init": (jnp.exp(seen.log_init), want["init"][0]),
        "init_r": (jnp.exp(earned.log_init), want["init"][1]),
        "weights": (jnp.exp(new.log_weights), want["weights"]),
        "symbols": (jnp.exp(seen.emissions[0].log_prob), want["symbols"]),
        "mean": (earned.returns.mean[..., 0], want["return_mean"]),
        "var": (earned.returns.var[..., 0], want["return_var"]),
        "alone": (jnp.exp(new.log_alone), want["alone"]),
        "evidence": (info.log_evidence.sum(axis=1), evidence),
    }
    for c in range(2):
        for k in range(2):
            pairs[f"pair{c}{k}"] = (jnp.exp(new.log_pairs[c][k]), want["pairs"][c][k])
    return {name: float(np.abs(np.asarray(got)[0] - x).max()) for name, (got, x) in pairs.items()}


@pytest.mark.usefixtures("x64")
def test_a_step_of_the_mixture_equals_brute_force() -> None:
    """Rows, weights, symbols, returns, the acting chain; a missing step, a prior, theta."""
    assert max(step_errors(COUPLED_MIXTURE).values()) < 1e-10


@pytest.mark.usefixtures("x64")
def test_brute_force_notices_a_broken_step() -> None:
    """The chains' moves mixed up."""

    def statistics(params, tapes, seen):
        return COUPLED_MIXTURE.statistics(params, tapes, seen._replace(xi=seen.xi[::-1]))

    errors = step_errors(COUPLED_MIXTURE._replace(statistics=statistics))
    assert errors["pair00"] > 0.01
    assert errors["weights"] > 0.001
    assert errors["symbols"] < 1e-10


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("coupling", ["mixture", "product"])
@pytest.mark.parametrize("theta", [0.0, pytest.param(0.2, marks=pytest.mark.slow), 1.0])
def test_the_objective_never_falls(coupling: str, theta: float) -> None:
    """Priors, floors, structural zeros, spare states, carried statistics; 60 steps of two models."""
    family, params = FAMILIES[coupling], stack_models([start(coupling, seed) for seed in range(2)])
    params = replace(params, log_pairs=with_zero(params.log_pairs))
    prior = Prior(variance_strength=1.0, variance_floor=0.2, transition=0.05)
    config = EMConfig(iterations=60, tolerance=0.0, theta=theta, prior=prior)
    tapes = stack(batch(pack=True), 2)
    carry = scale_statistics(em_step(family, params, tapes, config)[1].statistics, 0.3)
    new, report = em_fit(family, params, tapes, config, carry)
    assert not report.fell.any()
    assert float(report.drop.max()) < 1e-9
    assert (report.trace[:, -1] > report.trace[:, 0] + 1).all()
    assert (new.log_pairs[0][1][:, :, 0, 1] < NEG / 2).all()
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(new))


def with_zero(log_pairs):
    """Strand 1 in state 0 never lets strand 0 go to state 1."""
    rows = log_pairs[0][1].at[..., 0, 1].set(NEG)
    rows = rows - jax.nn.logsumexp(rows, axis=-1, keepdims=True)
    rows = jnp.where(log_pairs[0][1] > NEG / 2, jnp.maximum(rows, NEG), NEG).at[..., 0, 1].set(NEG)
    return ((log_pairs[0][0], rows), log_pairs[1])


@pytest.mark.usefixtures("x64")
def test_without_a_prior_the_objective_never_falls_either() -> None:
    for coupling, family in FAMILIES.items():
        prior = Prior(transition=0.0, initial=0.0, observation=0.0)
        config = EMConfig(iterations=40, tolerance=0.0, theta=0.3, prior=prior)
        report = em_fit(family, stack(start(coupling)), stack(batch()), config)[1]
        assert float(report.drop.max()) < 1e-9, coupling


@pytest.mark.usefixtures("x64")
def test_a_product_step_that_overshoots_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """All chains' rows scaled at once by the full ratio, not one after the other: no bound holds."""
    sound = couplings.scaled_pairs

    def at_once(pairs, moves, own, pseudo):
        new = [sound(pairs, moves, own, pseudo)[0]]
        flipped = [jnp.zeros_like(pairs[0]) if k == 0 else p for k, p in enumerate(pairs)]
        return (
            *new,
            *(3 * x - 2 * y for x, y in zip(sound(flipped, moves, own, pseudo)[1:], pairs[1:], strict=True)),
        )

    monkeypatch.setattr(couplings, "scaled_pairs", at_once)
    family = COUPLED_PRODUCT._replace(name="overshooting")
    config = EMConfig(iterations=20, tolerance=0.0)
    assert em_fit(family, stack(start("product")), stack(batch()), config)[1].fell.any()


@pytest.mark.usefixtures("x64")
def test_many_sweeps_solve_the_product_s_m_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the end the model's moves are the data's, summed over the other chain: the likelihood equations."""
    params = start("product")
    moves = jnp.asarray(np.random.default_rng(0).gamma(1.0, size=(2, 3, 2, 3)))
    pairs = (params.log_pairs[0][0], params.log_pairs[0][1][:, :2])
    monkeypatch.setattr(couplings, "SWEEPS", 400)
    new = couplings.PRODUCT.updated((pairs,), None, (moves,), 0.0)[0][0]
    foreseen = jnp.exp(couplings.product_rows(new, 0)) * moves.sum(axis=-1, keepdims=True)
    for k in range(2):
        np.testing.assert_allclose(couplings.to_chain(foreseen, k), couplings.to_chain(moves, k), rtol=1e-5)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("coupling", ["mixture", "product"])
def test_a_strand_that_is_ignored_leaves_a_flat_model(coupling: str) -> None:
    """Evidence of the strand that sees is the flat model's; so is the chain it acts by after a step."""
    seen = model(1)
    params = couple(0, (seen, silent(model(2))), coupling, own_weight=1.0, concentration=1e15)
    tapes, config = batch(), EMConfig(prior=PRIOR)
    np.testing.assert_allclose(
        log_evidence(FAMILIES[coupling], params, tapes), log_evidence(FLAT, seen, tapes), rtol=1e-6
    )
    coupled, flat = (
        em_step(family, stack(x), stack(tapes), config)[0]
        for family, x in ((FAMILIES[coupling], params), (FLAT, seen))
    )
    np.testing.assert_allclose(jnp.exp(coupled.log_alone), jnp.exp(flat.log_trans), atol=1e-6)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("coupling", ["mixture", "product"])
def test_capacity_does_not_matter(coupling: str) -> None:
    params, config = start(coupling), EMConfig(theta=0.5, prior=PRIOR)
    tapes = stack(batch())
    small, info = em_step(FAMILIES[coupling], stack(params), tapes, config)
    wide, same = em_step(FAMILIES[coupling], stack(with_capacities(params, (5, 4))), tapes, config)
    np.testing.assert_allclose(same.objective, info.objective, rtol=1e-12)
    shrunk = jax.tree.map(lambda x, y: x[tuple(slice(n) for n in y.shape)], wide, small)
    leaves_close(jax.tree.map(jnp.exp, shrunk.log_pairs), jax.tree.map(jnp.exp, small.log_pairs), atol=1e-12)
    leaves_close(shrunk.strands[1].returns, small.strands[1].returns, rtol=1e-10)
    np.testing.assert_allclose(jnp.exp(shrunk.log_alone), jnp.exp(small.log_alone), atol=1e-12)
    assert (jnp.exp(wide.log_alone[:, :, 3:]) == 0).all()


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("coupling", ["mixture", "product"])
def test_models_side_by_side_are_models_alone(coupling: str) -> None:
    made = [start(coupling, seed) for seed in range(2)]
    config = EMConfig(theta=0.2)
    together = em_step(FAMILIES[coupling], stack_models(made), stack(batch(), 2), config)[0]
    alone = em_step(FAMILIES[coupling], stack(made[1]), stack(batch()), config)[0]
    leaves_close(jax.tree.map(lambda x: x[1:], together), alone, rtol=1e-9)


@pytest.mark.parametrize("frozen", ["init", "transitions", "emissions", "returns"])
def test_what_is_frozen_stays(frozen: str) -> None:
    params = stack(start("mixture"))
    config = EMConfig(theta=0.2, prior=Prior(freeze=(frozen,)))
    new = em_step(COUPLED_MIXTURE, params, stack(batch()), config)[0]
    parts = {
        "init": lambda p: [s.log_init for s in p.strands],
        "transitions": lambda p: (p.log_pairs, p.log_weights, p.log_alone),
        "emissions": lambda p: p.strands[0].emissions,
        "returns": lambda p: p.strands[1].returns,
    }
    for name, part in parts.items():
        pairs = zip(jax.tree.leaves(part(params)), jax.tree.leaves(part(new)), strict=True)
        assert all(np.array_equal(x, y) for x, y in pairs) == (name == frozen)


def test_returns_matter_to_learning_and_not_to_acting() -> None:
    params, tapes = start("mixture"), batch()
    plain, paid = (log_evidence(COUPLED_MIXTURE, params, tapes, theta=theta) for theta in (0.0, 0.5))
    assert not np.allclose(plain, paid)
    acting = COUPLED_MIXTURE.acting(params)
    assert acting.log_trans.shape == (2, 3, 3)
    np.testing.assert_allclose(jnp.exp(acting.log_trans).sum(axis=-1), 1, rtol=1e-5)
    rows = COUPLED_MIXTURE.log_obs(params, tapes.observations, tapes.observed)
    np.testing.assert_allclose(rows, FLAT.log_obs(model(), tapes.observations, tapes.observed), rtol=1e-6)


def test_approximate_families_run_the_same_loop() -> None:
    families = {"mixture": COUPLED_MIXTURE_APPROXIMATE, "product": COUPLED_PRODUCT_APPROXIMATE}
    for coupling, family in families.items():
        params = start(coupling)
        new, report = fit(family, params, batch(), EMConfig(iterations=15, theta=0.2))
        assert float(report.trace[-1]) > float(report.trace[0])
        near = log_evidence(family, new, batch()).sum()
        np.testing.assert_allclose(near, log_evidence(FAMILIES[coupling], new, batch()).sum(), rtol=0.05)


def test_three_strands_learn_by_the_approximate_sweep() -> None:
    params = couple(1, (model(1), silent(model(2)), silent(model(3))), paid=(False, True, True))
    new, report = fit(COUPLED_MIXTURE_APPROXIMATE, params, batch(), EMConfig(iterations=5, theta=0.3))
    assert float(report.trace[-1]) > float(report.trace[0])
    np.testing.assert_allclose(jnp.exp(new.log_weights).sum(axis=-1), 1, rtol=1e-5)


@pytest.mark.usefixtures("x64")
def test_free_parameters_go_there_and_back() -> None:
    for coupling, family in FAMILIES.items():
        params = start(coupling)
        again = family.from_free(params, family.to_free(params), Prior())
        leaves_close(again, params, rtol=1e-9)
        assert float(bic(family, params, batch())) > 0
    plain = EMConfig().prior
    # Rows 3*(2+1), 2*(2+1) ... of 3x3, 2x3, 3x2 and 2x2, two actions; weights 2; a product shares 2 + 1.
    rows = 2 * (3 * 2 + 2 * 2 + 3 * 1 + 2 * 1)
    rest = (2 + 1) + 3 * 3
    assert int(COUPLED_MIXTURE.count_free(start("mixture"), plain, 0.0)) == rows + 2 + rest
    assert int(COUPLED_PRODUCT.count_free(start("product"), plain, 0.0)) == rows - 2 * (2 + 1) + rest


def test_statistics_of_batches_add_up() -> None:
    params, config = stack(start("product")), EMConfig(theta=0.2)
    halves = [jax.tree.map(lambda x, s=s: x[:, s], stack(batch())) for s in (slice(2), slice(2, None))]
    parts = [em_step(COUPLED_PRODUCT, params, half, config)[1].statistics for half in halves]
    whole = em_step(COUPLED_PRODUCT, params, stack(batch()), config)[1].statistics
    together = jax.vmap(add_statistics)(*parts)
    leaves_close(together.moves, whole.moves, rtol=1e-4, atol=1e-5)
    one, other = (x.strands[1].returns.states for x in (together, whole))
    leaves_close((one.weight, one.scatter), (other.weight, other.scatter), rtol=1e-4, atol=1e-5)


def test_files_hold_coupled_models(tmp_path) -> None:
    params = start("product")
    save(tmp_path / "model.npz", params, family=COUPLED_PRODUCT.name)
    stored = load(tmp_path / "model.npz")
    assert stored.family == "coupled_product"
    leaves_close(stored.params, params, rtol=0)
    assert stored.params.log_weights is None


def test_errors_name_the_argument() -> None:
    params, tapes = start("mixture"), batch()
    with pytest.raises(ValueError, match=r"params.log_weights must be None in a product"):
        fit(COUPLED_PRODUCT, params, tapes)
    pairs = ((params.log_pairs[0][0], params.log_pairs[0][1] + 1), params.log_pairs[1])
    with pytest.raises(ValueError, match=r"params.log_pairs\[0\]\[1\] must have rows that sum to one"):
        fit(COUPLED_MIXTURE, replace(params, log_pairs=pairs), tapes)
    with pytest.raises(ValueError, match=r"batch.observations\[0\] must be in 0\.\.3"):
        fit(COUPLED_MIXTURE, params, replace(tapes, observations=(tapes.observations[0] + 9,)))
    three = couple(0, (model(), silent(model()), silent(model())))
    with pytest.raises(ValueError, match="chain must have two chains"):
        e_step(COUPLED_MIXTURE, stack(three), stack(tapes), EMConfig())
    with pytest.raises(ValueError, match="coupling must be one of"):
        couple(0, (model(), model()), "sum")
    with pytest.raises(ValueError, match="models must be at least two"):
        couple(0, (model(),))
    with pytest.raises(ValueError, match=r"capacities must be at least \[3, 3\]"):
        with_capacities(params, (2, 3))
    with pytest.raises(ValueError, match="plan must be one of"):
        e_step(COUPLED_MIXTURE, stack(params), stack(tapes), EMConfig(plan="pairs"))
