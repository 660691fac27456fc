"""Part with an unmodelled joint: floating where it was seen, or pulled straight by its handle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from kineverse.articulations import Fixed, Floating
from kineverse.compilation import compile
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.estimation import Fit
from kineverse.estimation.identification.families import GroupMotion
from kineverse.grasping import Handle, find_handle
from kineverse.grasping.finger_branches import path_to_root
from kineverse.lie import Array, exp_so3, inverse, log_se3, pose_difference, to_quaternion, transform
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.spatial import axis_angle, translation
from kineverse.state import State
from kineverse.symbols import Symbol, position

_ROTATION_ARM = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])  # make rotations comparable to distances [m]
_STEPS, _DIFFERENCE = 3, 1e-5
_STRAIGHT = 1e-3  # turn by motion of the handle from which on a motion is a rotation [rad/m]


@dataclass(frozen=True, slots=True, eq=False)
class UnknownPart:
    """Part that moves freely in a model, and its handle."""

    model: Model  # copy of a model in which the part floats, and is pulled
    frame: str
    handle: Handle  # its coordinate is the distance by which the pull moves its middle [m]
    parent: str  # frame in which the part floats
    origin: Array  # pose (4, 4) of the part in the parent, in the model that was copied
    floating: tuple[Symbol, ...]  # seven coordinates of the floating joint

    @property
    def frame_T_handle(self) -> Array:
        """Pose (4, 4) of the handle's body in the part."""
        return np.asarray(self.model.fk(self.handle.frame, self.frame)({}))

    @property
    def point(self) -> Array:
        """Middle (3,) of the handle, in the frame of the part [m]."""
        return np.asarray((self.frame_T_handle @ self.handle.pose)[:3, 3])

    def values(self, parent_T_frame: Array) -> dict[Symbol, float]:
        """Return the coordinates of the part for its pose (4, 4) in the parent."""
        off = inverse(self.origin) @ parent_T_frame
        numbers = [*off[:3, 3], *to_quaternion(off[:3, :3])]
        return {**dict(zip(self.floating, map(float, numbers), strict=True)), self.handle.coordinate: 0.0}

    def pulled_along(self, twist: Array) -> UnknownPart:
        """Return the part in a copy of its model where the pull follows a twist (6,) in axes of the part."""
        v, w = twist[:3], twist[3:]
        v, w = np.array([v, w]) / np.linalg.norm(v + np.cross(w, self.point))
        pull, turn = self.handle.coordinate, float(np.linalg.norm(w))
        motion = translation(*(float(x) * pull for x in v))
        if turn > _STRAIGHT:
            pivot, rise = np.cross(w, v) / turn**2, v @ w / turn**2 * w
            there, back = translation(*pivot.tolist()), translation(*(-pivot).tolist())
            along = translation(*(float(x) * pull for x in rise))
            motion = along @ there @ axis_angle(w / turn, turn * pull) @ back
        copy = self.model.copy()
        with copy.edit() as edit:
            edit.remove(_pull_tag(self.frame))
            edit.attach(self.frame, f"{self.frame}/seen", motion, _pull_tag(self.frame))
        return replace(self, model=copy)


def free_part(model: Model, frame: str, handle: str, state: State) -> UnknownPart:
    """Return a part as something that floats, in a copy of a model."""
    model.fk(handle, frame)
    copy = model.copy()
    parent = model.frames[frame].parent
    pose = model.fk(frame, parent)
    parent_T_frame = np.asarray(pose(State({s: state[s] for s in pose.symbols})))
    name, pull = f"{frame}/seen", position(f"{frame}/pull")
    tag = _pull_tag(frame)
    with copy.edit() as edit:
        floating = Floating(name=name, parent=parent, child=name, origin=Pose.from_matrix(parent_T_frame))
        edit.apply(floating)
        edit.attach(frame, name, translation(pull, 0, 0), tag)
    try:
        result = find_handle(copy, pull, handle)
    except UnknownNameError as error:
        raise UnknownNameError(
            f"'{handle}' has no slim shape that stands out of '{frame}', so no hand closes around it. "
            "Name the body of a handle."
        ) from error
    frame_T_handle = copy.fk(handle, frame)({})
    outward = frame_T_handle[:3, :3] @ result.pose[:3, 0]
    with copy.edit() as edit:
        edit.remove(tag)
        edit.attach(frame, name, translation(*(float(v) * pull for v in outward)), tag)
    return UnknownPart(copy, frame, result, parent, parent_T_frame, copy.articulations[name].coordinates)


def _pull_tag(frame: str) -> str:
    return f"pull {frame}"


def forget_joint(model: Model, frame: str, state: State) -> Model:
    """Return a copy of a model in which a part is fixed where a state has it, as if its joint was unknown.

    Raises
    ------
    InvalidValueError
        For a frame that no joint with coordinates places directly.
    EditError
        If something else in the model needs the joint.

    Examples
    --------
    >>> model = kv.load("shelf_door")
    >>> forget = kv.manipulation.unknown_objects.forget_joint
    >>> unknown = forget(model, "shelf_door/door", model.default_state())
    >>> unknown.degrees_of_freedom
    ()
    """
    joint = find_joint(model, frame)
    if joint is None:
        movable = [a.child for a in model.articulations.values() if a.coordinates]
        raise InvalidValueError(
            f"No joint moves '{frame}' directly, so none can be forgotten. {suggest(frame, movable, 'part')}"
        )
    name = next(n for n, record in model.articulations.items() if record is joint)
    pose = model.fk(frame, joint.parent)
    origin = Pose.from_matrix(np.asarray(pose(State({s: state[s] for s in pose.symbols}))))
    copy = model.copy()
    with copy.edit() as edit:
        tag = copy.history.writers(f"articulations/{name}")[-1]
        edit.replace(tag, Fixed(name=name, parent=joint.parent, child=frame, origin=origin))
    return copy


