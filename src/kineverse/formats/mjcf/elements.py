"""MJCF element tree with its includes, and its text for MuJoCo.

MuJoCo receives no path, because it would open every file that a document names. Includes are expanded here,
from files within the root folder only, see :mod:`kineverse.formats.root_folder`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NoReturn, TypeAlias
from xml.sax.saxutils import quoteattr

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.root_folder import declared_roots, is_below, mesh_folders, outside_root_error
from kineverse.formats.xml_reader import Element, label, parse_xml, quote

MAX_ELEMENT_DEPTH = 450  # deepest nesting; MuJoCo reads 500, and bodies are nested in their parents


@dataclass(slots=True, eq=False)
class MjcfElement:
    """Element with its place in a file."""

    tag: str
    attributes: dict[str, str]
    children: list[MjcfElement] = field(default_factory=list)
    source: str = ""
    line: int = 0

    @property
    def place(self) -> str:
        """Line and opening tag, for warnings."""
        return f"line {self.line}, {label((self.tag, self.attributes, [], self.line))}"

    @property
    def where(self) -> str:
        """File, line and opening tag, for errors."""
        return f"{self.source}, {self.place}"

    def refuse(self, reason: str) -> NoReturn:
        """Raise an error about the element."""
        raise FormatError(f"{self.where}: {reason}")

    def walk(self) -> Iterator[MjcfElement]:
        """Yield the element and all of its descendants, depth first."""
        stack = [self]
        while stack:
            node = stack.pop()
            yield node
            stack.extend(reversed(node.children))


ElementRemark: TypeAlias = Callable[[MjcfElement | None, str], None]
"""Function that adds a warning about an element, or about the whole document."""


def read_tree(
    data: str | bytes,
    source: str,
    folder: str,
    root: str,
    on_recoverable_error: Callable[[str, int, str], None] | None = None,
) -> MjcfElement:
    """Return the root element of a document, with includes replaced by the content of their files."""

    def parsed(data: str | bytes, source: str) -> Element:
        fault = partial(on_recoverable_error, source) if on_recoverable_error else None
        return parse_xml(data, source, depth=MAX_ELEMENT_DEPTH, on_recoverable_error=fault)

    top = parsed(data, source)
    _check_root(top, source)
    document = MjcfElement("", {})
    included: set[Path] = set()
    stack: list[tuple[Element, MjcfElement, str, str]] = [(top, document, source, folder)]
    while stack:
        element, parent, source, here = stack.pop()
        tag, attributes, children, line = element
        node = MjcfElement(tag, attributes, source=source, line=line)
        if tag == "include":
            path = find_below_root(node, attributes.get("file", ""), root, folder, here)
            # A file that is included twice would repeat all of its names, or include itself.
            if path in included:
                node.refuse("is there a second time; a file is included once.")
            included.add(path)
            below = str(path.parent)
            children = parsed(read_file(path), path.name)[2]
            stack.extend((child, parent, path.name, below) for child in reversed(children))
            continue
        parent.children.append(node)
        stack.extend((child, node, source, here) for child in reversed(children))
    return document.children[0]


def find_below_root(node: MjcfElement, name: str, root: str, *places: str) -> Path:
    """Find the file that an element names, below the root folder or ``KINEVERSE_ROOT``."""
    if not any(places):
        node.refuse(f"names the file {quote(name)}, and the text has no folder. Load it from its file.")
    if not name or "\0" in name:
        node.refuse("names no file.")
    allowed = [root, *declared_roots(), *(beside for place in places for beside in mesh_folders(place, root))]
    outside = False
    for place in dict.fromkeys(places):
        path = os.path.realpath(os.path.join(place, name))
        if not any(is_below(path, folder) for folder in allowed if folder):
            outside = True
        elif os.path.isfile(path):  # False rather than an error for a name that is too long
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


def serialize_elements(
    root: MjcfElement, first: int = 1, without: frozenset[str] = frozenset()
) -> tuple[str, list[MjcfElement]]:
    """Return the text of a document, one element a line from line ``first`` on, and the elements in order.

    Sections of the document whose tags are in ``without`` become blank lines.
    """
    lines: list[str] = []
    nodes: list[MjcfElement] = []
    sections = set(root.children)
    stack: list[MjcfElement | str] = [root]
    while stack:
        part = stack.pop()
        if isinstance(part, str):
            lines[-1] += part
            continue
        if part.tag in without and part in sections:
            hidden = list(part.walk())
            nodes += hidden
            lines += [""] * len(hidden)
            continue
        words = [part.tag, *(f"{k}={quoteattr(v, _ESCAPED)}" for k, v in part.attributes.items())]
        nodes.append(part)
        lines.append(f"<{' '.join(words)}{'>' if part.children else '/>'}")
        if part.children:
            stack.append(f"</{part.tag}>")
            stack.extend(reversed(part.children))
    return "\n" * (first - 1) + "\n".join(lines), nodes
