"""A flat model as a value: ragged (no padding), immutable, printable; what edits read and write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

NEG = -1e30
"""The logarithm of an absent thing; equal to ``jaxpomdp.numerics.NEG`` (this package must not import JAX)."""

ROW_TOLERANCE = 1e-4
"""How far the probabilities of a row may be from summing to one."""


def safe_log(probability: np.ndarray) -> np.ndarray:
    """Return ``log p``, and ``NEG`` where ``p`` is zero.

    >>> safe_log(np.array([1.0, 0.0])).tolist()
    [0.0, -1e+30]
    """
    probability = np.asarray(probability)
    positive = probability > 0
    return np.where(positive, np.log(np.where(positive, probability, 1)), NEG).astype(probability.dtype)


def frozen(name: str, value: object) -> np.ndarray:
    """Return ``value`` as a read-only array of floats, without copying where it is one already.

    Raises:
        TypeError: it is not an array of numbers.
    """
    try:
        array = np.asarray(value)
        array = array if array.dtype.kind == "f" else array.astype(float)
    except (TypeError, ValueError) as error:
        raise TypeError(f"{name} must be an array of numbers, got {type(value).__name__}") from error
    view = array.view()
    view.flags.writeable = False
    return view


def expect_shape(name: str, array: np.ndarray, shape: Sequence[int | None]) -> None:
    """Stop unless ``array`` has this shape (``None``: any size).

    Raises:
        ValueError: naming the argument, the shape wanted and the shape that came.
    """
    fits = array.ndim == len(shape) and all(w in (None, g) for w, g in zip(shape, array.shape, strict=True))
    if not fits:
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} must have shape ({wanted}), got {array.shape}")


@dataclass(frozen=True, eq=False)
class Channel:
    """One emission channel: the name of its kind and arrays with states first, such as ``log_prob[N, O]``.

    Attributes:
        kind: name of the channel's class in the models, such as ``"Categorical"``.
        values: read-only arrays ``[N, ...]`` by the name of the parameter.
    """

    kind: str
    values: Mapping[str, np.ndarray]

    def __post_init__(self) -> None:
        arrays = {name: frozen(f"{self.kind}.{name}", value) for name, value in self.values.items()}
        object.__setattr__(self, "values", MappingProxyType(arrays))

    def take(self, origin: np.ndarray) -> Channel:
        """Return the channel whose state ``n`` is the old state ``origin[n]``."""
        return Channel(self.kind, {name: value[origin] for name, value in self.values.items()})

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Channel):
            return NotImplemented
        return self.kind == other.kind and equal_maps(self.values, other.values)

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class FlatSpec:
    """A flat action-conditioned HMM with returns, unpadded, in log space.

    Two specs are equal when every number is. The constructor checks shapes; ``validate`` checks the numbers.

    Attributes:
        log_init: ``[N]``, log probability of starting in each state.
        log_trans: ``[A, N, N]``, log probability of going from row to column under an action.
        emissions: a ``Channel`` per observation channel.
        return_mean: ``[N, K]``, mean return, K = 1 (per state) or A (per state and action).
        return_var: ``[N, K]``, its variance.

    Raises:
        ValueError: shapes disagree.

    >>> spec = FlatSpec.from_probabilities([1, 0], [[[0.5, 0.5], [0, 1]]], emissions=(np.eye(2),))
    >>> spec.num_states, spec.num_actions, spec.return_mean.shape
    (2, 1, (2, 1))
    >>> print(spec)
    FlatSpec of 2 states, 1 action, channels Categorical[2], a return per state
      state 0: starts 1.00, return 0 +- 1, a0 -> 0 (.50) 1 (.50)
      state 1: starts 0.00, return 0 +- 1, a0 -> 1 (1.0)
    """

    log_init: np.ndarray
    log_trans: np.ndarray
    emissions: tuple[Channel, ...]
    return_mean: np.ndarray
    return_var: np.ndarray

    def __post_init__(self) -> None:
        for name in ("log_init", "log_trans", "return_mean", "return_var"):
            object.__setattr__(self, name, frozen(name, getattr(self, name)))
        object.__setattr__(self, "emissions", tuple(self.emissions))
        _check_shapes(self)

    @property
    def num_states(self) -> int:
        """Number of states, N."""
        return self.log_init.shape[0]

    @property
    def num_actions(self) -> int:
        """Number of actions, A."""
        return self.log_trans.shape[0]

    @staticmethod
    def from_probabilities(
        init: object,
        trans: object,
        emissions: Sequence[object] = (),
        return_mean: object | None = None,
        return_var: object | None = None,
    ) -> FlatSpec:
        """Build a spec from probabilities ``init[N]``, ``trans[A, N, N]``, tables ``[N, O]`` or channels.

        Without returns every state gets mean 0 and variance 1.

        Raises:
            ValueError: shapes disagree, or the numbers are not probabilities.
        """
        start = frozen("init", init)
        none = np.zeros((len(start), 1), start.dtype)
        mean = frozen("return_mean", none if return_mean is None else return_mean)
        var = frozen("return_var", np.ones_like(mean) if return_var is None else return_var)
        channels = tuple(channel_of(c) for c in emissions)
        spec = FlatSpec(safe_log(start), safe_log(frozen("trans", trans)), channels, mean, var)
        validate(spec)
        return spec

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, FlatSpec):
            return NotImplemented
        return self.emissions == other.emissions and equal_maps(_arrays(self), _arrays(other))

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        kinds = ", ".join(f"{c.kind}{_sizes(c)}" for c in self.emissions) or "none"
        each = "state" if self.return_mean.shape[1] == 1 else "state and action"
        head = f"FlatSpec of {_count(self.num_states, 'state')}, {_count(self.num_actions, 'action')}"
        lines = [f"{head}, channels {kinds}, a return per {each}"]
        return "\n".join(lines + [_state_line(self, n) for n in range(self.num_states)])


def validate(spec: FlatSpec) -> None:
    """Stop unless the numbers make sense: finite, rows that sum to one, positive variances.

    Raises:
        ValueError: naming the array, the row, what was expected and what came.
    """
    for name, array in (_arrays(spec) | channel_arrays(spec)).items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite, got NaN or infinity at {_first(~np.isfinite(array))}")
    for name, array in {"log_init": spec.log_init, "log_trans": spec.log_trans}.items():
        expect_rows(name, array)
    for name, array in channel_arrays(spec).items():
        if name.endswith("log_prob"):
            expect_rows(name, array)
    if not (spec.return_var > 0).all():
        raise ValueError(f"return_var must be positive, got {spec.return_var.min()}")


def channel_of(emission: object) -> Channel:
    """Return a channel as it is, and a table ``[N, O]`` of probabilities as a categorical channel."""
    if isinstance(emission, Channel):
        return emission
    return Channel("Categorical", {"log_prob": safe_log(frozen("emission table", emission))})


def expect_rows(name: str, log_prob: np.ndarray) -> None:
    """Stop unless the rows (last axis) are probabilities.

    Raises:
        ValueError: naming the array, with the sum that came and its row.
    """
    totals = np.exp(log_prob).sum(-1)
    wrong = np.abs(totals - 1) > ROW_TOLERANCE
    if wrong.any():
        total, row = totals[wrong][0], _first(wrong)
        raise ValueError(f"{name}: probabilities must sum to 1, got {total:.6g} in row {row}")


def _check_shapes(spec: FlatSpec) -> None:
    expect_shape("log_init", spec.log_init, (None,))
    n = spec.num_states
    if n < 1:
        raise ValueError("log_init must hold at least one state, got none")
    expect_shape("log_trans", spec.log_trans, (None, n, n))
    expect_shape("return_mean", spec.return_mean, (n, None))
    expect_shape("return_var", spec.return_var, spec.return_mean.shape)
    if spec.return_mean.shape[1] not in (1, spec.num_actions):
        raise ValueError(
            f"return_mean must have 1 or {spec.num_actions} columns (per state, or per state and action), "
            f"got {spec.return_mean.shape[1]}"
        )
    for name, array in channel_arrays(spec).items():
        expect_shape(name, array, (n, *array.shape[1:]))


def _arrays(spec: FlatSpec) -> dict[str, np.ndarray]:
    return {k: getattr(spec, k) for k in ("log_init", "log_trans", "return_mean", "return_var")}


def channel_arrays(spec: Any) -> dict[str, np.ndarray]:
    """Return the arrays of a spec's channels by a name that says which channel they are of."""
    named = enumerate(spec.emissions)
    return {f"emissions[{i}].{name}": array for i, c in named for name, array in c.values.items()}


