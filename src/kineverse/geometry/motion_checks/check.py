"""Check of the motions of a model."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from kineverse.formats.reader_warnings import CrossedLimits
from kineverse.geometry.shapes import import_coal
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol

from .body_checks import check_bodies
from .joint_checks import (
    check_crossed_limits,
    check_joint_axis,
    check_joint_limits,
    check_moved_bodies,
    check_plane,
    check_scale,
)
from .moving_parts import MovingPart, MovingParts
from .report import CoordinateReport, MotionFinding, MotionReport
from .rigid_groups import RigidGroup
from .sweep_checks import check_sweep


def check_motion(model: ModelView, faults: Iterable[str] = ()) -> MotionReport:
    """Check what each coordinate of a model moves, over its whole range, and the bodies that it moves.

    Rigid groups are looked at, the frames that a coordinate moves as one, with all other coordinates at the
    default state. Only pairs of bodies that the coordinates of one joint move count: that two doors open into
    each other is no mistake. ``docs/checks.md`` says what is certain, and why.

    Parameters
    ----------
    model
        A model or a snapshot of one.
    faults
        Warnings of its reader, see :func:`kineverse.formats.collect_warnings`: limits that are crossed in the
        file are not in the model any more.

    Returns
    -------
    MotionReport
        Findings, which are certainly wrong; suspects, which are worth a look; and what could not be checked.

    Raises
    ------
    MissingDependencyError
        If coal is not installed.

    Examples
    --------
    >>> report = kv.geometry.check_motion(kv.load("shelf_door"))
    >>> report.ok, [one.name for one in report.coordinates]
    (True, ['shelf_door/door'])
    """
    import_coal()
    parts = MovingParts(model)
    crossed = {fault.joint: fault for fault in faults if isinstance(fault, CrossedLimits)}
    seen: set[int] = {0}
    reports = []
    for coordinate in model.degrees_of_freedom:
        name = str(coordinate)
        entries = list(_check_coordinate(parts, coordinate, seen))
        for joint in {name: None} | {group.joint: None for group in parts.groups.moved_by(coordinate)}:
            if joint in crossed:
                entries.insert(0, _crossed(crossed.pop(joint)))
        reports.append(CoordinateReport(name, tuple(entries)))
    has_robot = any(parts.is_robot_link(group) for group in list(parts.groups)[1:])
    rest = check_bodies(parts, parts.groups[0].bodies, not has_robot)
    # Of a joint that no coordinate is named for, as with a prefix, or one that cannot move.
    lost = map(_crossed, crossed.values())
    return MotionReport(tuple(reports), CoordinateReport("", (*lost, *rest)))


def _crossed(fault: CrossedLimits) -> MotionFinding:
    return MotionFinding("crossed_limits", "finding", str(fault), joint=fault.joint)


def _check_coordinate(parts: MovingParts, coordinate: Symbol, seen: set[int]) -> Iterator[MotionFinding]:
    groups = list(parts.groups.moved_by(coordinate))
    if not groups:
        yield MotionFinding("no_sweep", "cannot_say", "it moves no frame")
    for group in groups:
        part = MovingPart(parts, group, coordinate)
        if group is groups[0]:
            yield from check_crossed_limits(part)
        if any(one in parts.model.rates for one in group.coordinates):
            yield part.entry("no_sweep", "cannot_say", "speeds move its part")
        else:
            yield from _check_part(part)
        if group.number not in seen:
            seen.add(group.number)
            yield from _check_bodies(parts, group)


def _check_part(part: MovingPart) -> Iterator[MotionFinding]:
    yield from check_moved_bodies(part)
    limits = list(check_joint_limits(part))
    yield from limits
    if part.axis is None or not part.solids:
        return
    axis = list(check_joint_axis(part))
    yield from axis
    is_wrong = any(entry.severity == "finding" for entry in (*limits, *axis))
    if not is_wrong and part.limits[0] <= part.limits[1]:
        swept = list(check_sweep(part))
        yield from swept
        if not any(entry.severity == "suspect" for entry in swept):
            yield from check_plane(part)


def _check_bodies(parts: MovingParts, group: RigidGroup) -> Iterator[MotionFinding]:
    yield from check_scale(parts, parts.solids(group), group.joint)
    yield from check_bodies(parts, group.bodies, not parts.is_robot_link(group), group.joint)
