"""Planning groups of a semantic description: listed joints, links, chains and subgroups, resolved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from kineverse.errors import UnknownNameError
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.srdf.description import SrdfGroup, VirtualJoint
from kineverse.formats.srdf.model_names import ModelNames, optional, required
from kineverse.formats.xml_reader import Element, ElementError, label, quote

MOST_GROUPS = 1000
"""Largest number of groups: each may contain all the others, so the result grows with its square."""

PASSED_OVER = "it is passed over"


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
                    mistake = ElementError(part, "contains itself.")
                    self._remarks.mend(mistake, PASSED_OVER, self._elements[name])
                elif inner in self._elements and inner not in done:
                    stack.append((inner, iter(self._elements[inner][2])))
                    open_names.add(inner)
        return list(done)

    def _resolve(self, group: Element) -> _Members:
        members = _Members()
        for part in group[2]:
            try:
                self._add(members, part, group)
            except ElementError as mistake:
                self._remarks.mend(mistake, PASSED_OVER, group)
        return members

    def _add(self, members: _Members, part: Element, group: Element) -> None:
        """Add the joints and links that one child of a group stands for."""
        names, tag = self._names, part[0]
        if tag == "joint":
            self._add_joint(members, part)
        elif tag == "link":
            link = names.link(part, "name")
            above = names.joint_above(link)
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
                raise ElementError(part, f"is no group of this file; {_list(self._elements)}.")
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
        members.add(joint, self._names.child_links(joint))


def _list(groups: Mapping[str, Element]) -> str:
    named = ", ".join(quote(name) for name in list(groups)[:8])
    return f"there are {named}" if named else "there is none"


def add_unique(elements: dict[str, Element], element: Element, remarks: ReaderWarnings) -> bool:
    """Add an element under its name and return True; for a name that is taken, warn and return False."""
    name = required(element, "name")
    first = elements.setdefault(name, element)
    if first is element:
        return True
    mistake = ElementError(element, f"has the name of {label(first)} of line {first[3]} again.")
    remarks.mend(mistake, "the first one counts")
    return False
