"""A hand with a ball and two fingers that floats before furniture: a door, drawers, a puck and sliders."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse.articulations.locks import speed_lock
from kineverse.grasping import Gripper, find_gripper
from kineverse.model.body import Body, Box, Cylinder, Geometry, Inertia, Pose, Shape, Sphere

BALL, PANEL, HINGE = 0.03, 0.02, np.array([1.0, 0.0])
"""Radius of the ball, thickness of the door, and its hinge [m]."""


def solid(geometry: Geometry, at: tuple[float, float, float] = (0, 0, 0)) -> Body:
    return Body(collisions=(Shape(geometry, Pose.from_matrix(np.array(kv.translation(*at)()))),))


def pusher(
    *, locked: bool = False, closed_at: float = 0.0, mass: float | None = None, aside: float = 0.0
) -> kv.Model:
    """A ball 0.5 m above a hand: both move in x, y and turn; the furniture stands at different heights.

    The door (z = 0.3 to 0.7) turns about (1, 0) and opens away from the robot; a handle is before it at y = 0.7
    and z = 0.
    The drawer (z = 2) is shut at x = 1 and its handle is a bar before it. ``aside`` moves the drawer in y [m].
    A robot with a mass [kg] is strong enough to pull in a world with forces.
    """
    x, y, z, turn, finger = (kv.position(f"robot/{name}") for name in ("x", "y", "z", "turn", "finger"))
    door, drawer, bolt, puck = (kv.position(f"room/{name}") for name in ("door", "drawer", "bolt", "puck"))
    first, second, left, right = (
        kv.position(f"room/{name}") for name in ("first", "second", "left", "right")
    )
    model = kv.Model()
    with model.edit() as edit:
        body = Body() if mass is None else Body(inertia=Inertia(mass, (0.4, 0, 0, 0.4, 0, 0.4)))
        edit.add_frame("robot/base", "world", kv.translation(x, y, z) @ kv.rotation_z(turn), body)
        edit.add_frame("robot/ball", "robot/base", kv.translation(0, 0, 0.5), solid(Sphere(BALL)))
        edit.add_frame("robot/palm", "robot/base", np.eye(4), solid(Box((0.04, 0.12, 0.06))))
        tip = solid(Box((0.06, 0.01, 0.03)))
        edit.add_frame("robot/left_finger", "robot/palm", kv.translation(0.06, finger, 0), tip)
        edit.add_frame("robot/right_finger", "robot/palm", kv.translation(0.06, -finger, 0), tip)
        edit.constrain("robot/finger/range", 0.006, finger, 0.05)
        edit.add_frame("room/door", "world", kv.translation(*HINGE, 0.5) @ kv.rotation_z(-door))
        edit.add_frame("room/panel", "room/door", np.eye(4), solid(Box((PANEL, 0.8, 0.4)), (0, 0.4, 0)))
        edit.add_frame(
            "room/door_handle", "room/door", kv.translation(-0.06, 0.7, -0.5), solid(Cylinder(0.01, 0.1))
        )
        edit.constrain("room/door/range", -1.5, door, 1.5)
        edit.constrain("room/door/speed", -1.0, kv.velocity("room/door"), 1.0)
        edit.add_frame(
            "room/drawer", "world", kv.translation(1 - drawer, aside, 2), solid(Box((0.02, 0.4, 0.2)))
        )
        edit.add_frame(
            "room/drawer_handle", "room/drawer", kv.translation(-0.06, 0, 0), solid(Cylinder(0.01, 0.1))
        )
        edit.constrain("room/drawer/range", closed_at, drawer, 0.4)
        edit.constrain("room/drawer/speed", -0.2, kv.velocity("room/drawer"), 0.2)
        edit.add_frame("room/bolt", "world", kv.translation(3, bolt, 2), solid(Box((0.1, 0.1, 0.1))))
        if locked:
            edit.constrain("room/drawer/lock", *speed_lock(drawer, open_if=bolt > 0.5))
        edit.add_frame("room/puck", "world", kv.translation(1, puck, 4), solid(Box((0.03, 0.02, 0.05))))
        edit.add_frame(
            "room/first", "world", kv.translation(1 + first, 0, 6), solid(Box((0.02, 0.2, 0.1)), (1, 0, 0))
        )
        edit.add_frame(
            "room/second", "room/first", kv.translation(second, 0, 0), solid(Box((0.02, 0.2, 0.1)))
        )
        for name, coordinate, height in (("left", left, 8), ("right", right, 9)):
            edit.add_frame(
                f"room/{name}",
                "world",
                kv.translation(1 + coordinate, 0, height),
                solid(Box((0.02, 0.2, 0.1))),
            )
        edit.constrain("room/linked", 0, right - 2 * left, 0)
    return model


def gripper(model: kv.Model) -> Gripper:
    return find_gripper(model, "robot")


def angle_of_door(x: float, y: float) -> float:
    """Return the angle of the door whose front touches the ball: cos(q) (1 - x) + sin(q) y = radius + half a panel."""
    dx, dy = np.array([x, y]) - HINGE
    return float(np.arctan2(dx, dy) + np.arcsin((BALL + PANEL / 2) / np.hypot(dx, dy)))
