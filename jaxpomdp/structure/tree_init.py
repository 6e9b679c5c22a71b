"""Where a tree starts: at random, diverse (leaves at many depths) or sober (branches of one kind)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from jaxpomdp.structure.spec import Channel, FlatSpec, safe_log
from jaxpomdp.structure.topology import nested
from jaxpomdp.structure.tree import TreeSpec, allowed_horizontal, allowed_vertical

Form = Literal["diverse", "sober"]
LEAST = 1e-6
"""No possible entry starts below this: a zero would be structural, and stay."""


def random_tree(
    seed: int | np.random.Generator,
    states: int = 20,
    actions: int = 1,
    observations: int = 2,
    *,
    levels: int = 3,
    form: Form = "diverse",
    shape: Sequence[Any] | None = None,
    vertical_by_action: bool = False,
    return_by_action: bool = False,
    concentration: float = 1.0,
) -> TreeSpec:
    """Draw a tree: its shape, and every row of probabilities from a symmetric Dirichlet distribution.

    The thesis (6.4) starts from 20 production states and up to three levels.

    Args:
        seed: an integer, or a generator.
        states: leaves.
        actions: how many actions.
        observations: how many symbols.
        levels: depth of the deepest leaf at most.
        form: see ``random_shape``.
        shape: nested lists of the leaves 0 .. states-1, as ``[0, [1, 2]]``; drawn as ``levels`` and ``form``
            say if None.
        vertical_by_action: vertical transitions depend on the action.
        return_by_action: returns are modelled per leaf and action.
        concentration: the Dirichlet's parameter.

    Raises:
        ValueError: a size is below one, the form is unknown, or the shape is of other leaves.

    >>> tree = random_tree(0)
    >>> tree.num_states, int(tree.depth.max())
    (20, 3)
    """
    _check_sizes(states=states, actions=actions, observations=observations, levels=levels)
    rng = np.random.default_rng(seed)
    table = rng.dirichlet(np.full(observations, concentration), states)
    table = np.maximum(table, LEAST)
    columns = actions if return_by_action else 1
    flat = FlatSpec(
        np.full(states, -np.log(states)),
        np.full((actions, states, states), -np.log(states)),
        (Channel("Categorical", {"log_prob": np.log(table / table.sum(-1, keepdims=True))}),),
        0.1 * rng.normal(size=(states, columns)),
        np.ones((states, columns)),
    )
    return tree_over(
        rng,
        flat,
        levels=levels,
        form=form,
        shape=shape,
        vertical_by_action=vertical_by_action,
        concentration=concentration,
    )


def tree_over(
    seed: int | np.random.Generator,
    flat: FlatSpec,
    *,
    levels: int = 3,
    form: Form = "diverse",
    shape: Sequence[Any] | None = None,
    vertical_by_action: bool = False,
    concentration: float = 1.0,
) -> TreeSpec:
    """Put a random tree over the states of a flat model, which keep their emissions and returns.

    Its transitions are drawn anew (arguments as ``random_tree``).

    Raises:
        ValueError: a size is below one, the form is unknown, or the shape is of other leaves.
    """
    _check_sizes(levels=levels)
    rng = np.random.default_rng(seed)
    parents = nested(random_shape(rng, flat.num_states, levels, form) if shape is None else shape)
    if len(parents[0]) != flat.num_states:
        raise ValueError(f"shape must hold {flat.num_states} leaves, got {len(parents[0])}")
    n, internal, a = flat.num_states, len(parents[1]), flat.num_actions
    tables = a + 1 if vertical_by_action else 1
    m, dtype = n + internal, flat.log_trans.dtype
    blank = np.zeros((tables, internal, m)), np.zeros((a, m, m + 1))
    empty = TreeSpec(
        parents[0], parents[1], blank[0], blank[1], flat.emissions, flat.return_mean, flat.return_var
    )
    vertical = _random_rows(rng, allowed_vertical(empty), tables, concentration)
    horizontal = _random_rows(rng, allowed_horizontal(empty), a, concentration)
    if tables > 1:
        vertical[:-1, 0] = 0
    down, across = safe_log(vertical).astype(dtype), safe_log(horizontal).astype(dtype)
    return replace(empty, log_vertical=down, log_horizontal=across)


def random_shape(rng: np.random.Generator, states: int, levels: int, form: Form = "diverse") -> list[Any]:
    """Return nested lists of the leaves 0 .. states-1, at most ``levels`` deep.

    ``diverse``: every internal state divides its leaves at random among two to five children, at every depth.
    ``sober``: two levels, about as many branches as leaves in each.

    Raises:
        ValueError: the form is unknown.
    """
    leaves = list(range(states))
    if form == "diverse":
        return _divided(rng, leaves, levels)
    if form != "sober":
        raise ValueError(f"form must be 'diverse' or 'sober', got {form!r}")
    branches = int(np.sqrt(states)) if levels > 1 else 1
    if branches < 2:
        return leaves
    return [part.tolist() for part in np.array_split(np.array(leaves), branches)]


def _divided(rng: np.random.Generator, leaves: list[int], levels: int) -> list[Any]:
    if levels <= 1 or len(leaves) <= 2:
        return leaves
    parts = int(rng.integers(2, min(5, len(leaves) - 1) + 1))
    cuts = np.sort(rng.choice(np.arange(1, len(leaves)), parts - 1, replace=False))
    groups = [[int(leaf) for leaf in group] for group in np.split(np.array(leaves), cuts)]
    return [group[0] if len(group) == 1 else _divided(rng, group, levels - 1) for group in groups]


def _random_rows(
    rng: np.random.Generator, places: np.ndarray, tables: int, concentration: float
) -> np.ndarray:
    """Return ``[tables, rows, columns]``: Dirichlet rows over the allowed places, zeros elsewhere."""
    weight = np.maximum(rng.gamma(concentration, size=(tables, *places.shape)), LEAST) * places
    total = weight.sum(-1, keepdims=True)
    return weight / np.where(total > 0, total, 1)


def _check_sizes(**sizes: int) -> None:
    for name, size in sizes.items():
        if size < 1:
            raise ValueError(f"{name} must be at least 1, got {size}")
