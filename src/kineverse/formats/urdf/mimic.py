"""Mimic joints of a URDF, resolved to the joints that move independently."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from kineverse.errors import FormatError, suggest
from kineverse.formats.mimic import MimicRelation, resolve_mimic_chains
from kineverse.formats.reader_warnings import ReaderWarnings
from kineverse.formats.urdf.description import DOF_BY_TYPE, UrdfJoint, UrdfMimic
from kineverse.formats.xml_reader import quote


def resolve_mimic_joints(joints: Iterable[UrdfJoint], remarks: ReaderWarnings) -> list[UrdfJoint]:
    """Resolve mimic chains: each ``mimic`` names the joint at the end of its chain and the composed factors.

    A joint is independent, with a remark, if the joint that it mimics does not exist, has no single position,
    or mimics it in a cycle. Other parsers do the same.
    """
    joints = list(joints)
    if all(joint.mimic is None for joint in joints):
        return joints
    by_name = {joint.name: joint for joint in joints}

    def refuse(follower: str, reason: str) -> None:
        line, text = by_name[follower].line, f"<mimic> of <joint name={quote(follower)}>: {reason}"
        if remarks.strict:
            raise FormatError(f"{remarks.source}, line {line}, {text}")
        remarks.fault(line, f"{text.rstrip('. ')}; it moves by itself.")

    def check(follower: str, name: str) -> bool:
        leader = by_name.get(name)
        if leader is None:
            movable = [joint.name for joint in joints if DOF_BY_TYPE[joint.kind] == 1]
            refuse(
                follower,
                f"it mimics {quote(name)}, and there is no joint of that name. "
                f"{suggest(name, movable, 'joint to mimic')}",
            )
            return False
        if DOF_BY_TYPE[leader.kind] != 1:
            refuse(
                follower,
                f"it mimics {quote(leader.name)} (line {leader.line}), which is {leader.kind} and so has no "
                "single position to follow. Mimic a revolute, continuous or prismatic joint.",
            )
            return False
        return True

    following = {
        joint.name: MimicRelation(joint.mimic.joint, joint.mimic.multiplier, joint.mimic.offset)
        for joint in joints
        if joint.mimic is not None
    }
    resolved = resolve_mimic_chains(following, refuse, check=check)
    return [
        replace(joint, mimic=UrdfMimic(end.leader, end.multiplier, end.offset))
        if (end := resolved.get(joint.name))
        else replace(joint, mimic=None)
        for joint in joints
    ]
