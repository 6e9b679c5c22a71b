"""Inference by spans (Fine, Singer and Tishby 1998), which never flattens, is that of the flat chain."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.hierarchy import cubic, spans
from benchmarks.hierarchy.cubic import flat_counts, flat_evidence
from benchmarks.hierarchy.spans import Counts, reestimated, span_counts, span_evidence
from jaxpomdp.models.data import trial_batch
from jaxpomdp.models.em import EMConfig, em_step
from jaxpomdp.models.family import Prior
from jaxpomdp.models.hierarchical import HIERARCHICAL
from jaxpomdp.packing import TreeCapacity, pack, unpack
from jaxpomdp.structure.tree import TreeSpec
from jaxpomdp.structure.tree_forms import flatten_tree, maximal
from tests.models.problems import stack
from tests.structure.trees import make_tree, trees


def trial(seed: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.integers(3, size=steps), rng.integers(2, size=steps - 1)


def error_of(got: Counts, wanted: Counts) -> float:
    return max(float(np.abs(x - y).max()) for x, y in zip(got, wanted, strict=True))


@given(trees(most=7), st.integers(1, 6), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_the_flat_chain_gives_the_evidence_of_all_spans(spec: TreeSpec, steps: int, seed: int) -> None:
    data = trial(seed, steps)
    assert flat_evidence(spec, *data) == pytest.approx(span_evidence(spec, *data), rel=1e-10)


@given(trees(most=7), st.integers(1, 7), st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_the_flat_chain_gives_the_counts_of_all_spans(spec: TreeSpec, steps: int, seed: int) -> None:
    data = trial(seed, steps)
    assert error_of(flat_counts(spec, *data), span_counts(spec, *data)) < 1e-10


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("by_action", [False, True])
def test_an_iteration_of_em_is_theirs(by_action: bool) -> None:
    """Several trials of different lengths; the library on the device beside spans on the host."""
    spec, data = make_tree(2, 7, 3, by_action), [trial(seed, 4 + seed) for seed in range(4)]
    theirs = reestimated(spec, [span_counts(spec, *each) for each in data])
    batch = trial_batch([x for x, _ in data], [a for _, a in data])
    none = Prior(transition=0.0, initial=0.0, observation=0.0)
    room = TreeCapacity(spec.num_states, spec.num_internal, int(spec.depth.max()))
    ours, _ = em_step(HIERARCHICAL, pack([spec], room), stack(batch), EMConfig(prior=none))
    ours = unpack(ours, 0)
    rows = slice(1, None) if by_action else slice(None)
    np.testing.assert_allclose(
        np.exp(ours.log_vertical)[:, rows], np.exp(theirs.log_vertical)[:, rows], atol=1e-9
    )
    np.testing.assert_allclose(np.exp(ours.log_horizontal), np.exp(theirs.log_horizontal), atol=1e-9)
    tables = (np.exp(tree.emissions[0].values["log_prob"]) for tree in (ours, theirs))
    np.testing.assert_allclose(*tables, atol=1e-9)
    assert np.abs(np.exp(ours.log_horizontal) - np.exp(spec.log_horizontal)).max() > 0.05


def test_spans_notice_another_tree() -> None:
    spec, data = make_tree(0, 7, 3), trial(0, 6)
    other = make_tree(1, 7, 3)
    assert flat_evidence(other, *data) != pytest.approx(span_evidence(spec, *data), rel=1e-3)


def test_spans_notice_crediting_that_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ends left out, or activations credited a step late, which is another action's."""
    spec, data = make_tree(2, 7, 3, True), trial(0, 7)
    right, credit = flat_counts(spec, *data), spans._credit
    assert error_of(span_counts(spec, *data), right) < 1e-10

    def without_ends(counts, used, *rest):
        credit(counts, used._replace(ends=0 * used.ends), *rest)

    def late(counts, used, *rest):
        credit(counts, used._replace(down=np.roll(used.down, 1, 0)), *rest)

    for broken in (without_ends, late):
        monkeypatch.setattr(spans, "_credit", broken)
        assert error_of(span_counts(spec, *data), right) > 0.01


def test_spans_notice_a_chain_that_is_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flat chain of the maximal form taken for the minimal one."""
    spec, data = make_tree(2, 7, 3), trial(0, 7)
    monkeypatch.setattr(cubic, "flatten_tree", lambda tree: flatten_tree(unlooped(maximal(tree))))
    assert abs(flat_evidence(spec, *data) - span_evidence(spec, *data)) > 1e-3
    assert error_of(flat_counts(spec, *data), span_counts(spec, *data)) > 1e-3


def unlooped(spec: TreeSpec) -> TreeSpec:
    """The loops of internal states simply deleted, as the shortest way alone would have it."""
    table = spec.log_horizontal.copy()
    inner = np.arange(spec.root, spec.num_nodes)
    table[:, inner, inner] = -1e30
    return replace(spec, log_horizontal=table)
