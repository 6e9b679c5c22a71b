"""The offline phase: what is learned between trials, from trials alone; it never sees the environment.

Baum-Welch on the last trials with their returns, evidence for splits, splits, Baum-Welch again, and values
learned once more from the stored trials through the new model (thesis section 3.3).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import Array, Chain, TrialBatch
from jaxpomdp.agents.best import select
from jaxpomdp.agents.control import ControlConfig
from jaxpomdp.kernels import native
from jaxpomdp.kernels.control import ReplayData, replay_tape
from jaxpomdp.kernels.filtering import filter_tape
from jaxpomdp.kernels.returns import discounted_returns, return_histogram
from jaxpomdp.models.em import EMConfig, e_step, em_step
from jaxpomdp.models.family import Family, Prior
from jaxpomdp.structure.evidence import ReturnEvidence
from jaxpomdp.structure.policy import PolicyConfig
from jaxpomdp.structure.splits import SplitConfig


@dataclass(frozen=True)
class LearnerConfig:
    """How the model is learned, and how it grows. What the thesis leaves open is a field here.

    Raises:
        ValueError: a number is out of its range, or a name is unknown.
    """

    states: int = 25
    """States to start with."""
    initial: str = "observation"
    """``observation``: each state starts out peaked on one observation; ``random``: all at random."""
    theta: float = 0.2
    """Weight of the return in the likelihood (thesis 3.3); 0 is the Perceptual Distinctions Approach."""
    return_gamma: float = 0.95
    """Discount of the returns that are modelled."""
    return_by_action: bool = False
    """Model the return of every state and action, not of every state."""
    bootstrap: bool = True
    """After a trial was cut off its return goes on from the agent's own value (else it stops: the thesis)."""
    window: int = 200
    """Baum-Welch, tests and replay see this many last trials."""
    trials_per_phase: int = 50
    """Trials between offline phases."""
    rehearsals: int = 0
    """So many of them, the last, are as at the end: greedy, and nothing is learned on the way (but replay
    learns from them). They find out a policy that goes round in circles unless exploration frees it."""
    em_iterations: int = 3
    """Baum-Welch iterations in a phase, before any split."""
    split_iterations: int = 1
    """Further iterations after a phase in which any seed split."""
    replay_passes: int = 1
    """Passes of SARSA(lambda) over the stored trials after the model changed."""
    replay_lam: float | None = None
    """Lambda of the replay; None: that of control."""
    gate: float = 0.0
    """No model learning while the latest start returns have std / |mean| below this (0: never held back)."""
    gate_trials: int = 20
    """How many of the latest trials the gate looks at."""
    keep_best: int = 200
    """Return at the end to the policy that was best on average over so many trials (0: keep the last)."""
    revert_margin: float = 1.0
    """... if that average was better than the last one by more than so many standard errors."""
    probation: int = 0
    """... or always, and a policy counts as the best only when so many trials were made after it: against
    luck where trials succeed or fail (0: it counts at once; at most ``keep_best``)."""
    patience: int = 0
    """After so many trials without a better average, those held back by the gate not counted, go back to the
    best policy, or, where it is no better than the one of now, begin again with a new model (0: never)."""
    bins: int = 64
    """Bins of the return histograms."""
    prior: Prior = field(default_factory=Prior)
    """Pseudo-counts and variance floors."""
    split: SplitConfig = field(default_factory=SplitConfig)
    """When and how a state is split."""
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """How many splits, when, and up to how many states."""

    def __post_init__(self) -> None:
        """Refuse numbers and names that mean nothing."""
        least = {
            "states": 1,
            "window": 1,
            "trials_per_phase": 1,
            "em_iterations": 0,
            "replay_passes": 0,
            "bins": 4,
            "keep_best": 0,
            "probation": 0,
        }
        for name, bound in least.items():
            if getattr(self, name) < bound:
                raise ValueError(f"{name} must be at least {bound}, got {getattr(self, name)}")
        if not 0 <= self.rehearsals < self.trials_per_phase:
            raise ValueError(
                f"rehearsals must be from 0 to trials_per_phase - 1 = {self.trials_per_phase - 1}, "
                f"got {self.rehearsals}"
            )
        if self.initial not in ("observation", "random"):
            raise ValueError(f"initial must be 'observation' or 'random', got {self.initial!r}")
        if self.probation > self.keep_best:
            raise ValueError(
                f"probation must be from 0 to keep_best = {self.keep_best}, got {self.probation}"
            )
        if not self.theta >= 0:
            raise ValueError(f"theta must be at least 0, got {self.theta}")


