"""State splits (thesis 3.3): a state whose return is not Gaussian becomes one state per mixture component."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from jaxpomdp.structure.edits import (
    UNLIMITED,
    Allowance,
    Edit,
    Operator,
    Shares,
    clone_state,
    even_shares,
    jittered,
    sticky_among,
)
from jaxpomdp.structure.evidence import ReturnEvidence
from jaxpomdp.structure.mixture import Mixture, fewest_acceptable, fit_mixture
from jaxpomdp.structure.significance import ChiSquare, Correction, adjust, normality
from jaxpomdp.structure.spec import FlatSpec

KIND = "state"

_CHOICES = {
    "correction": get_args(Correction),
    "count": ("weight", "effective"),
    "rank": ("statistic", "effect", "likelihood", "spread"),
    "shares": ("even", "weights"),
    "other_actions": ("copy", "shift"),
}


@dataclass(frozen=True)
class SplitConfig:
    """When a state is split and how its probabilities are shared (the thesis leaves all of it open).

    Raises:
        ValueError: a setting is out of its range.
    """

    significance: float = 0.01
    """split where the corrected p-value of the test of normality is below this"""
    correction: Correction = "holm"
    """correction for testing many states at once: none, bonferroni, holm or benjamini-hochberg"""
    count: Literal["weight", "effective"] = "weight"
    """what counts as one return: every step (the thesis), or every trial, whose returns are alike"""
    minimum_weight: float = 30.0
    """least count of returns in a state"""
    minimum_effect: float = 0.0
    """least Cohen's w = sqrt(X^2 / count): how far from Gaussian, whatever the count"""
    minimum_spread: float = 0.02
    """least standard deviation of a state's return, in units of that of all returns; less is deterministic"""
    cells: int = 10
    """cells of equal probability that the test uses at most"""
    components: tuple[int, ...] = (2, 3, 4)
    """sizes of mixture that are tried, fewest first"""
    fit_significance: float = 0.05
    """a mixture is acceptable where chi-square does not reject it at this level"""
    minimum_share: float = 0.02
    """a mixture component lighter than this joins its neighbour"""
    variance_floor: float = 1e-4
    """least variance of a component, in units of the variance of all returns"""
    rank: Literal["statistic", "effect", "likelihood", "spread"] = "statistic"
    """which states go first: by X^2, by effect, by log-likelihood gained, by count times variance"""
    shares: Literal["even", "weights"] = "even"
    """how incoming probability is shared among copies: evenly (the thesis), or as the mixture's weights"""
    stay: float | None = None
    """share of a self-transition that a copy keeps to itself (sticky: 0.9); None: shared like the rest"""
    jitter: float = 0.5
    """log-scale of random differences between the shares of different predecessors, so that Baum-Welch can
    tell copies apart where theta is zero; drawn only where a source of random numbers is given"""
    other_actions: Literal["copy", "shift"] = "shift"
    """returns of actions the split was not found for: kept, or moved by as much as the component's mean"""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ValueError(f"{name} must be one of {', '.join(choices)}, got {getattr(self, name)!r}")
        for name in ("significance", "fit_significance", "minimum_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")
        if self.stay is not None and not 0 <= self.stay <= 1:
            raise ValueError(f"stay must be None or between 0 and 1, got {self.stay}")
        for name in ("minimum_weight", "minimum_effect", "minimum_spread", "variance_floor", "jitter"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be at least 0, got {getattr(self, name)}")
        if self.cells < 4:
            raise ValueError(
                f"cells must be at least 4 (a fitted Gaussian leaves cells - 3), got {self.cells}"
            )
        if not self.components or min(self.components) < 2:
            raise ValueError(f"components must be sizes of 2 or more, got {self.components}")


class StateSplit(NamedTuple):
    """What a state split needs: the mixture found, for which action's return, and how to share.

    Attributes:
        action: column of the return model, 0 where it is per state.
        mixture: one component per copy.
        accepted: chi-square accepted the mixture (else it is the best by BIC).
        shift: the other columns move with the component's mean.
        even: the copies' shares are even, else as the mixture's weights.
        stay: as in ``SplitConfig``.
        jitter: as in ``SplitConfig``.
        seed: of the jitter.
    """

    action: int
    mixture: Mixture
    accepted: bool
    shift: bool
    even: bool
    stay: float | None
    jitter: float
    seed: int

    @property
    def shares(self) -> np.ndarray:
        """``[m]``: the share of each copy."""
        return even_shares(self.mixture.components) if self.even else self.mixture.weight

    def row(self) -> dict[str, Any]:
        """Return the JSON-friendly part of the log row."""
        parts = {f"component_{k}": getattr(self.mixture, k).tolist() for k in ("weight", "mean", "var")}
        return {"action": self.action, "accepted": self.accepted, "seed": self.seed} | parts


def propose_splits(
    spec: Any,
    evidence: ReturnEvidence,
    config: SplitConfig = SplitConfig(),
    allowance: Allowance = UNLIMITED,
) -> list[Edit]:
    """Return the splits that the evidence calls for, best first (thesis 3.3).

    A state is tested for each column of its return model; the best-ranked action stands for the state.

    Raises:
        ValueError: evidence and spec have different numbers of states or return columns.
    """
    if evidence.hist.shape[:2] != spec.return_mean.shape:
        raise ValueError(
            f"evidence must have [states, return columns] = {spec.return_mean.shape} as the spec, "
            f"got {evidence.hist.shape[:2]}"
        )
    if allowance.room < 1 or allowance.edits < 1:
        return []
    tests = examine_states(evidence, config, allowance.free(spec.num_states))
    places = [(int(n), int(k)) for n, k in np.argwhere(tests.significant)]
    if config.rank == "likelihood":
        edits = _edits(evidence, config, allowance, tests, places)
        return _best_by_score(edits)[: allowance.edits]
    scores = _scores(tests, evidence, config)
    ranked = _first_of_each_state(sorted(places, key=lambda place: -scores[place]))
    return list(islice(_edits(evidence, config, allowance, tests, ranked, scores), allowance.edits))


class StateTests(NamedTuple):
    """Tests of all states ``[N, K]``: the counts used, the chi-square result, and what is significant."""

    counts: np.ndarray
    result: ChiSquare
    adjusted: np.ndarray
    significant: np.ndarray


def examine_states(
    evidence: ReturnEvidence, config: SplitConfig, free: np.ndarray | None = None
) -> StateTests:
    """Test the return of every state (and action) for normality, corrected for the number of tests made.

    Args:
        evidence: the returns.
        config: the settings.
        free: bool ``[N]``, states to test; the others are not counted as tests. ``None``: all.
    """
    weight = evidence.weight
    worth = evidence.effective if config.count == "effective" else weight
    scale = np.where(weight > 0, np.minimum(worth / np.where(weight > 0, weight, 1), 1), 0)
    counts = evidence.hist * scale[..., None]
    spread = config.minimum_spread**2 * evidence.pooled()[1]
    tested = (counts.sum(-1) >= config.minimum_weight) & (evidence.var > spread)
    tested &= True if free is None else free[:, None]
    var = np.where(tested, evidence.var, 1)
    result = normality(counts, evidence.edges, evidence.mean, var, cells=config.cells)
    tested &= result.dof >= 1
    adjusted = adjust(result.p_value, config.correction, tested)
    significant = tested & (adjusted < config.significance) & (result.effect >= config.minimum_effect)
    return StateTests(counts, result, adjusted, significant)


def apply_split(spec: FlatSpec, edit: Edit) -> FlatSpec:
    """Split the state: copies share what leads there, and each takes the return of its component.

    Raises:
        ValueError: the edit is for another number of states, or of another kind.
    """
    edit.stop_unless(KIND, spec.num_states)
    split: StateSplit = edit.details
    cloned = clone_state(spec, edit.node, split_shares(spec.num_actions, spec.num_states, split))
    copies = np.flatnonzero(edit.origin == edit.node)
    mean, var = cloned.return_mean.copy(), cloned.return_var.copy()
    if split.shift:
        mean[copies] += (split.mixture.mean - split.mixture.weight @ split.mixture.mean)[:, None]
    mean[copies, split.action] = split.mixture.mean
    var[copies, split.action] = split.mixture.var
    return replace(cloned, return_mean=mean, return_var=var)


def shrink_split(edit: Edit, room: int) -> Edit:
    """Return the split with at most ``room >= 1`` new states: the lightest components join others."""
    split: StateSplit = edit.details
    mixture = split.mixture.merged(room + 1)
    copied = (edit.node,) * (mixture.components - 1)
    return replace(edit, copied=copied, details=split._replace(mixture=mixture))


STATE_SPLIT = Operator(KIND, propose_splits, shrink_split, apply_split)
"""The state split as an operator."""


def _scores(tests: StateTests, evidence: ReturnEvidence, config: SplitConfig) -> np.ndarray:
    if config.rank == "spread":
        return tests.counts.sum(-1) * evidence.var
    return tests.result.effect if config.rank == "effect" else tests.result.statistic


def _first_of_each_state(places: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
    columns: dict[int, int] = {}
    for state, column in places:
        columns.setdefault(state, column)
    return list(columns.items())


def _best_by_score(edits: Iterable[Edit]) -> list[Edit]:
    """Return the best edit of each state, best first."""
    best: dict[int, Edit] = {}
    for edit in sorted(edits, key=lambda edit: -edit.score):
        best.setdefault(edit.node, edit)
    return list(best.values())


def _edits(
    evidence: ReturnEvidence,
    config: SplitConfig,
    allowance: Allowance,
    tests: StateTests,
    places: Iterable[tuple[int, int]],
    scores: np.ndarray | None = None,
) -> Iterator[Edit]:
    """Fit a mixture at each place and make the edit, where more than one component is left.

    Without ``scores`` the score is the log-likelihood that the mixture gains over one Gaussian.
    """
    for place in places:
        counts = tests.counts[place]
        mixture, accepted = _mixture(counts, evidence, config)
        if mixture.components >= 2:
            score = _gain(mixture, counts, evidence) if scores is None else float(scores[place])
            split = _split(place[1], mixture, accepted, config, allowance.rng)
            yield shrink_split(_edit(tests, place, score, split), allowance.room)


def _edit(tests: StateTests, place: tuple[int, int], score: float, split: StateSplit) -> Edit:
    state = place[0]
    return Edit(
        KIND,
        state,
        len(tests.counts),
        (state,) * (split.mixture.components - 1),
        score,
        float(tests.result.statistic[place]),
        float(tests.adjusted[place]),
        float(tests.result.effect[place]),
        float(tests.counts[place].sum()),
        split,
    )


def _split(
    column: int, mixture: Mixture, accepted: bool, config: SplitConfig, rng: np.random.Generator | None
) -> StateSplit:
    seed = 0 if rng is None else int(rng.integers(2**31))
    jitter = 0.0 if rng is None else config.jitter
    even, shift = config.shares == "even", config.other_actions == "shift"
    return StateSplit(column, mixture, accepted, shift, even, config.stay, jitter, seed)


def _gain(mixture: Mixture, counts: np.ndarray, evidence: ReturnEvidence) -> float:
    return mixture.log_likelihood - fit_mixture(evidence.centres, counts, 1).log_likelihood


def _mixture(counts: np.ndarray, evidence: ReturnEvidence, config: SplitConfig) -> tuple[Mixture, bool]:
    """Return the fewest acceptable components, without those that are too light."""
    mixture, accepted = fewest_acceptable(
        counts,
        evidence.edges,
        evidence.centres,
        components=config.components,
        significance=config.fit_significance,
        variance_floor=config.variance_floor * evidence.pooled()[1],
    )
    while mixture.components > 1 and mixture.weight.min() < config.minimum_share:
        mixture = mixture.merged(mixture.components - 1)
    return mixture, accepted


def split_shares(actions: int, states: int, split: StateSplit) -> Shares:
    """Return the shares of a split, jittered per action and predecessor."""
    shares, copies = split.shares, split.mixture.components
    incoming = np.broadcast_to(shares, (actions, states, copies))
    rows = shares if split.stay is None else sticky_among(shares, split.stay)
    among = np.broadcast_to(rows, (actions, copies, copies))
    if split.jitter == 0:
        return Shares(shares, incoming, among)
    rng = np.random.default_rng(split.seed)
    return Shares(*(jittered(part, split.jitter, rng) for part in (shares, incoming, among)))
