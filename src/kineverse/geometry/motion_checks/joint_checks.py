"""Checks of a joint without a sweep: limits, units, axis, and whether it moves anything."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from kineverse.errors import list_some
from kineverse.expressions.printing import format_number

from .moving_parts import MovingPart, MovingParts, has_shapes
from .report import MotionFinding, Severity, format_length
from .rigid_groups import STILL, Axis

MOST_TURNS = 2.25
"""Range of a hinge beyond which its limits are taken for degrees, in turns: 810°.

Wrists of robots have up to two turns. As radians, the least range in degrees that is found is 14.
"""

SYMMETRIC = 40.0
"""Range from -x to x of a hinge up to which x may stand for no limit, as 10 rad do [rad]."""

WHOLE_TURNS = 0.035
"""Largest difference of a range from whole turns, as valves and screws have [rad]: 2°, for π as 3.14."""

LEAST_ANGLE = math.radians(1.0)
"""Range of a hinge below which its limits are taken for radians that were read as degrees [rad].

The angle of a door, 1.57 rad, is 1.57°.
"""

LEAST_TRAVEL, LEAST_SHARE = 1e-3, 0.01
"""Range of a slider that is too small [m], if it is also below this share of the part."""

MOST_TRAVEL = 25.0
"""Range of a slider that is too large, in sizes of the part, if it is also twice the size of everything.

Metres that are given as millimetres are a thousand times as many; a lift travels ten times its height.
"""

AXIS_GAP = 0.25
"""Distance of an axis from the part and from all that carries it, in sizes of the part, that is too large.

