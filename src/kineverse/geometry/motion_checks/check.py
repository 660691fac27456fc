"""Check of the motions of a model."""

from __future__ import annotations

from collections.abc import Iterator

from kineverse.geometry.shapes import import_coal
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .body_checks import check_bodies
from .joint_checks import check_axis, check_limits, check_moved_bodies, check_plane, check_scale
from .moving_parts import MovingPart, MovingParts
from .report import CoordinateReport, MotionFinding, MotionReport
from .rigid_groups import RigidGroup
from .sweep_checks import check_sweep


def check_motion(model: ModelView) -> MotionReport:
    import_coal()
    parts = MovingParts(model)
    seen: set[int] = {0}
    reports = []
    for coordinate in model.degrees_of_freedom:
        entries = tuple(_check_coordinate(parts, coordinate, seen))
        reports.append(CoordinateReport(str(coordinate), entries))
    has_robot = any(parts.is_robot_link(group) for group in list(parts.groups)[1:])
    rest = tuple(check_bodies(parts, parts.groups[0].bodies, not has_robot))
    return MotionReport(tuple(reports), CoordinateReport("", rest))


def _check_coordinate(parts: MovingParts, coordinate: Symbol, seen: set[int]) -> Iterator[MotionFinding]:
    groups = list(parts.groups.moved_by(coordinate))
    if coordinate in parts.model.rates or not groups:
        why = "it is moved by speeds" if groups else "it moves no frame"
        yield MotionFinding("no_sweep", "cannot_say", why)
    for group in groups:
        if coordinate not in parts.model.rates:
            yield from _check_part(MovingPart(parts, group, coordinate))
        if group.number not in seen:
            seen.add(group.number)
            yield from _check_bodies(parts, group)


def _check_part(part: MovingPart) -> Iterator[MotionFinding]:
    yield from check_moved_bodies(part)
    limits = list(check_limits(part))
    yield from limits
    if part.axis is None or not part.solids:
        return
    axis = list(check_axis(part))
    yield from axis
    if not any(entry.severity == "finding" for entry in (*limits, *axis)):
        swept = list(check_sweep(part))
        yield from swept
        if not any(entry.severity == "suspect" for entry in swept):
            yield from check_plane(part)


def _check_bodies(parts: MovingParts, group: RigidGroup) -> Iterator[MotionFinding]:
    yield from check_scale(parts, parts.solids(group), group.joint)
    yield from check_bodies(parts, group.bodies, not parts.is_robot_link(group), group.joint)
