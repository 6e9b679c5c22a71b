"""Why do coupled agents fail in the hallway? Two suspects, measured at checkpoints of every seed.

    python benchmarks/coupled/diagnose.py

- *Acting lacks what learning has.* Learning sees both strands and the return, acting strand 0 alone. From the
  window of trials that learning sees: the mutual information ``I(o'; r | o, a)`` that strand 1 has about
  where strand 0 goes next, and what the observations are worth under the coupled model and under the chain
  that acts, in nats per step.
- *Exploration hides circles.* The share of trials that succeed in training, exploring, and greedily; and
  whether the gate holds the model, which then learns no more.

The controls: no return modelled (``theta = 0``); couplings frozen at even rows, where the strands are apart;
one trial in five as at the end (rehearsals); and the flat agent. Writes ``coupled-diagnosis.json`` and
``.png`` to ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from jaxpomdp._types import TrialBatch
from jaxpomdp.agents import experience, learner
from jaxpomdp.agents.agent import Agent, AgentConfig, AgentState
from jaxpomdp.agents.coupled_kind import CoupledModel
from jaxpomdp.agents.kinds import Kind
from jaxpomdp.agents.presets import HALLWAY, LEARNERS
from jaxpomdp.envs.hallway import hallway_navigation
from jaxpomdp.experiments.record import versions, write_json
from jaxpomdp.models.em import EMConfig, e_step
from jaxpomdp.models.family import Family
from jaxpomdp.models.flat import FLAT

RESULT = Path("benchmarks/results/coupled-diagnosis.json")
JUDGED = 48
"""Greedy trials at a checkpoint."""
EVEN = 1e6
"""Concentration of couplings that are as good as even."""


@dataclass(frozen=True)
class ApartModel:
    """A coupled model whose strands stay apart: couplings between them are even rows, and are not learned."""

    inner: CoupledModel

    def kind(self) -> Kind:
        """Return the kind of the model, with an M-step that learns all but the couplings."""
        kind = self.inner.kind()
        return kind._replace(family=apart(kind.family))


def apart(family: Family) -> Family:
    """Return the family with couplings between strands that stay as they are."""

    def m_step(params: Any, *rest: Any) -> Any:
        new, old = family.m_step(params, *rest), params.log_pairs
        pairs = ((new.log_pairs[0][0], old[0][1]), (old[1][0], new.log_pairs[1][1]))
        return replace(new, log_pairs=pairs, log_weights=params.log_weights)

    return family._replace(m_step=m_step)


def variants() -> dict[str, AgentConfig]:
    """Return the agents to look at, by name."""
    product, mixture = LEARNERS["cudhmm"], LEARNERS["cudhmm-mixture"]
    even = replace(product.model, concentration=EVEN, coupling_jitter=0.0)
    agents = {
        "product": product,
        "product, strands apart": replace(product, model=ApartModel(even)),
        "mixture": mixture,
        "flat": HALLWAY,
    }
    for name in ("product", "mixture"):
        agent = agents[name]
        agents[f"{name}, theta 0"] = replace(agent, learner=replace(agent.learner, theta=0.0))
        agents[f"{name}, rehearsals"] = replace(agent, learner=replace(agent.learner, rehearsals=1))
    return agents


def told(moves: np.ndarray) -> float:
    """Return ``I(o'; r | o, a)`` in nats, of expected moves ``[A, N, R, N]`` of strand 0.

    >>> even, sure = np.ones((1, 1, 2, 2)), np.eye(2)[None, None]
    >>> told(even), round(told(sure), 3)
    (0.0, 0.693)
    """
    visits = moves.sum(-1, keepdims=True)
    pooled = moves.sum(2, keepdims=True)
    rows = moves / np.where(visits > 0, visits, 1)
    mean = pooled / np.maximum(pooled.sum(-1, keepdims=True), 1e-300)
    some = moves > 0
    ratio = np.where(some, rows, 1) / np.where(some, np.broadcast_to(mean, moves.shape), 1)
    return float((moves * np.log(ratio)).sum() / max(moves.sum(), 1e-300))


def window(agent: Agent, state: AgentState) -> TrialBatch:
    """Return what learning sees: the window of trials, returns filled in."""
    settings = agent.config.learner
    tapes = experience.tapes_of(state.experience)
    options = {"gamma": settings.return_gamma, "bootstrap": settings.bootstrap}
    return learner.with_returns(jax.device_put(tapes.batch), jnp.asarray(tapes.tail), **options)


def acting_family(family: Family) -> Family:
    """Return a flat family that scores observations by the chain that acts."""

    def learning(params: Any, batch: TrialBatch, theta: float) -> Any:
        return family.acting(params), family.log_obs(params, batch.observations, batch.observed)

    return FLAT._replace(name=f"acting {family.name}", learning=learning)


def worth(family: Family, params: Any, batch: TrialBatch) -> np.ndarray:
    """Return the log-evidence of observations, in nats per step, ``[S]``."""
    seen = e_step(family, params, batch, EMConfig(theta=0.0)).log_evidence
    return np.asarray(seen.sum(axis=1) / batch.valid.sum(axis=(1, 2)))


def measured(agent: Agent, state: AgentState) -> dict[str, np.ndarray]:
    """Return what is known of every seed at a checkpoint, ``[S]`` each."""
    batch, params, family = window(agent, state), state.params, agent.family
    greedy = agent.evaluate(state, JUDGED, jax.random.key(1))["success"].mean(axis=1)
    acting = worth(acting_families(family), params, batch)
    found = {"greedy": greedy, "observations by acting": acting, "held": agent._held(state)}
    if hasattr(params, "strands"):
        seen = e_step(family, params, batch, learner.em_config(agent.config.learner))
        moves = np.asarray(seen.xi[0], float)
        found["told by strand 1"] = np.array([told(model) for model in moves])
        found["observations by both"] = worth(family, params, batch)
    return found


_ACTING: dict[str, Family] = {}


def acting_families(family: Family) -> Family:
    """Return ``acting_family`` of a family, the same one each time: a new one would be compiled anew."""
    return _ACTING.setdefault(family.name + str(id(family)), acting_family(family))


def followed(config: AgentConfig, seeds: list[int], trials: int, every: int) -> list[dict[str, Any]]:
    """Run an agent and measure it every so many trials."""
    agent = Agent(hallway_navigation(), config)
    state, rows, won = agent.init(seeds), [], []
    for done in range(config.learner.trials_per_phase, trials + 1, config.learner.trials_per_phase):
        state, phase = agent.run(state)
        won.append(phase["success"])
        if done % every == 0:
            latest = np.concatenate(won, axis=1)[:, -every:].mean(axis=1)
            found = measured(agent, state) | {"training": latest, "states": phase["states"]}
            rows.append(
                {"trials": done} | {k: np.round(np.asarray(v, float), 4).tolist() for k, v in found.items()}
            )
    return rows


def summary(rows: list[dict[str, Any]]) -> str:
    """Return a line about the last checkpoint: medians over seeds."""
    last = {name: np.median(value) for name, value in rows[-1].items() if name not in ("trials", "held")}
    text = ", ".join(f"{name} {value:.3f}" for name, value in last.items())
    return f"held {int(sum(rows[-1]['held']))} of {len(rows[-1]['held'])}, {text}"


def draw(found: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Draw the last checkpoint: success in training and greedily, and the two suspects' nats."""
    last = {name: rows[-1] for name, rows in found.items()}
    places = np.arange(len(last))
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 0.5 * len(last) + 1.5), sharey=True)
    for shift, (name, color) in zip((-0.2, 0.2), {"training": "C0", "greedy": "C3"}.items(), strict=True):
        shares = [100 * np.asarray(row[name]) for row in last.values()]
        left.barh(places + shift, [x.mean() for x in shares], 0.4, color=color, alpha=0.6, label=name)
        for place, seeds in zip(places + shift, shares, strict=True):
            left.plot(seeds, np.full(len(seeds), place), ".", color=color, ms=4)
    gap = [_gap(row) for row in last.values()]
    told_rows = [np.median(row.get("told by strand 1", 0.0)) for row in last.values()]
    right.barh(places - 0.2, told_rows, 0.4, color="C2", label="strand 1 tells of strand 0's moves")
    right.barh(places + 0.2, gap, 0.4, color="C1", label="observations: both strands against acting chain")
    left.set(yticks=places, yticklabels=list(last), xlabel="trials that succeed, % (a dot is a seed)")
    right.set(xlabel="nats per step, median of seeds")
    left.invert_yaxis()
    for axes in (left, right):
        axes.legend(fontsize=8, loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=120)


def _gap(row: dict[str, Any]) -> float:
    both = row.get("observations by both", row["observations by acting"])
    return float(np.median(np.subtract(both, row["observations by acting"])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(12)))
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--every", type=int, default=50)
    parser.add_argument("--only", nargs="*", default=list(variants()))
    options = parser.parse_args()
    run: Callable[[AgentConfig], Any] = lambda config: followed(  # noqa: E731
        config, options.seeds, options.trials, options.every
    )
    found = {}
    for name in options.only:
        found[name] = run(variants()[name])
        print(f"{name}: {summary(found[name])}", flush=True)
    settings = {"seeds": options.seeds, "trials": options.trials}
    write_json(RESULT, {"versions": versions(), "settings": settings, "found": found})
    draw(found, RESULT.with_suffix(".png"))


if __name__ == "__main__":
    main()
