"""The coupled hierarchy: a step against brute force, EM that never falls, and what must not matter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.coupled_packing import pack_coupled_trees, unpack_coupled_trees
from jaxpomdp.models.coupled_tree import COUPLED_TREE, LEAVES_ALONE
from jaxpomdp.models.em import EMConfig, e_step, em_fit, em_step, fit
from jaxpomdp.models.family import Prior
from jaxpomdp.models.hierarchical import HIERARCHICAL
from jaxpomdp.models.selection import bic, log_evidence
from jaxpomdp.models.store import load, save
from jaxpomdp.numerics import NEG
from jaxpomdp.packing import TreeCapacity, pack
from jaxpomdp.structure.coupled_tree import CoupledTreeSpec, coupled_tree, validate_coupled_tree
from jaxpomdp.structure.tree import allowed_horizontal, allowed_vertical
from tests.models.problems import batch, rich_trials, stack, to_batch
from tests.models.trees import spec_of
from tests.oracles import tree as tree_oracle
from tests.oracles.memory import enumerate_memory
from tests.structure.coupled_trees import coupled_trees, over

ROOM = TreeCapacity(8, 6, 4)
PRIOR = Prior(transition=0.1, initial=0.2, observation=0.05, variance_floor=0.0)


def coupled(seed: int = 0, **options) -> CoupledTreeSpec:
    return over(spec_of(seed, **options), seed)


def exact_room(spec: CoupledTreeSpec) -> TreeCapacity:
    return TreeCapacity(spec.num_states, spec.tree.num_internal, int(spec.tree.depth.max()))


def packed(*specs: CoupledTreeSpec):
    return pack_coupled_trees(specs, exact_room(specs[0]) if len(specs) == 1 else ROOM)


def row_mode(old: np.ndarray, counts: np.ndarray, pseudo: float) -> np.ndarray:
    mass = np.where(old > 0, counts + pseudo, 0)
    total = mass.sum(-1, keepdims=True)
    return np.where(total > 0, mass / np.where(total > 0, total, 1), old)


def listed(spec: CoupledTreeSpec, tapes, theta: float) -> list:
    """What brute force says of each tape: all paths of leaves and of what is remembered."""
    init, trans = tree_oracle.flat_of(spec.tree)
    chain = [np.log(x) for x in (init, trans)]
    chain += [spec.log_lead, spec.log_heed, spec.log_note]
    symbols, returns = np.exp(spec.tree.emissions[0].values["log_prob"]), spec.tree
    answers = []
    for b in range(tapes.valid.shape[0]):
        row = {name: np.asarray(getattr(tapes, name)[b]) for name in ("valid", "start", "actions")}
        seen, paid = np.asarray(tapes.observed[b]), np.asarray(tapes.has_return[b])
        density = np.where(seen[:, None], symbols.T[np.asarray(tapes.observations[0][b])], 1.0)
        away = (np.asarray(tapes.returns[b])[:, None] - returns.return_mean[:, 0]) ** 2
        var = returns.return_var[:, 0]
        normal = np.exp(-0.5 * away / var) / np.sqrt(2 * np.pi * var)
        density = density * np.where(paid[:, None], normal, 1.0) ** theta
        with np.errstate(divide="ignore"):
            answers.append(enumerate_memory(chain, np.log(density), *_tape(row)))
    return answers


def _tape(row: dict) -> tuple:
    return row["actions"], row["start"], row["valid"]


def step_errors(family, spec: CoupledTreeSpec) -> dict[str, float]:
    tapes = to_batch(rich_trials())
    tapes = replace(tapes, observations=tapes.observations[:1])
    answers = listed(spec, tapes, 0.3)
    total = {name: sum(getattr(a, name) for a in answers) for name in answers[0]._fields if name not in
             ("gamma", "held")}  # fmt: skip
    down, across = tree_oracle.counts_of(spec.tree, total["initial"], total["chain"])
    tree = spec.tree
    want = {
        "log_vertical": row_mode(allowed_vertical(tree), down.sum(0, keepdims=True), PRIOR.initial),
        "log_horizontal": row_mode(allowed_horizontal(tree), across, PRIOR.transition),
        "log_lead": row_mode(np.exp(spec.log_lead), total["lead"], PRIOR.transition),
        "log_heed": row_mode(np.exp(spec.log_heed), total["heed"], PRIOR.transition),
        "log_note": row_mode(np.exp(spec.log_note), total["note"], PRIOR.transition),
        "log_alone": row_mode(np.exp(spec.log_alone), total["xi"], PRIOR.transition),
    }
    new, info = em_step(family, packed(spec), stack(tapes), EMConfig(theta=0.3, prior=PRIOR))
    got = {name: getattr(new.tree if name.startswith(("log_v", "log_ho")) else new, name) for name in want}
    errors = {name: float(np.abs(np.exp(np.asarray(got[name][0])) - want[name]).max()) for name in want}
    errors["evidence"] = abs(float(info.log_evidence.sum()) - total["log_evidence"])
    return errors


@pytest.mark.usefixtures("x64")
def test_a_step_equals_brute_force() -> None:
    """Every table of the tree and of the memory; missing steps, returns, priors."""
    assert max(step_errors(COUPLED_TREE, coupled(0, states=4)).values()) < 1e-10


@pytest.mark.usefixtures("x64")
def test_brute_force_notices_a_broken_step() -> None:
    """All moves credited to the tree, as if the memory had led none."""

    def statistics(params, tapes, seen):
        return COUPLED_TREE.statistics(
            params, tapes, seen._replace(counts=seen.counts._replace(chain=seen.xi))
        )

    errors = step_errors(COUPLED_TREE._replace(statistics=statistics), coupled(0, states=4))
    assert errors["log_horizontal"] > 0.01
    assert errors["log_lead"] < 1e-10


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("theta", [0.0, 0.2, 1.0])
def test_the_objective_never_falls(theta: float) -> None:
    """Different trees side by side, priors, floors and nodes that are not heeded included; 60 steps."""
    prior = Prior(variance_strength=1.0, variance_floor=0.2, transition=0.05)
    config = EMConfig(iterations=60, tolerance=0.0, theta=theta, prior=prior)
    specs = [over(spec_of(s, states=5 + s, levels=2 + s), s, zeros=0.4) for s in range(3)]
    new, report = em_fit(COUPLED_TREE, packed(*specs), stack(batch(), 3), config)
    assert not report.fell.any()
    assert float(report.drop.max()) < 1e-9
    assert (report.trace[:, -1] > report.trace[:, 0] + 1).all()
    for old, spec in zip(specs, unpack_coupled_trees(new), strict=True):
        validate_coupled_tree(spec)
        np.testing.assert_array_equal(spec.heeded, old.heeded)


@pytest.mark.usefixtures("x64")
def test_a_memory_that_is_not_heeded_leaves_the_tree() -> None:
    """Evidence, and the tree after some steps of EM, are the tree model's."""
    tree = spec_of(0)
    config = EMConfig(iterations=5, tolerance=0.0, theta=0.2, prior=PRIOR)
    for spec in (coupled_tree(tree), over(tree, 0, deaf=True)):
        ours, _ = fit(COUPLED_TREE, packed(spec), batch(), config)
        plain, _ = fit(HIERARCHICAL, pack([tree], exact_room(spec)), batch(), config)
        for name in ("log_vertical", "log_horizontal"):
            got, want = (np.exp(np.asarray(getattr(x, name))) for x in (ours.tree, plain))
            np.testing.assert_allclose(got, want, atol=1e-9)
        evidence = [
            log_evidence(f, p, batch(), theta=0.2) for f, p in ((COUPLED_TREE, ours), (HIERARCHICAL, plain))
        ]
        np.testing.assert_allclose(*evidence, rtol=1e-9)


