"""Small random models and slow, obvious references for the tests of structure."""

from __future__ import annotations

import numpy as np

from jaxpomdp.structure.coupled_spec import CoupledSpec, StrandSpec
from jaxpomdp.structure.evidence import ReturnEvidence, even_edges, return_evidence
from jaxpomdp.structure.spec import Channel, FlatSpec, safe_log


def random_spec(
    seed: int, n: int, a: int = 2, per_action: bool = False, dtype: type = np.float64
) -> FlatSpec:
    """Draw a model with a table, a Gaussian channel and some impossible transitions."""
    rng = np.random.default_rng(seed)
    gaussian = {"mean": rng.normal(size=(n, 2)).astype(dtype), "var": rng.gamma(2, size=(n, 2)).astype(dtype)}
    columns = (n, a if per_action else 1)
    trans = rng.dirichlet(np.ones(n), (a, n))
    trans = np.where(trans < 0.1 / n, 0, trans)
    trans /= trans.sum(-1, keepdims=True)
    return FlatSpec.from_probabilities(
        rng.dirichlet(np.ones(n)).astype(dtype),
        trans.astype(dtype),
        [rng.dirichlet(np.ones(3), n).astype(dtype), Channel("DiagonalGaussian", gaussian)],
        rng.normal(size=columns).astype(dtype),
        rng.gamma(2, size=columns).astype(dtype),
    )


def random_coupled(
    seed: int, sizes: tuple[int, int], mixture: bool, a: int = 2, columns: int = 1, dtype: type = np.float64
) -> CoupledSpec:
    """Draw a coupled model: strand 0 sees one of 3 symbols, strand 1 emits a return."""
    rng = np.random.default_rng(seed)

    def rows(*shape: int) -> np.ndarray:
        return safe_log(rng.dirichlet(np.ones(shape[-1]), shape[:-1])).astype(dtype)

    n, m = sizes
    seen = StrandSpec(rows(n), (Channel("Categorical", {"log_prob": rows(n, 3)}),))
    mean, var = rng.normal(size=(m, columns)), rng.gamma(2, size=(m, columns))
    paid = StrandSpec(rows(m), (), mean.astype(dtype), var.astype(dtype))
    pairs = ((rows(a, n, n), rows(a, m, n)), (rows(a, n, m), rows(a, m, m)))
    return CoupledSpec((seen, paid), pairs, rows(2, 2) if mixture else None, rows(a, n, n))


def log_evidence(spec: FlatSpec, observations: np.ndarray, actions: np.ndarray) -> float:
    """Return the log-probability of discrete observations by the textbook forward pass."""
    table = np.exp(spec.emissions[0].values["log_prob"])
    alpha = np.exp(spec.log_init) * table[:, observations[0]]
    for action, observation in zip(actions, observations[1:], strict=False):
        alpha = (alpha @ np.exp(spec.log_trans[action])) * table[:, observation]
    return float(np.log(alpha.sum()))


def evidence_of(samples: list[np.ndarray], bins: int = 64) -> ReturnEvidence:
    """Gather evidence of one sample of returns per state, each in one state for sure."""
    returns = np.concatenate(samples)
    owner = np.repeat(np.arange(len(samples)), [len(sample) for sample in samples])
    edges = even_edges(returns.min(), returns.max(), bins)
    return return_evidence(returns, np.eye(len(samples))[owner], edges)
