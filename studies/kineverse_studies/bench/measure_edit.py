"""``edit``: edits of a large model, and of one joint of a robot up to its next pose."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from itertools import count
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from kineverse.articulations.joint import Joint
from kineverse.lie import Array
from kineverse.model import Pose

from .harness import BenchmarkSettings, Contender, Contenders, time_calls, time_contenders
from .large_models import (
    COPY,
    READERS,
    RELEVANT,
    TO_EMPTY,
    TO_LARGE,
    count_reruns,
    large_model_contenders,
    make_large_model,
)
from .result import Bar, BenchmarkResult, Comparison, Measurement, bound_median, compare_speed
from .workloads import BenchmarkRobot, find_benchmark_robot, strip_shapes

JOINT, PINOCCHIO, MUJOCO = (
    "kineverse, joint replaced",
    "pinocchio, file read again",
    "mujoco, joint moved, compiled",
)

_SHIFT = 0.01
"""Displacement of the joint [m]."""

_CONFIGURATION_RANGE = 0.3
"""Value of all coordinates [rad], [m]."""


def replace_joint(robot: BenchmarkRobot) -> Contender:
    """Return the contender that replaces an operation and evaluates the new pose."""
    model = robot.model.copy()
    tag, joint = _middle_joint(robot)
    origin = joint.origin
    assert isinstance(origin, Pose)  # as in all robot descriptions
    values = dict.fromkeys(robot.chain, _CONFIGURATION_RANGE)
    shifts = count(1)

    def edited_pose(shift: float) -> Array:
        with model.edit() as edit:
            edit.replace(tag, replace(joint, origin=_shift_origin(origin, shift)))
        return np.asarray(model.fk(robot.frame)(values))

    # Each shift differs from the last, because an edit that changes nothing takes no time.
    return Contender(
        JOINT, time_calls(lambda: edited_pose(_SHIFT * next(shifts))), lambda: [edited_pose(_SHIFT)]
    )


def _middle_joint(robot: BenchmarkRobot) -> tuple[str, Joint]:
    """Return tag and operation of the middle joint of the chain."""
    name = robot.chain[len(robot.chain) // 2].path
    for tag in robot.model.history.tags:
        operation = robot.model.history.entry(tag).operation
        if isinstance(operation, Joint) and operation.name == name:
            return tag, operation
    raise LookupError(name)


def _shift_origin(origin: Pose, shift: float) -> Pose:
    matrix = np.array(origin.matrix)
    matrix[0, 3] += shift
    return Pose.from_matrix(matrix)


def _sampled_configurations(robot: BenchmarkRobot) -> dict[str, Array]:
    return robot.positions(np.full((1, len(robot.coordinates)), _CONFIGURATION_RANGE))


def reread_file(robot: BenchmarkRobot, folder: Path) -> Contender:
    """Return the contender that reads a file with the joint moved, as pinocchio models are immutable."""
    import pinocchio as pin

    from .peers.pinocchio import PinocchioRobot

    file = folder / "edited.urdf"
    file.write_text(_edited_text(robot), encoding="utf-8")
    edited = replace(robot, file=file)

    def edited_pose() -> Array:
        peer = PinocchioRobot(edited)
        (row,) = peer.rows(_sampled_configurations(robot))
        pin.framesForwardKinematics(peer.model, peer.data, row)
        pose: Array = peer.pose.homogeneous
        return pose

    return Contender(PINOCCHIO, time_calls(edited_pose), lambda: [edited_pose()])


def recompile_specification(robot: BenchmarkRobot) -> Contender:
    """Return the contender that moves a body in MuJoCo's specification and compiles it."""
    import mujoco

    from .peers.mujoco_kinematics import MujocoRobot, make_robot_mjcf

    joint = _middle_joint(robot)[1]
    peer = MujocoRobot(robot)
    (row,) = peer.rows(_sampled_configurations(robot))
    specification = mujoco.MjSpec.from_string(make_robot_mjcf(robot))
    place = specification.body(joint.child).pos
    start = np.array(place)
    shifts = count(1)

    def edited_pose(shift: float) -> Array:
        place[:] = start + np.array([shift, 0.0, 0.0])
        peer.model = specification.compile()
        peer.data = mujoco.MjData(peer.model)
        peer.data.qpos[:] = row
        mujoco.mj_kinematics(peer.model, peer.data)
        return peer.pose(peer.body)

    return Contender(
        MUJOCO, time_calls(lambda: edited_pose(_SHIFT * next(shifts))), lambda: [edited_pose(_SHIFT)]
    )


def _edited_text(robot: BenchmarkRobot) -> str:
    """Return the robot's file with the joint moved, without shapes."""
    name = _middle_joint(robot)[1].name
    root = ElementTree.fromstring(strip_shapes(robot.file))
    element = next(e for e in root.iterfind("joint") if e.get("name") == name)
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    x, y, z = map(float, origin.get("xyz", "0 0 0").split())
    origin.set("xyz", f"{x + _SHIFT!r} {y!r} {z!r}")
    return ElementTree.tostring(root, encoding="unicode")


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure edits of a large model and of a robot."""
    robot = find_benchmark_robot(settings)
    large = make_large_model(settings.operations)
    measured = time_contenders(
        "edit", list(large_model_contenders(large)), settings.rounds, settings.progress
    )
    runs = Measurement("operations run by that", "operations", (float(count_reruns(large)),))
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        participants = Contenders([replace_joint(robot)])
        participants.add_peer("pinocchio", lambda: [reread_file(robot, Path(folder))])
        participants.add_peer("mujoco", lambda: [recompile_specification(robot)])
        edited = time_contenders("edit", participants.contenders, settings.rounds, settings.progress)
    ratio = compare_speed(measured, TO_LARGE, TO_EMPTY)
    return BenchmarkResult(
        name="edit",
        work=(
            f"edits of a model of {len(large.history.tags)} operations and {len(large.constraints)} "
            f"constraints; one joint of {robot.file.name} replaced, until the next pose of {robot.frame}"
        ),
        measurements=(*measured.values(), runs, *edited.values()),
        comparisons=(
            replace(ratio, bar=Bar(0.5, at_least=True)),
            Comparison(runs.name, runs.median, runs.unit, Bar(1 + READERS, at_least=False)),
            bound_median(measured[RELEVANT], 50e-6),
            bound_median(measured[COPY], 20e-6),
            bound_median(edited[JOINT], 5e-3),
            compare_speed(edited, JOINT, PINOCCHIO),
            compare_speed(edited, JOINT, MUJOCO),
        ),
        missing=tuple(participants.missing),
    )