The axis of a hinge between thin boards may lie beside both.
"""

FLAT = 3.0
"""Ratios of sizes of a plate: at least of the second to the least, at most of the largest to the second."""

NORMAL = math.radians(25.0)  # angle from the normal of a plate within which an axis is along it [rad]

OFF_CENTER = (
    0.25  # distance of an axis from the middle of a plate that turns in its plane, in its largest size
)

SCALE = 20.0
"""Size of a part, in sizes of all others together, from which on its scale is wrong; 1000 for millimetres."""

SMALLEST_PART, LARGEST_PART = 1e-3, 20.0
"""Least and largest size of a part that moves [m]: that of a grain, and of a house."""


def check_crossed_limits(part: MovingPart) -> Iterator[MotionFinding]:
    """Yield a finding for a coordinate whose limits exclude each other."""
    lower, upper = part.parts.model.limits(part.coordinate)
    if lower > upper:
        shown = format_number(lower), format_number(upper)
        text = f"no value is within the limits: the lower one is {shown[0]}, the upper one {shown[1]}"
        unit = "rad" if part.turns else "m"
        yield _finding(part, "crossed_limits", text, value=lower - upper, limit=0.0, unit=unit)


def check_joint_limits(part: MovingPart) -> Iterator[MotionFinding]:
    """Yield a finding or a suspect for limits in a wrong unit."""
    extent = part.limits[1] - part.limits[0]
    if not math.isfinite(extent) or extent <= 0.0 or part.axis is None:
        return
    if part.axis.turn:
        yield from _check_angles(part, part.axis, extent)
    elif part.solids and not part.parts.is_normalized:
        yield from _check_lengths(part, extent * part.axis.shift)


def _check_angles(part: MovingPart, axis: Axis, extent: float) -> Iterator[MotionFinding]:
    angle = extent * axis.turn  # of the part, which may be geared
    drives_slider = abs(axis.shift) > STILL or _shifts_another(part)
    turns = angle / math.tau
    # Whole degrees are no whole turns, though 44 rad nearly are.
    is_whole = abs(angle - math.tau * round(turns)) < WHOLE_TURNS and not extent.is_integer()
    if turns > MOST_TURNS and not is_whole and not drives_slider:
        shown = format_number(turns, 3), format_number(extent)
        text = f"turns {shown[0]} times; as degrees, a range of {shown[1]} is usual"
        is_open = sum(part.limits) == 0.0 and angle <= SYMMETRIC
        severity: Severity = "suspect" if is_open else "finding"
        limit = MOST_TURNS * math.tau
        yield _finding(part, "degrees_for_radians", text, severity, value=angle, limit=limit, unit="rad")
    elif angle < LEAST_ANGLE:
        text = f"turns by {format_number(math.degrees(angle), 3)}° only"
        yield _finding(
            part, "radians_for_degrees", text, "suspect", value=angle, limit=LEAST_ANGLE, unit="rad"
        )


def _shifts_another(part: MovingPart) -> bool:
    """Return True if the coordinate also shifts a part, as a spindle or a rack does."""
    others = (MovingPart(part.parts, g, part.coordinate) for g in part.parts.groups.moved_by(part.coordinate))
    return any(other.axis is not None and not other.turns for other in others)


def _check_lengths(part: MovingPart, travel: float) -> Iterator[MotionFinding]:
    if travel < min(LEAST_TRAVEL, LEAST_SHARE * part.size):
        text = f"moves by {format_length(travel)} only, and is {format_length(part.size)} large"
        yield _finding(part, "millimetres_for_metres", text, value=travel, limit=LEAST_TRAVEL, unit="m")
        return
    everything = part.parts.shape_of(part.parts.scene.bodies).size
    most = max(MOST_TRAVEL * part.size, 2.0 * everything)
    if travel > most:
        text = f"moves by {format_length(travel)}, and is {format_length(part.size)} large"
        yield _finding(part, "millimetres_for_metres", text, value=travel, limit=most, unit="m")


def check_joint_axis(part: MovingPart) -> Iterator[MotionFinding]:
    """Yield a finding for the axis of a hinge that is near neither the part nor anything else."""
    axis = part.fixed_axis
    if axis is None or not axis.turn or not part.solids:
        return
    most = AXIS_GAP * part.size
    if part.shape.distance_to_line(axis.point, axis.direction) <= most:
        return
    others = (part.parts.shape_of([body]) for body in part.parts.others(part.group))
    gap = min(shape.distance_to_line(axis.point, axis.direction) for shape in (part.shape, *others))
    if gap > most:
        text = f"turns about an axis that is {format_length(gap)} away from it and from all else"
        is_certain = not part.is_robot_link and part.parts.solids(part.carrier)
        severity: Severity = "finding" if is_certain else "suspect"
        yield _finding(part, "axis_outside", text, severity, value=gap, limit=most, unit="m")


def check_plane(part: MovingPart) -> Iterator[MotionFinding]:
    """Yield a suspect for a flat part that turns in its own plane about a point at its edge.

    A door or a lid turns out of its plane. Wheels and knobs turn in theirs, about their middle.
    """
    axis = part.fixed_axis
    if axis is None or not axis.turn or part.is_robot_link or len(part.shape.points) < 3:
        return
    directions, extents = part.shape.principal_extents
    longest, middle, least = extents.tolist()
    beside = float(np.linalg.norm(np.cross(axis.direction, part.shape.middle - axis.point)))
    is_plate = middle > FLAT * least and middle > longest / FLAT
    tilt = math.acos(min(1.0, abs(float(directions[2] @ axis.direction))))
    if is_plate and tilt < NORMAL and beside > OFF_CENTER * longest:
        text = f"is flat, and turns in its own plane about a point {format_length(beside)} from its middle"
        yield _finding(
            part, "turned_axis", text, "suspect", value=beside, limit=OFF_CENTER * longest, unit="m"
        )


def check_moved_bodies(part: MovingPart) -> Iterator[MotionFinding]:
    """Yield a finding if a joint moves no shapes at all, and what cannot be said without shapes."""
    model = part.parts.model
    carried = [body for group in part.parts.groups.subtree(part.group) for body in group.bodies]
    if not has_shapes(model, carried):
        if not part.parts.solid_bodies and not part.parts.unusable:
            yield _finding(part, "no_shapes", "the model has no shapes", "cannot_say")
            return
        if not part.group.is_child:
            return  # a further frame of a mechanism, such as the end of an arm
        what = f"only the mass of {list_some(map(repr, carried), 3)}" if carried else "nothing"
        severity: Severity = "suspect" if carried or part.is_robot_link else "finding"
        yield _finding(part, "moves_nothing", f"moves {what}: no shape hangs on it", severity)
    elif part.parts.has_missing_shapes(part.group.bodies):
        names = list_some((repr(b) for b, _ in part.parts.unusable if b in part.group.bodies), 3)
        yield _finding(part, "missing_shapes", f"shapes of {names} are missing or empty", "cannot_say")
    elif not part.solids:
        yield _finding(part, "no_shapes", "it has no shapes of its own", "cannot_say")


def check_scale(parts: MovingParts, bodies: Sequence[str], joint: str = "") -> Iterator[MotionFinding]:
    """Yield a suspect for the bodies of a part that are far too large, or too small to be seen."""
    if parts.is_normalized or not bodies:
        return
    rest = parts.shape_of([body for body in parts.scene.bodies if body not in set(bodies)]).size
    most = min(LARGEST_PART, SCALE * rest or LARGEST_PART)
    sizes = {body: parts.body_shape(body).size for body in bodies}
    largest, smallest = max(bodies, key=sizes.__getitem__), min(bodies, key=sizes.__getitem__)
    others = ""
    if sizes[largest] > most:
        body, limit = largest, most
        others = f", and all others together {format_length(rest)}" if rest else ""
    elif sizes[smallest] < SMALLEST_PART:
        body, limit = smallest, SMALLEST_PART
    else:
        return
    text = f"'{body}' is {format_length(sizes[body])} large{others}"
    yield MotionFinding("wrong_scale", "suspect", text, (body,), joint, sizes[body], limit, "m")


def _finding(
    part: MovingPart,
    kind: str,
    text: str,
    severity: Severity = "finding",
    *,
    value: float | None = None,
    limit: float | None = None,
    unit: str = "",
) -> MotionFinding:
    return MotionFinding(kind, severity, text, part.bodies, part.group.joint, value, limit, unit)
