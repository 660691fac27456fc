"""MJCF element tree with its includes, and its text for MuJoCo.

MuJoCo is given no path: it would open whatever a file names. Includes are expanded here, from within the
root of the file and nowhere else, see :mod:`kineverse.formats.root_folder`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NoReturn
from xml.sax.saxutils import quoteattr

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.root_folder import declared_roots, is_below, outside_root_error
from kineverse.formats.xml_reader import Element, label, parse_xml, quote

MAX_ELEMENT_DEPTH = 450
"""The deepest nesting of elements: MuJoCo reads 500, and a body is inside of the body that carries it."""


@dataclass(slots=True, eq=False)
class MjcfElement:
    """An element, and where it was written."""

    tag: str
    attributes: dict[str, str]
    children: list[MjcfElement] = field(default_factory=list)
    source: str = ""
    line: int = 0

    @property
    def place(self) -> str:
        """Line and opening tag, for remarks."""
        return f"line {self.line}, {label((self.tag, self.attributes, [], self.line))}"

    @property
    def where(self) -> str:
        """File, line and opening tag, for errors."""
        return f"{self.source}, {self.place}"

    def refuse(self, reason: str) -> NoReturn:
        """Raise the error that people see.

        Raises
        ------
        FormatError
            Always.
        """
        raise FormatError(f"{self.where}: {reason}")

    def walk(self) -> Iterator[MjcfElement]:
        """Yield the node and all below it."""
        ahead = [self]
        while ahead:
            node = ahead.pop()
            yield node
            ahead.extend(reversed(node.children))


def read_tree(
    data: str | bytes,
    source: str,
    folder: str,
    root: str,
    mend: Callable[[str, int, str], None] | None = None,
) -> MjcfElement:
    """Return the root of a document, with the content of what it includes in place of the includes.

    Parameters
    ----------
    data
        The document.
    source
        Its name in messages.
    folder
        Where it lies, from where the files it includes are named. Empty for text that lies nowhere.
    root
        The folder that they do not leave.
    mend
        Called with the file, the line and a text for what is read although XML forbids it; None to refuse it.

    Raises
    ------
    FormatError
        For what is no XML, or no MJCF; for includes that are not there, lead out of the root, or come
        twice.
    """

    def parsed(data: str | bytes, source: str) -> Element:
        return parse_xml(
            data, source, depth=MAX_ELEMENT_DEPTH, mend=None if mend is None else partial(mend, source)
        )

    top = parsed(data, source)
    _check_root(top, source)
    whole = MjcfElement("", {})
    included: set[Path] = set()
    ahead: list[tuple[Element, MjcfElement, str, str]] = [(top, whole, source, folder)]
    while ahead:
        element, parent, source, here = ahead.pop()
        tag, attributes, children, line = element
        node = MjcfElement(tag, attributes, source=source, line=line)
        if tag == "include":
            path = find_below_root(node, attributes.get("file", ""), root, folder, here)
            # A file in twice would have all its names twice, or include itself.
            if path in included:
                node.refuse("is there a second time; a file is included once.")
            included.add(path)
            below = str(path.parent)
            children = parsed(read_file(path), path.name)[2]
            ahead.extend((child, parent, path.name, below) for child in reversed(children))
            continue
        parent.children.append(node)
        ahead.extend((child, node, source, here) for child in reversed(children))
    return whole.children[0]


def find_below_root(node: MjcfElement, name: str, root: str, *places: str) -> Path:
    """Return the file that an element names, which is below the root, or below ``KINEVERSE_ROOT``.

    Parameters
    ----------
    node
        The element.
    name
        What it says: a path relative to one of the places.
    root
        The folder that it does not leave, a real path.
    places
        Folders from which it is looked for, one after the other.

    Raises
    ------
    FormatError
        If it is somewhere else, or is not there.
    """
    if not any(places):
        node.refuse(f"names the file {quote(name)}, and the text has no folder. Load it from its file.")
    if not name or "\0" in name:
        node.refuse("names no file.")
    allowed = [root, *declared_roots()]
    outside = False
    for place in dict.fromkeys(places):
        path = os.path.realpath(os.path.join(place, name))
        if not any(is_below(path, folder) for folder in allowed if folder):
            outside = True
        elif os.path.isfile(path):  # which is no for a name that is too long, and no error
            return Path(path)
    if outside:
        node.refuse(f"names {outside_root_error(name, root)}")
    return node.refuse(f"names {quote(name)}, and there is no such file below {root}.")


def _check_root(root: Element, source: str) -> None:
    tag, _, _, line = root
    if tag == "mujoco":
        return
    hint = {
        "mujocoinclude": " It is a part that other files include; load one of these.",
        "robot": " This is a URDF.",
        "sdf": " This is an SDF.",
    }.get(tag, "")
    raise FormatError(
        f"{source}, line {line}, {label(root)}: is not <mujoco>, the root element of an MJCF.{hint}"
    )


_ESCAPED = {"\n": "&#10;", "\r": "&#13;", "\t": "&#9;"}


def serialize_elements(root: MjcfElement, first: int = 1) -> tuple[str, list[MjcfElement]]:
    """Return a document, and its nodes by line from ``first`` on; the lines before are empty."""
    lines: list[str] = []
    nodes: list[MjcfElement] = []
    ahead: list[MjcfElement | str] = [root]
    while ahead:
        part = ahead.pop()
        if isinstance(part, str):
            lines[-1] += part
            continue
        words = [part.tag, *(f"{k}={quoteattr(v, _ESCAPED)}" for k, v in part.attributes.items())]
        nodes.append(part)
        lines.append(f"<{' '.join(words)}{'>' if part.children else '/>'}")
        if part.children:
            ahead.append(f"</{part.tag}>")
            ahead.extend(reversed(part.children))
    return "\n" * (first - 1) + "\n".join(lines), nodes
