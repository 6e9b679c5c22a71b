"""Reading the .pomdpx format of the APPL tools: factored models in XML, flattened here to one state.

A state is one value for each ``StateVar``, the first varying slowest; so are actions and observations. A
state variable that is fully observed (``fullyObs="true"``) is part of the observation, behind the ``ObsVar``.
Tables (``TBL``) and decision diagrams (``DD``) are both read.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxpomdp.envs.pomdp_lexer import ANY, number_of, text_of
from jaxpomdp.envs.pomdp_rows import scaled
from jaxpomdp.envs.pomdp_tables import ParsedPOMDP, RewardRules
from jaxpomdp.envs.pomdpx_factors import Factor, Variable, read_factor
from jaxpomdp.envs.pomdpx_xml import Element, parse_xml

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_SEEN = "seen:"


def read_pomdpx(source: str | Path) -> ParsedPOMDP:
    """Read a .pomdpx file.

    Rewards become rules over the flattened states, for the moves and observations that can happen. Names of
    several variables are joined by ``_``.

    Args:
        source: a path, or the text itself (any string that holds a line end).

    Raises:
        PomdpError: not well-formed XML, an element missing or unknown, or a row that does not sum to one.
        FileNotFoundError: there is no such file.
    """
    return _Flattener(_Model(parse_xml(text_of(source)))).parsed()


class _Model:
    """The variables and factors of a file, as written."""

    def __init__(self, top: Element) -> None:
        if top.tag != "pomdpx":
            raise top.error("expected <pomdpx>")
        self.discount = number_of(top.find("Discount").text)
        if self.discount is None or not 0 <= self.discount <= 1:
            raise top.find("Discount").error(f"must lie in [0, 1], got {top.find('Discount').text.strip()!r}")
        self.variables: dict[str, Variable] = {}
        self.previous, self.current = [], []
        self.actions, self.sensors = [], []
        self._read_variables(top.find("Variable"))
        self.initial = self._conditionals(top.find("InitialStateBelief"), self.previous)
        self.moves = self._conditionals(top.find("StateTransitionFunction"), self.current)
        self.observing = self._conditionals(top.find("ObsFunction"), self.sensors) if self.sensors else []
        rewards = top.find("RewardFunction").find_all("Func")
        self.rewards = [read_factor(f, self.variables, drawn=False) for f in rewards]

    def _read_variables(self, parent: Element) -> None:
        for element in parent.find_all("StateVar"):
            variable = Variable(_values(element, "s"), element.attributes.get("fullyObs", "false") == "true")
            for attribute, names in (("vnamePrev", self.previous), ("vnameCurr", self.current)):
                self.variables[element.attribute(attribute)] = variable
                names.append(element.attribute(attribute))
        for tag, names, letter in (("ActionVar", self.actions, "a"), ("ObsVar", self.sensors, "o")):
            for element in parent.find_all(tag):
                self.variables[element.attribute("vname")] = Variable(_values(element, letter))
                names.append(element.attribute("vname"))
        if not self.previous or not self.actions:
            raise parent.error("expected at least one <StateVar> and one <ActionVar> inside")

    def _conditionals(self, parent: Element, drawn: list[str]) -> list[Factor]:
        """Return one distribution for each variable, in an order in which parents come first."""
        factors = {}
        for element in parent.find_all("CondProb"):
            factor = read_factor(element, self.variables, drawn=True)
            factors[factor.scope[-1]] = factor
        if set(factors) != set(drawn):
            raise parent.error(f"expected a <CondProb> for each of {drawn}, got {list(factors)}")
        ordered: list[Factor] = []
        while factors:
            free = [name for name, f in factors.items() if not set(f.scope[:-1]) & set(factors)]
            if not free:
                raise parent.error(f"variables must not depend on each other in a circle: {list(factors)}")
            ordered += [factors.pop(name) for name in free]
        return ordered


def _values(element: Element, letter: str) -> tuple[str, ...]:
    for child in element.find_all("ValueEnum"):
        return tuple(child.text.split())
    count = number_of(element.find("NumValues").text)
    if count is None or count < 1 or count != int(count):
        raise element.error("NumValues must be a whole number above 0")
    return tuple(f"{letter}{i}" for i in range(int(count)))


class _Moments(NamedTuple):
    """Many moments at once: for each variable its value at every moment, and the moments' probabilities."""

    values: dict[str, np.ndarray]
    prob: np.ndarray

    def draw(self, factor: Factor) -> _Moments:
        """Split every moment by the values that a variable can take."""
        shape = (len(self.prob), factor.table.shape[-1])
        rows = np.broadcast_to(factor.at(self.values, factor.scope[:-1]), shape)
        moment, value = np.nonzero(rows)
        values = {name: array[moment] for name, array in self.values.items()}
        return _Moments(values | {factor.scope[-1]: value}, self.prob[moment] * rows[moment, value])


