"""Joints that follow joints, resolved to the ones that move by themselves."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NoReturn

from kineverse.errors import FormatError, suggest
from kineverse.formats.chains import Following, resolve_chains
from kineverse.formats.markup import quote
from kineverse.formats.urdf.description import FREEDOM, Joint, Mimic


def resolve(joints: Iterable[Joint], source: str) -> list[Joint]:
    """Return the joints, each ``mimic`` naming the joint at the end of its chain and the composed factors.

    Raises
    ------
    FormatError
        If a joint mimics one that does not exist, itself, in a circle, or one that has no single position.
    """
    joints = list(joints)
    if all(joint.mimic is None for joint in joints):
        return joints
    by_name = {joint.name: joint for joint in joints}

    def refuse(follower: str, reason: str) -> NoReturn:
        line = by_name[follower].line
        raise FormatError(f"{source}, line {line}, <mimic> of <joint name={quote(follower)}>: {reason}")

    def check(follower: str, name: str) -> None:
        leader = by_name.get(name)
        if leader is None:
            movable = [joint.name for joint in joints if FREEDOM[joint.kind] == 1]
            refuse(
                follower,
                f"it mimics {quote(name)}, and there is no joint of that name. "
                f"{suggest(name, movable, 'joint to mimic')}",
            )
        if FREEDOM[leader.kind] != 1:
            refuse(
                follower,
                f"it mimics {quote(leader.name)} (line {leader.line}), which is {leader.kind} and so has no "
                "single position to follow. Mimic a revolute, continuous or prismatic joint.",
            )

    following = {
        joint.name: Following(joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
        for joint in joints
        if joint.mimic is not None
    }
    resolved = resolve_chains(following, refuse, check=check)
    return [
        replace(joint, mimic=Mimic(end.leader, end.multiplier, end.offset))
        if (end := resolved.get(joint.name))
        else joint
        for joint in joints
    ]