@pytest.mark.usefixtures("x64")
def test_room_and_company_do_not_matter() -> None:
    specs = [coupled(seed, states=5 + seed, levels=2 + seed) for seed in range(2)]
    config = EMConfig(iterations=3, tolerance=0.0, theta=0.2, prior=PRIOR)
    together, report = fit(COUPLED_TREE, packed(*specs), batch(), config)
    for s, spec in [(1, specs[1])]:
        alone, lone = fit(COUPLED_TREE, packed(spec), batch(), config)
        np.testing.assert_allclose(report.trace[s], lone.trace[0], rtol=1e-9)
        left, right = unpack_coupled_trees(together)[s], unpack_coupled_trees(alone)[0]
        for (name, x), (_, y) in zip(left.tables(), right.tables(), strict=True):
            np.testing.assert_allclose(np.exp(x), np.exp(y), atol=1e-8, err_msg=name)


@given(st.lists(coupled_trees(), min_size=1, max_size=3), st.integers(0, 3))
@settings(max_examples=25, deadline=None)
def test_unpack_undoes_pack_exactly(specs: list[CoupledTreeSpec], spare: int) -> None:
    vertical = {len(spec.tree.log_vertical) for spec in specs}
    specs = specs[:1] if len(vertical) > 1 else specs
    with jax.enable_x64(True):
        room = max(spec.num_states for spec in specs) + spare
        assert unpack_coupled_trees(pack_coupled_trees(specs, room)) == specs


