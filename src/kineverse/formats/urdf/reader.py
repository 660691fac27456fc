"""URDF files and text as checked descriptions.

Specification: http://wiki.ros.org/urdf/XML and urdf.xsd of ros/urdfdom; ``docs/urdf.md`` lists where parsers
disagree and how it is decided here.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from kineverse.errors import FormatError
from kineverse.formats.files import read_file
from kineverse.formats.names import NumberedNames
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.root_folder import find_text_root
from kineverse.formats.urdf.bodies import UrdfLinkReader
from kineverse.formats.urdf.description import UrdfJoint, UrdfLink, UrdfRobot
from kineverse.formats.urdf.joints import read_urdf_joint
from kineverse.formats.urdf.mimic import resolve_mimic_joints
from kineverse.formats.urdf.tree import keep_one_parent, order_from_root
from kineverse.formats.xml_reader import Element, ElementError, Visit, label, parse_xml, quote

_VERSIONS = {"1.0": (1, 0), "1.1": (1, 1), "1.2": (1, 2)}
_EXTENSIONS = frozenset(("gazebo", "transmission"))
EXPAND = "Run xacro first: xacro robot.urdf.xacro > robot.urdf"

_OTHER_FORMATS = {
    "sdf": "an SDF",
    "mujoco": "an MJCF",
    "model": "a Gazebo manifest",
    "package": "a ROS manifest",
}

T = TypeVar("T", UrdfLink, UrdfJoint)


def read_urdf(
    path: str | os.PathLike[str], root: str | os.PathLike[str] | None = None, strict: bool = False
) -> UrdfRobot:
    """Read a URDF file; see :func:`parse_urdf`.

    Raises
    ------
    FormatError
        If the file cannot be read or is not a valid URDF; the message names file, line, element and reason.
    """
    path = Path(path)
    return parse_urdf(read_file(path), path.name, str(path.absolute().parent), root, strict)


def parse_urdf(
    text: str | bytes,
    source: str = "<urdf>",
    folder: str = "",
    root: str | os.PathLike[str] | None = None,
    strict: bool = False,
) -> UrdfRobot:
    """Read a URDF from text.

    Parameters
    ----------
    text
        The document.
    source
        Its name in error messages.
    folder
        The folder from which the meshes it names are found, when somebody asks for them.
    root
        The folder that they do not leave; None for that which :func:`kineverse.formats.root_folder.find_root` finds.
    strict
        Whether mistakes that others read past are refused, rather than remarked on.

    Raises
    ------
    FormatError
        If it is not a valid URDF; the message names source, line, element and reason.
    """
    remarks = ReaderWarnings(source, strict=strict)
    document = _Document(folder, find_text_root(folder, root), remarks)
    top = parse_xml(text, source, _EXTENSIONS, document.begin, mend=None if strict else remarks.fault)
    hint = document.finish(top)
    joints = keep_one_parent(list(document.joints.values()), remarks)
    links = tuple(document.links.values())
    roots, ordered, reached = order_from_root(links, joints, remarks, hint)
    name = top[1].get("name", "")
    return UrdfRobot(
        name,
        roots[0],
        tuple(reached),
        tuple(resolve_mimic_joints(ordered, remarks)),
        source,
        tuple(remarks.texts),
        roots[1:],
    )


class _Document:
    """The links and joints of a document, which are taken up as they come."""

    def __init__(self, folder: str, root: str, remarks: ReaderWarnings):
        self.links: dict[str, UrdfLink] = {}
        self.joints: dict[str, UrdfJoint] = {}
        self.remarks = remarks
        self._folder, self._root = folder, root
        self._strangers: list[Element] = []
        self._numbers = NumberedNames()

    def begin(self, root: Element) -> Visit:
        """Look at the root element, which has no children yet."""
        try:
            self._version = _version(root, self.remarks)
        except ElementError as mistake:
            raise self._error(mistake, root) from None
        self._xacro = _xacro_prefix(root)
        self._reader = UrdfLinkReader(self._folder, self._version, self.remarks, self._root)
        return self._take

    def finish(self, root: Element) -> str:
        """Do what needs all of the document; return a hint for the case that it is no tree."""
        self._reader.colour(self.links)
        try:
            hint = _note_strangers(root, self._strangers, bool(self.joints), self.remarks)
        except ElementError as mistake:
            raise self._error(mistake, mistake.element) from None
        if not self.links:
            declared = any(key.startswith("xmlns:") and "xacro" in value for key, value in root[1].items())
            hint += f" {EXPAND}" if declared else ""
            raise self._error(ElementError(root, f"has no <link>; a robot has at least one.{hint}"), root)
        return hint

    def _take(self, element: Element) -> None:
        tag = element[0]
        try:
            if tag in ("link", "joint"):
                _check_expanded(element, self._xacro, self.remarks)
            if tag == "link":
                link = self._reader.read(element)
                _add(self.links, link.name, link, element)
            elif tag == "joint":
                self._add_joint(read_urdf_joint(element, self._version, self.remarks), element)
            elif tag == "material":
                self._reader.materials.share(element)
            elif tag != "sensor":
                self._strangers.append(element)
        except ElementError as mistake:
            raise self._error(mistake, element) from None

    def _add_joint(self, joint: UrdfJoint, element: Element) -> None:
        """Take up a joint; a name that a fixed one has, too, goes to the other, which has a coordinate."""
        other = self.joints.get(joint.name)
        if other is None or "fixed" not in (joint.kind, other.kind):
            _add(self.joints, joint.name, joint, element)
            return
        name, fixed = joint.name, self._numbers.first_free(joint.name, self.joints)
        mistake = ElementError(
            element, f"has the name of the joint on line {other.line} again; names are unique."
        )
        self.remarks.mend(mistake, f'the fixed one is called "{fixed}"')
        if other.kind == "fixed" and joint.kind != "fixed":
            self.joints[name], joint = joint, other
        self.joints[fixed] = replace(joint, name=fixed)

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


def _version(root: Element, remarks: ReaderWarnings) -> tuple[int, int]:
    """Return the version of the specification that the root element claims, 1.0 if it claims none."""
    if root[0] != "robot":
        guess = f" This is {_OTHER_FORMATS[root[0]]} file." if root[0] in _OTHER_FORMATS else ""
        mistake = ElementError(root, f"is not <robot>, the root element of a URDF.{guess}")
        if root[0].lower() != "robot":
            raise mistake
        remarks.mend(mistake, "it is taken for that")
    if "name" not in root[1]:
        mistake = ElementError(root, 'has no name; the specification requires <robot name="...">.')
        remarks.mend(mistake, "it is called nothing")
    text = root[1].get("version", "1.0")
    if text in _VERSIONS:
        return _VERSIONS[text]
    mistake = ElementError(
        root, f"version={quote(text)} is not one that is read; {', '.join(_VERSIONS)} are."
    )
    try:
        latest = math.inf > float(text) > 1.2
    except ValueError:
        latest = False
    taken = "1.2" if latest else "1.0"
    remarks.mend(mistake, f"{taken} is taken")
    return _VERSIONS[taken]


def _note_strangers(
    root: Element, strangers: list[Element], has_joints: bool, remarks: ReaderWarnings
) -> str:
    """Remark on elements that may have been meant to be part of the robot, and return them as a hint.

    Elements that URDF does not know are allowed, and are ignored; but joints of other dialects are how links
    come to be without a parent.

    Raises
    ------
    ElementError
        For macros that were never expanded, where they are all that there is.
    """
    xacro = _xacro_prefix(root)
    for element in strangers:
        if element[0].startswith(xacro):
            mistake = ElementError(element, f"is xacro that was not expanded. {EXPAND}")
            if not has_joints:
                raise mistake
            remarks.mend(mistake, "it is passed over, and what it would add is missing")
    suspects = [
        e for e in strangers if e[0].lower().endswith(("link", "joint")) and not e[0].startswith(xacro)
    ]
    for element in suspects:
        remarks.add(element, "is ignored: URDF does not know it.")
    if not suspects:
        return ""
    shown = ", ".join(f"{label(element)} (line {element[3]})" for element in suspects[:4])
    return f" Ignored, since URDF does not know it: {shown}{', ...' if len(suspects) > 4 else ''}."


def _check_expanded(element: Element, xacro: str, remarks: ReaderWarnings) -> None:
    if "${" in element[1].get("name", ""):
        mistake = ElementError(element, f"has a name that xacro was to expand. {EXPAND}")
        remarks.mend(mistake, "it is taken as it is")
    for part in element[2]:
        if part[0].startswith(xacro):
            mistake = ElementError(part, f"is xacro that was not expanded. {EXPAND}")
            remarks.mend(mistake, "it is passed over, and what it would add is missing", element)


def _xacro_prefix(root: Element) -> str:
    """Return the prefix that marks elements of xacro, with its colon."""
    for key, value in root[1].items():
        if key.startswith("xmlns:") and value.rstrip("/#").endswith("xacro"):
            return key[len("xmlns:") :] + ":"
    return "xacro:"
