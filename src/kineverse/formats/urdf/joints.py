"""``<joint>`` elements to joints.

Specification: http://wiki.ros.org/urdf/XML/joint, and urdf.xsd of ros/urdfdom for defaults. A joint is read
for what its kind can have: the limits of a fixed joint mean nothing and are not looked at.
"""

from __future__ import annotations

import math
import sys

from kineverse.errors import suggest
from kineverse.formats.markup import Element, ElementError, abbreviate, name_of
from kineverse.formats.numerals import LARGEST
from kineverse.formats.remarks import Remarks
from kineverse.formats.rpy import snap
from kineverse.formats.urdf.attributes import number, pose, vector
from kineverse.formats.urdf.description import (
    FREEDOM,
    FRICTIONLESS,
    UNLIMITED,
    Dynamics,
    Joint,
    Kind,
    Limits,
    Mimic,
    Safety,
)
from kineverse.model.body import Vector3

_X = (1.0, 0.0, 0.0)
_SHORTEST_AXIS = 1e-9
_PARTS = frozenset(
    ("origin", "parent", "child", "axis", "limit", "safety_controller", "mimic", "dynamics", "calibration")
)


def read_joint(element: Element, version: tuple[int, int], remarks: Remarks) -> Joint:
    """Return the joint an element describes; what it mimics is not resolved yet.

    Raises
    ------
    ElementError
        If something is missing, malformed or without meaning.
    """
    name = name_of(element)
    kind = _kind(element)
    parts = _parts(element, remarks)
    origin = pose(parts.get("origin"), element, version, remarks)
    parent, child = _link(element, parts, "parent"), _link(element, parts, "child")
    line = element[3]
    if kind in ("fixed", "floating", "planar"):
        if "mimic" in parts and kind != "fixed":
            raise ElementError(
                parts["mimic"], f"cannot drive a {kind} joint: only a joint of one DoF can mimic."
            )
        axis = _axis(parts.get("axis"), element, remarks) if kind == "planar" else None
        return Joint(name, kind, parent, child, origin, axis, line=line)
    limit, safety, mimic, dynamics = map(parts.get, ("limit", "safety_controller", "mimic", "dynamics"))
    limits = _limits(limit, kind, element, version, remarks)
    return Joint(
        name,
        kind,
        parent,
        child,
        origin,
        _axis(parts.get("axis"), element, remarks),
        limits,
        _safety(safety, limits),
        None if mimic is None else _mimic(mimic),
        FRICTIONLESS
        if dynamics is None
        else Dynamics(number(dynamics, "damping", 0.0), number(dynamics, "friction", 0.0)),
        line,
    )


def _kind(element: Element) -> Kind:
    kind = element[1].get("type")
    if kind is None:
        raise ElementError(element, f"has no type; the specification requires one of {', '.join(FREEDOM)}.")
    if kind not in FREEDOM:
        raise ElementError(
            element, f'type="{abbreviate(kind)}" is no joint type of URDF. {suggest(kind, FREEDOM, "type")}'
        )
    return kind


def _parts(element: Element, remarks: Remarks) -> dict[str, Element]:
    """Return the children by tag, of several with one tag the first, as all parsers do."""
    children = element[2]
    parts = {part[0]: part for part in reversed(children)}
    if len(parts) != len(children):
        for part in children:
            if part[0] in _PARTS and part is not parts[part[0]] and part[1] != parts[part[0]][1]:
                remarks.add(part, f"is ignored: the one on line {parts[part[0]][3]} came first.", element)
    return parts


def _link(element: Element, parts: dict[str, Element], role: str) -> str:
    part = parts.get(role)
    if part is None:
        raise ElementError(element, f'has no <{role} link="..."/>; the specification requires it.')
    link = part[1].get("link")
    if not link:
        raise ElementError(part, "does not say which link.")
    return link


def _axis(axis: Element | None, joint: Element, remarks: Remarks) -> Vector3:
    """Return the unit vector of an axis; the specification's default is x."""
    if axis is None:
        return _X
    x, y, z = vector(axis, "xyz", _X)
    length = math.hypot(x, y, z)
    if length < _SHORTEST_AXIS:
        raise ElementError(
            axis, f'xyz="{abbreviate(axis[1]["xyz"])}" has length zero: nothing to move along or about.'
        )
    if abs(length - 1.0) > 1e-3:
        remarks.add(axis, f"has length {length:g}; only its direction is used.", joint)
    return (snap(x / length), snap(y / length), snap(z / length))


