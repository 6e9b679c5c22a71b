"""What an agent remembers of its past: the last K trials of every seed, and tapes made of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxpomdp._types import TrialBatch
from jaxpomdp.numerics import bucket


class Experience(NamedTuple):
    """The last ``K`` trials of ``S`` seeds, on the host, laid end to end and oldest first.

    A trial of ``n`` actions has ``n + 1`` steps; its last step has no action. Trials fill the table from the
    right: a length of 0 is a place not filled yet.

    Attributes:
        lengths: int ``[S, K]``, steps of each trial.
        terminated: bool ``[S, K]``, the world ended the trial (else it was cut off).
        tail: float ``[S, K]``, the agent's own best value where the trial ended (0 if it terminated).
        observations: a tuple with an array ``[S, P, ...]`` per channel.
        actions: int ``[S, P]``.
        rewards: float ``[S, P]``.
    """

    lengths: np.ndarray
    terminated: np.ndarray
    tail: np.ndarray
    observations: tuple[np.ndarray, ...]
    actions: np.ndarray
    rewards: np.ndarray


class Trials(NamedTuple):
    """Whole trials of one seed: per trial ``lengths``, ``terminated``, ``tail``; per step the rest."""

    lengths: np.ndarray
    terminated: np.ndarray
    tail: np.ndarray
    observations: tuple[np.ndarray, ...]
    actions: np.ndarray
    rewards: np.ndarray


def no_experience(seeds: int, window: int, observations: tuple[np.ndarray, ...]) -> Experience:
    """Return an empty store; ``observations`` give each channel's type by an array ``[...]`` of one step."""
    channels = tuple(np.zeros((seeds, 0, *np.shape(x)), np.asarray(x).dtype) for x in observations)
    empty = np.zeros((seeds, window))
    return Experience(
        empty.astype(np.int64),
        empty.astype(bool),
        empty.astype(np.float32),
        channels,
        np.zeros((seeds, 0), np.int32),
        np.zeros((seeds, 0), np.float32),
    )


def remember(store: Experience, new: list[Trials]) -> Experience:
    """Add each seed's new trials and forget all but the last ``K``."""
    return _stack([_extended(store, s, trials) for s, trials in enumerate(new)], store.lengths.shape[1])


def of_seed(store: Experience, s: int) -> Trials:
    """Return what one seed remembers."""
    kept = store.lengths[s] > 0
    total = int(store.lengths[s].sum())
    return Trials(
        store.lengths[s][kept],
        store.terminated[s][kept],
        store.tail[s][kept],
        tuple(channel[s, :total] for channel in store.observations),
        store.actions[s, :total],
        store.rewards[s, :total],
    )


def chained(old: Trials, new: Trials) -> Trials:
    """Return the trials of one seed, and after them its new ones."""
    return jax.tree.map(lambda *x: np.concatenate(x), old, new)


def _extended(store: Experience, s: int, new: Trials) -> Trials:
    window, trials = store.lengths.shape[1], chained(of_seed(store, s), new)
    dropped = int(trials.lengths[: max(len(trials.lengths) - window, 0)].sum())
    return Trials(
        trials.lengths[-window:],
        trials.terminated[-window:],
        trials.tail[-window:],
        tuple(channel[dropped:] for channel in trials.observations),
        trials.actions[dropped:],
        trials.rewards[dropped:],
    )


def _stack(seeds: list[Trials], window: int) -> Experience:
    size = max(len(trials.actions) for trials in seeds)

    def right(rows: list[np.ndarray]) -> np.ndarray:
        return np.stack([np.concatenate([np.zeros(window - len(row), row.dtype), row]) for row in rows])

    def flat(rows: list[np.ndarray]) -> np.ndarray:
        return np.stack([np.concatenate([r, np.zeros((size - len(r), *r.shape[1:]), r.dtype)]) for r in rows])

    channels = range(len(seeds[0].observations))
    return Experience(
        right([t.lengths for t in seeds]),
        right([t.terminated for t in seeds]),
        right([t.tail for t in seeds]),
        tuple(flat([t.observations[c] for t in seeds]) for c in channels),
        flat([t.actions for t in seeds]),
        flat([t.rewards for t in seeds]),
    )


class Tapes(NamedTuple):
    """Tapes ``[S, B, L]`` of everything remembered, on the host.

    ``batch`` has no returns yet; ``tail`` holds at the last step of each trial the value to go on from;
    ``trial`` numbers the trials of each seed (-1 at padding).
    """

    batch: TrialBatch
    tail: np.ndarray
    trial: np.ndarray


