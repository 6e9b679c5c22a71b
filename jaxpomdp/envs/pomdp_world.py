"""Between model files and worlds."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxpomdp.envs.build import Tables, assemble
from jaxpomdp.envs.pomdp_file import read_pomdp
from jaxpomdp.envs.pomdp_rows import scaled
from jaxpomdp.envs.pomdp_tables import ANY, ParsedPOMDP, RewardRules
from jaxpomdp.envs.pomdpx import read_pomdpx
from jaxpomdp.envs.world import World, model_of

FIRST_SYMBOL = "nothing-yet"
"""What an agent sees at a reset where observations belong to actions."""

_SAME = 1e-9


def from_pomdp(
    parsed: ParsedPOMDP,
    *,
    goal_states: Iterable[str | int] | str = (),
    name: str = "pomdp",
    discount: float | None = None,
    step_limit: int = 251,
    success_above: float = 0.0,
) -> World:
    """Return the world of a model file, cut into trials.

    Files describe one endless life. A trial ends in a state that is terminal: one of the ``E:`` lines, one
    that no action leaves and that pays nothing, or one of ``goal_states``. A goal's own reward, paid in the
    file for leaving it whatever the action, is paid here for entering it, since nobody acts there; what a
    goal that is never left would pay for ever is dropped. Costs become negative rewards. Rewards that depend
    on the observation are averaged over it: ``sum_o P(o | a, s') r(a, s, s', o)``.

    The observation at a reset is that of the start state, or, where observations depend on the action, a
    symbol of its own that is put behind the others.

    Args:
        parsed: from ``read_pomdp`` or ``read_pomdpx``.
        goal_states: names or numbers of states that end a trial when entered, or ``"reset"`` for the states
            from which every action leads back to the start distribution, as the goals of hallway2 do.
        name: of the world.
        discount: by default the file's.
        step_limit: of the world.
        success_above: of the world.

    Raises:
        ValueError: a goal is unknown or pays differently for different actions, or there is no discount.
    """
    if discount is None and parsed.discount is None:
        raise ValueError("discount must be given, since the file has no discount line")
    goals = _goals(parsed, goal_states)
    terminal = goals | (_for_ever(parsed) & np.all(parsed.expected_rewards() == 0, axis=0))
    terminal[list(parsed.end_states)] = True
    observation, first = _observations(parsed)
    extra = () if first is None else (FIRST_SYMBOL,)
    return assemble(
        _outcomes(parsed, terminal, _bonus(parsed, goals)),
        observation,
        parsed.start,
        terminal,
        first_observation=first,
        name=name,
        discount=parsed.discount if discount is None else discount,
        step_limit=step_limit,
        success_above=success_above,
        action_names=parsed.actions,
        observation_names=parsed.observations + extra,
    )


def read_world(path: str | Path, **settings: Any) -> World:
    """Return the world of a .POMDP or .pomdpx file, named after the file.

    Args:
        path: ends in ``.pomdpx`` for that format; anything else is read as .POMDP.
        **settings: of :func:`from_pomdp`; here ``goal_states`` is ``"reset"`` unless given.

    Raises:
        PomdpError: the file cannot be read.
        ValueError: it cannot be cut into trials as asked.
    """
    path = Path(path)
    parsed = read_pomdpx(path) if path.suffix.lower() == ".pomdpx" else read_pomdp(path)
    return from_pomdp(parsed, **{"goal_states": "reset", "name": path.stem, **settings})


def reset_states(parsed: ParsedPOMDP) -> np.ndarray:
    """Return the mask, bool ``[N]``, of the states that every action leaves by the start distribution."""
    mask = np.ones(parsed.num_states, bool)
    for matrix in parsed.transitions:
        for state in np.flatnonzero(mask):
            row = np.zeros(parsed.num_states)
            entries = slice(*matrix.indptr[state : state + 2])
            row[matrix.indices[entries]] = matrix.data[entries]
            mask[state] = np.abs(row - parsed.start).max() < _SAME
    return mask


def _goals(parsed: ParsedPOMDP, goal_states: Iterable[str | int] | str) -> np.ndarray:
    if isinstance(goal_states, str):
        if goal_states != "reset":
            raise ValueError(f"goal_states must be states or 'reset', got {goal_states!r}")
        return reset_states(parsed)
    mask = np.zeros(parsed.num_states, bool)
    for state in goal_states:
        index = parsed.states.index(state) if isinstance(state, str) and state in parsed.states else state
        if not isinstance(index, int | np.integer) or not 0 <= index < parsed.num_states:
            raise ValueError(f"goal_states must be among the {parsed.num_states} states, got {state!r}")
        mask[index] = True
    return mask


def _sign(parsed: ParsedPOMDP) -> float:
    return -1.0 if parsed.values == "cost" else 1.0


def _for_ever(parsed: ParsedPOMDP) -> np.ndarray:
    """Return the mask of the states that no action leaves."""
    stays = [np.asarray(matrix.diagonal()) >= 1 - _SAME for matrix in parsed.transitions]
    return np.all(stays, axis=0)


def _bonus(parsed: ParsedPOMDP, goals: np.ndarray) -> np.ndarray:
    """Return what entering each state pays beyond the transition, ``[N]``: a goal's reward for leaving it."""
    leaving = parsed.expected_rewards()
    left = goals & ~_for_ever(parsed)
    differs = left & (np.ptp(leaving, axis=0) > _SAME)
    if differs.any():
        state = parsed.states[int(np.flatnonzero(differs)[0])]
        raise ValueError(f"goal_states must pay the same for every action on leaving, {state!r} does not")
    return np.where(left, _sign(parsed) * leaving[0], 0.0)


