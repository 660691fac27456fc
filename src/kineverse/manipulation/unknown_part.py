"""Part of unknown motion in a model: where it was seen, and as something that a hand pulls straight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kineverse.articulations import Floating
from kineverse.compile import compile  # noqa: A004
from kineverse.estimation import Fit
from kineverse.grasping import Handle, find_handle
from kineverse.lie import Array, inverse, pose_difference, to_quaternion
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.spatial import translation
from kineverse.state import State
from kineverse.symbols import Symbol, position

_ROTATION_ARM = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
"""Lengths that make rotations comparable to distances [m]."""
_STEPS, _DIFFERENCE = 3, 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class UnknownPart:
    """Part that moves freely in a model, and its handle.

    Attributes
    ----------
    model
        Copy of a model in which the part floats, and is pulled along the outward normal of its handle.
    frame
        Frame of the part.
    handle
        The handle; its coordinate is the one of the straight pull [m].
    parent
        Frame in which the part floats.
    parent_T_frame
        Pose (4, 4) of the part in the model that was copied.
    floating
        The seven coordinates of the floating joint.
    """

    model: Model
    frame: str
    handle: Handle
    parent: str
    parent_T_frame: Array
    floating: tuple[Symbol, ...]

    def values(self, parent_T_frame: Array) -> dict[Symbol, float]:
        """Return the coordinates of the part for its pose (4, 4) in the parent."""
        off = inverse(self.parent_T_frame) @ parent_T_frame
        numbers = [*off[:3, 3], *to_quaternion(off[:3, :3])]
        return {**dict(zip(self.floating, map(float, numbers), strict=True)), self.handle.coordinate: 0.0}


def free_part(model: Model, frame: str, handle: str, state: State) -> UnknownPart:
    """Return a part as something that floats, in a copy of a model.

    Parameters
    ----------
    model
        The model; how it attaches the part does not matter.
    frame, handle
        Frame of the part, and frame of the handle's body, which is the part or rigidly below it.
    state
        State at which the part is where the model has it.

    Raises
    ------
    UnknownNameError
        For a frame that does not exist, or a handle without a slim shape that stands out.
    """
    model.fk(handle, frame)
    copy = model.copy()
    parent = model.frames[frame].parent
    pose = model.fk(frame, parent)
    parent_T_frame = np.asarray(pose(State({s: state[s] for s in pose.symbols})))
    name, pull = f"{frame}/seen", position(f"{frame}/pull")
    tag = f"pull {frame}"
    with copy.edit() as edit:
        floating = Floating(name=name, parent=parent, child=name, origin=Pose.from_matrix(parent_T_frame))
        edit.apply(floating)
        edit.attach(frame, name, translation(pull, 0, 0), tag)
    found = find_handle(copy, pull, handle)
    frame_T_handle = copy.fk(handle, frame)({})
    outward = frame_T_handle[:3, :3] @ found.pose[:3, 0]
    with copy.edit() as edit:
        edit.remove(tag)
        edit.attach(frame, name, translation(*(float(v) * pull for v in outward)), tag)
    return UnknownPart(copy, frame, found, parent, parent_T_frame, copy.articulations[name].coordinates)


def find_joint(model: ModelView, frame: str) -> Articulation | None:
    """Return the articulation with coordinates that places a frame, if any."""
    records = (record for record in model.articulations.values() if record.child == frame)
    return next((record for record in records if record.coordinates), None)


def write_joint(model: Model, frame: str, fit: Fit, parent: str) -> Symbol:
    """Write an identified joint into a model in place of what attached its part, and return its coordinate.

    The name of the earlier joint stays. Limits are left out: the range that was seen is not that of the joint.

    Parameters
    ----------
    model
        The model.
    frame
        Frame of the part.
    fit
        The identified joint between the parent and the part, with one joint value.
    parent
        Frame in which the part was observed.

    Raises
    ------
    EditError
        If something else in the model needs the earlier joint; the model is then unchanged.
    """
    records = {name: a for name, a in model.articulations.items() if a.child == frame}
    name = next(iter(records), f"{frame}/joint")
    writer = model.history.writers(f"frames/{frame}")[-1]
    with model.edit() as edit:
        if f"articulations/{name}" in _written(model, writer):
            edit.replace(writer, fit.operation(name, parent, frame, limits=False))
        else:
            child = f"{frame}/learned"
            edit.apply(fit.operation(name, parent, child, limits=False))
            edit.attach(frame, child, translation(0, 0, 0))
    (coordinate,) = model.fk(frame, parent).symbols
    return coordinate


def _written(model: Model, tag: str) -> set[str]:
    """Return the paths that an operation writes."""
    return {f"{kind}/{name}" for kind, name in model.history.entry(tag).writes}


class JointProjection:
    """Projection of poses of a part onto the joint of a model.

    Parameters
    ----------
    model
        The model.
    frame, parent
        Frame of the part, and a frame in which the joint alone moves it.
    """

    def __init__(self, model: ModelView, frame: str, parent: str) -> None:
        pose = model.fk(frame, parent)
        (self.coordinate,) = pose.symbols
        self._pose = compile(pose, [self.coordinate], tier="interpreter")

    def project(self, pose: Array, start: float) -> float:
        """Return the value at which the part is nearest to a pose (4, 4) in the parent [m], [rad].

        Gauss-Newton steps from a value nearby; a rotation counts by its angle times 0.3 m.
        """
        value = start
        for _ in range(_STEPS):
            here, ahead = (self._pose(np.array([v])) for v in (value, value + _DIFFERENCE))
            slope = pose_difference(ahead, here) / _DIFFERENCE * _ROTATION_ARM
            value += float(slope @ (pose_difference(pose, here) * _ROTATION_ARM)) / float(slope @ slope)
        return value
