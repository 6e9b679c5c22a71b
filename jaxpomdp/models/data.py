"""From trials as people have them (ragged lists) to the padded ``TrialBatch`` that inference takes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxpomdp._types import TrialBatch


class _Trial(NamedTuple):
    """One trial of ``T`` steps, on the host; arrays as in ``TrialBatch``."""

    observations: tuple[np.ndarray, ...]
    actions: np.ndarray
    rewards: np.ndarray
    returns: np.ndarray
    start: np.ndarray
    terminated: np.ndarray
    observed: np.ndarray
    has_return: np.ndarray


def trial_batch(
    observations: Sequence[Any] | tuple[Sequence[Any], ...],
    actions: Sequence[Any] | None = None,
    rewards: Sequence[Any] | None = None,
    *,
    gamma: float = 0.95,
    terminated: bool | Sequence[bool] = True,
    tails: Sequence[float] | None = None,
    pack: bool = False,
    length: int | None = None,
) -> TrialBatch:
    """Put trials of any lengths into one padded batch, ``R[t] = r[t] + gamma R[t+1]``.

    A trial of ``T`` observations has ``T - 1`` actions and rewards (the time-line of ``jaxpomdp._types``).

    Args:
        observations: a list with one entry per trial: integers ``[T]``, or floats ``[T]`` or ``[T, D]``.
            Several channels seen at once are a tuple of such lists. A step that is None, or has a NaN, is
            missing (in all channels).
        actions: a list with ``T - 1`` integers per trial; None if there is but one action.
        rewards: a list with ``T - 1`` numbers per trial, ``rewards[t]`` paid for ``actions[t]``; None if
            there are none, and then no return is modelled.
        gamma: the discount of the returns.
        terminated: whether each trial (or all) was ended by the world, so that nothing was to follow.
        tails: the return to expect from the last step of each trial on; counted for trials that were cut off.
            Without it the returns of trials that were cut off are not modelled.
        pack: lay short trials end to end, up to the longest, instead of one in a row.
        length: the steps of a row; as many as needed if None. A fixed length saves compilations.

    Returns:
        TrialBatch: arrays ``[B, T]``.

    Raises:
        ValueError: naming the argument and the trial, with what was expected and what came.

    Example:
        >>> batch = trial_batch([[0, 1, 1], [2, None]], [[0, 1], [1]], [[0.0, 1.0], [1.0]], gamma=0.5)
        >>> print(batch.valid.astype(int))
        [[1 1 1]
         [1 1 0]]
        >>> print(batch.returns[0], batch.observed[1])
        [0.5 1.  0. ] [ True False False]
    """
    if not 0 <= gamma <= 1:
        raise ValueError(f"gamma must be in 0..1, got {gamma}")
    channels = [_channel(c, name) for c, name in _named_channels(observations)]
    lengths = _lengths(channels)
    driven = _per_step("actions", actions, lengths)
    paid = _per_step("rewards", rewards, lengths)
    ended = _per_trial("terminated", terminated, len(lengths))
    beyond = None if tails is None else _per_trial("tails", tails, len(lengths))
    trials = [
        _trial(
            [channel[i] for channel in channels],
            _integers(f"actions[{i}]", driven[i]),
            _numbers(f"rewards[{i}]", paid[i]),
            gamma,
            bool(ended[i]),
            None if beyond is None else float(beyond[i]),
            rewards is not None,
        )
        for i in range(len(lengths))
    ]
    return _laid_out(trials, _rows(lengths, pack, length), length or max(lengths))


def _named_channels(observations: Any) -> list[tuple[Any, str]]:
    if isinstance(observations, tuple):
        named = [(channel, f"observations[{i}]") for i, channel in enumerate(observations)]
    else:
        named = [(observations, "observations")]
    if not named or any(len(channel) == 0 for channel, _ in named):
        raise ValueError("observations must hold at least one trial, got none")
    return named


def _steps(trial: Any, name: str) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the values ``[T]`` or ``[T, D]`` of one trial, None if all are missing, and which are there."""
    steps = list(trial)
    if not steps:
        raise ValueError(f"{name} must hold at least one step, got none")
    there = np.array([step is not None for step in steps])
    if not there.any():
        return None, there
    filler = steps[int(np.argmax(there))]
    try:
        values = np.asarray([filler if step is None else step for step in steps])
    except ValueError as error:
        raise ValueError(f"{name} must have steps of one size, got {error}") from None
    if values.dtype.kind not in "biuf" or values.ndim > 2:
        came = f"{values.dtype} {values.shape}"
        raise ValueError(f"{name} must be integers [T], or floats [T] or [T, D], got {came}")
    if values.dtype.kind != "f":
        return values.astype(np.int64), there
    flat = values.reshape(len(steps), -1)
    there &= ~np.isnan(flat).any(axis=1)
    if np.isinf(flat[there]).any():
        raise ValueError(f"{name} must be finite (NaN marks a missing step), got infinity")
    return np.where(there[:, None], flat, 0), there


