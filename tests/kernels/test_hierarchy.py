"""The tree's chain and counts against the literal flow of activity, in float64."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.kernels.hierarchy import (
    beyond,
    branching,
    descendants,
    flatten,
    node_belief,
    node_path,
    parents,
    tree_counts,
)
from jaxpomdp.numerics import NEG
from jaxpomdp.packing import TreeCapacity, pack
from jaxpomdp.structure.topology import paths_of
from jaxpomdp.structure.tree import TreeSpec, allowed_horizontal, allowed_vertical
from tests.oracles import tree as oracle
from tests.structure.trees import make_tree, thesis_tree, trees

LEAVES, INTERNAL, LEVELS = 9, 9, 4
flatten_padded = jax.jit(flatten)
count_padded = jax.jit(tree_counts, static_argnames=("internal", "tables"))


def padded(spec: TreeSpec):
    """The same in more room than it needs, so that one compilation serves every tree."""
    params = pack([spec], TreeCapacity(LEAVES, INTERNAL, LEVELS))
    return params.log_vertical[0], params.log_horizontal[0], params.path[0]


def arrays(spec: TreeSpec, levels: int | None = None):
    path = paths_of(spec.parent, spec.num_states, levels)
    return jnp.asarray(spec.log_vertical), jnp.asarray(spec.log_horizontal), jnp.asarray(path)


def chain_error(spec: TreeSpec, chain) -> float:
    init, trans = oracle.flat_of(spec)
    n = spec.num_states
    got_init, got_trans = np.exp(chain.log_init), np.exp(chain.log_trans)
    assert got_init[n:].sum() == got_trans[:, n:].sum() == got_trans[:, :, n:].sum() == 0
    return max(np.abs(got_init[:n] - init).max(), np.abs(got_trans[:, :n, :n] - trans).max())


def random_counts(spec: TreeSpec, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Expected counts such as an E-step gives: none where the flat chain has no probability."""
    rng = np.random.default_rng(seed)
    init, trans = oracle.flat_of(spec)
    return rng.gamma(1, size=init.shape) * (init > 0), rng.gamma(1, size=trans.shape) * (trans > 0)


def count_error(spec: TreeSpec, counts, initial: np.ndarray, xi: np.ndarray) -> float:
    down, across = oracle.counts_of(spec, initial, xi)
    if len(spec.log_vertical) == 1:
        down = down.sum(0, keepdims=True)
    vertical = np.asarray(counts.vertical) * allowed_vertical(spec)
    horizontal = np.asarray(counts.horizontal) * allowed_horizontal(spec)
    vertical[: len(vertical) - 1, 0] = 0
    return max(np.abs(vertical - down).max(), np.abs(horizontal - across).max())


@given(trees(most=LEAVES))
@settings(max_examples=60, deadline=None)
def test_the_chain_is_the_flow_of_activity(spec: TreeSpec) -> None:
    with jax.enable_x64(True):
        assert chain_error(spec, flatten_padded(*padded(spec))) < 1e-10


@pytest.mark.usefixtures("x64")
def test_the_flow_of_activity_notices_a_broken_chain() -> None:
    """Leaves with the way to their neighbour, and entries that cost nothing."""
    spec = make_tree(1, 8, 3)
    vertical, horizontal, path = arrays(spec)
    chain = flatten(vertical, horizontal, path)
    assert chain_error(spec, chain) < 1e-10
    shuffled = path.at[:, 1:].set(jnp.roll(path[:, 1:], 1, 0))
    assert chain_error(spec, flatten(vertical, horizontal, shuffled)) > 0.01
    assert chain_error(spec, flatten(vertical * 0, horizontal, path)) > 0.01


