"""URDF files and text as checked descriptions.

Specification: http://wiki.ros.org/urdf/XML and urdf.xsd of ros/urdfdom. ``docs/urdf.md`` lists the
differences between parsers and the choices made here.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from msgspec import structs

from kineverse.errors import FormatError, list_some, suggest
from kineverse.formats.files import read_file
from kineverse.formats.names import NumberedNames
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.root_folder import find_text_root
from kineverse.formats.xml_reader import Element, ElementError, Visit, decode_xml, label, parse_xml, quote
from kineverse.model.frame import WORLD

from .bodies import UrdfLinkReader
from .description import UrdfJoint, UrdfLink, UrdfRobot
from .joints import read_urdf_joint, resolve_mimic_joints
from .kept_elements import KeptElement, KeptParts, find_elements, find_occurring, has_unknown_parts

_VERSIONS = {"1.0": (1, 0), "1.1": (1, 1), "1.2": (1, 2)}
_EXTENSIONS = frozenset(("gazebo", "transmission"))
XACRO_HINT = "A file called robot.urdf.xacro is expanded"

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

    Examples
    --------
    >>> robot = kv.formats.urdf.read_urdf(kv.formats.locate_model("pr2").path)
    >>> robot.name, robot.root, robot.dof
    ('pr2', 'base_footprint', 19)
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
    source
        Name of the document in error messages.
    folder
        Folder relative to which meshes are found.
    root
        Folder that contains all meshes; None for that of :func:`kineverse.formats.root_folder.find_root`.
    strict
        If True, mistakes that other parsers accept are errors. Otherwise they are warnings.

    Raises
    ------
    FormatError
        If the text is no valid URDF; the message names source, line, element and reason.

    Examples
    --------
    >>> text = '''
    ... <robot name="cupboard">
    ...   <link name="body"/>
    ...   <link name="door"/>
    ...   <joint name="hinge" type="revolute">
    ...     <parent link="body"/>
    ...     <child link="door"/>
    ...     <axis xyz="0 0 1"/>
    ...     <limit lower="0" upper="1.5" velocity="1" effort="10"/>
    ...   </joint>
    ... </robot>
    ... '''
    >>> robot = kv.formats.urdf.parse_urdf(text)
    >>> robot.root, robot.dof, robot.joints[0].limits.upper
    ('body', 1, 1.5)
    """
    remarks = ReaderWarnings(source, strict=strict)
    document = _Document(folder, find_text_root(folder, root), remarks)
    top = parse_xml(
        text, source, _EXTENSIONS, document.begin, on_recoverable_error=None if strict else remarks.fault
    )
    hint = document.finish(top)
    joints = keep_one_parent(list(document.joints.values()), remarks)
    links = tuple(document.links.values())
    roots, ordered, reached = order_from_root(links, joints, remarks, hint)
    name = top[1].get("name", "")
    kept = document.kept_parts(text, top)
    return UrdfRobot(
        name,
        roots[0],
        tuple(reached),
        tuple(resolve_mimic_joints(ordered, remarks)),
        source,
        tuple(remarks.texts),
        roots[1:],
        kept,
    )