def test_frozen_parts_stay() -> None:
    params, parts = packed(coupled()), ("log_lead", "log_heed", "log_note", "log_alone")
    for frozen in ("transitions", "emissions"):
        config = EMConfig(theta=0.2, prior=Prior(freeze=(frozen,)))
        new = em_step(COUPLED_TREE, params, stack(batch()), config)[0]
        same = [np.array_equal(getattr(params, name), getattr(new, name)) for name in parts]
        assert same == [frozen == "transitions"] * 4
        tree = "log_horizontal" if frozen == "transitions" else frozen
        left, right = (jax.tree.leaves(getattr(x.tree, tree)) for x in (params, new))
        assert all(np.array_equal(x, y) for x, y in zip(left, right, strict=True))


def test_returns_matter_to_learning_and_acting_is_a_chain_of_leaves() -> None:
    params = jax.tree.map(lambda x: x[0], packed(coupled()))
    plain, paid = (log_evidence(COUPLED_TREE, params, batch(), theta=theta) for theta in (0.0, 0.5))
    assert not np.allclose(plain, paid)
    chain = COUPLED_TREE.acting(params)
    np.testing.assert_allclose(jnp.exp(chain.log_trans).sum(axis=-1), 1, rtol=1e-5)
    seen = e_step(LEAVES_ALONE, stack(params), stack(batch()), EMConfig(theta=0.5))
    np.testing.assert_allclose(seen.gamma.sum(-1)[np.asarray(stack(batch()).valid)], 1, rtol=1e-5)


@pytest.mark.usefixtures("x64")
def test_free_parameters_go_there_and_back() -> None:
    params = jax.tree.map(lambda x: x[0], packed(over(spec_of(0), 0, zeros=0.4)))
    again = COUPLED_TREE.from_free(params, COUPLED_TREE.to_free(params), Prior())
    for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(params), strict=True):
        np.testing.assert_allclose(np.exp(x), np.exp(y), rtol=1e-9)


def test_only_what_is_heeded_is_counted() -> None:
    tree, prior = spec_of(0), Prior()
    deaf, heard = (jax.tree.map(lambda x: x[0], packed(x)) for x in (coupled_tree(tree), over(tree, 0)))
    base = int(HIERARCHICAL.count_free(deaf.tree, prior, 0.0))
    assert int(COUPLED_TREE.count_free(deaf, prior, 0.0)) == base
    leaves, actions = tree.num_states, tree.num_actions
    more = actions * leaves * (leaves - 1) + 2 * leaves
    assert int(COUPLED_TREE.count_free(heard, prior, 0.0)) == base + more
    assert float(bic(COUPLED_TREE, heard, batch())) > 0


def test_files_hold_coupled_trees(tmp_path: Path) -> None:
    params = packed(coupled(0), coupled(1, states=7, levels=3))
    save(tmp_path / "model.npz", params, family=COUPLED_TREE.name)
    stored = load(tmp_path / "model.npz")
    assert stored.family == "coupled_tree"
    assert unpack_coupled_trees(stored.params) == unpack_coupled_trees(params)


def test_errors_name_the_argument() -> None:
    params, tapes = packed(coupled()), batch()
    with pytest.raises(ValueError, match=r"params.log_lead must have rows that sum to one"):
        fit(COUPLED_TREE, replace(params, log_lead=params.log_lead + 1), tapes)
    with pytest.raises(ValueError, match=r"params.log_heed must have shape"):
        fit(COUPLED_TREE, replace(params, log_heed=params.log_heed[:, :-1]), tapes)
    with pytest.raises(ValueError, match=r"params.log_note"):
        fit(COUPLED_TREE, replace(params, log_note=params.log_note * jnp.nan), tapes)
    with pytest.raises(ValueError, match="plan must be one of"):
        fit(COUPLED_TREE, params, tapes, EMConfig(plan="scan"))
    assert float(params.log_heed.min()) > NEG / 2
