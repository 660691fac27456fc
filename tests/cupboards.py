"""A robot of a base and a head, before a cupboard with a door and a drawer behind it."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse.articulations import OmniBase
from kineverse.model.body import Body, Box, Pose, Shape


def box(*size: float, at: tuple[float, float, float] = (0, 0, 0)) -> Body:
    pose = np.eye(4)
    pose[:3, 3] = at
    shape = Shape(Box(size), Pose.from_matrix(pose))
    return Body(visuals=(shape,), collisions=(shape,))


def hinged_door() -> kv.Model:
    """A door on a cupboard, without bodies."""
    model = kv.Model()
    with model.edit() as edit:
        edit.add_frame("cupboard", "world", kv.translation(1, 0, 0))
        hinge = {"axis": (0, 0, 1), "lower": 0.0, "upper": 1.5, "velocity": 1.0}
        edit.apply(kv.Revolute(name="hinge", parent="cupboard", child="door", **hinge))
    return model


def cupboard() -> kv.Model:
    """A head 1 m up, before a cupboard at x = 2 with a door, behind which is a drawer; and a wall."""
    model = kv.Model()
    door, drawer, pan = (kv.position(name) for name in ("cupboard/door", "cupboard/drawer", "robot/pan"))
    with model.edit() as edit:
        edit.apply(OmniBase(name="robot/base", parent="world", child="robot/base"))
        edit.add_frame("robot/neck", "robot/base", kv.translation(0, 0, 1), body=box(0.2, 0.2, 0.2))
        edit.add_frame("robot/head_tilt_link", "robot/neck", kv.rotation_z(pan), body=box(0.1, 0.1, 0.1))
        edit.add_frame("cupboard", "world", kv.translation(2, 0, 1), body=box(0.02, 1, 1, at=(0.5, 0, 0)))
        edit.add_frame("cupboard/hinge", "cupboard", kv.translation(0, 0.5, 0) @ kv.rotation_z(-door))
        edit.add_frame("cupboard/panel", "cupboard/hinge", np.eye(4), body=box(0.02, 1, 1, at=(0, -0.5, 0)))
        edit.add_frame(
            "cupboard/drawer", "cupboard", kv.translation(0.3 - drawer, 0, 0), body=box(0.2, 0.2, 0.2)
        )
        edit.add_frame("wall", "world", kv.translation(4, 0, 1), body=box(0.1, 1, 1))
        edit.constrain("cupboard/door/range", 0, door, 2)
    return model


def state(model: kv.Model, **values: float) -> kv.State:
    """Return the default state with other values, whose names have __ for slashes."""
    return model.default_state().updated({name.replace("__", "/"): v for name, v in values.items()})
