"""XML writer with escaped text and numbers that are read back to the last bit."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field

from kineverse.errors import FormatError

_FORBIDDEN = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_ESCAPES = {
    "&": "&amp;",
    "<": "&lt;",
    ">": "&gt;",
    '"': "&quot;",
    # Readers replace these by spaces unless they are escaped.
    "\t": "&#9;",
    "\n": "&#10;",
    "\r": "&#13;",
}


@dataclass
class Tag:
    """Element of XML: attributes in order, and child elements, or text in place of these.

    ``verbatim`` is the whole element as text of a document, written in place of all others.
    """

    name: str
    attributes: dict[str, str] = field(default_factory=dict)
    inside: list[Tag] = field(default_factory=list)
    text: str = ""
    verbatim: str = ""

    def add(self, kind: str, /, **attributes: str | float | Iterable[float] | None) -> Tag:
        """Add a child element and return it; attributes that are None are left out."""
        tag = Tag(kind)
        for key, value in attributes.items():
            tag.give(key.rstrip("_"), value)
        self.inside.append(tag)
        return tag

    def add_text(
        self, kind: str, text: str | float | Iterable[float], /, **attributes: str | float | None
    ) -> Tag:
        """Add a child element that contains text, a number or several, and return it."""
        tag = self.add(kind, **attributes)
        tag.text = text if isinstance(text, str) else format_numbers(text)
        return tag

    def give(self, key: str, value: str | float | Iterable[float] | None) -> None:
        """Set an attribute to text, a number or several, unless it is None."""
        if value is not None:
            self.attributes[key] = value if isinstance(value, str) else format_numbers(value)


def format_xml(root: Tag, remarks: Iterable[str] = ()) -> bytes:
    """Return an element as the text of a document, after remarks as comments."""
    lines = ['<?xml version="1.0" encoding="utf-8"?>']
    # Two hyphens are forbidden in a comment.
    lines += [f"<!-- {re.sub('-(?=-|$)', '- ', _check_characters(remark))} -->" for remark in remarks]
    waiting: list[tuple[int, Tag | str]] = [(0, root)]
    while waiting:
        depth, tag = waiting.pop()
        if isinstance(tag, str):
            lines.append(" " * depth + tag)
            continue
        if tag.verbatim:
            lines.append(" " * depth + tag.verbatim)
            continue
        start = tag.name + "".join(
            f' {key}="{escape_attribute(value)}"' for key, value in tag.attributes.items()
        )
        if tag.text:
            lines.append(f"{' ' * depth}<{start}>{escape_attribute(tag.text)}</{tag.name}>")
            continue
        if not tag.inside:
            lines.append(f"{' ' * depth}<{start}/>")
            continue
        lines.append(f"{' ' * depth}<{start}>")
        waiting.append((depth, f"</{tag.name}>"))
        waiting += [(depth + 2, inside) for inside in reversed(tag.inside)]
    return ("\n".join(lines) + "\n").encode()


def escape_attribute(text: str) -> str:
    """Return text as the value of an attribute."""
    return "".join(_ESCAPES.get(c, c) for c in _check_characters(text))


def _check_characters(text: str) -> str:
    bad = _FORBIDDEN.search(text)
    if bad is not None:
        raise FormatError(f"XML cannot carry {bad.group()!a}, which is part of {text!a:.100}. Rename it.")
    return text


def format_numbers(values: float | Iterable[float]) -> str:
    """Return numbers as text, each in the shortest form that is read back exactly."""
    if isinstance(values, (int, float)):
        values = (values,)
    words = []
    for value in values:
        if not math.isfinite(value):
            raise FormatError(f"A description has finite numbers only, and not {value}.")
        words.append(repr(float(value) + 0.0).removesuffix(".0"))
    return " ".join(words)