def _limits(
    limit: Element | None, kind: Kind, joint: Element, version: tuple[int, int], remarks: Remarks
) -> Limits:
    if limit is None:
        if kind == "continuous":
            return UNLIMITED
        raise ElementError(
            joint,
            f"is {kind} but has no <limit>; the specification requires "
            '<limit lower="..." upper="..." effort="..." velocity="..."/>'
            + (', or type="continuous" for a joint without bounds.' if kind == "revolute" else "."),
        )
    if version >= (1, 2):
        return _limits_1_2(limit, kind)
    effort, velocity = number(limit, "effort"), number(limit, "velocity")
    if velocity <= 0.0:
        remarks.add(limit, f"has velocity {velocity:g}, which is taken as no bound at all.", joint)
    lower = upper = None
    if kind != "continuous":
        lower, upper = _range(limit, number(limit, "lower", 0.0), number(limit, "upper", 0.0))
        if "lower" not in limit[1] and "upper" not in limit[1]:
            remarks.add(
                limit, "has neither lower nor upper; both are 0 by the specification: it cannot move.", joint
            )
    for key in ("acceleration", "deceleration", "jerk"):
        if key in limit[1]:
            remarks.add(limit, f"has {key}, which is ignored: it came with URDF 1.2.", joint)
    return Limits(
        _bound(lower), _bound(upper), _bound(velocity) if velocity > 0.0 else None, _bound(abs(effort))
    )


def _limits_1_2(limit: Element, kind: Kind) -> Limits:
    """Return limits as URDF 1.2 reads them: open where left out, but a range needs both ends."""
    lower = upper = None
    if kind != "continuous":
        lower, upper = _range(limit, number(limit, "lower"), number(limit, "upper"))
    keys = ("velocity", "effort", "acceleration", "deceleration", "jerk")
    values = {key: number(limit, key) for key in keys if key in limit[1]}
    for key, value in values.items():
        if value < 0.0:
            raise ElementError(limit, f"has {key}={value!r}; URDF 1.2 refuses negative magnitudes.")
    if "acceleration" in values:
        values.setdefault("deceleration", values["acceleration"])
    return Limits(_bound(lower), _bound(upper), **{key: _bound(value) for key, value in values.items()})


def _bound(value: float | None) -> float | None:
    """Return a bound; the largest number there is bounds nothing, and is written where URDF wants one."""
    return None if value is None or abs(value) == sys.float_info.max else value


def _range(limit: Element, lower: float, upper: float) -> tuple[float, float]:
    if lower > upper:
        raise ElementError(limit, f"has lower={lower!r} above upper={upper!r}: no position would be valid.")
    if lower > LARGEST or upper < -LARGEST:
        raise ElementError(
            limit, f"has lower={lower!r} and upper={upper!r}: all positions would be beyond {LARGEST:g}."
        )
    return lower, upper


def _safety(safety: Element | None, limits: Limits) -> Safety | None:
    if safety is None:
        return None
    lower, upper = number(safety, "soft_lower_limit", 0.0), number(safety, "soft_upper_limit", 0.0)
    if lower > upper:
        raise ElementError(safety, f"has soft_lower_limit={lower!r} above soft_upper_limit={upper!r}.")
    result = Safety(lower, upper, number(safety, "k_position", 0.0), number(safety, "k_velocity"))
    if limits.lower is None or limits.upper is None or not result.bounds:
        return result
    if upper < limits.lower or lower > limits.upper:
        raise ElementError(
            safety,
            f"has soft limits [{lower!r}, {upper!r}] outside of the limits "
            f"[{limits.lower!r}, {limits.upper!r}]: no position would be valid.",
        )
    return result


def _mimic(mimic: Element) -> Mimic:
    joint = mimic[1].get("joint")
    if not joint:
        raise ElementError(mimic, "does not say which joint.")
    return Mimic(joint, number(mimic, "multiplier", 1.0), number(mimic, "offset", 0.0))