def find_joint(model: ModelView, frame: str) -> Articulation | None:
    """Return the articulation with coordinates that places a frame, if any."""
    records = (record for record in model.articulations.values() if record.child == frame)
    return next((record for record in records if record.coordinates), None)


def write_joint(model: Model, frame: str, fit: Fit, parent: str) -> Symbol:
    """Write an identified joint into a model in place of what attached its part, and return its coordinate.

    The name of the earlier joint stays. The joint has no limits: the range that was seen is not its own.
    """
    records = {name: a for name, a in model.articulations.items() if a.child == frame}
    name = next(iter(records), f"{frame}/joint")
    writer = model.history.writers(f"frames/{frame}")[-1]
    with model.edit() as edit:
        if ("articulations", name) in model.history.entry(writer).writes:
            edit.replace(writer, fit.operation(name, parent, frame, limits=False))
        else:
            child = f"{frame}/learned"
            edit.apply(fit.operation(name, parent, child, limits=False))
            edit.attach(frame, child, translation(0, 0, 0))
    (coordinate,) = model.fk(frame, parent).symbols
    return coordinate


def align_fit(fit: Fit, zero: Array, ahead: Array) -> Fit:
    """Return an identified joint with the value 0 at the nearest place to a pose (4, 4), and positive ahead.

    Identified values are about their mean. With this zero, a part that was shut is shut at 0 in each new fit.
    A curve, and a joint of several coordinates, stays as it is.
    """
    motion = fit.motion
    if not isinstance(motion, GroupMotion) or motion.joints != 1:
        return fit
    path = JointPath.of_fit(fit, zero)
    shift, values = path.value, fit.joint_values - path.value
    turn = np.eye(4) if path.project(ahead) >= shift else np.diag([1.0, -1.0, -1.0, 1.0])
    twist = np.zeros(6)
    twist[motion.parametrisation.joints[0]] = shift
    twist[2] += motion.pitch * twist[5]
    left = motion.left @ transform(exp_so3(twist[3:]), twist[:3])
    motion = replace(motion, left=left @ turn, right=turn @ motion.right)
    return replace(fit, motion=motion, joint_values=turn[2, 2] * values, frame=motion.left)


def place_frame(model: Model, frame: str, pose: Array) -> None:
    """Put the furniture that carries a frame where the frame has a pose (4, 4) in the world."""
    if frame == WORLD:
        return
    if model.fk(frame).symbols:
        raise InvalidValueError(
            f"'{frame}' is moved by joints itself; name a frame that stands still as beside=."
        )
    *_, top = (name for name in path_to_root(model, frame) if name != WORLD)
    with model.edit() as edit:
        edit.attach(top, WORLD, pose @ inverse(model.fk(frame)({})) @ model.fk(top)({}), f"seen {top}")


class JointPath:
    """Poses of a part along a joint with one degree of freedom, and the value where the part is."""

    def __init__(self, pose: Callable[[float], Array], first: Array, start: float = 0.0) -> None:
        self.pose = pose
        self.start = self.value = start
        self.start = self.project(first)

    @classmethod
    def of_fit(cls, fit: Fit, first: Array) -> Self:
        """Return the path of an identified joint."""

        def pose(value: float) -> Array:
            return np.asarray(fit.motion.linearise(np.array([[value]])).pose[0])

        return cls(pose, first, float(fit.joint_values[0, 0]))

    @classmethod
    def of_model(cls, model: ModelView, frame: str, parent: str, first: Array) -> tuple[Self, Symbol]:
        """Return the path of a part in a model, and the coordinate that moves it."""
        expression = model.fk(frame, parent)
        (coordinate,) = expression.symbols
        function = compile(expression, [coordinate], tier="interpreter")
        return cls(lambda value: np.asarray(function(np.array([value]))), first), coordinate

    @property
    def direction(self) -> float:
        """Sign of the motion so far."""
        return math.copysign(1.0, self.value - self.start)

    def project(self, pose: Array) -> float:
        """Move the value to where the part is nearest to a pose (4, 4), and return it [m], [rad].

        Gauss-Newton steps from the present value; a rotation counts by its angle times 0.3 m.
        """
        for _ in range(_STEPS):
            here, ahead = self.pose(self.value), self.pose(self.value + _DIFFERENCE)
            slope = pose_difference(ahead, here) / _DIFFERENCE * _ROTATION_ARM
            off = pose_difference(pose, here) * _ROTATION_ARM
            self.value += float(slope @ off) / float(slope @ slope)
        return self.value

    def twist(self) -> Array:
        """Return the twist (6,) of the part in its own axes by the value, in the direction of the motion."""
        here, ahead = self.pose(self.value), self.pose(self.value + _DIFFERENCE)
        return self.direction * log_se3(inverse(here) @ ahead) / _DIFFERENCE
