"""URDF files and text to a checked description.

Specification: http://wiki.ros.org/urdf/XML and urdf.xsd of ros/urdfdom; ``docs/urdf.md`` lists where parsers
disagree and how it is decided here.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TypeVar

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.markup import Element, ElementError, Visit, label, parse, quote
from kineverse.formats.remarks import Remarks
from kineverse.formats.urdf.bodies import LinkReader
from kineverse.formats.urdf.description import Joint, Link, Robot
from kineverse.formats.urdf.joints import read_joint
from kineverse.formats.urdf.mimicry import resolve
from kineverse.formats.urdf.tree import root_outwards

_VERSIONS = {"1.0": (1, 0), "1.1": (1, 1), "1.2": (1, 2)}
_EXTENSIONS = frozenset(("gazebo", "transmission"))
_OTHER_FORMATS = {
    "sdf": "an SDF",
    "mujoco": "an MJCF",
    "model": "a Gazebo manifest",
    "package": "a ROS manifest",
}

T = TypeVar("T", Link, Joint)


def read_urdf(path: str | os.PathLike[str]) -> Robot:
    """Read a URDF file.

    Raises
    ------
    FormatError
        If the file cannot be read or is not a valid URDF; the message names file, line, element and reason.
    """
    path = Path(path)
    return parse_urdf(read_file(path), source=path.name, folder=str(path.absolute().parent))


def parse_urdf(text: str | bytes, source: str = "<urdf>", folder: str = "") -> Robot:
    """Read a URDF from text.

    Parameters
    ----------
    text
        The document.
    source
        Its name in error messages.
    folder
        The folder from which the meshes it names are found, when somebody asks for them.

    Raises
    ------
    FormatError
        If it is not a valid URDF; the message names source, line, element and reason.
    """
    document = _Document(source, folder)
    root = parse(text, source, _EXTENSIONS, document.begin)
    hint = document.finish(root)
    joints = resolve(document.joints.values(), source)
    links = tuple(document.links.values())
    top, ordered = root_outwards(links, joints, source, hint)
    return Robot(root[1]["name"], top, links, ordered, source, tuple(document.remarks.texts))


class _Document:
    """The links and joints of a document, which are taken up as they come."""

    def __init__(self, source: str, folder: str):
        self.links: dict[str, Link] = {}
        self.joints: dict[str, Joint] = {}
        self.remarks = Remarks(source)
        self._folder = folder
        self._strangers: list[Element] = []

    def begin(self, root: Element) -> Visit:
        """Look at the root element, which has no children yet."""
        try:
            self._version = _version(root)
        except ElementError as mistake:
            raise self._error(mistake, root) from None
        self._reader = LinkReader(self._folder, self._version, self.remarks)
        return self._take

    def finish(self, root: Element) -> str:
        """Do what needs all of the document; return a hint for the case that it is no tree."""
        self._reader.colour(self.links)
        hint = _note_strangers(root, self._strangers, self.remarks)
        if not self.links:
            raise self._error(ElementError(root, f"has no <link>; a robot has at least one.{hint}"), root)
        return hint

    def _take(self, element: Element) -> None:
        tag = element[0]
        try:
            if tag == "link":
                link = self._reader.read(element)
                _add(self.links, link.name, link, element)
            elif tag == "joint":
                joint = read_joint(element, self._version, self.remarks)
                _add(self.joints, joint.name, joint, element)
            elif tag == "material":
                self._reader.materials.share(element)
            elif tag != "sensor":
                self._strangers.append(element)
        except ElementError as mistake:
            raise self._error(mistake, element) from None

    def _error(self, mistake: ElementError, owner: Element) -> FormatError:
        """Return the error that people see; a mistake is often deep inside the element they know by name."""
        of = "" if mistake.element is owner else f"{label(mistake.element)} "
        where = f"{self.remarks.source}, line {mistake.element[3]}, {label(owner)}"
        return FormatError(f"{where}: {of}{mistake.message}")


def _add(named: dict[str, T], name: str, part: T, element: Element) -> None:
    other = named.setdefault(name, part)
    if other is not part:
        raise ElementError(
            element, f"has the name of the {element[0]} on line {other.line} again; names are unique."
        )


def _version(root: Element) -> tuple[int, int]:
    """Return the version of the specification that the root element claims, 1.0 if it claims none."""
    if root[0] != "robot":
        guess = f" This is {_OTHER_FORMATS[root[0]]} file." if root[0] in _OTHER_FORMATS else ""
        raise ElementError(root, f"is not <robot>, the root element of a URDF.{guess}")
    if "name" not in root[1]:
        raise ElementError(root, 'has no name; the specification requires <robot name="...">.')
    text = root[1].get("version", "1.0")
    if text not in _VERSIONS:
        raise ElementError(
            root, f"version={quote(text)} is not one that is read; {', '.join(_VERSIONS)} are."
        )
    return _VERSIONS[text]


def _note_strangers(root: Element, strangers: list[Element], remarks: Remarks) -> str:
    """Remark on elements that may have been meant to be part of the robot, and return them as a hint.

    Elements that URDF does not know are allowed, and are ignored; but macros that were never expanded and
    joints of other dialects are how links come to be without a parent.
    """
    xacro = _xacro_prefix(root)
    suspects = [e for e in strangers if e[0].startswith(xacro) or e[0].lower().endswith(("link", "joint"))]
    if not suspects:
        return ""
    remedy = ""
    for element in suspects:
        if element[0].startswith(xacro):
            remedy = " Expand xacro first: xacro robot.urdf.xacro > robot.urdf"
            remarks.add(element, "is ignored: it is xacro that was not expanded.")
        else:
            remarks.add(element, "is ignored: URDF does not know it.")
    shown = ", ".join(f"{label(element)} (line {element[3]})" for element in suspects[:4])
    return f" Ignored, since URDF does not know it: {shown}{', ...' if len(suspects) > 4 else ''}.{remedy}"


def _xacro_prefix(root: Element) -> str:
    """Return the prefix that marks elements of xacro, with its colon."""
    for key, value in root[1].items():
        if key.startswith("xmlns:") and value.rstrip("/#").endswith("xacro"):
            return key[len("xmlns:") :] + ":"
    return "xacro:"
