"""URDF joint elements as checked joints.

Specification: http://wiki.ros.org/urdf/XML/joint, and urdf.xsd of ros/urdfdom for defaults. The limits of a
fixed joint, which does not move, are ignored; what a joint that moves does not have is, with a remark.
Mistakes that other parsers accept are read as they do, with a remark, unless the document is read strictly.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from functools import partial

from msgspec.structs import replace

from kineverse.errors import FormatError, suggest
from kineverse.formats.mimic import MimicRelation, resolve_mimic_chains
from kineverse.formats.reader_warnings import ChangedMotion, CrossedLimits, Fault, ReaderWarnings
from kineverse.formats.xml_reader import Element, ElementError, abbreviate, quote, read_name
from kineverse.formats.xml_values import (
    LARGEST,
    read_attribute_number,
    read_attribute_vector,
    read_or_default,
    read_origin,
    scale_to_bounds,
)
from kineverse.lie import snap
from kineverse.model.body import Vector3

from .description import (
    DOF_BY_TYPE,
    FRICTIONLESS,
    SPECIFIED_TYPES,
    UNLIMITED,
    UrdfDynamics,
    UrdfJoint,
    UrdfJointType,
    UrdfLimits,
    UrdfSafetyController,
)

_X = (1.0, 0.0, 0.0)
_Z = (0.0, 0.0, 1.0)
_MIN_AXIS_LENGTH = 1e-9
_ZEROS = ("0", "0.0", "0.", "-0", "-0.0")
_PARTS = frozenset(
    ("origin", "parent", "child", "axis", "limit", "safety_controller", "mimic", "dynamics", "calibration")
)


def read_urdf_joint(element: Element, version: tuple[int, int], remarks: ReaderWarnings) -> UrdfJoint:
    """Return the joint of a ``<joint>`` element; mimic chains are not resolved yet."""
    name = read_or_default(lambda: read_name(element), "", "it is called by its links", remarks)
    kind = _kind(element, remarks)
    parts = _parts(element, remarks)
    parent, child = _link(element, parts, "parent"), _link(element, parts, "child")
    name = name or f"{parent}_{child}"
    origin = read_origin(parts.get("origin"), element, version, remarks)
    line = element[3]
    if kind == "fixed":
        return UrdfJoint(name, kind, parent, child, origin, line=line)
    has_one_dof = DOF_BY_TYPE[kind] == 1
    axis = None
    if has_one_dof:
        axis = _axis(parts.get("axis"), element, remarks, "the joint does not move, it is fixed")
        if axis is None:
            return UrdfJoint(name, "fixed", parent, child, origin, line=line)
    elif kind == "planar":
        axis = _axis(parts.get("axis"), element, remarks, "the plane is that of x and y") or _Z
    limit, safety, mimic, dynamics = map(parts.get, ("limit", "safety_controller", "mimic", "dynamics"))
    if mimic is not None and not has_one_dof:
        mistake = ElementError(mimic, f"cannot drive a {kind} joint: only a joint of one DoF can mimic.")
        remarks.repair(mistake, "it moves by itself", element)
        mimic = None
    limits = _limits(limit, kind, element, version, remarks)
    controller = read_or_default(lambda: _safety(safety, limits), None, "it is left out", remarks, element)
    if safety is not None and controller is not None and controller.has_limits:
        if not has_one_dof or kind == "continuous":
            remarks.add(
                safety, f"has soft limits, which a {kind} joint has none of here; they are ignored.", element
            )
            controller = replace(controller, soft_lower=0.0, soft_upper=0.0)
    return UrdfJoint(
        name,
        kind,
        parent,
        child,
        origin,
        axis,
        limits,
        controller,
        None if mimic is None else _mimic(mimic),
        read_or_default(lambda: _dynamics(dynamics), FRICTIONLESS, "it is left out", remarks, element),
        line,
    )


def _dynamics(dynamics: Element | None) -> UrdfDynamics:
    if dynamics is None:
        return FRICTIONLESS
    return UrdfDynamics(
        read_attribute_number(dynamics, "damping", 0.0), read_attribute_number(dynamics, "friction", 0.0)
    )


def _kind(element: Element, remarks: ReaderWarnings) -> UrdfJointType:
    kind = element[1].get("type")
    if kind is None:
        raise ElementError(
            element, f"has no type; the specification requires one of {', '.join(SPECIFIED_TYPES)}."
        )
    if kind not in SPECIFIED_TYPES:
        mistake = ElementError(
            element,
            f'type="{abbreviate(kind)}" is no joint type of URDF. {suggest(kind, SPECIFIED_TYPES, "type")}',
        )
        if kind not in DOF_BY_TYPE:
            raise mistake
        remarks.repair(mistake, "MuJoCo knows it as a ball joint, which it is here")
    return kind


def _parts(element: Element, remarks: ReaderWarnings) -> dict[str, Element]:
    """Return the children by tag; of several with one tag, the first, as all parsers do."""
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
        raise ElementError(part, "does not name a link.")
    return link


def _axis(axis: Element | None, joint: Element, remarks: ReaderWarnings, taken: str) -> Vector3 | None:
    """Return the unit vector of an axis, x by default; None, with a remark, for a vector of length zero."""
    if axis is None:
        return _X
    if "xyz" not in axis[1]:
        remarks.add(axis, "has no xyz; it is 1 0 0, the default, where others move about nothing.", joint)
    x, y, z = scale_to_bounds(read_attribute_vector(axis, "xyz", _X, turns=True))
    length = math.hypot(x, y, z)
    if length < _MIN_AXIS_LENGTH:
        mistake = ElementError(
            axis, f'xyz="{abbreviate(axis[1]["xyz"])}" has length zero: nothing to move along or about.'
        )
        remarks.repair(mistake, taken, joint)
        return None
    if abs(length - 1.0) > 1e-3:
        remarks.add(axis, f"has length {length:g}; only its direction is used.", joint)
    return (snap(x / length), snap(y / length), snap(z / length))


def _limits(
    limit: Element | None,
    kind: UrdfJointType,
    joint: Element,
    version: tuple[int, int],
    remarks: ReaderWarnings,
) -> UrdfLimits:
    if limit is None:
        if kind in ("revolute", "prismatic"):
            mistake = ElementError(
                joint,
                f"is {kind} but has no <limit>; the specification requires "
                '<limit lower="..." upper="..." effort="..." velocity="..."/>'
                + (', or type="continuous" for a joint without bounds.' if kind == "revolute" else "."),
            )
            remarks.repair(mistake, "it has no limits")
        return UNLIMITED
    newer = version >= (1, 2)
    lower = upper = None
    has_range = "lower" in limit[1] or "upper" in limit[1]
    if kind in ("revolute", "prismatic") or (kind == "planar" and has_range):
        lower, upper = _range(limit, joint, newer, remarks)
    elif has_range and any(limit[1].get(key, "0").strip() not in _ZEROS for key in ("lower", "upper")):
        remarks.add(limit, f"has lower and upper, which a {kind} joint has not; they are ignored.", joint)
    values = {key: _magnitude(limit, key, joint, newer, remarks) for key in ("effort", "velocity")}
    for key in ("acceleration", "deceleration", "jerk"):
        if newer:
            values[key] = _magnitude(limit, key, joint, newer, remarks)
        elif key in limit[1]:
            remarks.add(limit, f"has {key}, which is ignored: it came with URDF 1.2.", joint)
    if kind in ("floating", "spherical"):
        for key in ("velocity", "acceleration", "deceleration", "jerk"):
            if values.pop(key, None) is not None:
                remarks.add(limit, f"has {key}, which a {kind} joint has not here; it is ignored.", joint)
        return UrdfLimits(effort=_bound(values["effort"]))
    if values.get("deceleration") is None and "deceleration" not in limit[1]:
        values["deceleration"] = values.get("acceleration")
    return UrdfLimits(_bound(lower), _bound(upper), **{key: _bound(value) for key, value in values.items()})


def _magnitude(
    limit: Element, key: str, joint: Element, newer: bool, remarks: ReaderWarnings
) -> float | None:
    """Return a limit of a magnitude; from URDF 1.2 on it is optional and must not be negative."""
    if newer and key not in limit[1]:
        return None
    value = read_or_default(
        lambda: read_attribute_number(limit, key), None, "it bounds nothing", remarks, joint
    )
    if value is None:
        return None
    if newer and value < 0.0:
        mistake = ElementError(limit, f"has {key}={value!r}; URDF 1.2 refuses negative magnitudes.")
        remarks.repair(mistake, "it bounds nothing", joint)
        return None
    if key == "velocity" and not newer and value <= 0.0:
        remarks.add(limit, f"has velocity {value:g}, which is taken as no bound at all.", joint)
        return None
    return abs(value)


def _bound(value: float | None) -> float | None:
    """Return a limit; the largest float, written where URDF requires a number, is no limit."""
    return None if value is None or abs(value) == sys.float_info.max else value


def _range(
    limit: Element, joint: Element, newer: bool, remarks: ReaderWarnings
) -> tuple[float | None, float | None]:
    """Return the ends of a range, None for an infinite one; a joint without valid range is not limited.

    Bullet and MuJoCo read invalid ranges in the same way.
    """
    attributes = limit[1]
    if newer:
        for key in ("lower", "upper"):
            if key not in attributes:
                mistake = ElementError(limit, f"has no {key}; the specification requires it.")
                remarks.repair(mistake, "the joint is not limited", joint)
                return None, None
    elif "lower" not in attributes and "upper" not in attributes:
        remarks.add(
            limit, "has neither lower nor upper; both are 0 by the specification: it cannot move.", joint
        )
    lower, upper = _end(limit, "lower", joint, remarks), _end(limit, "upper", joint, remarks)
    if math.isnan(lower) or math.isnan(upper):
        return None, None
    invalid: ElementError | None = None
    kind: Callable[[str], Fault] = Fault
    if lower > upper:
        kind = partial(CrossedLimits.of, joint[1].get("name", ""))
        invalid = ElementError(
            limit, f"has lower={lower!r} above upper={upper!r}: no position would be valid."
        )
    elif lower > LARGEST or upper < -LARGEST:
        invalid = ElementError(
            limit, f"has lower={lower!r} and upper={upper!r}: all positions would be beyond {LARGEST:g}."
        )
    if invalid is not None:
        remarks.repair(invalid, "the joint is not limited", joint, kind)
        return None, None
    return (lower if lower > -math.inf else None), (upper if upper < math.inf else None)


def _end(limit: Element, key: str, joint: Element, remarks: ReaderWarnings) -> float:
    """Return an end of a range: infinite for no limit, NaN if the attribute is no number."""
    text = limit[1].get(key, "0").strip()
    if not text:
        return read_or_default(lambda: read_attribute_number(limit, key), 0.0, "it is 0", remarks, joint)
    try:
        value = float(text) if text.isascii() and "_" not in text else None
    except ValueError:
        value = None
    if value is None or math.isfinite(value):
        return read_attribute_number(limit, key, 0.0)
    return read_or_default(
        lambda: read_attribute_number(limit, key), value, "it bounds nothing", remarks, joint
    )


def _safety(safety: Element | None, limits: UrdfLimits) -> UrdfSafetyController | None:
    """Return the safety controller of a joint; its soft limits have to overlap the limits."""
    if safety is None:
        return None
    keys = ("soft_lower_limit", "soft_upper_limit", "k_position")
    lower, upper, gain = (read_attribute_number(safety, key, 0.0) for key in keys)
    if lower > upper:
        raise ElementError(safety, f"has soft_lower_limit={lower!r} above soft_upper_limit={upper!r}.")
    result = UrdfSafetyController(lower, upper, gain, read_attribute_number(safety, "k_velocity"))
    if limits.lower is None or limits.upper is None or not result.has_limits:
        return result
    if upper < limits.lower or lower > limits.upper:
        raise ElementError(
            safety,
            f"has soft limits [{lower!r}, {upper!r}] outside of the limits "
            f"[{limits.lower!r}, {limits.upper!r}]: no position would be valid.",
        )
    return result


def _mimic(mimic: Element) -> MimicRelation[str]:
    joint = mimic[1].get("joint")
    if not joint:
        raise ElementError(mimic, "does not name a joint.")
    return MimicRelation(
        joint, read_attribute_number(mimic, "multiplier", 1.0), read_attribute_number(mimic, "offset", 0.0)
    )


def resolve_mimic_joints(joints: Iterable[UrdfJoint], remarks: ReaderWarnings) -> list[UrdfJoint]:
    """Resolve mimic chains: each ``mimic`` names the joint at the end of its chain and the composed factors.

    A joint is independent, with a remark, if the joint that it mimics does not exist, has no single position,
    or mimics it in a cycle. Other parsers do the same.
    """
    joints = list(joints)
    if all(joint.mimic is None for joint in joints):
        return joints
    by_name = {joint.name: joint for joint in joints}

    def refuse(follower: str, reason: str, advice: str = "", kind: type[Fault] = Fault) -> None:
        line, text = by_name[follower].line, f"<mimic> of <joint name={quote(follower)}>: {reason}"
        if remarks.strict:
            raise FormatError(f"{remarks.source}, line {line}, {text} {advice}".rstrip())
        remarks.fault(line, f"{text.rstrip('. ')}; it moves by itself. {advice}".rstrip(), kind)

    def check(follower: str, name: str) -> bool:
        leader = by_name.get(name)
        if leader is None:
            movable = [joint.name for joint in joints if DOF_BY_TYPE[joint.kind] == 1]
            refuse(
                follower,
                f"it mimics {quote(name)}, and there is no joint of that name.",
                suggest(name, movable, "joint to mimic"),
                ChangedMotion,
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

    following = {joint.name: joint.mimic for joint in joints if joint.mimic is not None}
    ends = resolve_mimic_chains(following, refuse, check=check)
    return [j if j.mimic is None else replace(j, mimic=ends.get(j.name)) for j in joints]
