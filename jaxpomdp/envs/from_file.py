"""Worlds from parsed .POMDP and .pomdpx files."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxpomdp.envs.build import Tables, assemble
from jaxpomdp.envs.world import World

if TYPE_CHECKING:
    from jaxpomdp.envs.pomdp_tables import ParsedPOMDP

USUAL_DISCOUNT = 0.95
"""Taken where the file has no discount line."""

_SAME = 1e-4
"""How far a row of a file may be from the start vector and still be a reset; files round."""


def from_pomdp(
    parsed: ParsedPOMDP, *, name: str = "file", step_limit: int = 251, success_above: float = 0.0
) -> World:
    """Make a world of a parsed file.

    Files run for ever and start again by themselves; a world has trials. A trial ends in a state that the
    file marks with ``E:``, that keeps the agent for ever without pay, or from which every action leads back
    to the start (and where no trial begins). If leaving such a state pays, that is earned first, on the way
    to one more state with an observation of its own, ``end``. Costs become negative rewards, and a reward
    that depends on the observation its expectation. Where the observation depends on the action a trial
    begins with one more observation, ``start``, which tells nothing.

    Args:
        parsed: what the file says.
        name: of the world.
        step_limit: actions in a trial at most.
        success_above: a trial that ends with a last reward above this is a success.
    """
    tables = _tables(parsed)
    over = _over(parsed, tables)
    paid = over & np.any(tables.prob * tables.reward != 0, axis=(0, 2))
    paid[list(parsed.end_states)] = False
    observation, names = _observations(parsed)
    start, terminal = parsed.start, over & ~paid
    if paid.any():
        tables = _with_end(tables, paid)
        observation, names = _with_end_symbol(observation), (*names, "end")
        start, terminal = np.append(start, 0.0), np.append(terminal, True)
    first = None
    if observation.shape[0] > 1:
        observation, first = _with_start_symbol(observation)
        names = (*names, "start")
    return assemble(
        _stay(tables, terminal),
        observation,
        start,
        terminal,
        first_observation=first,
        name=name,
        discount=USUAL_DISCOUNT if parsed.discount is None else parsed.discount,
        step_limit=step_limit,
        success_above=success_above,
        action_names=tuple(parsed.actions),
        observation_names=names,
    )


def _tables(parsed: ParsedPOMDP) -> Tables:
    """Pad the sparse rows of the file to ``[A, N, K]``."""
    sign = -1.0 if parsed.values == "cost" else 1.0
    rows = [matrix.tocoo() for matrix in parsed.transitions]
    width = max(1, *(int(np.bincount(row.row).max(initial=0)) for row in rows))
    shape = (parsed.num_actions, parsed.num_states, width)
    successors = np.broadcast_to(np.arange(parsed.num_states)[None, :, None], shape).copy()
    tables = Tables(successors, np.zeros(shape), np.zeros(shape))
    for action, row in enumerate(rows):
        order = np.argsort(row.row, kind="stable")
        state = row.row[order]
        place = (action, state, _position_in_run(state))
        tables.successors[place], tables.prob[place] = row.col[order], row.data[order]
        tables.reward[place] = sign * parsed.transition_rewards(action)[order]
    return tables


def _position_in_run(sorted_keys: np.ndarray) -> np.ndarray:
    """Return 0, 1, 2, ... within each run of equal keys."""
    begins = np.searchsorted(sorted_keys, sorted_keys, side="left")
    return np.arange(len(sorted_keys)) - begins


def _over(parsed: ParsedPOMDP, tables: Tables) -> np.ndarray:
    """Mark the states that end a trial, bool ``[N]``."""
    kept = np.all(_prob_of_staying(tables) > 1 - _SAME, axis=0)
    idle = kept & ~np.any(tables.prob * tables.reward != 0, axis=(0, 2))
    resets = np.ones(parsed.num_states, bool)
    for matrix in parsed.transitions:
        resets &= abs(matrix - parsed.start[None, :]).max(axis=1) < _SAME
    over = (idle | resets) & (parsed.start == 0)
    over[list(parsed.end_states)] = True
    return over


def _prob_of_staying(tables: Tables) -> np.ndarray:
    own = tables.successors == np.arange(tables.prob.shape[1])[None, :, None]
    return np.sum(tables.prob * own, axis=-1)


def _with_end(tables: Tables, paid: np.ndarray) -> Tables:
    """Add one state, last, that the ``paid`` states lead to with the reward expected of leaving them."""
    num_states = tables.prob.shape[1]
    earned = np.sum(tables.prob * tables.reward, axis=-1)
    more = [(0, 0), (0, 1), (0, 0)]
    successors, prob, reward = (np.pad(x, more) for x in tables)
    leaving = np.append(paid, False)
    for array in (prob, reward):
        array[:, leaving] = 0
    successors[:, leaving] = num_states
    prob[:, leaving, 0], reward[:, leaving, 0] = 1, earned[:, paid]
    return Tables(successors, prob, reward)


def _stay(tables: Tables, terminal: np.ndarray) -> Tables:
    """Make terminal states keep the agent for nothing."""
    successors, prob, reward = (x.copy() for x in tables)
    successors[:, terminal] = np.flatnonzero(terminal)[None, :, None]
    prob[:, terminal], reward[:, terminal] = 0, 0
    prob[:, terminal, 0] = 1
    return Tables(successors, prob, reward)


def _observations(parsed: ParsedPOMDP) -> tuple[np.ndarray, tuple[str, ...]]:
    tables = (
        parsed.observation_probs if parsed.observation_depends_on_action() else parsed.observation_probs[:1]
    )
    return np.stack([table.toarray() for table in tables]), tuple(parsed.observations)


def _with_end_symbol(observation: np.ndarray) -> np.ndarray:
    """Add one state and one observation that only it shows."""
    wider = np.pad(observation, [(0, 0), (0, 1), (0, 1)])
    wider[:, -1, -1] = 1
    return wider


def _with_start_symbol(observation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add one observation that only a reset shows, in every state."""
    wider = np.pad(observation, [(0, 0), (0, 0), (0, 1)])
    first = np.zeros(wider.shape[1:])
    first[:, -1] = 1
    return wider, first