def equal_maps(left: Mapping[str, np.ndarray], right: Mapping[str, np.ndarray]) -> bool:
    """Return whether two maps hold equal arrays under equal names."""
    return left.keys() == right.keys() and all(np.array_equal(left[k], right[k]) for k in left)


def _first(mask: np.ndarray) -> tuple[int, ...]:
    return tuple(int(i) for i in np.argwhere(mask)[0])


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("s" if number != 1 else "")


def _sizes(channel: Channel) -> str:
    first = next(iter(channel.values.values()), np.zeros((0, 0)))
    return f"[{first.shape[1]}]" if first.ndim > 1 else ""


def _state_line(spec: FlatSpec, state: int) -> str:
    """Describe one state: its start, its return, and the likeliest successors under each action."""
    pairs = zip(spec.return_mean[state], np.sqrt(spec.return_var[state]), strict=True)
    returns = ", ".join(f"{mean:.3g} +- {deviation:.2g}" for mean, deviation in pairs)
    exits = "; ".join(exits_line(row, a) for a, row in enumerate(np.exp(spec.log_trans[:, state])))
    return f"  state {state}: starts {np.exp(spec.log_init[state]):.2f}, return {returns}, {exits}"


def exits_line(row: np.ndarray, action: int, shown: int = 3) -> str:
    """Describe where a row of probabilities leads, by the likeliest states."""
    likely = sorted(np.argsort(-row, kind="stable")[:shown])
    parts = [f"{k} ({'1.0' if row[k] >= 0.995 else f'{row[k]:.2f}'[1:]})" for k in likely if row[k] >= 0.005]
    return f"a{action} -> " + " ".join(parts)
