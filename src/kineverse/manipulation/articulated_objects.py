"""Articulated objects of a model: doors, flaps and drawers, distinguished by their motions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np

from kineverse._names import match_names
from kineverse.geometry.objects import collision_shapes
from kineverse.geometry.shapes import solid_from_geometry
from kineverse.lie import Array, inverse, rotation_angle
from kineverse.model.frame_dependence import moved_frames
from kineverse.model.model_view import ModelView
from kineverse.symbols import Symbol
from kineverse.worlds import Robot

MotionKind: TypeAlias = Literal["door", "flap", "drawer", "knob", "linkage"]
KINDS: tuple[MotionKind, ...] = get_args(MotionKind)

_SAMPLES = 5
_STILL = 1e-6  # rotation below which a motion is a translation [rad]
_SAME = 1e-3  # largest difference of the axes of a motion about one axis, as direction and as point [m]
_UPRIGHT = math.cos(math.pi / 4)
_KNOB = 0.08  # largest distance of a knob from its axis [m]


@dataclass(frozen=True, slots=True)
class ArticulatedObject:
    """Object that one coordinate moves between two limits.

    Attributes
    ----------
    kind
        ``"drawer"``: it is translated; ``"door"``: it turns about an upright axis; ``"flap"``: about a level
        one; ``"knob"``: about an axis through itself; ``"linkage"``: about an axis that moves.
    shut
        Limit nearest to the default value [m], [rad].
    opened
        The other limit [m], [rad].

    See Also
    --------
    kineverse.manipulation.find_articulated_objects
    """

    coordinate: Symbol
    kind: MotionKind
    shut: float
    opened: float


def find_articulated_objects(
    model: ModelView, robot: Robot | str | None = None
) -> tuple[ArticulatedObject, ...]:
    """Return the objects that coordinates with two limits move, in the order of the model.

    Parameters
    ----------
    robot
        A robot, or the prefix of its names, which is not an object.

    Raises
    ------
    MissingDependencyError
        Without the extra ``geometry``.
    UnknownNameError
        If nothing of the model that moves is below the prefix.

    Examples
    --------
    >>> found = kv.manipulation.find_articulated_objects(kv.load("shelf_door"))
    >>> [(one.coordinate, one.kind) for one in found]
    [(shelf_door/door, 'door')]
    """
    known = None if robot is None else Robot.of(model, robot)
    free = [s for s in model.degrees_of_freedom if known is None or not known.moves(s)]
    defaults = model.default_state()
    result = []
    for coordinate, frames in moved_frames(model, free).items():
        limits = sorted(map(float, model.limits(coordinate)), key=lambda v: abs(v - defaults[coordinate]))
        bodies = [name for name in frames if name in model.bodies and collision_shapes(model.bodies[name])]
        if bodies and all(map(math.isfinite, limits)) and limits[0] != limits[1]:
            kind = _find_kind(model, coordinate, bodies, limits)
            result.append(ArticulatedObject(coordinate, kind, *limits))
    return tuple(result)


def find_shut_value(model: ModelView, coordinate: Symbol) -> float:
    """Return the limit of a coordinate nearest to its default value, or that value if there is none."""
    default = model.default_state()[coordinate]
    finite = [float(limit) for limit in model.limits(coordinate) if math.isfinite(limit)]
    return min(finite, key=lambda limit: abs(limit - default), default=default)


def select_objects(
    objects: Sequence[ArticulatedObject], patterns: Iterable[str]
) -> tuple[ArticulatedObject, ...]:
    """Return the objects whose coordinates match names or patterns, in the order of the patterns."""
    by_name = {str(one.coordinate): one for one in objects}
    return tuple(by_name[name] for name in match_names(patterns, by_name, "door, drawer or other object"))


def _find_kind(
    model: ModelView, coordinate: Symbol, bodies: Sequence[str], limits: Sequence[float]
) -> MotionKind:
    state = model.default_state()
    samples = [state.updated({coordinate: float(v)}) for v in np.linspace(limits[0], limits[1], _SAMPLES)]
    axes: list[tuple[Array, Array]] = []
    farthest = 0.0
    for name in bodies:
        pose = model.fk(name)
        poses = np.array([np.asarray(pose(sample), dtype=float) for sample in samples])
        steps = poses[1:] @ inverse(poses[:-1])
        if float(rotation_angle(steps[:, :3, :3]).max()) < _STILL:
            continue
        own = [_find_axis(step) for step in steps]
        axes += own
        farthest = max(farthest, _find_extent(model, name, poses[0], *own[0]))
    if not axes:
        return "drawer"
    along, point = axes[0]
    for other, through in axes[1:]:
        if 1.0 - abs(along @ other) > _SAME or np.linalg.norm(np.cross(through - point, along)) > _SAME:
            return "linkage"
    if farthest < _KNOB:
        return "knob"
    return "door" if abs(along[2]) > _UPRIGHT else "flap"


def _find_axis(step: Array) -> tuple[Array, Array]:
    """Return direction (3,) and a point (3,) of the screw axis of a rotation with translation (4, 4)."""
    R, p = step[:3, :3], step[:3, 3]
    along = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    along /= np.linalg.norm(along)
    across = p - along * (along @ p)
    point = np.asarray(np.linalg.lstsq(np.eye(3) - R, across, rcond=None)[0], dtype=float)
    return along, point


def _find_extent(model: ModelView, name: str, pose: Array, along: Array, point: Array) -> float:
    """Return the largest distance of the bounding spheres of a body's shapes from an axis [m]."""
    farthest = 0.0
    for shape in collision_shapes(model.bodies[name]):
        solid = solid_from_geometry(shape.geometry)
        centre = pose @ shape.origin.matrix @ np.append(solid.centre, 1.0)
        distance = float(np.linalg.norm(np.cross(centre[:3] - point, along)))
        farthest = max(farthest, distance + solid.radius)
    return farthest