class _Document:
    def __init__(self, folder: str, root: str, remarks: ReaderWarnings):
        self.links: dict[str, UrdfLink] = {}
        self.joints: dict[str, UrdfJoint] = {}
        self.remarks = remarks
        self._folder, self._root = folder, root
        self._unknown_elements: list[Element] = []
        self._has_unknown_parts = False
        self._owners: set[tuple[str, str]] = set()  # links and joints that have unknown parts
        self._numbers = NumberedNames()

    def begin(self, root: Element) -> Visit:
        """Read the root element, which has no children yet; return the visitor of its children."""
        try:
            self._version = _version(root, self.remarks)
        except ElementError as mistake:
            raise mistake.located(self.remarks.source, root) from None
        self._xacro = _xacro_prefix(root)
        self._reader = UrdfLinkReader(self._folder, self._version, self.remarks, self._root)
        return self._read_element

    def finish(self, root: Element) -> str:
        """Complete the links after the end of the document; return a hint for joints that form no tree."""
        self._reader.assign_materials(self.links)
        try:
            hint = _warn_unknown_elements(root, self._unknown_elements, bool(self.joints), self.remarks)
        except ElementError as mistake:
            raise mistake.located(self.remarks.source) from None
        if not self.links:
            declared = any(key.startswith("xmlns:") and "xacro" in value for key, value in root[1].items())
            hint += f" {XACRO_HINT}" if declared else ""
            empty = ElementError(root, f"has no <link>; a robot has at least one.{hint}")
            raise empty.located(self.remarks.source)
        return hint

    def kept_parts(self, text: str | bytes, top: Element) -> KeptParts:
        """Return the parts of the document that its links and joints do not say."""
        visuals = (
            (link, tuple(found.get(k, ("", False)) for k in range(max(found) + 1)))
            for link, found in self._reader.visual_materials.items()
        )
        elements: tuple[KeptElement, ...] = ()
        namespaces = tuple((k, v) for k, v in top[1].items() if k.startswith("xmlns:"))
        if self._has_unknown_parts or any(_mentions(text, tag) for tag in _EXTENSIONS):
            plain = decode_xml(text)
            if plain is None:
                self.remarks.add(top, "is in no encoding whose extensions can be kept; they are left out.")
            else:
                elements = tuple(find_elements(plain, self._owners, self._xacro))
        names = find_occurring(elements, dict.fromkeys((*self.links, *self.joints))) if elements else ()
        kept = KeptParts(top[1].get("name", ""), "", namespaces, tuple(self._reader.materials.defined))
        return structs.replace(kept, visuals=tuple(visuals), elements=elements, names=names)

    def _read_element(self, element: Element) -> None:
        tag = element[0]
        try:
            if tag in ("link", "joint"):
                _check_expanded(element, self._xacro, self.remarks)
                if has_unknown_parts(element):
                    self._has_unknown_parts = True
                    self._owners.add((tag, element[1].get("name", "")))
            if tag == "link":
                link = self._reader.read(element)
                _add(self.links, link.name, link, element)
            elif tag == "joint":
                self._add_joint(read_urdf_joint(element, self._version, self.remarks), element)
            elif tag == "material":
                self._reader.materials.define(element)
            else:
                self._has_unknown_parts = True
                if tag != "sensor":
                    self._unknown_elements.append(element)
        except ElementError as mistake:
            raise mistake.located(self.remarks.source, element) from None

    def _add_joint(self, joint: UrdfJoint, element: Element) -> None:
        """Add a joint; of a fixed joint and another of the same name, the fixed one is renamed."""
        other = self.joints.get(joint.name)
        if other is None or "fixed" not in (joint.kind, other.kind):
            _add(self.joints, joint.name, joint, element)
            return
        name, fixed = joint.name, self._numbers.first_free(joint.name, self.joints)
        mistake = ElementError(
            element, f"has the name of the joint on line {other.line} again; names are unique."
        )
        self.remarks.repair(mistake, f'the fixed one is called "{fixed}"')
        if other.kind == "fixed" and joint.kind != "fixed":
            self.joints[name], joint = joint, other
        self.joints[fixed] = structs.replace(joint, name=fixed)


def _mentions(text: str | bytes, tag: str) -> bool:
    return f"<{tag}" in text if isinstance(text, str) else f"<{tag}".encode() in text.replace(b"\0", b"")


def _add(by_name: dict[str, T], name: str, part: T, element: Element) -> None:
    other = by_name.setdefault(name, part)
    if other is not part:
        raise ElementError(
            element, f"has the name of the {element[0]} on line {other.line} again; names are unique."
        )


def _version(root: Element, remarks: ReaderWarnings) -> tuple[int, int]:
    """Return the version of the specification that the root element states, 1.0 by default."""
    if root[0] != "robot":
        guess = f" This is {_OTHER_FORMATS[root[0]]} file." if root[0] in _OTHER_FORMATS else ""
        mistake = ElementError(root, f"is not <robot>, the root element of a URDF.{guess}")
        if root[0].lower() != "robot":
            raise mistake
        remarks.repair(mistake, "it is taken for that")
    if "name" not in root[1]:
        mistake = ElementError(root, 'has no name; the specification requires <robot name="...">.')
        remarks.repair(mistake, "it is called nothing")
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
    assumed = "1.2" if latest else "1.0"
    remarks.repair(mistake, f"{assumed} is taken")
    return _VERSIONS[assumed]


def _warn_unknown_elements(
    root: Element, unknown: list[Element], has_joints: bool, remarks: ReaderWarnings
) -> str:
    """Warn of unknown elements that may be meant as parts of the robot, and return them as a hint.

    URDF allows unknown elements, and they are ignored. Joints of other dialects among them leave links
    without parent.
    """
    xacro = _xacro_prefix(root)
    for element in unknown:
        if element[0].startswith(xacro):
            mistake = ElementError(element, f"is xacro that was not expanded. {XACRO_HINT}")
            if not has_joints:
                raise mistake
            remarks.repair(mistake, "it is passed over, and what it would add is missing")
    suspects = [e for e in unknown if e[0].lower().endswith(("link", "joint")) and not e[0].startswith(xacro)]
    for element in suspects:
        remarks.add(element, "is ignored: URDF does not know it.")
    if not suspects:
        return ""
    shown = ", ".join(f"{label(element)} (line {element[3]})" for element in suspects[:4])
    return f" Ignored, since URDF does not know it: {shown}{', ...' if len(suspects) > 4 else ''}."


def _check_expanded(element: Element, xacro: str, remarks: ReaderWarnings) -> None:
    if "${" in element[1].get("name", ""):
        mistake = ElementError(element, f"has a name that xacro was to expand. {XACRO_HINT}")
        remarks.repair(mistake, "it is taken as it is")
    for part in element[2]:
        if part[0].startswith(xacro):
            mistake = ElementError(part, f"is xacro that was not expanded. {XACRO_HINT}")
            remarks.repair(mistake, "it is passed over, and what it would add is missing", element)


def _xacro_prefix(root: Element) -> str:
    for key, value in root[1].items():
        if key.startswith("xmlns:") and value.rstrip("/#").endswith("xacro"):
            return key[len("xmlns:") :] + ":"
    return "xacro:"