class _Flattener:
    """Turns factors into tables over joint states, actions and observations."""

    def __init__(self, model: _Model) -> None:
        self.model = model
        self.seen = [name for name in model.current if model.variables[name].seen]
        self.num_states, self.num_actions = self._count(model.previous), self._count(model.actions)
        self.observed = model.sensors + self.seen

    def parsed(self) -> ParsedPOMDP:
        model = self.model
        actions = range(self.num_actions)
        transitions = tuple(self._transitions(a) for a in actions)
        observation_probs = tuple(self._observations(a) for a in actions)
        return ParsedPOMDP(
            states=self._joint_names(model.previous),
            actions=self._joint_names(model.actions),
            observations=self._joint_names(self.observed) if self.observed else ("nothing",),
            discount=model.discount,
            values="reward",
            start=self._start(),
            transitions=transitions,
            observation_probs=observation_probs,
            rewards=self._rewards(transitions, observation_probs),
        )

    def _sizes(self, names: Iterable[str]) -> list[int]:
        return [len(self.model.variables[name].values) for name in names]

    def _count(self, names: Iterable[str]) -> int:
        return math.prod(self._sizes(names))

    def _joint_names(self, names: list[str]) -> tuple[str, ...]:
        return tuple(map("_".join, itertools.product(*(self.model.variables[name].values for name in names))))

    def _digits(self, names: list[str], joint: np.ndarray) -> dict[str, np.ndarray]:
        return dict(zip(names, np.unravel_index(joint, self._sizes(names)), strict=True))

    def _joint(self, names: list[str], values: dict[str, np.ndarray]) -> np.ndarray:
        return np.ravel_multi_index([values[name] for name in names], self._sizes(names))

    def _acting(self, action: int, count: int) -> dict[str, np.ndarray]:
        return self._digits(self.model.actions, np.full(count, action))

    def _start(self) -> np.ndarray:
        moments = _Moments({}, np.ones(1))
        for factor in self.model.initial:
            moments = moments.draw(factor)
        start = np.zeros(self.num_states)
        np.add.at(start, self._joint(self.model.previous, moments.values), moments.prob)
        return start

    def _sparse(self, rows: np.ndarray, columns: np.ndarray, prob: np.ndarray, width: int) -> csr_array:
        from scipy.sparse import csr_array

        return scaled(csr_array((prob, (rows, columns)), shape=(self.num_states, width)))

    def _transitions(self, action: int) -> csr_array:
        everywhere = np.arange(self.num_states)
        values = self._digits(self.model.previous, everywhere) | self._acting(action, self.num_states)
        moments = _Moments(values, np.ones(self.num_states))
        for factor in self.model.moves:
            moments = moments.draw(factor)
        names = self.model.previous, self.model.current
        rows, columns = (self._joint(side, moments.values) for side in names)
        return self._sparse(rows, columns, moments.prob, self.num_states)

    def _observations(self, action: int) -> csr_array:
        everywhere = np.arange(self.num_states)
        moments = _Moments(
            self._digits(self.model.current, everywhere) | self._acting(action, self.num_states),
            np.ones(self.num_states),
        )
        for factor in self.model.observing:
            moments = moments.draw(factor)
        columns = self._joint(self.observed, moments.values) if self.observed else everywhere * 0
        rows = self._joint(self.model.current, moments.values)
        return self._sparse(rows, columns, moments.prob, self._count(self.observed))

    # --- rewards

    def _rewards(self, moves: tuple[csr_array, ...], seeing: tuple[csr_array, ...]) -> RewardRules:
        """Return one rule for each moment that pays, naming only what the factors depend on."""
        model = self.model
        used = {name for factor in model.rewards for name in factor.scope}
        axes = [bool(used & set(names)) for names in (model.previous, model.current, model.sensors)]
        blocks = [
            self._action_rewards(a, self._reward_moments(axes, moves[a], seeing[a]), axes)
            for a in range(self.num_actions)
        ]
        index, value = zip(*blocks, strict=True)
        return RewardRules(np.concatenate(index), np.concatenate(value))

    def _reward_moments(self, axes: list[bool], moves: csr_array, seeing: csr_array) -> list[np.ndarray]:
        """Return joint state left, arrived in and observation of all moments that can pay differently."""
        everywhere = np.arange(self.num_states)
        left = arrived = everywhere
        if axes[0] and (axes[1] or axes[2]):
            left, arrived = moves.tocoo().coords
        seen = np.zeros_like(arrived)
        if axes[2]:
            possible = seeing[arrived].tocoo()
            left, arrived, seen = left[possible.row], arrived[possible.row], possible.col
        return [left, arrived, seen]

    def _action_rewards(
        self, action: int, moments: list[np.ndarray], axes: list[bool]
    ) -> tuple[np.ndarray, np.ndarray]:
        left, arrived, seen = moments
        model = self.model
        values = self._digits(model.previous, left) | self._digits(model.current, arrived)
        values |= self._acting(action, len(left))
        if axes[2]:
            values |= {n: v for n, v in self._digits(self.observed, seen).items() if n in model.sensors}
        paid = np.zeros(len(left))
        for factor in model.rewards:
            paid = paid + factor.at(values, factor.scope)
        named = [np.where(used, joint, ANY) for used, joint in zip(axes, moments, strict=True)]
        index = np.stack([np.full(len(left), action), *named], axis=-1).astype(np.int64)
        index, where = np.unique(index[paid != 0], axis=0, return_index=True)
        return index, paid[paid != 0][where]
