"""Checks of a part over the range of its coordinate: parts that float, come apart, or enter others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from kineverse.articulations import Prismatic, Revolute
from kineverse.errors import NoSolutionError
from kineverse.expressions.printing import format_number
from kineverse.geometry.collision_filter import Rule
from kineverse.geometry.mesh_files import Floats
from kineverse.geometry.objects import collision_shapes
from kineverse.geometry.scene import Scene
from kineverse.geometry.shapes import sample_inside
from kineverse.lie import inverse, rotation_along_z, translation
from kineverse.model.body import Body, Mesh, Pose
from kineverse.model.model import Model
from kineverse.state import State
from kineverse.symbols import position

from .moving_parts import STATES, MovingPart
from .report import MotionFinding, Severity, format_length
from .rigid_groups import Axis

AWAY = 0.25  # distance from all others, in sizes of the part, at which it floats or has come apart
SMALL_GAP = (
    0.02  # distance up to which a part of any size is held [m]: rails and bearings often have no shape
)

GAP, LEAST_GAP = 0.15, 0.01
"""Distance of a part from all others that is a suspect, in sizes of the part, and at least [m]."""

ENTERED, LEAST_ENTERED = 0.01, 3e-3
"""Depth that is a suspect if two bodies do not overlap at rest, in sizes of the part, and at least [m].

The edge of a door turns into its frame by a part of its thickness.
"""

BEFORE = 4.0
"""Further depth that is accepted, in depths at rest.

Shapes that overlap at rest are coarse, or one slides in the other, as a bolt does.
"""

DEEPER, LEAST_DEEPER = 0.15, 0.01
"""Further depth that is a suspect whatever the depth at rest, in sizes of the part, and at least [m]."""

SWALLOWED, OUTSIDE_AT_REST = 0.3, 0.1
"""Share of a hinged part in the hull of what it hangs on that is a suspect, if its share at rest is less.

