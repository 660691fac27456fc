"""A small room: a finger as the robot, and a cupboard that stands askew, with a drawer."""

from __future__ import annotations

import kineverse as kv
from kineverse.articulations import Fixed
from kineverse.model import Body, Box, Shape
from kineverse.model.basic_operations import SetBody
from kineverse.model.body import Pose

FINGER, DRAWER, CUPBOARD = "robot/x", "room/drawer", "room/cupboard"


def make_room() -> kv.Model:
    """Return the room; the cupboard stands on a floor that is turned, and is tilted itself."""
    box = Body((Shape(Box((0.3, 0.3, 0.3))),), (Shape(Box((0.3, 0.3, 0.3))),))
    model = kv.Model()
    with model.edit() as edit:
        edit.apply(kv.Prismatic(name=FINGER, parent="world", child=FINGER, axis=(1, 0, 0), velocity=1))
        edit.apply(Fixed(name="robot/tip_joint", parent=FINGER, child="robot/tip"))
        edit.apply(
            Fixed(name="room/floor_joint", parent="world", child="room/floor", origin=_place(1, 0, 0, 0.7))
        )
        origin = _place(0.5, 0.2, 0.4, -0.2, tilt=0.1)
        edit.apply(Fixed(name="room/stand", parent="room/floor", child=CUPBOARD, origin=origin))
        edit.apply(
            kv.Prismatic(
                name=DRAWER, parent=CUPBOARD, child=DRAWER, axis=(-1, 0, 0), lower=0, upper=0.4, velocity=1
            )
        )
        edit.apply(Fixed(name="room/handle_joint", parent=DRAWER, child="room/handle"))
        for frame in ("robot/tip", CUPBOARD, DRAWER, "room/handle"):
            edit.apply(SetBody(frame, box), tag=f"body {frame}")
    return model


def _place(x: float, y: float, z: float, angle: float, tilt: float = 0.0) -> Pose:
    pose = kv.translation(x, y, z) @ kv.rotation_z(angle) @ kv.rotation_x(tilt)
    return Pose.from_matrix(pose)
