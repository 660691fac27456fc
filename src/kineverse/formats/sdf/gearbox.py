"""SDF gearboxes as hinges of which one follows the other.

θ2 = -ratio θ1, with the angle θ1 from the reference body to the parent about ``<axis>`` and the angle θ2 from
the reference body to the child about ``<axis2>``. The hinge of the parent is another joint of the file. If
there is no hinge of the child, the gearbox becomes that hinge.
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
_HINGE_TYPES = ("revolute", "continuous")


def resolve_gearboxes(
    hinges: Sequence[ResolvedJoint], attachments: dict[PoseNode, PoseNode]
) -> list[ResolvedJoint]:
    """Replace gearboxes by hinges that follow others.

    A gearbox that couples two other hinges is removed, and the hinge of its child follows that of its parent.
    """
    between: dict[frozenset[PoseNode], int] = {}
    result: list[ResolvedJoint | None] = list(hinges)
    for index, hinge in enumerate(hinges):
        if hinge.joint.kind in _HINGE_TYPES:
            between.setdefault(frozenset((hinge.parent, hinge.child)), index)
    for index, hinge in enumerate(hinges):
        if hinge.joint.kind != "gearbox":
            continue
        node = hinge.node
        if not read_child_text(node.element, "gearbox_reference_body"):
            with node.document.locate_errors(node.element):
                mistake = ElementError(
                    node.element, "has no <gearbox_reference_body>: nothing says what it turns against."
                )
                node.document.remarks.mend(mistake, "it is left out")
            result[index] = None
            continue
        body = find_reference_body(node, attachments)
        with node.document.locate_errors(node.element):
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
                pose_in_parent=pose_between(body, node),
                axes=(replace(second, suffix=""),),
                gear=MimicRelation(driver.joint.name, factor),
            )
            result[index] = replace(hinge, joint=joint, parent=body)
            continue
        found = result[driven]
        assert found is not None
        axis = found.joint.axes[0]
        if axis.mimic is not None:
            node.refuse(f"its child's hinge {quote(found.joint.name)} follows another joint already.")
        factor *= _sense(found, hinge, body, second)
        axis = replace(axis, mimic=MimicRelation(driver.joint.name, factor))
        result[driven] = replace(found, joint=replace(found.joint, axes=(axis,)))
        result[index] = None
    return [hinge for hinge in result if hinge is not None]


def _sense(hinge: ResolvedJoint, gearbox: ResolvedJoint, body: PoseNode, axis: SdfAxis) -> float:
    """Return the sign of a hinge's angle from the reference body about an axis of the gearbox, 1 or -1."""
    hinge_axis = rotate_direction(pose_between(gearbox.node, hinge.node), hinge.joint.axes[0].xyz)
    cosine = _dot(hinge_axis, axis.xyz)
    if abs(cosine) < 1.0 - _PARALLEL:
        angle = math.degrees(math.acos(min(abs(cosine), 1.0)))
        gearbox.node.refuse(
            f"its axis is {angle:.3g}° away from that of the hinge {quote(hinge.joint.name)}, "
            "where they have to be parallel."
        )
    return math.copysign(1.0, cosine) * (1.0 if hinge.parent is body else -1.0)


def _dot(a: Vector3, b: Vector3) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))
