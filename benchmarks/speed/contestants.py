"""Who is timed: every plan of ours, and what a user would pick instead, on equal work.

The work is one E-step: the log-evidence of every trial, smoothed state probabilities, and expected
transitions per action. Where a peer cannot do that it gets the nearest equal work, and ``MISSING`` says so.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from timing import on_cpu
from workloads import Data, Load, log_likelihood

from jaxpomdp import Chain
from jaxpomdp.kernels.posterior import posterior

Call = Callable[[], object]

MISSING = {
    "dynamax, actions": "no batch of models, no masks: mapped over; T[a_t] by transition_fn; counts per step",
    "dynamax, no actions": "one matrix for all steps: less work than ours",
    "hmmlearn": "no actions, no batch of models: one model with as many sequences; less work than ours",
    "pomegranate": "no actions, no batch of models: one model with as many sequences; less work than ours",
    "NumPy loop": "the textbook's loop over time with all trials of a model at once; equal work",
    "ours, XLA only": "plan `grouped`",
    "ours, mapped": "plan `scan`",
    "ours, blocked": "plan `blocked`",
}
"""What each peer lacks, and what it is given instead; which plan of ours it is."""

LONG = 10_000
"""From so many steps on, tapes are cut into blocks on a CPU too, for comparison; it has nothing to gain."""

GIBIBYTES = 6
"""A contestant that would need more than this for one array is left out."""


def ours(plan: str) -> Callable[[Load, Data], Call]:
    """Return our E-step under one evaluation plan."""

    def make(load: Load, data: Data) -> Call:
        chains = Chain(jnp.log(data.init), jnp.log(data.trans))
        log_obs = jax.vmap(log_likelihood)(jnp.asarray(data.emit), jnp.asarray(data.seen))
        start = jnp.zeros(data.seen.shape, bool).at[..., 0].set(True)
        arguments = (chains, log_obs, jnp.asarray(data.actions), start, jnp.ones_like(start))
        return lambda: jax.block_until_ready(posterior(*arguments, plan=plan))

    return make


def _refuse_pairs_of_every_step(load: Load) -> None:
    """Raise where a probability for each step and pair of states, of one model's trials, would not fit."""
    if 4.0 * load.trials * load.steps * load.states**2 > GIBIBYTES * 2**30:
        raise MemoryError("its transition probabilities of every step would not fit")


def dynamax_with_actions(load: Load, data: Data) -> Call:
    """Return dynamax's smoother, given ``T[a_t]`` for every step, and counts summed per action."""
    _refuse_pairs_of_every_step(load)
    smoother = import_module("dynamax.hidden_markov_model.inference").hmm_smoother

    def trial(init: Any, trans: Any, log_obs: Any, actions: Any) -> Any:
        found = smoother(init, None, log_obs, transition_fn=lambda t: trans[actions[t]])
        count = jax.ops.segment_sum(found.trans_probs, actions[:-1], load.actions)
        return found.marginal_loglik, found.smoothed_probs, count

    def model(row: Any) -> Any:
        init, trans, emit, seen, actions = row
        log_obs = log_likelihood(emit, seen)
        evidence, gamma, count = jax.vmap(trial, (None, None, 0, 0))(init, trans, log_obs, actions)
        return evidence, gamma, count.sum(0)

    each = jax.jit(lambda rows: jax.lax.map(model, rows))
    rows = jax.device_put(tuple(data))
    return lambda: jax.block_until_ready(each(rows))


def dynamax_without_actions(load: Load, data: Data) -> Call:
    """Return dynamax's smoother with one transition matrix."""
    smoother = import_module("dynamax.hidden_markov_model.inference").hmm_smoother

    def model(row: Any) -> Any:
        init, trans, emit, seen = row
        found = jax.vmap(lambda log_obs: smoother(init, trans, log_obs))(log_likelihood(emit, seen))
        return found.marginal_loglik, found.smoothed_probs, found.trans_probs.sum(0)

    each = jax.jit(jax.vmap(lambda *row: model(row)))
    rows = jax.device_put((data.init, data.trans[:, 0], data.emit, data.seen))
    return lambda: jax.block_until_ready(each(*rows))


