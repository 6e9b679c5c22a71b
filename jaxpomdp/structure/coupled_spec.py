"""A coupled model as a value: ragged (no padding), immutable, printable; what edits read and write."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from jaxpomdp.structure.spec import Channel, exits_line, expect_rows, expect_shape, frozen


@dataclass(frozen=True, eq=False)
class StrandSpec:
    """One chain of a coupled model, in log space: where it starts and what it emits.

    Attributes:
        log_init: ``[N]``.
        emissions: a ``Channel`` per observation channel; maybe none.
        return_mean: ``[N, K]``, K = 1 or A; None where the strand emits no returns.
        return_var: ``[N, K]`` or None, as ``return_mean``.

    Raises:
        ValueError: shapes disagree.
    """

    log_init: np.ndarray
    emissions: tuple[Channel, ...] = ()
    return_mean: np.ndarray | None = None
    return_var: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "log_init", frozen("log_init", self.log_init))
        object.__setattr__(self, "emissions", tuple(self.emissions))
        for name in ("return_mean", "return_var"):
            value = getattr(self, name)
            object.__setattr__(self, name, None if value is None else frozen(name, value))
        _check_strand(self)

    @property
    def num_states(self) -> int:
        """Number of states, N."""
        return self.log_init.shape[0]

    def arrays(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield every array with its name."""
        yield "log_init", self.log_init
        for i, channel in enumerate(self.emissions):
            yield from ((f"emissions[{i}].{name}", array) for name, array in channel.values.items())
        if self.return_mean is not None and self.return_var is not None:
            yield from (("return_mean", self.return_mean), ("return_var", self.return_var))


