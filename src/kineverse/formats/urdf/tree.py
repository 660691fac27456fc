"""That links and joints form one tree.

Everything here is iterative and linear, whatever the depth: a chain of 10^5 links is a robot like any other.
"""

from __future__ import annotations

from collections.abc import Sequence

from kineverse.errors import FormatError, suggest
from kineverse.formats.markup import quote
from kineverse.formats.urdf.description import Joint, Link

_SHOWN = 8


def root_outwards(
    links: Sequence[Link], joints: Sequence[Joint], source: str, hint: str = ""
) -> tuple[str, tuple[Joint, ...]]:
    """Return the root link, and the joints from there outwards, children in the order of the file.

    Parameters
    ----------
    links, joints
        In the order of the file, with unique names.
    source
        The name of the file in error messages.
    hint
        What else the reader noticed that may explain why there is no tree.

    Raises
    ------
    FormatError
        If a joint names a link that does not exist, a link has two parents, or there is not exactly one root.
    """
    lines = {link.name: link.line for link in links}
    joints_below: dict[str, list[Joint]] = {}
    joint_above: dict[str, Joint] = {}
    for joint in joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in lines:
                raise FormatError(
                    f"{_place(source, joint)}: its {role} link {quote(name)} does not exist; every link "
                    f"needs a <link> element of its own. {suggest(name, lines, 'link')}"
                )
        other = joint_above.setdefault(joint.child, joint)
        if other is not joint:
            raise FormatError(
                f"{_place(source, joint)}: its child link {quote(joint.child)} has a parent already, by "
                f"the joint {quote(other.name)} on line {other.line}. URDF describes trees only: a link "
                "has one parent."
            )
        joints_below.setdefault(joint.parent, []).append(joint)

    roots = [link for link in links if link.name not in joint_above]
    if len(roots) > 1:
        shown = ", ".join(f"{quote(link.name)} (line {link.line})" for link in roots[:_SHOWN])
        more = f" and {len(roots) - _SHOWN} more" if len(roots) > _SHOWN else ""
        raise FormatError(
            f"{source}, line {roots[1].line}, <link name={quote(roots[1].name)}>: there are {len(roots)} "
            "links that are nobody's child, where one root is expected: "
            f"{shown}{more}. Connect them by joints.{hint}"
        )
    ordered = _outwards(roots[0].name, joints_below) if roots else []
    if len(ordered) != len(joints):
        reached = {joint.child for joint in ordered}
        loop = _loop(next(joint for joint in joints if joint.child not in reached), joint_above)
        shown = " -> ".join(f"{quote(joint.name)}" for joint in loop[:_SHOWN])
        more = f" and {len(loop) - _SHOWN} more" if len(loop) > _SHOWN else ""
        circle = (
            f"the joints {shown}{more} lead in a circle"
            if len(loop) > 1
            else "its child link is its own parent"
        )
        raise FormatError(
            f"{_place(source, loop[0])}: {circle}. URDF describes trees only: remove a joint.{hint}"
        )
    return roots[0].name, tuple(ordered)


def _outwards(root: str, joints_below: dict[str, list[Joint]]) -> list[Joint]:
    """Return the joints below a link, depth first."""
    ordered: list[Joint] = []
    ahead = joints_below.get(root, [])[::-1]
    while ahead:
        joint = ahead.pop()
        ordered.append(joint)
        ahead.extend(reversed(joints_below.get(joint.child, ())))
    return ordered


def _loop(start: Joint, joint_above: dict[str, Joint]) -> list[Joint]:
    """Return the joints of the circle that ``start`` is in or below, from the first of the file onwards."""
    joint, passed = start, {start.name}
    while True:
        joint = joint_above[joint.parent]
        if joint.name in passed:
            break
        passed.add(joint.name)
    loop = [joint]
    while (above := joint_above[loop[-1].parent]) is not joint:
        loop.append(above)
    loop.reverse()
    first = min(range(len(loop)), key=lambda index: loop[index].line)
    return loop[first:] + loop[:first]


def _place(source: str, joint: Joint) -> str:
    return f"{source}, line {joint.line}, <joint name={quote(joint.name)}>"
