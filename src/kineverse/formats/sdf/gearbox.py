"""SDF gearboxes as hinges of which one follows the other.

With θ1 the angle from the reference body to the parent about ``<axis>`` and θ2 that from there to the child
about ``<axis2>``, θ2 = -ratio θ1. The hinge of the parent is another joint of the file. That of the
child may be one; where there is none, the gearbox is that hinge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from kineverse.formats.mimic import MimicRelation
from kineverse.formats.poses import rotate_direction
from kineverse.formats.xml_reader import ElementError, quote
from kineverse.formats.xml_values import read_child_number, read_child_text
from kineverse.model.body import Vector3

from .description import SdfAxis
from .joints import ResolvedJoint, find_reference_body
from .pose_graph import PoseNode, pose_between

_PARALLEL = 1e-4
_TURNING = ("revolute", "continuous")


def resolve_gearboxes(
    hinges: Sequence[ResolvedJoint], carriers: dict[PoseNode, PoseNode]
) -> list[ResolvedJoint]:
    """Return the joints without the gearboxes that only couple two others, which follow each other instead.

    Raises
    ------
    FormatError
        If a gearbox has nothing to couple.
    """
    between: dict[frozenset[PoseNode], int] = {}
    result: list[ResolvedJoint | None] = list(hinges)
    for at, hinge in enumerate(hinges):
        if hinge.joint.kind in _TURNING:
            between.setdefault(frozenset((hinge.parent, hinge.child)), at)
    for at, hinge in enumerate(hinges):
        if hinge.joint.kind != "gearbox":
            continue
        node = hinge.node
        if not read_child_text(node.element, "gearbox_reference_body"):
            with node.document.about(node.element):
                mistake = ElementError(
                    node.element, "has no <gearbox_reference_body>: nothing says what it turns against."
                )
                node.document.remarks.mend(mistake, "it is left out")
            result[at] = None
            continue
        body = find_reference_body(node, carriers)
        with node.document.about(node.element):
            ratio = read_child_number(node.element, "gearbox_ratio", 1.0)
        if not ratio:
            node.refuse("has the ratio 0, so nothing would turn.")
        driving = between.get(frozenset((body, hinge.parent)))
        if driving is None:
            node.refuse(
                f"there is no hinge between its reference body {quote(body.path)} and its parent "
                f"{quote(hinge.parent.path)}, whose angle it would pass on."
            )
        first, second = hinge.joint.axes
        driver = hinges[driving]
        factor = -ratio * _sense(driver, hinge, body, first)
        driven = between.get(frozenset((body, hinge.child)))
        if driven is None:
            joint = replace(
                hinge.joint,
                parent=body.path or "world",
                in_parent=pose_between(body, node),
                axes=(replace(second, suffix=""),),
                gear=MimicRelation(driver.joint.name, factor),
            )
            result[at] = replace(hinge, joint=joint, parent=body)
            continue
        found = result[driven]
        assert found is not None
        axis = found.joint.axes[0]
        if axis.following is not None:
            node.refuse(f"its child's hinge {quote(found.joint.name)} follows another joint already.")
        factor *= _sense(found, hinge, body, second)
        following = replace(axis, following=MimicRelation(driver.joint.name, factor))
        result[driven] = replace(found, joint=replace(found.joint, axes=(following,)))
        result[at] = None
    return [hinge for hinge in result if hinge is not None]


def _sense(hinge: ResolvedJoint, gearbox: ResolvedJoint, body: PoseNode, axis: SdfAxis) -> float:
    """Return 1 where a hinge turns from the body about an axis of the gearbox, -1 where against that."""
    there = rotate_direction(pose_between(gearbox.node, hinge.node), hinge.joint.axes[0].xyz)
    cosine = _dot(there, axis.xyz)
    if abs(cosine) < 1.0 - _PARALLEL:
        angle = math.degrees(math.acos(min(abs(cosine), 1.0)))
        gearbox.node.refuse(
            f"its axis is {angle:.3g}° away from that of the hinge {quote(hinge.joint.name)}, "
            "where they have to be parallel."
        )
    return math.copysign(1.0, cosine) * (1.0 if hinge.parent is body else -1.0)


def _dot(a: Vector3, b: Vector3) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))
