"""The hierarchical model: a step against brute force, EM that never falls, and what must not matter."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.kernels.decoding import viterbi
from jaxpomdp.models.em import EMConfig, em_fit, em_step, fit
from jaxpomdp.models.family import Prior
from jaxpomdp.models.gradient import GradientConfig, fit_gradient
from jaxpomdp.models.hierarchical import HIERARCHICAL, beliefs_of_nodes, flatten_trees, path_of_nodes
from jaxpomdp.models.store import load, save
from jaxpomdp.numerics import NEG
from jaxpomdp.packing import TreeCapacity, pack, unpack, unpack_all
from jaxpomdp.structure.tree import allowed_horizontal, allowed_vertical, validate_tree
from jaxpomdp.structure.tree_forms import flatten_tree, one_level
from tests.models.problems import LIGHT, batch, model, rich_trials, stack, to_batch
from tests.models.trees import LIGHT_TREE, SCALED_TREE, numbers, spec_of, tree
from tests.oracles import em as paths_oracle
from tests.oracles import tree as tree_oracle

ROOM = TreeCapacity(8, 6, 4)
CONFIG = EMConfig(iterations=4, tolerance=0.0, theta=0.2)


def first(params):
    return jax.tree.map(lambda x: x[0], params)


def as_oracle(spec) -> dict:
    """The flat model by the flow of activity, as the enumerating oracle takes it; vectors say nothing."""
    init, trans = tree_oracle.flat_of(spec)
    n = spec.num_states
    return {
        "init": init,
        "trans": trans,
        "symbols": np.exp(spec.emissions[0].values["log_prob"]),
        "mean": np.zeros((n, 2)),
        "cov": np.tile(np.eye(2), (n, 1, 1)),
        "return_mean": spec.return_mean,
        "return_var": spec.return_var,
    }


def step_error(family, by_action: bool, prior: Prior) -> dict[str, float]:
    """Largest difference of the tables after one step from brute force: every path, every edge."""
    spec, trials = spec_of(0, states=4, by_action=by_action), rich_trials()
    _, credit = paths_oracle.expected(as_oracle(spec), trials, 0.3)
    down, across = tree_oracle.counts_of(spec, credit["init"], credit["trans"])
    down = down if by_action else down.sum(0, keepdims=True)
    tapes = to_batch(trials)
    tapes = replace(tapes, observations=tapes.observations[:1])
    packed = pack([spec], TreeCapacity(4, spec.num_internal, 2))
    new, _ = em_step(family, packed, stack(tapes), EMConfig(theta=0.3, prior=prior))
    allowed = {"log_vertical": allowed_vertical(spec), "log_horizontal": allowed_horizontal(spec)}
    pseudo = {"log_vertical": prior.initial, "log_horizontal": prior.transition}
    errors = {}
    for name, counts in {"log_vertical": down, "log_horizontal": across}.items():
        mass = np.where(allowed[name], counts + pseudo[name], 0)
        total = mass.sum(-1, keepdims=True)
        wanted = np.where(total > 0, mass / np.where(total > 0, total, 1), np.exp(getattr(spec, name)))
        got = np.exp(np.asarray(getattr(new, name)[0]))
        if name == "log_vertical" and by_action:
            got[:-1, 0], wanted[:-1, 0] = 0, 0
        errors[name] = float(np.abs(got - wanted).max())
    return errors


PRIOR = Prior(transition=0.1, initial=0.2, observation=0.05, variance_floor=0.0)


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("by_action", [False, True])
def test_a_step_equals_brute_force(by_action: bool) -> None:
    assert max(step_error(SCALED_TREE, by_action, PRIOR).values()) < 1e-10


@pytest.mark.usefixtures("x64")
def test_brute_force_notices_a_broken_step() -> None:
    def statistics(params, tapes, seen):
        return HIERARCHICAL.statistics(params, tapes, seen._replace(xi=jnp.swapaxes(seen.xi, 1, 2)))

    errors = step_error(SCALED_TREE._replace(statistics=statistics), False, PRIOR)
    assert errors["log_horizontal"] > 0.01


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("theta", [0.0, 0.2, 1.0])
def test_the_objective_never_falls(theta: float) -> None:
    """Different trees side by side, priors and floors included; 60 steps."""
    prior = Prior(variance_strength=1.0, variance_floor=0.2)
    config = EMConfig(iterations=60, tolerance=0.0, theta=theta, prior=prior)
    specs = [spec_of(seed, states=5 + seed, levels=2 + seed) for seed in range(3)]
    report = em_fit(SCALED_TREE, pack(specs, ROOM), stack(batch(), 3), config)[1]
    assert not report.fell.any()
    assert float(report.drop.max()) < 1e-10
    assert (report.trace[:, -1] > report.trace[:, 0] + 1).all()


def test_what_is_learned_is_a_tree_of_the_same_shape() -> None:
    """Rows sum to one where they did, zeros stay zero, and nothing is NaN."""
    specs = [spec_of(seed, states=5 + seed, levels=2 + seed, by_action=True) for seed in range(3)]
    fitted, _ = fit(LIGHT_TREE, pack(specs, ROOM), batch(), CONFIG)
    for old, new in zip(specs, unpack_all(fitted), strict=True):
        validate_tree(new)
        assert (new.leaf_parent.tolist(), new.node_parent.tolist()) == (
            old.leaf_parent.tolist(),
            old.node_parent.tolist(),
        )


def test_one_level_learns_as_the_flat_model() -> None:
    params = model()
    flat = unpack(stack(params), 0)
    other = first(pack([one_level(flat)], TreeCapacity(flat.num_states, 1, 1)))
    plain, report = fit(LIGHT, params, batch(), CONFIG)
    levelled, same = fit(LIGHT_TREE, other, batch(), CONFIG)
    np.testing.assert_allclose(report.trace, same.trace, rtol=1e-5)
    back = flatten_tree(unpack(stack(levelled), 0))
    np.testing.assert_allclose(np.exp(back.log_trans), np.exp(plain.log_trans), atol=1e-4)
    np.testing.assert_allclose(back.return_mean, plain.returns.mean, atol=1e-4)


def test_the_device_and_the_host_flatten_alike() -> None:
    specs = [spec_of(seed, states=5 + seed, levels=2 + seed) for seed in range(3)]
    chain = flatten_trees(pack(specs, ROOM))
    for s, spec in enumerate(specs):
        n, flat = spec.num_states, flatten_tree(spec)
        np.testing.assert_allclose(np.exp(chain.log_trans[s, :, :n, :n]), np.exp(flat.log_trans), atol=1e-6)
        np.testing.assert_allclose(np.exp(chain.log_init[s, :n]), np.exp(flat.log_init), atol=1e-6)
        assert (chain.log_trans[s, :, n:] == NEG).all()


def test_room_and_company_do_not_matter() -> None:
    """Trees of other sizes beside it, spare leaves, internal states and levels."""
    specs = [spec_of(seed, states=5 + seed, levels=2 + seed) for seed in range(3)]
    together, report = fit(LIGHT_TREE, pack(specs, ROOM), batch(), CONFIG)
    for s, spec in enumerate(specs):
        exact = TreeCapacity(spec.num_states, spec.num_internal, int(spec.depth.max()))
        alone, lone = fit(LIGHT_TREE, pack([spec], exact), batch(), CONFIG)
        np.testing.assert_allclose(report.trace[s], lone.trace[0], rtol=1e-5)
        left, right = unpack(together, s), unpack(alone, 0)
        for name in ("log_vertical", "log_horizontal", "return_mean"):
            np.testing.assert_allclose(
                np.exp(getattr(left, name)), np.exp(getattr(right, name)), atol=2e-4, err_msg=name
            )


def test_the_order_of_leaves_does_not_matter() -> None:
    """Leaves renumbered: the same objective, and rows that moved with them."""
    spec, order = spec_of(1, states=5), np.array([3, 0, 4, 1, 2])
    nodes = np.concatenate([order, np.arange(5, spec.num_nodes)])
    columns = np.append(nodes, spec.num_nodes)
    moved = replace(
        spec,
        leaf_parent=spec.leaf_parent[order],
        log_vertical=spec.log_vertical[:, :, nodes],
        log_horizontal=spec.log_horizontal[:, nodes][:, :, columns],
        emissions=tuple(c.take(order) for c in spec.emissions),
        return_mean=spec.return_mean[order],
        return_var=spec.return_var[order],
    )
    fitted, report = fit(LIGHT_TREE, pack([spec, moved], ROOM), batch(), CONFIG)
    np.testing.assert_allclose(report.trace[0], report.trace[1], rtol=1e-5)
    plain, shuffled = unpack_all(fitted)
    wanted = np.exp(plain.log_horizontal[:, nodes][:, :, columns])
    np.testing.assert_allclose(np.exp(shuffled.log_horizontal), wanted, atol=2e-4)


def test_frozen_parts_stay() -> None:
    params = tree()
    for frozen in ("init", "transitions"):
        new, report = fit(LIGHT_TREE, params, batch(), replace(CONFIG, prior=Prior(freeze=(frozen,))))
        assert not report.fell
        before, now = numbers(params), numbers(new)
        same = {name: np.array_equal(before[name], now[name]) for name in before}
        assert same == {"log_vertical": frozen == "init", "log_horizontal": frozen == "transitions"}


def test_gradients_climb_the_same_objective() -> None:
    params, tapes = tree(), batch()
    better, trace = fit_gradient(HIERARCHICAL, params, tapes, GradientConfig(iterations=30))
    assert np.isfinite(trace).all()
    assert trace[-1] > trace[0] + 1
    validate_tree(unpack(stack(better), 0))


def test_free_numbers_are_counted_by_row() -> None:
    """A row of k possible entries decides k - 1 numbers."""
    spec = spec_of(0, states=5)
    counted = int(HIERARCHICAL.count_free(tree(0), Prior(freeze=("emissions", "returns")), 0.0))
    rows = [allowed_vertical(spec)] + [allowed_horizontal(spec)] * spec.num_actions
    assert counted == sum(int(np.maximum(r.sum(-1) - 1, 0).sum()) for r in rows)


def test_best_paths_and_beliefs_are_of_nodes() -> None:
    params, tapes = tree(), batch()
    chain, log_obs = HIERARCHICAL.learning(params, tapes, 0.2)
    best = jax.vmap(partial(viterbi, chain))(log_obs, tapes.actions, tapes.start, tapes.valid)
    way = jax.vmap(partial(path_of_nodes, params))(best.states, tapes.start, tapes.valid)
    valid = np.asarray(tapes.valid)
    assert (np.asarray(way.nodes)[valid][:, 0] == 5).all()
    assert (np.asarray(way.nodes)[~valid] == -1).all()
    assert np.asarray(way.entered)[valid & np.asarray(tapes.start)][:, 0].all()
    nodes = beliefs_of_nodes(params, jnp.exp(chain.log_init))
    assert float(nodes[5]) == pytest.approx(1, abs=1e-5)


def test_a_tree_is_stored_and_read_again(tmp_path: Path) -> None:
    params = pack([spec_of(0), spec_of(1, states=7, levels=3)], ROOM)
    save(tmp_path / "tree.npz", params, family=HIERARCHICAL.name)
    stored = load(tmp_path / "tree.npz")
    assert stored.family == "hierarchical"
    assert unpack_all(stored.params) == unpack_all(params)


@pytest.mark.usefixtures("x64")
def test_packing_gives_back_what_it_was_given() -> None:
    specs = [spec_of(seed, states=3 + seed, levels=1 + seed % 4, by_action=True) for seed in range(6)]
    assert unpack_all(pack(specs, TreeCapacity(9, 9, 5))) == specs
    assert unpack_all(pack(specs, 8)) == specs
    with pytest.raises(ValueError, match=r"capacity must hold .* internal states, got 1"):
        pack(specs, TreeCapacity(9, 1, 5))
    with pytest.raises(ValueError, match="levels must be at least"):
        pack(specs, TreeCapacity(9, 9, 1))
    with pytest.raises(ValueError, match=r"specs must be alike; .* tree with 3 vertical tables"):
        pack([specs[0], spec_of(0)], 9)


def spoiled(name: str, value):
    return replace(tree(), **{name: value(getattr(tree(), name))})


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (lambda: spoiled("log_vertical", lambda x: x * 0.5), "params.log_vertical must have rows that sum"),
        (lambda: spoiled("log_horizontal", lambda x: x - 1), "params.log_horizontal must have rows that sum"),
        (lambda: spoiled("path", lambda x: x.at[0, 0].set(6)), "params.path must lead from the root"),
        (lambda: spoiled("path", lambda x: x.at[0].set(jnp.roll(x[0], 1))), "params.path must lead"),
        (lambda: spoiled("log_horizontal", lambda x: x.at[0, 5, 0].set(-1.0)), "no sibling, or itself"),
        (lambda: spoiled("log_vertical", lambda x: x.at[:, 0, 5].set(-1.0)), "sum to one|no child"),
        (lambda: spoiled("log_horizontal", lambda x: x[:, :-1]), "params.log_horizontal must have shape"),
        (lambda: spoiled("alive", lambda x: x & False), "params.alive must hold at least one"),
    ],
)
def test_errors_name_the_argument(params, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit(HIERARCHICAL, params(), batch())