A cupboard is hollow, so a door that opens inwards may touch nothing in it.
"""

SAMPLES = 200  # points of a part whose places in a hull are looked at

_EVERYTHING = Rule("*", "*", True)


@dataclass(frozen=True)
class SweptOverlap:
    """Overlap of two bodies that is deeper than at rest."""

    bodies: tuple[str, str]
    depth: float  # how much deeper than at rest [m]
    limit: float  # depth that is accepted [m]
    state: State

    @property
    def excess(self) -> float:
        """Depth over the accepted one."""
        return self.depth / self.limit


class Sweep:
    """Distances of a part from all that it does not carry, at the default state and over its range."""

    def __init__(self, part: MovingPart) -> None:
        self.part = part
        parts = part.parts
        self.others = parts.others(part.group)
        self.reach = max(AWAY * part.size, SMALL_GAP)
        exceptions = [rule for rule in parts.scene.rules if not rule.check]
        rules = [_EVERYTHING, *exceptions]
        moving = part.group.coordinates  # what is carried does not move in the part
        self._query = parts.scene.watch(part.solids, "*", self.reach, moving=moving, rules=rules)
        self._rests = self._look(parts.default) or {}

    def _look(self, state: State) -> dict[tuple[str, str], float] | None:
        """Return the distances within reach by body of the part and other body; None if a loop is open."""
        scene = self.part.parts.scene
        try:
            scene.update(state)
        except NoSolutionError:
            return None
        found = self._query()
        names, own, others = scene.bodies, set(self.part.solids), set(self.others)
        result = {}
        for (i, j), distance in zip(found.body_indices.tolist(), found.distances.tolist(), strict=True):
            a, b = names[i], names[j]
            pair = (a, b) if a in own else (b, a)
            if pair[1] in others:  # and not what is carried and moves by the same coordinate
                result[pair] = distance
        return result

    @property
    def rest_gap(self) -> float:
        """Distance from the nearest other body at the default state [m]; infinite beyond reach."""
        return min(self._rests.values(), default=np.inf)

    @cached_property
    def _moved(self) -> list[tuple[State, dict[tuple[str, str], float]]]:
        found = ((state, self._look(state)) for state in self.part.states())
        return [(state, distances) for state, distances in found if distances is not None]

    @cached_property
    def floats(self) -> bool:
        """True if nothing is within reach of the part in any state."""
        return not self._rests and not any(distances for _, distances in self._moved)

    def loose_state(self) -> State | None:
        """Return the state furthest from rest in which all that is near at rest is out of reach, if any."""
        home = self.part.home
        loose = [state for state, distances in self._moved if not self._rests.keys() & distances.keys()]
        return (
            max(loose, key=lambda s: abs(s[self.part.coordinate] - home)) if loose and self._rests else None
        )

    def overlaps(self, mirrored: bool = False) -> list[SweptOverlap]:
        """Return the deepest overlap of each pair of bodies that only this joint moves, the worst first."""
        moved = self._moved
        if mirrored:
            looks = ((state, self._look(state)) for state in self.part.states(mirrored=True))
            moved = [(state, distances) for state, distances in looks if distances is not None]
        worst: dict[tuple[str, str], SweptOverlap] = {}
        for state, distances in moved:
            for pair, distance in distances.items():
                if distance >= 0.0 or pair[1] not in self._own_pairs:
                    continue
                found = self._overlap(pair, -distance, state)
                if found is not None and (pair not in worst or found.depth > worst[pair].depth):
                    worst[pair] = found
        return sorted(worst.values(), key=lambda overlap: -overlap.excess)

    def _overlap(self, pair: tuple[str, str], depth: float, state: State) -> SweptOverlap | None:
        before, size = max(0.0, -self._rests.get(pair, 0.0)), self.part.size
        limit = accepted_depth(before, size)
        return SweptOverlap(pair, depth - before, limit, state) if depth - before > limit else None

    @cached_property
    def _own_pairs(self) -> set[str]:
        """Other bodies whose pose in the part depends on the coordinates of this joint alone."""
        parts, group = self.part.parts, self.part.group
        allowed = set(group.coordinates)
        return {
            body
            for other in parts.groups
            if other.number != group.number and parts.groups.coordinates_between(group, other) <= allowed
            for body in other.bodies
        }

    def find_swallowing_body(self, mirrored: bool = False) -> tuple[str, float, State] | None:
        """Return a body in whose hull a hinged part turns from outside, the share of it, and the state."""
        part, parts = self.part, self.part.parts
        hull = part.shape.hull
        axis = part.fixed_axis
        if hull is None or axis is None or not axis.turn or part.is_robot_link:
            return None
        points = sample_inside(hull.points, hull.triangles, hull.points.mean(axis=0), SAMPLES)
        rest = inverse(parts.group_pose(part.group))
        local = points @ rest[:3, :3].T + rest[:3, 3]
        carrier = parts.group_pose(part.carrier)
        best: tuple[str, float, State] | None = None
        for body in sorted({other for _, other in self._rests} & set(part.carrier.bodies)):
            around = parts.shape_of([body]).hull
            if around is None or (around.face_distances(points) < 0.0).mean() > OUTSIDE_AT_REST:
                continue
            for state in part.states(mirrored):
                try:
                    pose = carrier @ parts.groups.pose(part.group, state)
                except NoSolutionError:
                    continue
                share = float((around.face_distances(local @ pose[:3, :3].T + pose[:3, 3]) < 0.0).mean())
                if share > max(SWALLOWED, best[1] if best else 0.0):
                    best = body, share, state
        return best

    def is_confirmed(self, overlap: SweptOverlap) -> bool:
        """Return True if the surfaces of meshes overlap too, whose hulls do.

        A cabinet is hollow, and its hull is not. The depth of surfaces is less exact, so hulls have to agree.
        Surfaces that are deep in each other at rest are badly drawn, and then only the hulls count.
        """
        parts = self.part.parts
        shapes = [s for name in overlap.bodies for s in collision_shapes(parts.model.bodies[name])]
        if not any(isinstance(shape.geometry, Mesh) for shape in shapes):
            return True
        depths = []
        for state in (parts.default, overlap.state):
            parts.surfaces.update(state)
            depths.append(max(0.0, -parts.surfaces.distance(*overlap.bodies).distance))
        size = self.part.size
        return depths[0] > DEEPER * size or depths[1] - depths[0] > accepted_depth(0.0, size)


def accepted_depth(before: float, size: float) -> float:
    """Return the further depth that is accepted for a part of a size, after a depth at rest [m]."""
    least = max(ENTERED * size, LEAST_ENTERED)
    return max(least, min(least + BEFORE * before, max(DEEPER * size, LEAST_DEEPER)))


def check_sweep(part: MovingPart) -> Iterator[MotionFinding]:
    """Yield what a sweep of the coordinate shows about a part with shapes."""
    if not part.parts.solids(part.carrier):
        text = f"what carries it, '{part.group.parent}', has no shapes"
        yield _entry(part, "no_shapes", "cannot_say", text)
        return
    sweep = Sweep(part)
    if sweep.floats:
        yield from _floating(part, sweep)
        return
    yield from _gap(part, sweep)
    if part.limits[0] == part.limits[1]:
        return
    overlap = next(filter(sweep.is_confirmed, sweep.overlaps()), None)
    loose = sweep.loose_state()
    if overlap is not None:
        yield _entering(part, sweep, overlap)
    elif (swallowed := sweep.find_swallowing_body()) is not None:
        yield _swallowed(part, sweep, *swallowed)
    elif loose is not None:
        kind, text = (
            "comes_apart",
            f"leaves all that it is near at rest, by more than {format_length(sweep.reach)}",
        )
        if part.is_unlimited(loose):
            kind, text = "no_limits", f"{text}, as no limit stops it"
        yield _entry(part, kind, "suspect", text, limit=sweep.reach, unit="m", state=loose)


def _floating(part: MovingPart, sweep: Sweep) -> Iterator[MotionFinding]:
    severity: Severity = "suspect" if part.is_robot_link else "finding"
    parts = part.parts
    parts.scene.update(parts.default)
    pairs = [(body, other) for body in part.solids for other in sweep.others]
    distance = min(found.distance for found in parts.scene.distances(pairs))
    text = f"is {format_length(distance)} away from everything, and {format_length(part.size)} large"
    yield _entry(part, "floats", severity, text, value=distance, limit=sweep.reach, unit="m")


def _gap(part: MovingPart, sweep: Sweep) -> Iterator[MotionFinding]:
    limit = max(GAP * part.size, LEAST_GAP)
    if sweep.rest_gap > limit and not part.is_robot_link:
        is_near = np.isfinite(sweep.rest_gap)
        far = format_length(sweep.rest_gap) if is_near else f"at least {format_length(sweep.reach)}"
        value = sweep.rest_gap if is_near else None
        text = f"is {far} away from everything at rest"
        yield _entry(part, "gap", "suspect", text, value=value, limit=limit, unit="m")


def _entering(part: MovingPart, sweep: Sweep, overlap: SweptOverlap) -> MotionFinding:
    what = f"enters '{overlap.bodies[1]}' by {format_length(overlap.depth)}"
    kind = "into_carrier"
    if part.is_unlimited(overlap.state):
        kind, what = "no_limits", f"{what}, as no limit stops it"
    elif explained := _explain(part, sweep):
        kind, what = explained[0], f"{what}; {explained[1]}"
    return _entry(
        part,
        kind,
        "suspect",
        what,
        value=overlap.depth,
        limit=overlap.limit,
        unit="m",
        state=overlap.state,
        against=overlap.bodies[1],
    )


def _swallowed(part: MovingPart, sweep: Sweep, body: str, share: float, state: State) -> MotionFinding:
    text = f"turns into '{body}', in whose hull {format_number(100 * share, 2)} % of it end"
    kind = "no_limits" if part.is_unlimited(state) else "into_carrier"
    if kind == "into_carrier" and sweep.find_swallowing_body(mirrored=True) is None:
        kind, text = "flipped_axis", f"{text}; the other way it is free"
    return _entry(
        part, kind, "suspect", text, value=share, limit=SWALLOWED, unit="1", state=state, against=body
    )


def _explain(part: MovingPart, sweep: Sweep) -> tuple[str, str] | None:
    """Return the kind of mistake without which the part would move freely, and how."""
    mirrored = sweep.overlaps(mirrored=True)
    if not mirrored:
        return "flipped_axis", "the other way it is free"
    axis = part.fixed_axis
    if axis is None or len(part.group.coordinates) > 1:
        return None
    across = rotation_along_z(axis.direction)
    for column in (0, 1):
        for sign in (1.0, -1.0):
            if _is_free_about(part, sweep, replace(axis, direction=sign * across[:, column])):
                return "turned_axis", f"along {_format_direction(sign * across[:, column])} it is free"
    return None


def _is_free_about(part: MovingPart, sweep: Sweep, axis: Axis) -> bool:
    """Return True if the part moves freely, and stays near, with another axis, in a model of its own."""
    parts, model = part.parts, Model()
    near = sorted({other for _, other in sweep._rests} | {o for o in sweep.others if o in sweep._own_pairs})
    values = axis.rate * (np.linspace(*part.range, STATES) - part.home)
    joint: dict[str, Any] = {"name": "q", "parent": "world", "child": "moved"}
    joint["axis"] = tuple(axis.direction.tolist())
    joint["origin"] = Pose.from_matrix(translation(axis.point))
    place = translation(-axis.point)
    with model.edit() as edit:
        edit.apply((Revolute if axis.turn else Prismatic)(**joint))
        for names, parent, before in ((part.solids, "moved", place), (near, "world", np.eye(4))):
            for name in names:
                kept = tuple(
                    shape
                    for number, shape in enumerate(collision_shapes(parts.model.bodies[name]))
                    if (name, number) not in parts.unusable
                )
                pose = Pose.from_matrix(before @ parts.default_pose(name))
                edit.add_frame(f"body/{name}", parent, pose, body=Body(collisions=kept))
    scene, q = Scene(model), position("q")
    ones, others = ([f"body/{name}" for name in names] for names in (part.solids, near))
    query = scene.watch(ones, others, sweep.reach, rules=[_EVERYTHING])
    rest: dict[tuple[int, ...], float] = {}
    for k, value in enumerate([0.0, *values.tolist()]):
        scene.update({q: value})
        found = query()
        seen = {
            tuple(p): d for p, d in zip(found.body_indices.tolist(), found.distances.tolist(), strict=True)
        }
        rest = rest if k else seen
        depths = ((max(0.0, -rest.get(pair, 0.0)), -distance) for pair, distance in seen.items())
        if not rest.keys() & seen.keys() or any(d - b > accepted_depth(b, part.size) for b, d in depths):
            return False
    return True


def _format_direction(direction: Floats) -> str:
    return f"({', '.join(format_number(x, 2) for x in direction.tolist())})"


def _entry(
    part: MovingPart,
    kind: str,
    severity: Severity,
    text: str,
    *,
    value: float | None = None,
    limit: float | None = None,
    unit: str = "",
    state: State | None = None,
    against: str = "",
) -> MotionFinding:
    at = {} if state is None else {str(part.coordinate): float(state[part.coordinate])}
    joint = part.group.joint
    return MotionFinding(kind, severity, text, part.bodies, joint, value, limit, unit, at, against)