# -- tree ----------------------------------------------------------------------------------------------------

_SHOWN = 8


def keep_one_parent(joints: Sequence[UrdfJoint], remarks: ReaderWarnings) -> list[UrdfJoint]:
    """Return the joints with one parent joint for each link: the last by name, as in urdfdom."""
    joint_above: dict[str, UrdfJoint] = {}
    for joint in joints:
        other = joint_above.setdefault(joint.child, joint)
        if other is joint:
            continue
        text = (
            f"its child link {quote(joint.child)} has a parent already, by the joint {quote(other.name)} on "
            f"line {other.line}. URDF describes trees only: a link has one parent."
        )
        kept, dropped = (joint, other) if joint.name.encode() > other.name.encode() else (other, joint)
        joint_above[joint.child] = kept
        remarks.mistake(joint.line, f"{_label(joint)}: {text}", f"{quote(dropped.name)} is left out")
    return [joint for joint in joints if joint_above[joint.child] is joint]


def order_from_root(
    links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], remarks: ReaderWarnings, hint: str = ""
) -> tuple[tuple[str, ...], tuple[UrdfJoint, ...], list[UrdfLink]]:
    """Return the roots, the joints from the roots outwards, and the links that they reach.

    Siblings are in the order of the file.
    """
    source = remarks.source
    links = _with_world(links, joints, remarks)
    lines = {link.name: link.line for link in links}
    joints_below: dict[str, list[UrdfJoint]] = {}
    joint_above: dict[str, UrdfJoint] = {}
    for joint in joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in lines:
                raise FormatError(
                    f"{source}, line {joint.line}, {_label(joint)}: its {role} link {quote(name)} does not "
                    f"exist; every link needs a <link> element of its own. {suggest(name, lines, 'link')}"
                )
        joint_above[joint.child] = joint
        joints_below.setdefault(joint.parent, []).append(joint)

    roots = [link for link in links if link.name not in joint_above]
    if len(roots) > 1:
        shown = list_some((f"{quote(link.name)} (line {link.line})" for link in roots), _SHOWN)
        text = (
            f"<link name={quote(roots[1].name)}>: there are {len(roots)} links without a parent, "
            f"where one root is expected: {shown}. Connect them by joints.{hint}"
        )
        remarks.mistake(roots[1].line, text, "all of them stand where the first does")
    ordered = [joint for root in roots for joint in _outwards(root.name, joints_below)]
    reached = {root.name for root in roots} | {joint.child for joint in ordered}
    if len(ordered) != len(joints):
        loop = _loop(next(joint for joint in joints if joint.child not in reached), joint_above)
        shown = " -> ".join(f"{quote(joint.name)}" for joint in loop[:_SHOWN])
        more = f" and {len(loop) - _SHOWN} more" if len(loop) > _SHOWN else ""
        cycle = f"the joints {shown}{more} lead in a circle"
        if len(loop) == 1:
            cycle = "its child link is its own parent"
        text = f"{_label(loop[0])}: {cycle}. URDF describes trees only: remove a joint.{hint}"
        if not roots:
            raise FormatError(f"{source}, line {loop[0].line}, {text}")
        left = len(links) - len(reached)
        remarks.mistake(loop[0].line, text, f"{left} links that no root holds are left out")
    return tuple(root.name for root in roots), tuple(ordered), [k for k in links if k.name in reached]


def _with_world(
    links: Sequence[UrdfLink], joints: Sequence[UrdfJoint], remarks: ReaderWarnings
) -> Sequence[UrdfLink]:
    """Return the links, with the world if it is a parent without a link of its own, as in Drake."""
    joint = next((joint for joint in joints if joint.parent == WORLD), None)
    if joint is None or remarks.strict or any(link.name == WORLD for link in links):
        return links
    remarks.fault(
        joint.line,
        f"{_label(joint)}: its parent link {quote(WORLD)} has no <link> element of its own; it is the world.",
    )
    return [UrdfLink(WORLD, line=joint.line), *links]


def _outwards(root: str, joints_below: dict[str, list[UrdfJoint]]) -> list[UrdfJoint]:
    ordered: list[UrdfJoint] = []
    stack = joints_below.get(root, [])[::-1]
    while stack:
        joint = stack.pop()
        ordered.append(joint)
        stack.extend(reversed(joints_below.get(joint.child, ())))
    return ordered


def _loop(start: UrdfJoint, joint_above: dict[str, UrdfJoint]) -> list[UrdfJoint]:
    """Return the joints of the cycle that ``start`` is in or below, beginning with the first in the file."""
    joint, visited = start, {start.name}
    while True:
        joint = joint_above[joint.parent]
        if joint.name in visited:
            break
        visited.add(joint.name)
    loop = [joint]
    while (above := joint_above[loop[-1].parent]) is not joint:
        loop.append(above)
    loop.reverse()
    first = min(range(len(loop)), key=lambda index: loop[index].line)
    return loop[first:] + loop[:first]


def _label(joint: UrdfJoint) -> str:
    return f"<joint name={quote(joint.name)}>"
