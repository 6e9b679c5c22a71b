"""Evidence gathered on the device against its definition on enumerated pairs."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jaxpomdp.agents.tree_evidence import evidence_of_model, gather_tree_evidence
from jaxpomdp.models.em import EMConfig
from jaxpomdp.models.hierarchical import HIERARCHICAL
from jaxpomdp.structure.tree_evidence import TreeEvidence, tree_evidence
from tests.models.problems import ACTIONS, SYMBOLS, batch, stack
from tests.models.trees import SCALED_TREE, tree
from tests.oracles.hmm import log_of, path_weights, trials_of

THETA, BINS = 0.5, 4


def pairs_of(chain, log_obs, actions, start, valid) -> np.ndarray:
    """Enumerate every path of every trial of a tape: ``[T, N, N]``."""
    steps, states = log_obs.shape
    pairs = np.zeros((steps, states, states))
    init, trans, rows = (log_of(x) for x in (chain.log_init, chain.log_trans, log_obs))
    for trial in trials_of(start, valid):
        paths, weight = path_weights(init, trans, rows[trial], actions[trial])
        share = np.exp(weight - weight.max())
        share /= share.sum()
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
    found = gather_tree_evidence(family, models, data, data.observations[0], config, SYMBOLS, BINS)
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
    wrong = by_definition(tree(1, states=4), tapes, got.edges)
    assert np.abs(got.symbols - wrong.symbols).max() > 0.01
