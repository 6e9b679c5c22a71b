"""A POMDP as written in a file: names, sparse tables, and rewards as the rules that the file gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxpomdp.envs.pomdp_lexer import ANY, Note

if TYPE_CHECKING:
    from scipy.sparse import csr_array


class RewardRules(NamedTuple):
    """Rewards as ``M`` rules in the order written; a later one overrides an earlier one, no rule means 0.

    Attributes:
        index: int64 ``[M, 4]``: action, state left, state arrived in, observation; ``ANY`` = whatever it is.
        value: float64 ``[M]``.
    """

    index: np.ndarray
    value: np.ndarray

    def depends_on(self, axis: int) -> bool:
        """Say whether a rule names the action (0), state left (1), arrived in (2) or observation (3)."""
        return bool(np.any(self.index[:, axis] != ANY))

    def lookup(self, action: Any, state: Any, arrived: Any, observation: Any) -> np.ndarray:
        """Return the rewards of many moments at once, float64 in the broadcast shape of the arguments.

        Rules are gathered by which of the four they name; each such kind is one sorted table of keys.

        Example:
            >>> rules = RewardRules(np.array([[ANY, 0, ANY, ANY], [1, 0, ANY, ANY]]), np.array([5.0, 7.0]))
            >>> rules.lookup([0, 1, 1], [0, 0, 2], 0, 0)
            array([5., 7., 0.])
        """
        arrays = np.broadcast_arrays(action, state, arrived, observation)
        moment = np.stack([np.ravel(x) for x in arrays], axis=-1).astype(np.int64)
        latest = np.full(len(moment), -1, np.int64)
        named = self.index != ANY
        for kind in sorted({tuple(row) for row in named.tolist()}):
            rules = np.flatnonzero(np.all(named == kind, axis=1))
            axes = np.flatnonzero(kind)
            latest = np.maximum(latest, _latest(self.index[rules][:, axes], rules, moment[:, axes]))
        value = np.append(self.value, 0.0)[latest]
        return value.reshape(arrays[0].shape)


def _latest(keys: np.ndarray, rules: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return for each wanted key the last of the ``rules`` that has it, or -1."""
    if keys.shape[1] == 0:
        return np.full(len(wanted), rules[-1])
    sizes = np.maximum(keys.max(axis=0), wanted.max(axis=0, initial=0)) + 1
    flat, flat_wanted = (np.asarray(np.ravel_multi_index(tuple(x.T), tuple(sizes))) for x in (keys, wanted))
    order = np.argsort(flat, kind="stable")
    place = np.searchsorted(flat[order], flat_wanted, side="right") - 1
    found = order[np.maximum(place, 0)]
    return np.where((place >= 0) & (flat[found] == flat_wanted), rules[found], -1)


@dataclass(frozen=True, eq=False)
class ParsedPOMDP:
    """What a .POMDP or .pomdpx file says, with ``N`` states, ``A`` actions, ``O`` observations.

    Attributes:
        states, actions, observations: names; ``"0", "1", ...`` where the file only counts.
        discount: as given, or None without a discount line.
        values: ``"reward"`` or ``"cost"``; rewards are kept as written, so costs are positive.
        start: float64 ``[N]``.
        transitions: for each action a sparse float64 ``[N, N]`` (row: from, column: to).
        observation_probs: for each action a sparse float64 ``[N, O]``, at the state arrived in.
        rewards: the rules, with their dependence on the next state and the observation kept.
        end_states: the states after which nothing happens (``E:`` lines).
        notes: what was mended or assumed.
    """

    states: tuple[str, ...]
    actions: tuple[str, ...]
    observations: tuple[str, ...]
    discount: float | None
    values: str
    start: np.ndarray
    transitions: tuple[csr_array, ...]
    observation_probs: tuple[csr_array, ...]
    rewards: RewardRules
    end_states: tuple[int, ...] = ()
    notes: tuple[Note, ...] = ()

    @property
    def num_states(self) -> int:
        """``N``."""
        return len(self.states)

    @property
    def num_actions(self) -> int:
        """``A``."""
        return len(self.actions)

    @property
    def num_observations(self) -> int:
        """``O``."""
        return len(self.observations)

    def transition_rewards(self, action: int) -> np.ndarray:
        """Return ``r(s, a, s') = sum_o P(o | a, s') r(a, s, s', o)`` for the stored transitions of an action.

        Returns:
            float64, one value for each entry of ``transitions[action].tocoo()``, in its order.
        """
        moves = self.transitions[action].tocoo()
        if not self.rewards.depends_on(3):
            return self.rewards.lookup(action, moves.row, moves.col, 0)
        seen = self.observation_probs[action].toarray()
        everything = np.arange(self.num_observations)
        paid = self.rewards.lookup(action, moves.row[:, None], moves.col[:, None], everything[None, :])
        return np.sum(paid * seen[moves.col], axis=1)

    def expected_rewards(self) -> np.ndarray:
        """Return ``r(a, s) = sum_s' P(s' | s, a) r(s, a, s')``, float64 ``[A, N]``, as written."""
        table = np.zeros((self.num_actions, self.num_states))
        for action, matrix in enumerate(self.transitions):
            moves = matrix.tocoo()
            np.add.at(table[action], moves.row, moves.data * self.transition_rewards(action))
        return table

    def observation_depends_on_action(self) -> bool:
        """Say whether ``P(o | a, s)`` differs between actions."""
        first = self.observation_probs[0]
        return any(x is not first and abs(x - first).max() > 0 for x in self.observation_probs[1:])