def _outcomes(parsed: ParsedPOMDP, terminal: np.ndarray, bonus: np.ndarray) -> Tables:
    width = max(1, *(int(np.diff(matrix.indptr).max()) for matrix in parsed.transitions))
    shape = (parsed.num_actions, parsed.num_states, width)
    successors = np.broadcast_to(np.arange(parsed.num_states)[None, :, None], shape).copy()
    prob, reward = np.zeros(shape), np.zeros(shape)
    for a, matrix in enumerate(parsed.transitions):
        moves = matrix.tocoo()
        place = np.arange(len(moves.row)) - matrix.indptr[moves.row]
        successors[a, moves.row, place] = moves.col
        prob[a, moves.row, place] = moves.data
        reward[a, moves.row, place] = _sign(parsed) * parsed.transition_rewards(a) + bonus[moves.col]
    successors[:, terminal] = np.flatnonzero(terminal)[None, :, None]
    prob[:, terminal] = np.eye(1, width)
    reward[:, terminal] = 0
    return Tables(successors, prob, reward)


def _observations(parsed: ParsedPOMDP) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the observation table and, where it depends on the action, the one for a reset."""
    if not parsed.observation_depends_on_action():
        return parsed.observation_probs[0].toarray()[None], None
    table = np.stack([matrix.toarray() for matrix in parsed.observation_probs])
    table = np.concatenate([table, np.zeros((*table.shape[:2], 1))], axis=-1)
    first = np.zeros(table.shape[1:])
    first[:, -1] = 1
    return table, first


def to_pomdp(world: World) -> ParsedPOMDP:
    """Return a world as the content of a .POMDP file, for other solvers; ``write_pomdp`` writes it.

    Terminal states keep the agent for ever and are listed as end states (``E:``). Rewards become one rule for
    each action, state and successor: the mean over outcomes that agree in these. The observation at a reset,
    the noise on rewards and the step limit have no place in the format and are left out.
    """
    from scipy.sparse import csr_array

    model = model_of(world)
    trans, obs = np.asarray(model.trans, np.float64), np.asarray(model.obs, np.float64)
    seen = [scaled(csr_array(table)) for table in obs]
    return ParsedPOMDP(
        states=tuple(map(str, range(world.num_states))),
        actions=tuple(name.replace(" ", "-") for name in world.action_names),
        observations=tuple(_one_word(name) for name in world.observation_names),
        discount=world.discount,
        values="reward",
        start=np.asarray(world.start_prob, np.float64) / np.sum(np.asarray(world.start_prob, np.float64)),
        transitions=tuple(scaled(csr_array(table)) for table in trans),
        observation_probs=tuple(seen * world.num_actions if len(seen) == 1 else seen),
        rewards=_rules_of(world, trans),
        end_states=tuple(np.flatnonzero(np.asarray(world.terminal)).tolist()),
    )


def _one_word(name: str) -> str:
    return "-".join(name.replace(":", " ").replace("#", " ").split())


def _rules_of(world: World, trans: np.ndarray) -> RewardRules:
    prob, paid = (np.asarray(x, np.float64) for x in (world.transition_prob, world.reward))
    a, s, k = np.nonzero((prob > 0) & (paid != 0))
    arrived = np.asarray(world.successors)[a, s, k]
    total = np.zeros_like(trans)
    np.add.at(total, (a, s, arrived), prob[a, s, k] * paid[a, s, k])
    a, s, arrived = np.nonzero(total)
    index = np.stack([a, s, arrived, np.full_like(a, ANY)], axis=-1)
    return RewardRules(index, total[a, s, arrived] / trans[a, s, arrived])
