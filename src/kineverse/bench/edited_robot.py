"""A robot with one joint replaced, until its next pose is there."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import cast
from xml.etree import ElementTree

import numpy as np

from kineverse.articulations.joint import Joint
from kineverse.model import Pose

from .agreement import Array
from .robot import Robot, bare_text
from .timing import Contender, timed

JOINT, PINOCCHIO, MUJOCO = (
    "kineverse, joint replaced",
    "pinocchio, file read again",
    "mujoco, joint moved, compiled",
)

_SHIFT = 0.01
"""How far the joint is moved [m]."""

_EVERYWHERE = 0.3
"""Where all coordinates are [rad], [m]."""


def joint_replaced(robot: Robot) -> Contender:
    """Return who replaces an operation, and evaluates the new pose."""
    model = robot.model.copy()
    tag, joint = _joint_on_the_way(robot)
    values = dict.fromkeys(robot.chain, _EVERYWHERE)
    shifts = count(1)

    def at(shift: float) -> Array:
        with model.edit() as edit:
            edit.replace(tag, replace(joint, origin=_shifted(cast(Pose, joint.origin), shift)))
        return np.asarray(model.fk(robot.frame)(values))

    # Every time by another shift: a model that is what it was before would be done at once.
    return Contender(JOINT, timed(lambda: at(_SHIFT * next(shifts))), lambda: [at(_SHIFT)])


def _joint_on_the_way(robot: Robot) -> tuple[str, Joint]:
    """Return tag and operation of the middle one of the joints that move the frame."""
    name = robot.chain[len(robot.chain) // 2].path
    for tag in robot.model.history.tags:
        operation = robot.model.history.entry(tag).operation
        if isinstance(operation, Joint) and operation.name == name:
            return tag, operation
    raise LookupError(name)


def _shifted(origin: Pose, shift: float) -> Pose:
    matrix = np.array(origin.matrix)
    matrix[0, 3] += shift
    return Pose.of(matrix)


def _everywhere(robot: Robot) -> dict[str, Array]:
    return robot.positions(np.full((1, len(robot.coordinates)), _EVERYWHERE))


def read_again(robot: Robot, folder: Path) -> Contender:
    """Return who reads a file in which the joint is moved, as a model in pinocchio stays what it is."""
    import pinocchio as pin

    from .pinocchio_robot import PinocchioRobot

    file = folder / "edited.urdf"
    file.write_text(_edited_text(robot), encoding="utf-8")
    edited = replace(robot, file=file)

    def at() -> Array:
        peer = PinocchioRobot(edited)
        (row,) = peer.rows(_everywhere(robot))
        pin.framesForwardKinematics(peer.model, peer.data, row)
        pose: Array = peer.pose.homogeneous
        return pose

    return Contender(PINOCCHIO, timed(at), lambda: [at()])


def compiled_again(robot: Robot) -> Contender:
    """Return who moves a body in MuJoCo's specification, and compiles that."""
    import mujoco

    from .mujoco_robot import MujocoRobot, mujoco_text

    joint = _joint_on_the_way(robot)[1]
    peer = MujocoRobot(robot)
    (row,) = peer.rows(_everywhere(robot))
    specification = mujoco.MjSpec.from_string(mujoco_text(robot))
    place = specification.body(joint.child).pos
    start = np.array(place)
    shifts = count(1)

    def at(shift: float) -> Array:
        place[:] = start + np.array([shift, 0.0, 0.0])
        peer.model = specification.compile()
        peer.data = mujoco.MjData(peer.model)
        peer.data.qpos[:] = row
        mujoco.mj_kinematics(peer.model, peer.data)
        return peer.pose(peer.body)

    return Contender(MUJOCO, timed(lambda: at(_SHIFT * next(shifts))), lambda: [at(_SHIFT)])


def _edited_text(robot: Robot) -> str:
    """Return the robot's file with the joint moved, without shapes."""
    name = _joint_on_the_way(robot)[1].name
    root = ElementTree.fromstring(bare_text(robot.file))
    element = next(e for e in root.iterfind("joint") if e.get("name") == name)
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    x, y, z = map(float, origin.get("xyz", "0 0 0").split())
    origin.set("xyz", f"{x + _SHIFT!r} {y!r} {z!r}")
    return ElementTree.tostring(root, encoding="unicode")
