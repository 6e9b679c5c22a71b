"""Variables of a .pomdpx file and the tables over them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jaxpomdp.envs.pomdp_lexer import number_of
from jaxpomdp.envs.pomdp_rows import EXACT, TOLERANCE
from jaxpomdp.envs.pomdpx_xml import Element


class Variable(NamedTuple):
    """One factor of the state, action or observation: its values, and whether the agent sees it (states)."""

    values: tuple[str, ...]
    seen: bool = False


class Factor(NamedTuple):
    """A dense table over named variables; for probabilities the last is the one that is drawn.

    Attributes:
        scope: names of the variables, one for each axis.
        table: float64.
    """

    scope: tuple[str, ...]
    table: np.ndarray

    def at(self, values: Mapping[str, np.ndarray], scope: Sequence[str]) -> np.ndarray:
        """Return the table at many values at once, over the variables of ``scope``; further axes stay."""
        return self.table[tuple(values[name] for name in scope)] if scope else self.table[None]


Variables = Mapping[str, Variable]


def read_factor(element: Element, variables: Variables, *, drawn: bool) -> Factor:
    """Read a ``CondProb`` (``drawn``: a distribution of its ``Var`` given its parents) or a ``Func``.

    Raises:
        PomdpError: an unknown variable or value, numbers that do not fit, or a row that does not sum to one.
    """
    parents = [word for word in element.find("Parent").text.split() if word != "null"]
    scope = tuple(parents + element.find("Var").text.split()[:1] * drawn)
    for name in scope:
        if name not in variables:
            raise element.error(f"expected one of the variables {', '.join(variables)}, got {name!r}")
    parameter = element.find("Parameter")
    table = np.zeros([len(variables[name].values) for name in scope])
    kind = parameter.attributes.get("type", "TBL")
    if kind not in ("TBL", "DD"):
        raise parameter.error(f"type must be TBL or DD, got {kind!r}")
    filler = _TableFiller(scope, variables, table)
    if kind == "TBL":
        for entry in parameter.find_all("Entry"):
            filler.fill_entry(entry)
    else:
        filler.fill_diagram(parameter)
    return Factor(scope, _checked(table, scope, variables, element) if drawn else table)


def _checked(table: np.ndarray, scope: Sequence[str], variables: Variables, element: Element) -> np.ndarray:
    total = table.sum(axis=-1)
    wrong = np.argwhere(np.abs(total - 1) > TOLERANCE)
    if wrong.size or np.any(table < 0):
        where = tuple(wrong[0]) if wrong.size else ()
        values = [f"{name} = {variables[name].values[i]}" for name, i in zip(scope, where, strict=False)]
        given = ", ".join(values) or "nothing"
        raise element.error(f"P({scope[-1]} | {given}) must be positive and sum to 1, got {total[where]}")
    return np.where(np.abs(total - 1)[..., None] > EXACT, table / total[..., None], table)


class _TableFiller:
    """Fills a dense table from entries with patterns, or from a decision diagram."""

    def __init__(self, scope: tuple[str, ...], variables: Variables, table: np.ndarray) -> None:
        self.scope, self.variables, self.table = scope, variables, table
        self.templates: dict[str, Element] = {}

    def _value(self, axis: int, word: str, element: Element) -> int:
        known = self.variables[self.scope[axis]].values
        if word not in known:
            shown = ", ".join(known[:8])
            raise element.error(f"expected a value of {self.scope[axis]} ({shown}), got {word!r}")
        return known.index(word)

    def fill_entry(self, entry: Element) -> None:
        """Write one entry: ``*`` repeats the numbers, ``-`` runs over them, row by row."""
        instance = entry.find("Instance")
        words = instance.text.split()
        if len(words) != len(self.scope):
            message = f"expected {len(self.scope)} words, one for each of {self.scope}, got {words}"
            raise instance.error(message)
        where = tuple(
            slice(None) if word in "*-" else slice(i := self._value(axis, word, instance), i + 1)
            for axis, word in enumerate(words)
        )
        spread = [n if word == "-" else 1 for n, word in zip(self.table.shape, words, strict=True)]
        numbers = next(entry.find_all("ProbTable", "ValueTable"), None)
        if numbers is None:
            raise entry.error("expected a <ProbTable> or <ValueTable> inside")
        self.table[where] = self._numbers(numbers, spread)

    def _numbers(self, element: Element, shape: list[int]) -> np.ndarray:
        words = element.text.split()
        if words == ["uniform"]:
            return np.full([1] * len(shape), 1 / self.table.shape[-1])
        if words == ["identity"]:
            sides = [n for n in shape if n > 1]
            if len(sides) != 2 or sides[0] != sides[1]:
                raise element.error(f"identity needs two '-' of the same size, got sizes {sides}")
            return np.eye(sides[0]).reshape(shape)
        values = [number_of(word) for word in words]
        bad = next((word for word, value in zip(words, values, strict=True) if value is None), None)
        if bad is not None or len(values) != math.prod(shape):
            got = f"{len(values)} numbers" if bad is None else repr(bad)
            raise element.error(f"expected {math.prod(shape)} numbers, got {got}")
        return np.array(values, np.float64).reshape(shape)

    def fill_diagram(self, parameter: Element) -> None:
        """Write a decision diagram: every path from the top fixes some variables and ends in a number."""
        self.templates = {t.attribute("id"): t for t in parameter.find_all("SubDAGTemplate")}
        self._fill_children(parameter.find("DAG"), self.table, self.scope, 0)

    def _fill_children(self, above: Element, part: np.ndarray, scope: tuple[str, ...], depth: int) -> None:
        if len(above.children) != 1 or depth > 1000:
            raise above.error("expected exactly one element inside")
        self._fill(above.children[0], part, scope, depth)

    def _fill(self, node: Element, part: np.ndarray, scope: tuple[str, ...], depth: int) -> None:
        """Write ``node`` into ``part``, a view of the table over the variables that are still open."""
        if node.tag == "Terminal":
            value = number_of(node.text)
            if value is None:
                raise node.error(f"expected a number, got {node.text!r}")
            part[...] = value
        elif node.tag == "Node":
            axis = self._axis(node, scope)
            for edge in node.find_all("Edge"):
                index = self._value(self.scope.index(scope[axis]), edge.attribute("val"), edge)
                rest = part[(slice(None),) * axis + (slice(index, index + 1),)].squeeze(axis)
                self._fill_children(edge, rest, scope[:axis] + scope[axis + 1 :], depth + 1)
        elif node.tag == "SubDAG":
            self._fill_shorthand(node, part, scope, depth)
        else:
            raise node.error("expected <Node>, <Terminal> or <SubDAG>")

    def _axis(self, node: Element, scope: tuple[str, ...]) -> int:
        if node.attribute("var") not in scope:
            raise node.error(f"expected one of the open variables {scope}, got {node.attribute('var')!r}")
        return scope.index(node.attribute("var"))

    def _fill_shorthand(self, node: Element, part: np.ndarray, scope: tuple[str, ...], depth: int) -> None:
        kind = node.attribute("type")
        if kind == "template":
            template = self.templates.get(node.attribute("idref"))
            if template is None:
                raise node.error(f"expected one of the templates {list(self.templates)}")
            return self._fill_children(template, part, scope, depth + 1)
        axis = self._axis(node, scope)
        last = np.moveaxis(part, axis, -1)
        if kind == "uniform":
            last[...] = 1 / last.shape[-1]
        elif kind == "deterministic":
            last[...] = 0
            last[..., self._value(self.scope.index(scope[axis]), node.attribute("val"), node)] = 1
        elif kind == "persistent":
            variable = self.variables[scope[axis]]
            same = [i for i, name in enumerate(scope) if i != axis and self.variables[name] is variable]
            if len(same) != 1:
                raise node.error("persistent needs the variable's previous value among the parents")
            np.moveaxis(part, (same[0], axis), (-2, -1))[...] = np.eye(part.shape[axis])
        else:
            raise node.error(f"type must be uniform, deterministic, persistent or template, got {kind!r}")
