"""Small problems that the tests of models share."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Posterior, TrialBatch
from jaxpomdp.kernels.smoothing import smooth_scaled
from jaxpomdp.models.data import trial_batch
from jaxpomdp.models.emission import Categorical, DiagonalGaussian, ReturnModel
from jaxpomdp.models.flat import FLAT, FlatParams
from jaxpomdp.models.full_gaussian import FullGaussian
from jaxpomdp.models.init import with_capacity

STATES, ACTIONS, SYMBOLS = 3, 2, 4


def _forward_backward(init, trans, log_obs, actions, start, valid) -> Posterior:
    """One tape, in NumPy, one step after the other."""
    steps, states = log_obs.shape
    weight = np.exp(log_obs - log_obs.max(axis=1, keepdims=True))
    alpha, beta, norm = np.zeros((steps, states)), np.ones((steps, states)), np.ones(steps)
    xi, evidence = np.zeros_like(trans), 0.0
    for t in np.flatnonzero(valid):
        predicted = init if start[t] else alpha[t - 1] @ trans[actions[t - 1]]
        norm[t] = predicted @ weight[t]
        alpha[t] = predicted * weight[t] / norm[t]
        evidence += np.log(norm[t]) + log_obs[t].max()
    for t in reversed(range(steps - 1)):
        if valid[t + 1] and not start[t + 1]:
            ahead = weight[t + 1] * beta[t + 1] / norm[t + 1]
            beta[t] = trans[actions[t]] @ ahead
            xi[actions[t]] += alpha[t][:, None] * trans[actions[t]] * ahead[None, :]
    gamma = alpha * beta
    return Posterior(evidence, gamma, xi, (gamma * start[:, None]).sum(axis=0))


def _all_tapes(*arguments) -> Posterior:
    init, trans, log_obs, *tapes = (np.asarray(x) for x in arguments)
    each = [
        [_forward_backward(i, t, *tape) for tape in zip(*rows, strict=True)]
        for i, t, *rows in zip(init, trans, log_obs, *tapes, strict=True)
    ]
    made = Posterior(
        np.array([[tape.log_evidence for tape in rows] for rows in each]),
        np.array([[tape.gamma for tape in rows] for rows in each]),
        np.array([sum(tape.xi for tape in rows) for rows in each]),
        np.array([sum(tape.initial for tape in rows) for rows in each]),
    )
    return Posterior(*(x.astype(init.dtype) for x in made))


def light_posterior(chains, log_obs, actions, start, valid, *, plan="auto") -> Posterior:
    """The posterior by a call back to NumPy: independent of the kernels, and quick to compile."""
    init, trans = jnp.exp(chains.log_init), jnp.exp(chains.log_trans)
    shapes = (log_obs.shape[:2], log_obs.shape, trans.shape, init.shape)
    results = Posterior(*(jax.ShapeDtypeStruct(shape, init.dtype) for shape in shapes))
    return jax.pure_callback(_all_tapes, results, init, trans, log_obs, actions, start, valid)


def scaled_posterior(chains, log_obs, actions, start, valid, *, plan="auto") -> Posterior:
    """The kernels' scaled route without its rescue: for float64, which callbacks lose."""
    over_tapes = jax.vmap(lambda *tape: smooth_scaled(*tape)[0], in_axes=(None, 0, 0, 0, 0))
    each = jax.vmap(over_tapes)(chains, log_obs, actions, start, valid)
    return each._replace(xi=jnp.sum(each.xi, axis=1), initial=jnp.sum(each.initial, axis=1))


LIGHT = FLAT._replace(posterior=light_posterior)
SCALED = FLAT._replace(posterior=scaled_posterior)


def trials(seed: int = 0, lengths: tuple[int, ...] = (6, 3, 5)) -> dict[str, Any]:
    """Ragged trials of symbols, with a missing step, and rewards that depend on the symbol."""
    rng = np.random.default_rng(seed)
    symbols = [[int(o) for o in rng.integers(SYMBOLS, size=n)] for n in lengths]
    symbols[0][2] = None
    return {
        "observations": symbols,
        "actions": [rng.integers(ACTIONS, size=n - 1) for n in lengths],
        "rewards": [rng.normal(size=n - 1) for n in lengths],
    }


def batch(seed: int = 0, **options: Any) -> TrialBatch:
    return trial_batch(**trials(seed), **options)


def model(seed: int = 0, capacity: int = STATES) -> FlatParams:
    """One random model of symbols (NumPy's draws: JAX's would compile)."""
    rng = np.random.default_rng(seed)
    params = FlatParams(
        jnp.asarray(np.log(rng.dirichlet(np.ones(STATES)))),
        jnp.asarray(np.log(rng.dirichlet(np.ones(STATES), (ACTIONS, STATES)))),
        (Categorical(jnp.asarray(np.log(rng.dirichlet(np.ones(SYMBOLS), STATES)))),),
        ReturnModel(jnp.asarray(rng.normal(size=(STATES, 1))), jnp.ones((STATES, 1))),
        jnp.ones(STATES, bool),
    )
    return with_capacity(params, capacity)


