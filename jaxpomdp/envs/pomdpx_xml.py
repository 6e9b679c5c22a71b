"""The smallest XML tree that still knows the line and column of every element."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from xml.parsers import expat

from jaxpomdp.envs.pomdp_lexer import PomdpError


@dataclasses.dataclass
class Element:
    """A tag with attributes, the text directly inside, and its children, seen at ``line`` and ``column``."""

    tag: str
    attributes: dict[str, str]
    line: int
    column: int
    text: str = ""
    children: list[Element] = dataclasses.field(default_factory=list)

    def error(self, message: str) -> PomdpError:
        """Return the error to raise about this element."""
        return PomdpError(self.line, self.column, f"<{self.tag}>: {message}")

    def find_all(self, *tags: str) -> Iterator[Element]:
        """Give the children with one of the tags."""
        return (child for child in self.children if child.tag in tags)

    def find(self, tag: str) -> Element:
        """Return the first child with a tag.

        Raises:
            PomdpError: there is none.
        """
        for child in self.find_all(tag):
            return child
        raise self.error(f"expected a <{tag}> inside")

    def attribute(self, name: str) -> str:
        """Return an attribute.

        Raises:
            PomdpError: there is none of this name.
        """
        if name not in self.attributes:
            raise self.error(f"expected the attribute {name!r}")
        return self.attributes[name]


def parse_xml(text: str) -> Element:
    """Read XML into a tree. Entity declarations are refused, so a short text cannot grow into a long one.

    Raises:
        PomdpError: the text is not well-formed XML.
    """
    top = Element("", {}, 1, 1)
    stack = [top]
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        element = Element(tag, attributes, parser.CurrentLineNumber, parser.CurrentColumnNumber + 1)
        stack[-1].children.append(element)
        stack.append(element)

    def data(words: str) -> None:
        stack[-1].text += words

    def refuse(*_: object) -> None:
        raise PomdpError(parser.CurrentLineNumber, parser.CurrentColumnNumber + 1, "entities are not allowed")

    parser.StartElementHandler, parser.CharacterDataHandler = start, data
    parser.EndElementHandler = lambda _: stack.pop()
    parser.EntityDeclHandler = refuse
    parser.buffer_text = True
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        message = f"not well-formed XML: {expat.errors.messages[error.code]}"
        raise PomdpError(error.lineno, error.offset + 1, message) from None
    return top.children[0]