def em_config(config: LearnerConfig) -> EMConfig:
    """Return the settings of Baum-Welch that a learner's settings ask for."""
    return EMConfig(iterations=max(config.em_iterations, 1), theta=config.theta, prior=config.prior)


@partial(jax.jit, static_argnames=("gamma", "bootstrap"))
def with_returns(batch: TrialBatch, tail: Array, *, gamma: float, bootstrap: bool) -> TrialBatch:
    """Fill in the returns of tapes ``[S, B, L]``; ``tail`` is where truncated trials go on, if they do."""
    ends = jnp.where(batch.terminated | (not bootstrap), 0, tail)
    over = jax.vmap(jax.vmap(partial(discounted_returns, gamma=gamma)))
    returns = over(batch.rewards, batch.valid, batch.start, tail=ends)
    return replace(batch, returns=returns)


def hidden(batch: TrialBatch, held: Array) -> TrialBatch:
    """Hide the tapes of the models that are ``held[S]`` from inference, so that these cost nothing."""
    return replace(batch, valid=batch.valid & ~held[:, None, None])


@partial(jax.jit, static_argnames=("family", "config"))
def refit(
    family: Family, params: Any, batch: TrialBatch, held: Array, config: EMConfig, iterations: int
) -> tuple[Any, Array]:
    """Run Baum-Welch on the models that are not held; return the models and their log-evidence ``[S]``.

    The number of iterations is data: phases with and without a split share what was compiled.
    """
    batch = hidden(batch, held)

    def iterate(_: int, carry: tuple[Any, Array]) -> tuple[Any, Array]:
        models, info = em_step(family, carry[0], batch, config)
        return models, jnp.sum(info.log_evidence, axis=-1)

    nothing = jnp.zeros(len(held), batch.rewards.dtype)
    fitted, evidence = jax.lax.fori_loop(0, iterations, iterate, (params, nothing))
    return select(held, params, fitted), evidence


@partial(jax.jit, static_argnames=("family", "config", "bins", "by_trial"))
def gather_evidence(
    family: Family, params: Any, batch: TrialBatch, trial: Array, config: EMConfig, bins: int, by_trial: bool
) -> tuple[Array, ...]:
    """Gather what the split tests need, on the device: arrays of ``ReturnEvidence`` with leading ``S``.

    ``by_trial`` counts how many independent trials a state's weight is worth; else every step counts as one.
    """
    seen = e_step(family, params, batch, config)
    choices = params.returns.mean.shape[-1]
    over = partial(evidence_of_model, bins=bins, choices=choices, by_trial=by_trial)
    return jax.vmap(over)(seen.gamma, batch, trial)


def evidence_of_model(
    gamma: Array, batch: TrialBatch, trial: Array, *, bins: int, choices: int, by_trial: bool
) -> tuple[Array, ...]:
    """Return the arrays of ``ReturnEvidence`` of one model, from smoothed beliefs ``gamma[B, T, N]``."""
    counted = batch.valid & batch.has_return
    returns = jnp.where(counted, batch.returns, 0)
    low = jnp.min(jnp.where(counted, batch.returns, jnp.inf))
    high = jnp.max(jnp.where(counted, batch.returns, -jnp.inf))
    empty = ~jnp.any(counted)
    low, high = jnp.where(empty, 0, low), jnp.where(empty, 1, high)
    edges = jnp.linspace(low, jnp.maximum(high, low + 1e-6 * (1 + jnp.abs(low))), bins + 1)
    hist = return_histogram(gamma, returns, batch.actions, counted, edges, choices)
    chosen = jax.nn.one_hot(batch.actions if choices > 1 else 0 * batch.actions, choices, dtype=returns.dtype)
    chosen = (chosen * counted[..., None]).reshape(-1, choices)
    rows = gamma.reshape(-1, gamma.shape[-1])
    away = (returns - _mean(returns, counted)).reshape(-1, 1)
    weight, first, second = (jnp.matmul(rows.T, chosen * x, precision="highest") for x in (1, away, away**2))
    mean = first / jnp.maximum(weight, 1e-30)
    var = jnp.maximum(second / jnp.maximum(weight, 1e-30) - mean**2, 0)
    effective = _effective(rows, chosen, trial, weight) if by_trial else weight
    return edges, _centres(returns, counted, edges), hist, mean + _mean(returns, counted), var, effective


