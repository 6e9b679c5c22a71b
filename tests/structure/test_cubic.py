"""Evidence by spans (Fine, Singer and Tishby 1998), which never flattens, is that of the flat model."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.hierarchy.cubic import flat_evidence, span_evidence
from jaxpomdp.structure.tree import TreeSpec
from tests.structure.trees import make_tree, trees


@given(trees(most=7), st.integers(1, 6), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_the_flat_chain_gives_the_evidence_of_all_spans(spec: TreeSpec, steps: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = rng.integers(3, size=steps), rng.integers(2, size=steps - 1)
    assert flat_evidence(spec, *data) == pytest.approx(span_evidence(spec, *data), rel=1e-10)


def test_spans_notice_another_tree() -> None:
    spec, rng = make_tree(0, 7, 3), np.random.default_rng(0)
    data = rng.integers(3, size=6), rng.integers(2, size=5)
    assert flat_evidence(make_tree(1, 7, 3), *data) != pytest.approx(span_evidence(spec, *data), rel=1e-3)
