"""Splits of a coupled model (thesis 3.4): a state of strand 0 becomes several, and strand 1 gains states too.

A split of ``S^O`` is a flat model's: found by the return in the state, one copy per mixture component. For
every split ``S^R`` gains a state, at the return statistics of the state that was split (or one at each of the
components'), with random couplings.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from jaxpomdp.structure.coupled_spec import CoupledSpec, StrandSpec
from jaxpomdp.structure.edits import UNLIMITED, Allowance, Edit, Operator, Shares, clone_state, jittered
from jaxpomdp.structure.evidence import ReturnEvidence
from jaxpomdp.structure.spec import FlatSpec, safe_log
from jaxpomdp.structure.splits import SplitConfig, StateSplit, propose_splits, shrink_split, split_shares

KIND = "coupled state"
Added = Literal["none", "state", "components"]


@dataclass(frozen=True)
class CoupledSplitConfig:
    """When a state of strand 0 is split, and what strand 1 gains by it.

    Raises:
        ValueError: a setting is out of its range.
    """

    split: SplitConfig = field(default_factory=SplitConfig)
    """how a state is found and shared out, as in a flat model"""
    added: Added = "state"
    """what strand 1 gains: a state at the return of the split state (the thesis), or one a component"""
    return_cap: int = 12
    """states of strand 1 at most"""
    coupling_jitter: float = 1.0
    """log-scale of random differences between the ways in which strand 1 leads to the copies"""
    concentration: float = 10.0
    """of the Dirichlet distribution of the rows to and from a new state of strand 1; large is even"""

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        if self.added not in get_args(Added):
            raise ValueError(f"added must be one of {', '.join(get_args(Added))}, got {self.added!r}")
        if self.return_cap < 1:
            raise ValueError(f"return_cap must be at least 1, got {self.return_cap}")
        if not self.coupling_jitter >= 0:
            raise ValueError(f"coupling_jitter must be at least 0, got {self.coupling_jitter}")
        if not self.concentration > 0:
            raise ValueError(f"concentration must be positive, got {self.concentration}")


class CoupledSplit(NamedTuple):
    """What a split of a coupled model needs.

    Attributes:
        split: of the state of strand 0.
        mean: ``[K]``, the mean return in the state, in the columns of strand 1's return model.
        var: ``[K]``, its variance.
        config: what strand 1 gains.
    """

    split: StateSplit
    mean: np.ndarray
    var: np.ndarray
    config: CoupledSplitConfig

    def returns(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and variance ``[J, K]`` of the states that strand 1 gains."""
        if self.config.added == "none":
            return self.mean[None][:0], self.var[None][:0]
        if self.config.added == "state":
            return self.mean[None], self.var[None]
        mixture, column = self.split.mixture, min(self.split.action, len(self.mean) - 1)
        away = mixture.mean - mixture.weight @ mixture.mean
        mean, var = self.mean + away[:, None], np.repeat(self.var[None], mixture.components, axis=0)
        mean[:, column], var[:, column] = mixture.mean, mixture.var
        return mean, var

    def row(self) -> dict[str, Any]:
        """Return the JSON-friendly part of the log row."""
        return self.split.row() | {"added": self.config.added}


def propose_coupled(
    spec: CoupledSpec,
    evidence: ReturnEvidence,
    config: CoupledSplitConfig = CoupledSplitConfig(),
    allowance: Allowance = UNLIMITED,
) -> list[Edit]:
    """Return the splits of strand 0 that the evidence calls for, best first.

    Args:
        spec: the model; strand 1 emits the return.
        evidence: the return in each state of strand 0, per state or per state and action.
        config: the settings.
        allowance: what may be proposed.

    Raises:
        ValueError: evidence and spec have different numbers of states.
    """
    mean, var = _statistics(spec, evidence)
    seen = np.maximum(evidence.var, np.finfo(float).tiny)
    flat = FlatSpec(spec.strands[0].log_init, spec.log_alone, (), evidence.mean, seen)
    return [
        replace(edit, kind=KIND, details=CoupledSplit(edit.details, mean[edit.node], var[edit.node], config))
        for edit in propose_splits(flat, evidence, config.split, allowance)
    ]


def _statistics(spec: CoupledSpec, evidence: ReturnEvidence) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and variance ``[N_0, K]`` of the return in the columns of strand 1's model."""
    if evidence.hist.shape[0] != spec.num_states:
        raise ValueError(f"evidence must have {spec.num_states} states, got {evidence.hist.shape[0]}")
    columns, whole = returns_of(spec.strands[1])[0].shape[1], evidence.per_state()
    floor = max(1e-6 * evidence.pooled()[1], 1e-9)
    if columns != evidence.hist.shape[1]:
        shape = (spec.num_states, columns)
        return np.broadcast_to(whole.mean, shape), np.broadcast_to(np.maximum(whole.var, floor), shape)
    seen = evidence.weight > 1
    return np.where(seen, evidence.mean, whole.mean), np.maximum(
        np.where(seen, evidence.var, whole.var), floor
    )


