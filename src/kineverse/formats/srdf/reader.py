"""SRDF files and text as checked descriptions.

Specification: http://wiki.ros.org/srdf/review and the parser of MoveIt (ros-planning/srdfdom). Elements that
name unknown links or joints are passed over with a warning, since one SRDF often serves several variants of
a robot.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from msgspec.structs import replace

from kineverse.errors import UnknownNameError, suggest
from kineverse.formats.files import read_file
from kineverse.formats.names import check_prefix
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.xml_reader import Element, ElementError, label, parse_xml, quote
from kineverse.formats.xml_values import parse_number
from kineverse.model.articulation import Articulation
from kineverse.model.frame import WORLD
from kineverse.model.model_view import ModelView

from .description import CollisionRule, EndEffector, Srdf, SrdfGroup, VirtualJoint

_IGNORED = frozenset(("link_sphere_approximation", "joint_property"))
_VIRTUAL_KINDS = ("fixed", "planar", "floating")
_URDF_ONLY = frozenset(("link", "joint"))


def read_srdf(
    path: str | os.PathLike[str], model: ModelView, prefix: str = "", *, strict: bool = False
) -> Srdf:
    """Read an SRDF file about a robot of a model; see :func:`parse_srdf`.

    Raises
    ------
    FormatError
        If the file cannot be read or is no SRDF; the message names file, line, element and reason.
    UnknownNameError
        If none of its links is in the model below the prefix.

    Examples
    --------
    >>> text = "<robot name='r'><group name='oven'><joint name='oven_door'/></group></robot>"
    >>> with open("kitchen.srdf", "w", encoding="utf-8") as file:
    ...     size = file.write(text)
    >>> srdf = kv.formats.read_srdf("kitchen.srdf", kv.load("kitchen"), prefix="kitchen")
    >>> srdf.groups["oven"].links
    ('kitchen/oven_door',)
    """
    path = Path(path)
    return parse_srdf(read_file(path), model, prefix, source=path.name, strict=strict)


def parse_srdf(
    text: str | bytes, model: ModelView, prefix: str = "", *, source: str = "<srdf>", strict: bool = False
) -> Srdf:
    """Read an SRDF about a robot of a model from text.

    Parameters
    ----------
    model
        Model that contains the robot, in its present version.
    prefix
        Prefix of the robot's names in the model, without the slash.
    source
        Name of the document in messages.
    strict
        If True, mistakes in single elements are errors. Otherwise they are warnings, and the element is
        passed over.

    Raises
    ------
    FormatError
        If the text is no SRDF, or the prefix is none; the message names source, line, element and reason.
    UnknownNameError
        If none of its links is in the model below the prefix.

    Examples
    --------
    >>> text = '''
    ... <robot name="kitchen">
    ...   <group name="fridge"><joint name="fridge_door"/></group>
    ...   <group_state name="ajar" group="fridge"><joint name="fridge_door" value="0.2"/></group_state>
    ... </robot>
    ... '''
    >>> srdf = kv.formats.srdf.parse_srdf(text, kv.load("kitchen"), prefix="kitchen")
    >>> srdf.groups["fridge"].coordinates, srdf.states
    (('kitchen/fridge_door',), {'ajar': {'kitchen/fridge_door': 0.2}})
    """
    check_prefix(prefix)
    remarks = ReaderWarnings(source, strict=strict)
    root = parse_xml(text, source, on_recoverable_error=None if strict else remarks.fault)
    try:
        _check_root(root)
        document = _SemanticDocument(root, ModelNames(model, prefix or ""), remarks)
    except ElementError as mistake:
        raise mistake.located(source) from None
    return document.result


def _check_root(root: Element) -> None:
    if root[0] != "robot":
        raise ElementError(root, "is not <robot>, the root element of an SRDF.")
    tags = {part[0] for part in root[2]}
    if _URDF_ONLY & tags and not {"group", "disable_collisions"} & tags:
        raise ElementError(root, "is a URDF: it has links and joints. Load it as a model, and read its SRDF.")


class _SemanticDocument:
    """Elements of a document, read in the order in which they need each other."""

    def __init__(self, root: Element, names: ModelNames, remarks: ReaderWarnings) -> None:
        self._names, self._remarks = names, remarks
        self._by_tag: dict[str, list[Element]] = {}
        for element in root[2]:
            self._by_tag.setdefault(element[0], []).append(element)
        if len(self._by_tag.get("group", ())) > MOST_GROUPS:
            raise ElementError(root, f"has more than {MOST_GROUPS} groups; no robot needs that.")
        virtual = self._virtual_joints()
        passive = self._passive_joints()
        groups = self._groups(virtual, passive)
        rules = self._rules()
        end_effectors = self._end_effectors(groups)
        names.check_robot(remarks.source)
        states = self._states(groups)
        self._warn_unknown()
        self.result = Srdf(
            root[1].get("name", ""),
            rules,
            groups,
            end_effectors,
            states,
            virtual,
            passive,
            tuple(remarks.texts),
        )

    def _elements(self, tag: str) -> list[Element]:
        return self._by_tag.pop(tag, [])

    def _virtual_joints(self) -> dict[str, VirtualJoint]:
        result: dict[str, VirtualJoint] = {}
        seen: dict[str, Element] = {}
        for element in self._elements("virtual_joint"):
            with self._remarks.passing_over():
                if not add_unique(seen, element, self._remarks):
                    continue
                name, kind = required(element, "name"), required(element, "type")
                if kind not in _VIRTUAL_KINDS:
                    raise ElementError(element, f"type={quote(kind)} is none of {', '.join(_VIRTUAL_KINDS)}.")
                child = self._names.link(element, "child_link")
                result[name] = VirtualJoint(name, kind, required(element, "parent_frame"), child)
        return result

    def _passive_joints(self) -> tuple[str, ...]:
        found: dict[str, None] = {}
        for element in self._elements("passive_joint"):
            with self._remarks.passing_over():
                found[self._names.joint(element)] = None
        return tuple(found)

    def _groups(self, virtual: dict[str, VirtualJoint], passive: tuple[str, ...]) -> dict[str, SrdfGroup]:
        elements: dict[str, Element] = {}
        for element in self._elements("group"):
            with self._remarks.passing_over():
                add_unique(elements, element, self._remarks)
        return GroupResolver(elements, self._names, virtual, self._remarks).resolve(passive)

    def _rules(self) -> tuple[CollisionRule, ...]:
        """Return the collision rules; of several about a pair the last one counts, as MoveIt orders them."""
        rules: list[CollisionRule] = []
        warned: set[str] = set()
        for element in self._elements("disable_default_collisions"):
            with self._remarks.passing_over():
                link = self._names.link(element, "link")
                rules.append((link, f"{self._names.prefix}*", False, "off by default"))
        for tag, check in (("enable_collisions", True), ("disable_collisions", False)):
            for element in self._elements(tag):
                try:
                    a, b = self._names.link(element, "link1"), self._names.link(element, "link2")
                    if a == b:
                        raise ElementError(element, f"names {quote(a)} twice; a pair has two links.")
                    rules.append((a, b, check, optional(element, "reason")))
                except ElementError as mistake:
                    # A link that this variant of the robot lacks may have a rule with each of the others.
                    if mistake.message not in warned:
                        self._remarks.repair(mistake, "all rules like this are passed over")
                    warned.add(mistake.message)
        return tuple(rules)

    def _end_effectors(self, groups: dict[str, SrdfGroup]) -> dict[str, EndEffector]:
        result: dict[str, EndEffector] = {}
        seen: dict[str, Element] = {}
        for element in self._elements("end_effector"):
            with self._remarks.passing_over():
                if not add_unique(seen, element, self._remarks):
                    continue
                name, group = required(element, "name"), required(element, "group")
                parent = self._names.link(element, "parent_link")
                above = optional(element, "parent_group")
                for key, said in (("group", group), ("parent_group", above)):
                    if said and said not in groups:
                        raise ElementError(element, f"{key}={quote(said)} is no group of this file.")
                if parent in groups[group].links:
                    self._remarks.add(
                        element,
                        f"has its parent_link {quote(parent)} in its own group, which MoveIt refuses.",
                    )
                result[name] = EndEffector(name, group, parent, above)
        return result

    def _states(self, groups: dict[str, SrdfGroup]) -> dict[str, dict[str, float]]:
        states: dict[str, dict[str, float]] = {}
        by_group: dict[str, dict[str, dict[str, float]]] = {}
        for element in self._elements("group_state"):
            with self._remarks.passing_over():
                name, group = required(element, "name"), required(element, "group")
                if group not in groups:
                    raise ElementError(element, f"group={quote(group)} is no group of this file.")
                own = by_group.setdefault(group, {})
                if name in own:
                    raise ElementError(element, f"is a state of the group {quote(group)} already.")
                own[name] = values = self._values(element)
                together = states.setdefault(name, {})
                differing = [c for c, value in values.items() if together.setdefault(c, value) != value]
                if differing:
                    self._remarks.add(
                        element,
                        f"differs from the state of that name of another group, about {quote(differing[0])}; "
                        "in states the first one counts.",
                    )
        for group, own in by_group.items():
            groups[group] = replace(groups[group], states=own)
        return states

    def _values(self, state: Element) -> dict[str, float]:
        values: dict[str, float] = {}
        for part in state[2]:
            if part[0] != "joint":
                self._remarks.add(part, "is ignored: a state has joints only.", state)
                continue
            with self._remarks.passing_over(state):
                joint = self._names.joint(part)
                values.update(self._joint_values(part, joint))
        return values

    def _joint_values(self, part: Element, joint: str) -> dict[str, float]:
        record = self._names.articulations[joint]
        words = required(part, "value").split()
        try:
            numbers = [parse_number(word) for word in words]
        except ValueError as error:
            raise ElementError(part, f"value={quote(part[1]['value'])} {error}.") from None
        if record.follows is not None and not record.coordinates:
            return {}  # a mimic joint: its value follows from that of another joint
        names = [str(symbol) for symbol in record.coordinates]
        if not names:
            raise ElementError(part, "is fixed in the model, and has no value.")
        if len(numbers) != len(names):
            raise ElementError(
                part, f"has {len(numbers)} values, and the model has {len(names)}: {', '.join(names)}."
            )
        return dict(zip(names, numbers, strict=True))

    def _warn_unknown(self) -> None:
        for tag, elements in self._by_tag.items():
            if tag not in _IGNORED:
                for element in elements:
                    self._remarks.add(element, "is ignored: SRDF does not know it.")


_MOST_SUGGESTIONS = 50  # unknown names for which similar ones are looked up, which takes a while


class ModelNames:
    """Frames and articulations of a robot in a model, by their names in its files."""

    def __init__(self, model: ModelView, prefix: str) -> None:
        self._frames = dict(model.frames)
        self.prefix = f"{prefix}/" if prefix else ""  # with its slash
        self._free = {str(s) for s in model.degrees_of_freedom}
        self.articulations: Mapping[str, Articulation] = dict(model.articulations)
        self.above = {a.child: name for name, a in self.articulations.items()}
        self._near: dict[tuple[str, str], str] = {}
        self._sought: dict[str, bool] = {}

    def link(self, element: Element, key: str) -> str:
        """Return the frame of the link that an attribute names."""
        return self._find(element, key, "link", self._frames)

    def joint(self, element: Element, key: str = "name") -> str:
        """Return the articulation of the joint that an attribute names."""
        return self._find(element, key, "joint", self.articulations)

    def moving_joint_above(self, link: str) -> str | None:
        """Return the nearest articulation that moves a frame; None if there is none."""
        for frame in self._ancestors(link):
            joint = self.above.get(frame)
            if joint is not None and self.is_moving(joint):
                return joint
        return None

    def is_moving(self, joint: str) -> bool:
        """Return whether an articulation moves: it has coordinates, or follows others."""
        record = self.articulations[joint]
        return bool(record.coordinates or record.speeds or record.follows is not None)

    def free_coordinates(self, joint: str) -> list[str]:
        """Return the names of the free coordinates of an articulation."""
        return [str(s) for s in self.articulations[joint].coordinates if str(s) in self._free]

    def chain(self, base: str, tip: str) -> tuple[list[str], list[str]]:
        """Return the frames between two frames, both included, and the articulations between them.

        The way goes up from the base to the common ancestor and down to the tip.
        """
        up, down = self._ancestors(base), self._ancestors(tip)
        on_the_way_up = set(up)
        shared = next((frame for frame in down if frame in on_the_way_up), None)
        if shared is None:
            raise UnknownNameError(f"'{base}' and '{tip}' are joined by nothing but the world")
        rising, falling = up[: up.index(shared)], down[: down.index(shared)][::-1]
        frames = [*rising, shared, *falling]
        joints = [j for frame in (*rising, *falling) if (j := self.above.get(frame)) is not None]
        return frames, joints

    def check_robot(self, source: str) -> None:
        """Raise an UnknownNameError if nothing that was sought is in the model: the prefix is another one."""
        if not self._sought or any(self._sought.values()):
            return
        first, known = next(iter(self._sought)), {*self._frames, *self.articulations}
        prefixes = sorted(name.removesuffix(f"/{first}") for name in known if name.endswith(f"/{first}"))
        prefixes += [""] if first in known else []
        hint = (
            f"There is one below prefix {' and below '.join(map(repr, prefixes[:4]))}: give it as prefix=."
            if prefixes
            else suggest(self.prefix + first, known, "link or joint")
        )
        raise UnknownNameError(
            f"{source}: the model has no link or joint of this description below the prefix "
            f"'{self.prefix.rstrip('/')}', such as {quote(first)}. {hint}"
        )

    def _ancestors(self, frame: str) -> list[str]:
        result = []
        while frame != WORLD:
            result.append(frame)
            frame = self._frames[frame].parent
        return result

    def _find(self, element: Element, key: str, what: str, known: Mapping[str, object]) -> str:
        said = required(element, key)
        name = self.prefix + said
        self._sought[said] = self._sought.get(said, False) or name in known
        if name in known:
            return name
        if (what, said) not in self._near and len(self._near) < _MOST_SUGGESTIONS:
            below = [name[len(self.prefix) :] for name in known if name.startswith(self.prefix)]
            self._near[what, said] = f" ({suggest(said, below, what).rstrip('.')})"
        hint = self._near.get((what, said), "")
        raise ElementError(element, f"{quote(said)} is no {what} of the model{hint}.")


def optional(element: Element, key: str) -> str:
    """Return an attribute of an element without blanks around it, as MoveIt takes names; empty if missing."""
    return element[1].get(key, "").strip()


def required(element: Element, key: str) -> str:
    """Return an attribute of an element without blanks around it."""
    said = optional(element, key)
    if not said:
        raise ElementError(element, f"has no {key}; {label(element).split()[0].strip('<>')} needs one.")
    return said


MOST_GROUPS = 1000  # each may contain all the others, so the result grows with the square


@dataclass
class _Members:
    """Joints and links of a group in the order of the file; the values are not used."""

    joints: dict[str, None] = field(default_factory=dict)
    links: dict[str, None] = field(default_factory=dict)

    def add(self, joints: list[str], links: list[str]) -> None:
        self.joints.update(dict.fromkeys(joints))
        self.links.update(dict.fromkeys(links))


class GroupResolver:
    """Groups of one document, resolved in a model."""

    def __init__(
        self,
        elements: Mapping[str, Element],
        names: ModelNames,
        virtual_joints: Mapping[str, VirtualJoint],
        remarks: ReaderWarnings,
    ) -> None:
        self._elements, self._names, self._remarks = elements, names, remarks
        self._virtual_joints = virtual_joints
        self._members: dict[str, _Members] = {}

    def resolve(self, passive_joints: tuple[str, ...]) -> dict[str, SrdfGroup]:
        """Return all groups, without named states, in the order of the file."""
        for name in self._ordered():
            self._members[name] = self._resolve(self._elements[name])
        passive = set(passive_joints)
        groups = {}
        for name in self._elements:
            members = self._members[name]
            joints = [joint for joint in members.joints if self._names.is_moving(joint)]
            free = [c for j in joints if j not in passive for c in self._names.free_coordinates(j)]
            groups[name] = SrdfGroup(name, tuple(joints), tuple(dict.fromkeys(free)), tuple(members.links))
        return groups

    def _ordered(self) -> list[str]:
        """Return the names of the groups, subgroups first; a group is no part of itself."""
        done: dict[str, None] = {}
        for start in self._elements:
            if start in done:
                continue
            # A stack in place of recursion, since a file may nest its groups as deep as it likes.
            stack = [(start, iter(self._elements[start][2]))]
            open_names = {start}
            while stack:
                name, parts = stack[-1]
                part = next(parts, None)
                if part is None:
                    stack.pop()
                    open_names.discard(name)
                    done[name] = None
                    continue
                inner = optional(part, "name") if part[0] == "group" else ""
                if inner in open_names:
                    with self._remarks.passing_over(self._elements[name]):
                        raise ElementError(part, "contains itself.")
                elif inner in self._elements and inner not in done:
                    stack.append((inner, iter(self._elements[inner][2])))
                    open_names.add(inner)
        return list(done)

    def _resolve(self, group: Element) -> _Members:
        members = _Members()
        for part in group[2]:
            with self._remarks.passing_over(group):
                self._add(members, part, group)
        return members

    def _add(self, members: _Members, part: Element, group: Element) -> None:
        names, tag = self._names, part[0]
        if tag == "joint":
            self._add_joint(members, part)
        elif tag == "link":
            link = names.link(part, "name")
            above = names.above.get(link)
            members.add([] if above is None else [above], [link])
        elif tag == "chain":
            base, tip = names.link(part, "base_link"), names.link(part, "tip_link")
            try:
                links, joints = names.chain(base, tip)
            except UnknownNameError as error:
                raise ElementError(part, f"is no chain: {error}.") from None
            members.add(joints, links)
        elif tag == "group":
            inner = required(part, "name")
            if inner not in self._elements:
                named = ", ".join(quote(name) for name in list(self._elements)[:8])
                raise ElementError(part, f"is no group of this file; there are {named}.")
            # A group that contains itself has been reported already.
            found = self._members.get(inner, _Members())
            members.add(list(found.joints), list(found.links))
        elif tag == "passive_joint":
            self._remarks.add(part, "is a joint of the group here; outside of groups it is passive.", group)
            self._add_joint(members, part)
        else:
            self._remarks.add(part, "is ignored: a group has no such part.", group)

    def _add_joint(self, members: _Members, part: Element) -> None:
        name = optional(part, "name")
        if name in self._virtual_joints:
            # The model may have a base in its place, whose articulation has another name.
            above = self._names.moving_joint_above(self._virtual_joints[name].child_link)
            joint = [] if above is None else [above]
        else:
            joint = [self._names.joint(part)]
        members.add(joint, [self._names.articulations[name].child for name in joint])


def add_unique(elements: dict[str, Element], element: Element, remarks: ReaderWarnings) -> bool:
    """Add an element under its name and return True; for a name that is taken, warn and return False."""
    name = required(element, "name")
    first = elements.setdefault(name, element)
    if first is element:
        return True
    mistake = ElementError(element, f"has the name of {label(first)} of line {first[3]} again.")
    remarks.repair(mistake, "the first one counts")
    return False
