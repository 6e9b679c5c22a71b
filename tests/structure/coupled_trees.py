"""Small random coupled trees for the tests."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from jaxpomdp.structure.coupled_tree import CoupledTreeSpec
from jaxpomdp.structure.spec import safe_log
from jaxpomdp.structure.tree import TreeSpec
from tests.structure.trees import trees


def over(tree: TreeSpec, seed: int, *, deaf: bool = False, zeros: float = 0.0) -> CoupledTreeSpec:
    """Draw a memory beside a tree; some nodes (all, if ``deaf``) are not heeded, some never kept."""
    rng, n, a = np.random.default_rng((seed, 9)), tree.num_states, tree.num_actions
    heed, note = rng.dirichlet(np.ones(2), (2, n))
    heed[(rng.random(n) < zeros) | deaf] = 1, 0
    note[rng.random(n) < zeros] = 1, 0
    lead, alone = rng.dirichlet(np.ones(n), (2, a, n))
    dtype = tree.log_vertical.dtype
    return CoupledTreeSpec(tree, *(safe_log(x).astype(dtype) for x in (lead, heed, note, alone)))


@st.composite
def coupled_trees(draw: st.DrawFn, most: int = 7) -> CoupledTreeSpec:
    """Draw a coupled tree of any shape."""
    return over(
        draw(trees(most=most)), draw(st.integers(0, 100_000)), zeros=draw(st.sampled_from([0.0, 0.5]))
    )