@dataclass(frozen=True, eq=False)
class CoupledSpec:
    """A coupled HMM, unpadded, in log space (see ``models.coupled``).

    Two specs are equal when every number is. The constructor checks shapes; ``validate`` checks the numbers.

    Attributes:
        strands: the chains; an agent acts by strand 0.
        log_pairs: ``log_pairs[c][k]`` is ``[A, N_k, N_c]``, log rows of strand ``c`` heeding ``k``.
        log_weights: ``[C, C]``, log of how much strand (row) heeds strand (column); None in a product.
        log_alone: ``[A, N_0, N_0]``, log transitions of strand 0 by itself.

    Raises:
        ValueError: shapes disagree.

    >>> one, two = StrandSpec(np.log([0.5, 0.5])), StrandSpec(np.zeros(1))
    >>> even, sure = np.full((1, 2, 2), np.log(0.5)), np.zeros((1, 1, 1))
    >>> pairs = ((even, even[:, :1]), (np.zeros((1, 2, 1)), sure))
    >>> print(CoupledSpec((one, two), pairs, None, even))
    CoupledSpec of strands of 2 and 1 states, 1 action, product coupling
      strand 0, state 0: starts 0.50, a0 -> 0 (.50) 1 (.50)
      strand 0, state 1: starts 0.50, a0 -> 0 (.50) 1 (.50)
      strand 1, state 0: starts 1.00, a0 -> 0 (1.0)
    """

    strands: tuple[StrandSpec, ...]
    log_pairs: tuple[tuple[np.ndarray, ...], ...]
    log_weights: np.ndarray | None
    log_alone: np.ndarray

    def __post_init__(self) -> None:
        pairs = tuple(
            tuple(frozen(f"log_pairs[{c}][{k}]", pair) for k, pair in enumerate(row))
            for c, row in enumerate(self.log_pairs)
        )
        object.__setattr__(self, "strands", tuple(self.strands))
        object.__setattr__(self, "log_pairs", pairs)
        object.__setattr__(self, "log_alone", frozen("log_alone", self.log_alone))
        if self.log_weights is not None:
            object.__setattr__(self, "log_weights", frozen("log_weights", self.log_weights))
        _check_shapes(self)

    @property
    def num_states(self) -> int:
        """Number of states of strand 0, which acts."""
        return self.strands[0].num_states

    @property
    def num_actions(self) -> int:
        """Number of actions, A."""
        return self.log_alone.shape[0]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of states of every strand."""
        return tuple(strand.num_states for strand in self.strands)

    def tables(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield every table of log rows between states, with its name."""
        yield "log_alone", self.log_alone
        for c, row in enumerate(self.log_pairs):
            yield from ((f"log_pairs[{c}][{k}]", pair) for k, pair in enumerate(row))
        if self.log_weights is not None:
            yield "log_weights", self.log_weights

    def arrays(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yield every array with its name."""
        yield from self.tables()
        for c, strand in enumerate(self.strands):
            yield from ((f"strands[{c}].{name}", array) for name, array in strand.arrays())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CoupledSpec):
            return NotImplemented
        mine, theirs = dict(self.arrays()), dict(other.arrays())
        kinds = [[c.kind for c in strand.emissions] for strand in self.strands]
        return (
            mine.keys() == theirs.keys()
            and kinds == [[c.kind for c in strand.emissions] for strand in other.strands]
            and all(np.array_equal(mine[name], theirs[name]) for name in mine)
        )

    __hash__ = None  # type: ignore[assignment]

    def __str__(self) -> str:
        sizes, actions = " and ".join(map(str, self.sizes)), self.num_actions
        rule = "product" if self.log_weights is None else "mixture"
        head = f"CoupledSpec of strands of {sizes} states, {actions} action{'s' * (actions != 1)}"
        states = [(c, n) for c, size in enumerate(self.sizes) for n in range(size)]
        lines = [_weights_line(self.log_weights)] if self.log_weights is not None else []
        return "\n".join([f"{head}, {rule} coupling", *lines, *(_state_line(self, c, n) for c, n in states)])


def validate(spec: CoupledSpec) -> None:
    """Stop unless the numbers make sense: finite, rows that sum to one, positive variances.

    Raises:
        ValueError: naming the array, the row, what was expected and what came.
    """
    for name, array in spec.arrays():
        if not np.isfinite(array).all():
            where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            raise ValueError(f"{name} must be finite, got NaN or infinity at {where}")
        if name.endswith(("log_init", "log_prob")):
            expect_rows(name, array)
        if name.endswith("return_var") and not (array > 0).all():
            raise ValueError(f"{name} must be positive, got {array.min()}")
    for name, array in spec.tables():
        expect_rows(name, array)


def _check_strand(strand: StrandSpec) -> None:
    expect_shape("log_init", strand.log_init, (None,))
    if strand.num_states < 1:
        raise ValueError("log_init must hold at least one state, got none")
    if (strand.return_mean is None) != (strand.return_var is None):
        raise ValueError("return_mean and return_var must both be given or both be None")
    for name, array in strand.arrays():
        expect_shape(name, array, (strand.num_states, *array.shape[1:]))
    if strand.return_mean is not None and strand.return_var is not None:
        expect_shape("return_mean", strand.return_mean, (strand.num_states, None))
        expect_shape("return_var", strand.return_var, strand.return_mean.shape)


def _check_shapes(spec: CoupledSpec) -> None:
    chains = len(spec.strands)
    if chains < 2:
        raise ValueError(f"strands must be at least two, got {chains}")
    if len(spec.log_pairs) != chains or any(len(row) != chains for row in spec.log_pairs):
        came = [len(row) for row in spec.log_pairs]
        raise ValueError(f"log_pairs must be {chains} by {chains}, one a pair, got {came}")
    sizes, actions = spec.sizes, spec.log_alone.shape[0]
    expect_shape("log_alone", spec.log_alone, (None, sizes[0], sizes[0]))
    for c, row in enumerate(spec.log_pairs):
        for k, pair in enumerate(row):
            expect_shape(f"log_pairs[{c}][{k}]", pair, (actions, sizes[k], sizes[c]))
    if spec.log_weights is not None:
        expect_shape("log_weights", spec.log_weights, (chains, chains))
    for c, strand in enumerate(spec.strands):
        columns = 1 if strand.return_mean is None else strand.return_mean.shape[1]
        if columns not in (1, actions):
            raise ValueError(f"strands[{c}].return_mean must have 1 or {actions} columns, got {columns}")


def _weights_line(log_weights: np.ndarray) -> str:
    rows = [" ".join(f"{w:.2f}" for w in row) for row in np.exp(log_weights)]
    return "  weights " + "; ".join(f"strand {c} heeds {row}" for c, row in enumerate(rows))


def _state_line(spec: CoupledSpec, c: int, n: int) -> str:
    """Describe one state: its start, its returns, and the likeliest successors by its strand's own rows."""
    strand = spec.strands[c]
    parts = [f"starts {np.exp(strand.log_init[n]):.2f}"]
    if strand.return_mean is not None and strand.return_var is not None:
        pairs = zip(strand.return_mean[n], np.sqrt(strand.return_var[n]), strict=True)
        parts.append("return " + ", ".join(f"{mean:.3g} +- {deviation:.2g}" for mean, deviation in pairs))
    parts.append("; ".join(exits_line(row, a) for a, row in enumerate(np.exp(spec.log_pairs[c][c][:, n]))))
    return f"  strand {c}, state {n}: {', '.join(parts)}"
