"""Packing of coupled models: exact both ways and blind to capacity; mistakes are named."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpomdp.coupled_packing import pack_coupled, unpack_coupled
from tests.structure.worlds import random_coupled


@given(
    st.lists(st.tuples(st.integers(1, 6), st.integers(1, 4)), min_size=1, max_size=3),
    st.tuples(st.integers(0, 3), st.integers(0, 3)),
    st.booleans(),
    st.sampled_from([1, 2]),
)
@settings(max_examples=25, deadline=None)
def test_unpack_undoes_pack_exactly(
    sizes: list[tuple[int, int]], spare: tuple[int, int], mixture: bool, columns: int
) -> None:
    specs = [
        random_coupled(i, size, mixture, columns=columns, dtype=np.float32) for i, size in enumerate(sizes)
    ]
    room = tuple(max(size[c] for size in sizes) + spare[c] for c in range(2))
    params = pack_coupled(specs, room)
    assert tuple(strand.alive.shape[1] for strand in params.strands) == room
    assert unpack_coupled(params) == specs


def test_spare_slots_have_no_probability_and_valid_parameters() -> None:
    specs = [random_coupled(0, (3, 2), True), random_coupled(1, (5, 1), True)]
    params = jax.device_get(pack_coupled(specs, (6, 4)))
    one, two = (strand.alive for strand in params.strands)
    assert one.sum(1).tolist() == [3, 5]
    assert two.sum(1).tolist() == [2, 1]
    total = np.exp(params.log_pairs[1][0]).sum(-1)
    np.testing.assert_allclose(total, np.broadcast_to(one[:, None], total.shape), atol=1e-6)
    assert (params.strands[1].returns.var > 0).all()


def test_mistakes_are_named() -> None:
    spec, other = random_coupled(0, (3, 2), True), random_coupled(0, (3, 2), False)
    with pytest.raises(ValueError, match="specs must hold at least one model, got none"):
        pack_coupled([], (3, 2))
    with pytest.raises(ValueError, match=r"specs must be alike; specs\[0\] has .*mixture.* has .*product"):
        pack_coupled([spec, other], (3, 2))
    with pytest.raises(ValueError, match="capacity must hold the largest model's 3 states, got 2"):
        pack_coupled([spec], (2, 2))
    with pytest.raises(ValueError, match="room must have 2 numbers"):
        pack_coupled([spec], (3,))
    with pytest.raises(ValueError, match=r"leading axis \[S\]"):
        unpack_coupled(jax.tree.map(lambda x: x[0], pack_coupled([spec], (3, 2))))