def returns_of(strand: StrandSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the return model of a strand.

    Raises:
        ValueError: it has none.
    """
    if strand.return_mean is None or strand.return_var is None:
        raise ValueError("strands[1] must emit returns, got a strand without")
    return strand.return_mean, strand.return_var


def shrink_coupled(edit: Edit, room: int) -> Edit:
    """Return the split with at most ``room >= 1`` new states of strand 0."""
    inner = shrink_split(replace(edit, details=edit.details.split), room)
    return replace(inner, details=edit.details._replace(split=inner.details))


def apply_coupled(spec: CoupledSpec, edit: Edit) -> CoupledSpec:
    """Split the state of strand 0, and add to strand 1 what the edit says.

    Raises:
        ValueError: the edit is for another number of states, or of another kind.
    """
    edit.stop_unless(KIND, spec.num_states)
    done: CoupledSplit = edit.details
    shares = split_shares(spec.num_actions, spec.num_states, done.split)
    rng = np.random.default_rng((done.split.seed, 1))
    jitter = done.config.coupling_jitter if done.split.jitter > 0 else 0.0
    cloned = clone_acting(spec, edit.node, shares, jitter, rng)
    mean, var = done.returns()
    kept = np.argsort(-done.split.mixture.weight)[: done.config.return_cap - spec.sizes[1]]
    kept = kept[kept < len(mean)] if len(mean) > 1 else np.arange(min(len(mean), len(kept)))
    return add_return_states(cloned, mean[kept], var[kept], done.config.concentration, rng)


def clone_acting(
    spec: CoupledSpec, node: int, shares: Shares, jitter: float = 0.0, rng: np.random.Generator | None = None
) -> CoupledSpec:
    """Copy a state of strand 0; copies share what leads there, and keep everything else.

    In a product the copies are as likely from another strand as the state was: its own strand shares them
    out, and the normalisation leaves all other probabilities as they were. Without jitter the evidence is
    unchanged under either coupling.

    Args:
        spec: the model.
        node: the state.
        shares: among the copies, from the states of strand 0.
        jitter: log-scale of random differences between the copies, from other strands.
        rng: of the jitter.
    """
    own = clone_state(_flat_view(spec, spec.log_pairs[0][0]), node, shares)
    alone = clone_state(_flat_view(spec, spec.log_alone), node, shares)
    copies, origin = len(shares.initial), np.arange(own.num_states)
    origin[spec.num_states :] = node
    columns = np.flatnonzero(origin == node)
    pairs = [list(row) for row in spec.log_pairs]
    for k in range(1, len(spec.strands)):
        share = np.broadcast_to(shares.initial, (spec.num_actions, spec.sizes[k], copies))
        share = jittered(share, jitter, rng) if rng is not None and jitter > 0 else share
        pairs[0][k] = _led(pairs[0][k][:, :, origin], columns, share, spec.log_weights is not None)
        pairs[k][0] = pairs[k][0][:, origin]
    pairs[0][0] = own.log_trans
    strand = replace(spec.strands[0], log_init=own.log_init, emissions=own.emissions)
    strand = _paid_copies(strand, origin)
    rows = tuple(map(tuple, pairs))
    return CoupledSpec((strand, *spec.strands[1:]), rows, spec.log_weights, alone.log_trans)


def _flat_view(spec: CoupledSpec, log_trans: np.ndarray) -> FlatSpec:
    strand = spec.strands[0]
    none = np.zeros((strand.num_states, 1))
    return FlatSpec(strand.log_init, log_trans, strand.emissions, none, none + 1)


def _paid_copies(strand: StrandSpec, origin: np.ndarray) -> StrandSpec:
    if strand.return_mean is None or strand.return_var is None:
        return strand
    return replace(strand, return_mean=strand.return_mean[origin], return_var=strand.return_var[origin])


def _led(table: np.ndarray, columns: np.ndarray, share: np.ndarray, mixture: bool) -> np.ndarray:
    """Share out the columns of copies among rows ``[A, N_k, N]``, or, in a product, only tilt them."""
    rows = np.exp(table.astype(float))
    rows[:, :, columns] *= share if mixture else share / share.mean(axis=(0, 1))
    return safe_log(rows / rows.sum(axis=-1, keepdims=True)).astype(table.dtype)


def add_return_states(
    spec: CoupledSpec, mean: np.ndarray, var: np.ndarray, concentration: float, rng: np.random.Generator
) -> CoupledSpec:
    """Add states to strand 1, with these returns and random couplings; other rows keep their proportions.

    Args:
        spec: the model; strand 1 emits returns and has no channels.
        mean: ``[J, K]``.
        var: ``[J, K]``.
        concentration: of the Dirichlet distribution of the new entries and rows.
        rng: of the draws.
    """
    strand, new = spec.strands[1], len(mean)
    if new == 0:
        return spec
    old_mean, old_var = returns_of(strand)
    pairs = [list(row) for row in spec.log_pairs]
    pairs[1] = [_widened(pair, new, concentration, rng) for pair in pairs[1]]
    for row in pairs:
        drawn = rng.dirichlet(np.full(row[1].shape[2], concentration), (spec.num_actions, new))
        row[1] = np.concatenate([row[1], safe_log(drawn).astype(row[1].dtype)], axis=1)
    longer = replace(
        strand,
        log_init=_widened(strand.log_init, new, concentration, rng),
        return_mean=np.concatenate([old_mean, mean.astype(old_mean.dtype)]),
        return_var=np.concatenate([old_var, var.astype(old_var.dtype)]),
    )
    strands = (spec.strands[0], longer, *spec.strands[2:])
    return CoupledSpec(strands, tuple(map(tuple, pairs)), spec.log_weights, spec.log_alone)


def _widened(log_rows: np.ndarray, new: int, concentration: float, rng: np.random.Generator) -> np.ndarray:
    """Give rows ``new`` entries more, about an even share in all."""
    drawn = rng.dirichlet(np.full(log_rows.shape[-1] + new, concentration), log_rows.shape[:-1])
    share = drawn[..., log_rows.shape[-1] :]
    rest = np.exp(log_rows.astype(float)) * (1 - share.sum(axis=-1, keepdims=True))
    return safe_log(np.concatenate([rest, share], axis=-1)).astype(log_rows.dtype)


COUPLED_SPLIT = Operator(KIND, propose_coupled, shrink_coupled, apply_coupled)
"""The split of a coupled model as an operator."""
