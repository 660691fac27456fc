"""A small robot beside a door, for tests of robots that are topics."""

from __future__ import annotations

from functools import cache

import kineverse as kv
from cupboards import box
from kineverse.articulations import DifferentialDrive, OmniBase
from kineverse.model.basic_operations import SetBody
from kineverse.worlds import Robot
from kineverse_ros.robot_settings import RobotConnection, RobotSettings, connect_names

WHEELS = {"radius": 0.1, "track": 0.4}


@cache
def load_robot(omni: bool = True) -> kv.Model:
    """Return the robot ``bot`` with a lift and a camera that pans, on any base or on two wheels, and a door."""
    model = kv.Model()
    names = {"name": "bot/base", "parent": "world", "child": "bot/base"}
    with model.edit() as edit:
        edit.apply(OmniBase(**names) if omni else DifferentialDrive(**names, **WHEELS))
        edit.add_frame("bot/base_link", "bot/base", kv.translation(0.1, 0, 0), body=box(0.2, 0.2, 0.2))
        limits = {"lower": -1.0, "upper": 1.0, "velocity": 1.0}
        edit.apply(
            kv.Prismatic(
                name="bot/lift", parent="bot/base_link", child="bot/column", axis=(0, 0, 1), **limits
            )
        )
        edit.apply(
            kv.Revolute(name="bot/pan", parent="bot/column", child="bot/camera", axis=(0, 0, 1), **limits)
        )
        edit.apply(SetBody("bot/camera", box(0.1, 0.1, 0.1)))
        edit.add_frame("wall", "world", kv.translation(2, 0, 0))
        edit.apply(kv.Revolute(name="hinge", parent="wall", child="door", axis=(0, 0, 1), **limits))
        edit.apply(SetBody("door", box(0.02, 0.4, 0.4)))
    return model


def connect(model: kv.Model, **settings) -> RobotConnection:
    return connect_names(Robot.of(model, "bot"), RobotSettings(**settings), ["door"])
