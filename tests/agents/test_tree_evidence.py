"""Evidence gathered on the device against its definition on enumerated pairs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxpomdp.agents import tree_evidence as evidence
from jaxpomdp.agents.tree_evidence import evidence_of_model, gather_tree_evidence
from jaxpomdp.models.em import EMConfig
from jaxpomdp.models.hierarchical import HIERARCHICAL
from jaxpomdp.structure.tree_evidence import TreeEvidence, tree_evidence
from tests.models.problems import ACTIONS, SYMBOLS, batch, stack
from tests.models.trees import SCALED_TREE, tree
from tests.oracles.hmm import log_of, path_weights, trials_of

THETA, BINS = 0.5, 4


def pairs_of(chain, log_obs, actions, start, valid) -> np.ndarray:
    """Enumerate every path of every trial of a tape: ``[T, N+1, N]``, the last row for starts."""
    steps, states = log_obs.shape
    pairs = np.zeros((steps, states + 1, states))
    init, trans, rows = (log_of(x) for x in (chain.log_init, chain.log_trans, log_obs))
    for trial in trials_of(start, valid):
        paths, weight = path_weights(init, trans, rows[trial], actions[trial])
        share = np.exp(weight - weight.max())
        share /= share.sum()
        np.add.at(pairs[trial[0], states], paths[:, 0], share)
        for k in range(1, len(trial)):
            np.add.at(pairs[trial[k]], (paths[:, k - 1], paths[:, k]), share)
    return pairs


def by_definition(params, tapes, edges: np.ndarray) -> TreeEvidence:
    chain, log_obs = HIERARCHICAL.learning(params, tapes, THETA)
    parts = []
    for b in range(tapes.valid.shape[0]):
        tape = jax.tree.map(lambda x, b=b: np.asarray(x[b]), tapes)
        pairs = pairs_of(chain, np.asarray(log_obs[b]), tape.actions, tape.start, tape.valid)
        seen = np.where(tape.observed & tape.valid, tape.observations[0], -1)
        counted = tape.has_return & tape.valid
        sizes = {"num_actions": ACTIONS, "num_symbols": SYMBOLS, "has_return": counted}
        parts.append(tree_evidence(pairs, tape.actions, seen, tape.returns, edges, **sizes))
    sums = [sum(np.asarray(x) for x in field) for field in zip(*parts, strict=True)]
    return TreeEvidence(*sums[:-1], edges)


def gathered(family, params, tapes) -> TreeEvidence:
    config = EMConfig(theta=THETA)
    models, data = stack(params), stack(tapes)
    found = evidence.gather_tree_evidence(family, models, data, data.observations[0], config, SYMBOLS, BINS)
    return evidence_of_model(found, 0, params.alive.shape[0])


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize("pack", [False, True])
def test_the_device_gathers_what_the_definition_says(pack: bool) -> None:
    """Trials of several lengths, with a missing step, alone on a row or several on one."""
    params, tapes = tree(states=4), batch(pack=pack)
    got = gathered(SCALED_TREE, params, tapes)
    wanted = by_definition(params, tapes, got.edges)
    for name, x, y in zip(TreeEvidence._fields, got, wanted, strict=True):
        np.testing.assert_allclose(x, y, atol=1e-9, err_msg=name)
    got.check(4, ACTIONS)


def error_of(got: TreeEvidence, wanted: TreeEvidence) -> float:
    return max(float(np.abs(x - y).max()) for x, y in zip(got, wanted, strict=True))


def own_step(belief, first, valid):
    """The belief of the step itself in place of that of the step before."""
    return whole_before(jnp.roll(belief, -1, axis=1), first, valid)


def no_starts(belief, first, valid):
    return whole_before(belief, first, valid).at[..., -1].set(0)


def blurred(chains, log_obs, batch):
    """An even belief in place of the filtered one."""
    return jnp.full_like(log_obs, 1 / log_obs.shape[-1])


def forgetful(group, groups):
    """The first step of every block is left out."""
    slots, numbers = whole_blocks(group, groups)
    return slots.at[:, 0].set(len(group)), numbers


whole_before, whole_blocks = evidence._before, evidence._blocks
BROKEN = [
    ("_before", own_step),
    ("_before", no_starts),
    ("filter_chains", blurred),
    ("_blocks", forgetful),
]


@pytest.mark.usefixtures("x64")
@pytest.mark.parametrize(("name", "broken"), BROKEN, ids=[f.__name__ for _, f in BROKEN])
def test_the_definition_notices_a_broken_kernel(name, broken, monkeypatch: pytest.MonkeyPatch) -> None:
    params, tapes = tree(states=4), batch(pack=True)
    wanted = by_definition(params, tapes, gathered(SCALED_TREE, params, tapes).edges)
    monkeypatch.setattr(evidence, "gather_tree_evidence", gather_tree_evidence.__wrapped__)
    monkeypatch.setattr(evidence, name, broken)
    assert error_of(gathered(SCALED_TREE, params, tapes), wanted) > 0.01
    monkeypatch.undo()
    assert error_of(gathered(SCALED_TREE, params, tapes), wanted) < 1e-9


@pytest.mark.usefixtures("x64")
def test_the_definition_notices_another_model_and_transposed_pairs() -> None:
    params, tapes = tree(states=4), batch()
    got = gathered(SCALED_TREE, params, tapes)
    assert error_of(got, by_definition(tree(1, states=4), tapes, got.edges)) > 0.01
    turned = got._replace(transitions=got.transitions.swapaxes(1, 2))
    assert error_of(turned, by_definition(params, tapes, got.edges)) > 0.01