def _mean(returns: Array, counted: Array) -> Array:
    return jnp.sum(jnp.where(counted, returns, 0)) / jnp.maximum(jnp.sum(counted), 1)


def _centres(returns: Array, counted: Array, edges: Array) -> Array:
    bins = edges.shape[0] - 1
    index = jnp.clip(jnp.searchsorted(edges, returns.reshape(-1), side="right") - 1, 0, bins - 1)
    mass = jax.ops.segment_sum(counted.reshape(-1).astype(returns.dtype), index, bins)
    total = jax.ops.segment_sum(jnp.where(counted, returns, 0).reshape(-1), index, bins)
    return jnp.where(mass > 0, total / jnp.maximum(mass, 1), (edges[1:] + edges[:-1]) / 2)


def _effective(rows: Array, chosen: Array, trial: Array, weight: Array) -> Array:
    """Return ``[N, K]``: ``(sum_b W_b)^2 / sum_b W_b^2`` over trials of weight ``W_b``."""
    weights = (rows[:, :, None] * chosen[:, None, :]).reshape(rows.shape[0], -1)
    each = jax.ops.segment_sum(weights, trial.reshape(-1), num_segments=trial.size // 2)
    squares = jnp.sum(each**2, axis=0).reshape(weight.shape)
    return weight**2 / jnp.maximum(squares, 1e-30)


def evidence_of_seed(arrays: tuple[np.ndarray, ...], s: int, alive: np.ndarray) -> ReturnEvidence:
    """Return the evidence of one seed, without its spare slots."""
    edges, centres, hist, mean, var, effective = (np.asarray(x[s], np.float64) for x in arrays)
    kept = np.flatnonzero(alive)
    return ReturnEvidence(
        np.maximum.accumulate(edges), centres, *(x[kept] for x in (hist, mean, var, effective))
    )


@partial(jax.jit, static_argnames=("family", "config", "passes", "lam"))
def replay(
    family: Family, params: Any, batch: TrialBatch, q: Array, config: ControlConfig, passes: int, lam: float
) -> Array:
    """Learn values once more from stored tapes, by the beliefs of the model as it is now: ``q[S, N, A]``."""
    beliefs = filter_batch(family, params, batch)
    if native.available() and q.dtype == jnp.float32:
        return native.sarsa_replay(
            q,
            beliefs,
            batch.actions,
            batch.rewards,
            batch.start,
            batch.valid,
            batch.terminated,
            alpha=config.alpha,
            gamma=config.gamma,
            lam=lam,
            passes=passes,
            replacing=config.replacing,
            rule=config.rule,
        )

    def one(value: Array, data: ReplayData) -> Array:
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), data)
        once = partial(replay_tape, replacing=config.replacing, rule=config.rule)
        return jax.lax.fori_loop(
            0, passes, lambda _, v: once(v, flat, config.alpha, config.gamma, lam), value
        )

    data = ReplayData(beliefs, batch.actions, batch.rewards, batch.start, batch.valid, batch.terminated)
    return jax.vmap(one)(q, data)


def filter_batch(family: Family, params: Any, batch: TrialBatch) -> Array:
    """Return what an agent with these models would have believed at every step, ``[S, B, T, N]``."""
    log_obs = jax.vmap(family.log_obs)(params, batch.observations, batch.observed)
    return filter_chains(jax.vmap(family.acting)(params), log_obs, batch)


def filter_chains(chains: Chain, log_obs: Array, batch: TrialBatch) -> Array:
    """Return the filtered beliefs of ``S`` chains on their tapes ``[S, B, T, N]``, the fastest way here."""
    if native.available() and log_obs.dtype == jnp.float32:
        tables = jnp.exp(chains.log_init), jnp.exp(chains.log_trans)
        return native.filter_tapes(*tables, log_obs, batch.actions, batch.start, batch.valid)[0]
    over_tapes = jax.vmap(lambda *tape: filter_tape(*tape).belief, in_axes=(None, 0, 0, 0, 0))
    return jax.vmap(over_tapes)(chains, log_obs, batch.actions, batch.start, batch.valid)