def models(count: int, capacity: int = STATES) -> FlatParams:
    made = [model(seed, capacity) for seed in range(count)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *made)


def rich_trials(seed: int = 0, lengths: tuple[int, ...] = (5, 3, 4)) -> list[dict]:
    """Trials for the brute-force oracle: symbols, vectors and returns, some missing."""
    rng = np.random.default_rng(seed)
    made = []
    for n in lengths:
        made.append(
            {
                "symbols": [int(o) for o in rng.integers(SYMBOLS, size=n)],
                "vectors": list(rng.normal(size=(n, 2))),
                "actions": [int(a) for a in rng.integers(ACTIONS, size=n)],
                "returns": [float(r) for r in rng.normal(size=n)],
            }
        )
    made[0]["symbols"][1] = made[0]["vectors"][1] = None
    made[1]["returns"][0] = None
    return made


def rich_model(seed: int = 0, columns: int = ACTIONS, full: bool = True) -> dict:
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(STATES, 2, 2))
    made = {
        "init": rng.dirichlet(np.ones(STATES)),
        "trans": rng.dirichlet(np.ones(STATES), (ACTIONS, STATES)),
        "symbols": rng.dirichlet(np.ones(SYMBOLS), STATES),
        "mean": rng.normal(size=(STATES, 2)),
        "cov": half @ np.swapaxes(half, 1, 2) + 0.3 * np.eye(2),
        "return_mean": rng.normal(size=(STATES, columns)),
        "return_var": rng.uniform(0.5, 2, size=(STATES, columns)),
    }
    if not full:
        made["cov"] = made["cov"] * np.eye(2)
    made["trans"][0, 1] = [0.0, 0.4, 0.6]
    return made


def to_params(made: dict, *, full: bool = True) -> FlatParams:
    """The library's parameters of an oracle's model (one model, the array's own precision)."""
    from jaxpomdp.numerics import safe_log

    a = {name: jnp.asarray(value) for name, value in made.items()}
    diagonal = DiagonalGaussian(a["mean"], jnp.diagonal(a["cov"], axis1=1, axis2=2))
    vector = FullGaussian(a["mean"], a["cov"]) if full else diagonal
    return FlatParams(
        safe_log(a["init"]),
        safe_log(a["trans"]),
        (Categorical(safe_log(a["symbols"])), vector),
        ReturnModel(a["return_mean"], a["return_var"]),
        jnp.ones(len(made["init"]), bool),
    )


def to_batch(made: list[dict], **options: Any) -> TrialBatch:
    """The library's batch of an oracle's trials; returns are put in by hand."""
    symbols = [trial["symbols"] for trial in made]
    vectors = [trial["vectors"] for trial in made]
    actions = [trial["actions"][:-1] for trial in made]
    tapes = trial_batch((symbols, vectors), actions, **options)
    width = tapes.valid.shape[1]
    returns = [trial["returns"] for trial in made]
    there = np.array([[r is not None for r in row] + [False] * (width - len(row)) for row in returns])
    values = np.array([[r or 0.0 for r in row] + [0.0] * (width - len(row)) for row in returns])
    last = np.array([trial["actions"] + [0] * (width - len(trial["actions"])) for trial in made])
    return TrialBatch(
        tapes.observations,
        jnp.asarray(last),
        tapes.rewards,
        jnp.asarray(values),
        tapes.valid,
        tapes.start,
        tapes.terminated,
        tapes.observed,
        jnp.asarray(there),
    )


def stack(tree: Any, count: int = 1) -> Any:
    """Give every leaf a leading axis ``S``."""
    return jax.tree.map(lambda x: jnp.broadcast_to(x[None], (count, *x.shape)), tree)


def permuted(params: FlatParams, order: Any) -> FlatParams:
    order = jnp.asarray(order)
    take = partial(jnp.take, indices=order, axis=0)
    return FlatParams(
        take(params.log_init),
        params.log_trans[:, order][:, :, order],
        jax.tree.map(take, params.emissions),
        jax.tree.map(take, params.returns),
        take(params.alive),
    )


def assert_trees_close(x: Any, y: Any, *, rtol: float = 0.0, atol: float = 1e-5) -> None:
    assert jax.tree.structure(x) == jax.tree.structure(y)
    for path, leaf in jax.tree_util.tree_leaves_with_path(x):
        other = dict(jax.tree_util.tree_leaves_with_path(y))[path]
        name = jax.tree_util.keystr(path)
        np.testing.assert_allclose(np.asarray(leaf), np.asarray(other), rtol=rtol, atol=atol, err_msg=name)