def hmmlearn(load: Load, data: Data) -> Call:
    """Return one iteration of hmmlearn's ``fit``, its E-step and a cheap M-step, on as many sequences."""
    kind = import_module("hmmlearn.hmm").CategoricalHMM
    model = kind(
        load.states, n_iter=1, implementation="scaling", n_features=load.symbols, init_params="", params=""
    )
    model.startprob_, model.transmat_, model.emissionprob_ = (
        np.float64(x) / np.float64(x).sum(-1, keepdims=True)
        for x in (data.init[0], data.trans[0, 0], data.emit[0])
    )
    model.params = "ste"
    sequences, lengths = data.seen.reshape(-1, 1), [load.steps] * (load.models * load.trials)
    return lambda: model.fit(sequences, lengths)


def pomegranate(load: Load, data: Data) -> Call:
    """Return pomegranate's ``forward_backward`` on as many sequences, model by model."""
    _refuse_pairs_of_every_step(load)
    torch = import_module("torch")
    dense = import_module("pomegranate.hmm").DenseHMM
    categorical = import_module("pomegranate.distributions").Categorical
    torch.set_num_threads(torch.get_num_threads())
    model = dense(
        [categorical(torch.tensor(row[None])) for row in data.emit[0]],
        edges=torch.tensor(data.trans[0, 0]),
        starts=torch.tensor(data.init[0]),
        ends=torch.full((load.states,), 1e-6),
    )
    batches = [torch.tensor(seen[..., None]) for seen in data.seen]
    return lambda: [model.forward_backward(batch) for batch in batches]


def numpy_loop(load: Load, data: Data) -> Call:
    """Return a scaled forward-backward loop over time, all trials of a model at once."""

    def call() -> list[Any]:
        return [_by_numpy(*row) for row in zip(*data, strict=True)]

    return call


def _by_numpy(
    init: np.ndarray, trans: np.ndarray, emit: np.ndarray, seen: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    likelihood = emit.T[seen]
    trials, steps, states = likelihood.shape
    alpha, scale = np.empty_like(likelihood), np.empty((trials, steps), np.float32)
    predicted = np.broadcast_to(init, (trials, states))
    for t in range(steps):
        joint = predicted * likelihood[:, t]
        scale[:, t] = joint.sum(-1)
        alpha[:, t] = joint / scale[:, t, None]
        predicted = np.matmul(alpha[:, t, None], trans[actions[:, t]])[:, 0]
    beta, gamma, count = np.ones((trials, states), np.float32), np.empty_like(alpha), np.zeros_like(trans)
    for t in range(steps - 1, -1, -1):
        gamma[:, t] = alpha[:, t] * beta
        back = likelihood[:, t] * beta / scale[:, t, None]
        if t:
            for a in range(len(trans)):
                chosen = actions[:, t - 1] == a
                count[a] += alpha[chosen, t - 1].T @ back[chosen] * trans[a]
            beta = np.matmul(trans[actions[:, t - 1]], back[..., None])[..., 0]
    return np.log(scale).sum(-1), gamma, count


CONTESTANTS: dict[str, Callable[[Load, Data], Call]] = {
    "ours": ours("auto"),
    "ours, XLA only": ours("grouped"),
    "ours, mapped": ours("scan"),
    "ours, blocked": ours("blocked"),
    "dynamax, actions": dynamax_with_actions,
    "dynamax, no actions": dynamax_without_actions,
    "hmmlearn": hmmlearn,
    "pomegranate": pomegranate,
    "NumPy loop": numpy_loop,
}

ON_THE_CPU = ("hmmlearn", "pomegranate", "NumPy loop")


def entrants(load: Load) -> list[str]:
    """Return who is timed on this device: peers that use it, and plans of ours that are meant for it."""
    if not on_cpu():
        return [name for name in CONTESTANTS if name not in ON_THE_CPU]
    spared = {"ours, mapped"} | ({"ours, blocked"} if load.steps < LONG else set())
    return [name for name in CONTESTANTS if name not in spared]