LONG = 4096
"""Rows double in length up to here; beyond, padding costs gigabytes, and another compilation is cheaper."""


def tapes_of(store: Experience, *, least: int = 256) -> Tapes:
    """Lay the trials of every seed end to end on rows of one length, none cut in two.

    Rows are as long as the longest trial (in buckets, at least ``least``), and as many as the seed with the
    most steps needs (in buckets), so shapes are few and padding is little.
    """
    longest = int(store.lengths.max(initial=1))
    width = bucket(longest, least=least, step=2.0 if longest <= LONG else 1.25)
    places = [_places(lengths[lengths > 0], width) for lengths in store.lengths]
    rows = bucket(
        max(int(where[-1]) // width + 1 if len(where) else 1 for where in places), least=8, step=1.25
    )
    return _laid(store, places, rows, width)


def _places(lengths: np.ndarray, width: int) -> np.ndarray:
    """Return where each trial begins, as ``row * width + column``: the next row when it does not fit."""
    begins, cursor = np.zeros(len(lengths), np.int64), 0
    for i, length in enumerate(lengths.tolist()):
        if cursor % width + length > width:
            cursor += -cursor % width
        begins[i] = cursor
        cursor += length
    return begins


def _laid(store: Experience, places: list[np.ndarray], rows: int, width: int) -> Tapes:
    seeds, size = len(places), rows * width
    source = np.full((seeds, size), -1, np.int64)
    trial = np.full((seeds, size), -1, np.int32)
    start, last, terminated = (np.zeros((seeds, size), bool) for _ in range(3))
    tail = np.zeros((seeds, size), np.float32)
    for s, begins in enumerate(places):
        kept = store.lengths[s] > 0
        lengths = store.lengths[s][kept]
        number = np.repeat(np.arange(len(lengths)), lengths)
        inside = np.arange(len(number)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
        where = begins[number] + inside
        source[s, where], trial[s, where] = np.arange(len(number)), number
        start[s, begins], last[s, begins + lengths - 1] = True, True
        terminated[s, begins + lengths - 1] = store.terminated[s][kept]
        tail[s, begins + lengths - 1] = store.tail[s][kept]
    valid = source >= 0

    def take(values: np.ndarray) -> np.ndarray:
        index = np.where(valid, source, 0).reshape(seeds, size, *(1,) * (values.ndim - 2))
        return np.take_along_axis(values, index, 1).reshape(seeds, rows, width, *values.shape[2:])

    def fold(values: np.ndarray) -> np.ndarray:
        return values.reshape(seeds, rows, width)

    rewards = take(store.rewards)
    batch = TrialBatch(
        tuple(take(channel) for channel in store.observations),
        take(store.actions),
        rewards,
        np.zeros_like(rewards),
        fold(valid),
        fold(start),
        fold(terminated),
        fold(valid),
        fold(valid & ~last),
    )
    return Tapes(batch, fold(tail), fold(trial))


def start_returns(store: Experience, gamma: float, *, latest: int) -> list[np.ndarray]:
    """Return the discounted return from the start of each seed's latest trials, cut off at truncation."""
    return [_start_returns(of_seed(store, s), gamma)[-latest:] for s in range(len(store.lengths))]


def _start_returns(trials: Trials, gamma: float) -> np.ndarray:
    if not len(trials.lengths):
        return np.zeros(0)
    begins = np.cumsum(trials.lengths) - trials.lengths
    inside = np.arange(len(trials.rewards)) - np.repeat(begins, trials.lengths)
    last = np.zeros(len(trials.rewards), bool)
    last[begins + trials.lengths - 1] = True
    paid = np.where(last, 0.0, trials.rewards * gamma**inside)
    return np.add.reduceat(paid, begins)


def split_log(log: Any, count: int) -> list[Trials]:
    """Cut the log of an online phase (``trial.Log``, arrays ``[S, L]``) into each seed's trials."""
    host = type(log)(*(np.asarray(field)[:, :count] for field in log))
    return [_trials_of(type(log)(*row)) for row in zip(*host, strict=True)]


def _trials_of(log: Any) -> Trials:
    """Return one seed's trials: after every ended action comes a step for the last observation."""
    log = type(log)(*(field[log.active] for field in log))
    ends = np.flatnonzero(log.ended)
    actions = np.diff(np.concatenate([[-1], ends]))
    after = ends + 1
    return Trials(
        actions + 1,
        log.terminated[ends],
        np.where(log.terminated[ends], 0, log.best[ends]).astype(np.float32),
        (np.insert(log.observation, after, log.arrived[ends]),),
        np.insert(log.action, after, 0),
        np.insert(log.reward, after, 0),
    )
