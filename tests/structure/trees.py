"""Small random trees for the tests, and the example of the thesis."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_init import random_tree


@st.composite
def trees(draw: st.DrawFn, most: int = 9, actions: int = 2) -> TreeSpec:
    """Draw a tree of any shape, vertical transitions by action or not, some entries zero."""
    seed = draw(st.integers(0, 100_000))
    return make_tree(
        seed, draw(st.integers(1, most)), draw(st.integers(1, 4)), draw(st.booleans()), actions=actions
    )


def make_tree(
    seed: int, states: int, levels: int, by_action: bool = False, *, actions: int = 2, symbols: int = 3
) -> TreeSpec:
    return random_tree(seed, states, actions, symbols, levels=levels, vertical_by_action=by_action)


def thesis_tree(dtype: type = np.float64) -> TreeSpec:
    """Figure 5.1 as far as its text gives numbers: T(s1, end) = .7, T(i1, i2) = .3, pi(i2, s3) = .4.

    The rest is made up, with a fifth leaf below the root for i1 to lead to.
    """
    vertical, horizontal = np.zeros((1, 3, 8)), np.zeros((1, 8, 9))
    s1, s2, s3, s4, s5, _, i1, i2, end = range(9)
    vertical[0, 0, [i1, i2, s5]] = 0.5, 0.4, 0.1
    vertical[0, 1, [s1, s2]] = 0.8, 0.2
    vertical[0, 2, [s3, s4]] = 0.4, 0.6
    horizontal[0, s1, [s2, end]] = 0.3, 0.7
    horizontal[0, s2, [s1, s2, end]] = 0.5, 0.4, 0.1
    horizontal[0, s3, [s4, end]] = 0.9, 0.1
    horizontal[0, s4, [s3, end]] = 0.2, 0.8
    horizontal[0, s5, [s5, i1]] = 0.5, 0.5
    horizontal[0, i1, [i2, s5]] = 0.3, 0.7
    horizontal[0, i2, i1] = 1.0
    tables = vertical.astype(dtype), horizontal.astype(dtype)
    return TreeSpec.from_probabilities([[0, 1], [2, 3], 4], *tables, [np.eye(5).astype(dtype)])
