"""Joints that follow joints, resolved to the ones that move by themselves.

Of a chain ``c = m2 b + o2``, ``b = m1 a + o1`` remains ``c = (m2 m1) a + (m2 o1 + o2)``. Each joint is
resolved once, so that chains of any length take linear time.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

from kineverse.errors import FormatError, suggest
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
    resolved: dict[str, Mimic] = {}
    for joint in joints:
        if joint.mimic is not None and joint.name not in resolved:
            _resolve_chain(joint, by_name, resolved, source)
    return [replace(joint, mimic=resolved[joint.name]) if joint.mimic else joint for joint in joints]


def _resolve_chain(start: Joint, by_name: dict[str, Joint], resolved: dict[str, Mimic], source: str) -> None:
    chain: dict[str, Joint] = {}
    joint = start
    while joint.mimic is not None and joint.name not in resolved:
        chain[joint.name] = joint
        leader = by_name.get(joint.mimic.joint)
        if leader is None:
            movable = [name for name, other in by_name.items() if FREEDOM[other.kind] == 1]
            raise FormatError(
                f"{_place(source, joint)}: it mimics {quote(joint.mimic.joint)}, and there is no joint of "
                f"that name. {suggest(joint.mimic.joint, movable, 'joint to mimic')}"
            )
        if leader.name in chain:
            circle = " -> ".join(f"{quote(name)}" for name in list(chain)[:8])
            raise FormatError(
                f"{_place(source, joint)}: it mimics itself"
                + (f", by way of {circle}" if len(chain) > 1 else "")
                + ". One of them has to move by itself: remove its <mimic>."
            )
        if FREEDOM[leader.kind] != 1:
            raise FormatError(
                f"{_place(source, joint)}: it mimics {quote(leader.name)} (line {leader.line}), which is "
                f"{leader.kind} and so has no single position to follow. Mimic a revolute, continuous or "
                "prismatic joint."
            )
        joint = leader
    end = resolved.get(joint.name, Mimic(joint.name))
    for follower in reversed(chain.values()):
        assert follower.mimic is not None
        multiplier = follower.mimic.multiplier * end.multiplier
        offset = follower.mimic.multiplier * end.offset + follower.mimic.offset
        if not (math.isfinite(multiplier) and math.isfinite(offset)):
            raise FormatError(f"{_place(source, follower)}: the factors along its chain of <mimic> overflow.")
        end = resolved[follower.name] = Mimic(end.joint, multiplier, offset)


def _place(source: str, joint: Joint) -> str:
    return f"{source}, line {joint.line}, <mimic> of <joint name={quote(joint.name)}>"