def _channel(trials: Any, name: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return ``(values, there)`` of each trial: integers ``[T]`` or floats ``[T, D]``, one kind for all."""
    read = [_steps(trial, f"{name}[{i}]") for i, trial in enumerate(trials)]
    known = [values for values, _ in read if values is not None]
    if not known:
        raise ValueError(f"{name} must hold at least one observation, got only missing steps")
    real = any(values.dtype.kind == "f" for values in known)
    sizes = {values.shape[1] if values.ndim == 2 else 1 for values in known} if real else {0}
    if not real and any(values.ndim > 1 for values in known):
        raise ValueError(f"{name} must be one integer per step (vectors are floats), got several")
    if len(sizes) > 1:
        raise ValueError(f"{name} must have one dimension throughout, got {sorted(sizes)}")
    return [(_filled(values, len(there), max(sizes)), there) for values, there in read]


def _filled(values: np.ndarray | None, steps: int, size: int) -> np.ndarray:
    """Return floats ``[T, size]``, or integers ``[T]`` if the size is 0."""
    if size == 0:
        return np.zeros(steps, np.int64) if values is None else values
    return np.zeros((steps, size)) if values is None else values.reshape(steps, size).astype(np.float64)


def _lengths(channels: list[list[tuple[np.ndarray, np.ndarray]]]) -> list[int]:
    lengths = [len(there) for _, there in channels[0]]
    for index, channel in enumerate(channels[1:], start=1):
        came = [len(there) for _, there in channel]
        if came != lengths:
            raise ValueError(f"observations[{index}] must have trials of lengths {lengths}, got {came}")
    return lengths


def _per_step(name: str, values: Sequence[Any] | None, lengths: list[int]) -> list[np.ndarray]:
    """Return ``T - 1`` entries for each trial; zeros if there are none."""
    if values is None:
        return [np.zeros(steps - 1, np.int64) for steps in lengths]
    if len(values) != len(lengths):
        raise ValueError(f"{name} must have {len(lengths)} trials, as observations, got {len(values)}")
    arrays = [np.asarray(trial) for trial in values]
    for i, (array, steps) in enumerate(zip(arrays, lengths, strict=True)):
        if array.shape != (steps - 1,):
            expected = f"shape ({steps - 1},): one between each two of {steps} observations"
            raise ValueError(f"{name}[{i}] must have {expected}; got {array.shape}")
    return arrays


def _per_trial(name: str, value: Any, trials: int) -> np.ndarray:
    array = np.asarray(value)
    if array.ndim == 0:
        return np.full(trials, array)
    if array.shape != (trials,):
        raise ValueError(f"{name} must have one entry per trial ({trials}), got shape {array.shape}")
    return array


def _integers(name: str, values: np.ndarray) -> np.ndarray:
    if values.size and (values.dtype.kind not in "biu" or values.min() < 0):
        raise ValueError(f"{name} must be integers from 0 on, got {values.dtype} from {values.min()}")
    return values.astype(np.int64)


def _numbers(name: str, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind not in "biuf" or not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite numbers, got {values}")
    return values.astype(np.float64)


def _discounted(rewards: np.ndarray, gamma: float, tail: float) -> np.ndarray:
    """Return ``R[T]`` with ``R[t] = r[t] + gamma R[t+1]`` and ``R[T-1] = tail``."""
    returns = np.full(len(rewards) + 1, tail)
    for step in range(len(rewards) - 1, -1, -1):
        returns[step] = rewards[step] + gamma * returns[step + 1]
    return returns


def _trial(
    channels: list[tuple[np.ndarray, np.ndarray]],
    actions: np.ndarray,
    rewards: np.ndarray,
    gamma: float,
    ended: bool,
    tail: float | None,
    paid: bool,
) -> _Trial:
    steps = len(actions) + 1
    first, last = np.arange(steps) == 0, np.arange(steps) == steps - 1
    known = paid and (ended or tail is not None)
    return _Trial(
        observations=tuple(values for values, _ in channels),
        actions=np.append(actions, 0),
        rewards=np.append(rewards, 0.0),
        returns=_discounted(rewards, gamma, 0.0 if ended or tail is None else tail),
        start=first,
        terminated=last & ended,
        observed=np.logical_and.reduce([there for _, there in channels]),
        has_return=~last & known,
    )


def _rows(lengths: list[int], pack: bool, length: int | None) -> list[list[int]]:
    """Return the trials of each row: one each, or first fit by decreasing length."""
    room = length or max(lengths)
    if max(lengths) > room:
        raise ValueError(f"length must be at least {max(lengths)}, the longest trial, got {length}")
    if not pack:
        return [[i] for i in range(len(lengths))]
    rows: list[list[int]] = []
    left: list[int] = []
    for i in sorted(range(len(lengths)), key=lambda i: -lengths[i]):
        row = next((r for r, free in enumerate(left) if free >= lengths[i]), len(rows))
        if row == len(rows):
            rows.append([])
            left.append(room)
        rows[row].append(i)
        left[row] -= lengths[i]
    return rows


def _laid_out(trials: list[_Trial], rows: list[list[int]], length: int) -> TrialBatch:
    def tape(pieces: list[np.ndarray]) -> np.ndarray:
        joined = np.concatenate(pieces)
        return np.pad(joined, [(0, length - len(joined))] + [(0, 0)] * (joined.ndim - 1))

    def stacked(pick: Any) -> Any:
        return jnp.asarray(np.stack([tape([pick(trials[i]) for i in row]) for row in rows]))

    channels = range(len(trials[0].observations))
    return TrialBatch(
        observations=tuple(stacked(lambda trial, c=c: trial.observations[c]) for c in channels),
        actions=stacked(lambda trial: trial.actions),
        rewards=stacked(lambda trial: trial.rewards),
        returns=stacked(lambda trial: trial.returns),
        valid=stacked(lambda trial: np.ones(len(trial.actions), bool)),
        start=stacked(lambda trial: trial.start),
        terminated=stacked(lambda trial: trial.terminated),
        observed=stacked(lambda trial: trial.observed),
        has_return=stacked(lambda trial: trial.has_return),
    )