@given(trees(most=7), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_counts_are_credited_edge_by_edge(spec: TreeSpec, seed: int) -> None:
    initial, xi = random_counts(spec, seed)
    n, i, tables = spec.num_states, spec.num_internal, len(spec.log_vertical)
    spare = (0, LEAVES - n)
    with jax.enable_x64(True):
        wide = np.pad(initial, spare), np.pad(xi, ((0, 0), spare, spare))
        counts = jax.device_get(count_padded(*wide, padded(spec)[2], INTERNAL, tables))
    place = np.r_[0:n, LEAVES : LEAVES + i]
    columns = np.append(place, LEAVES + INTERNAL)
    vertical = counts.vertical[:, :i][:, :, place]
    counts = counts._replace(vertical=vertical, horizontal=counts.horizontal[:, place][:, :, columns])
    assert count_error(spec, counts, initial, xi) < 1e-10


@pytest.mark.usefixtures("x64")
def test_crediting_notices_the_thesis_denominators() -> None:
    """Entries into an internal state in place of its exits (printed in 5.3), and transposed transitions."""
    spec = make_tree(1, 8, 3)
    initial, xi = random_counts(spec, 0)
    _, _, path = arrays(spec)
    there = tree_counts(jnp.asarray(initial), jnp.asarray(xi), path, spec.num_internal, 1)
    assert count_error(spec, there, initial, xi) < 1e-10
    turned = tree_counts(jnp.asarray(initial), jnp.asarray(xi).swapaxes(1, 2), path, spec.num_internal, 1)
    assert count_error(spec, turned, initial, xi) > 0.1
    entries = there.vertical[0].sum(0)
    exits = there._replace(horizontal=there.horizontal.at[:, :, -1].set(entries[None]))
    assert count_error(spec, exits, initial, xi) > 0.1


@pytest.mark.usefixtures("x64")
def test_the_example_of_the_thesis() -> None:
    chain = flatten(*arrays(thesis_tree()))
    assert float(jnp.exp(chain.log_trans[0, 0, 2])) == pytest.approx(0.084, abs=1e-12)


def test_depths_at_which_ways_part() -> None:
    path = jnp.asarray(paths_of(thesis_tree().parent, 5, 3))
    level = branching(path)
    assert level[0].tolist() == [2, 2, 1, 1, 1]
    assert level[4].tolist() == [1, 1, 1, 1, 1]
    assert parents(path, 8).tolist() == thesis_tree().parent.tolist()
    np.testing.assert_array_equal(descendants(path, 8), thesis_tree().below)


def test_sums_beyond_stop_at_the_logarithm_of_nothing() -> None:
    assert beyond(jnp.array([1.0, 2.0, 3.0])).tolist() == [5, 3, 0]
    assert beyond(jnp.array([0.0, NEG, NEG, NEG])).tolist() == pytest.approx([NEG, NEG, NEG, 0])


def test_room_for_depth_and_spare_slots_change_nothing() -> None:
    spec = make_tree(2, 7, 3)
    plain = flatten(*arrays(spec))
    deep = flatten(*arrays(spec, levels=6))
    np.testing.assert_array_equal(plain.log_trans, deep.log_trans)
    vertical, horizontal, path = arrays(spec)
    gone = flatten(vertical, horizontal, path.at[3].set(-1))
    assert (gone.log_trans[:, 3] == NEG).all()
    assert (gone.log_trans[:, :, 3] == NEG).all()
    assert gone.log_init[3] == NEG


def test_gradients_are_finite() -> None:
    vertical, horizontal, path = arrays(make_tree(2, 7, 3))
    loss = lambda v, h: sum(jnp.sum(jnp.exp(x) ** 2) for x in flatten(v, h, path))  # noqa: E731
    for gradient in jax.grad(loss, (0, 1))(vertical, horizontal):
        assert jnp.isfinite(gradient).all()


def test_beliefs_of_each_level_sum_to_one() -> None:
    spec = make_tree(3, 9, 3)
    path = jnp.asarray(paths_of(spec.parent, 9))
    belief = jnp.asarray(np.random.default_rng(0).dirichlet(np.ones(9), 4).astype(np.float32))
    nodes = node_belief(belief, path, spec.num_internal)
    np.testing.assert_allclose(nodes[:, spec.root], 1, rtol=1e-5)
    for depth in range(spec.depth.max() + 1):
        of_level = (spec.depth == depth) | ((spec.depth < depth) & (np.arange(spec.num_nodes) < 9))
        np.testing.assert_allclose(nodes[:, of_level].sum(1), 1, rtol=1e-5)


def test_paths_through_the_tree_say_where_nodes_are_entered_and_left() -> None:
    """Trial s0 s1 s2 s2, then padding; in the thesis's tree s0 and s1 are below i1, s2 below i2."""
    path = jnp.asarray(paths_of(thesis_tree().parent, 5))
    states = jnp.array([0, 1, 2, 2, -1])
    first, last = (jnp.array([t == k for t in range(5)]) for k in (0, 3))
    way = node_path(states, path, first, last)
    assert way.nodes.tolist() == [[5, 6, 0], [5, 6, 1], [5, 7, 2], [5, 7, 2], [-1, -1, -1]]
    entered = [[1, 1, 1], [0, 0, 1], [0, 1, 1], [0, 0, 1], [0, 0, 0]]
    left = [[0, 0, 1], [0, 1, 1], [0, 0, 1], [1, 1, 1], [0, 0, 0]]
    assert way.entered.astype(int).tolist() == entered
    assert way.left.astype(int).tolist() == left
