"""Poses, Jacobians and documents of a robot in pinocchio."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from kineverse.lie import Array
from kineverse_studies.bench.harness import Contender, time_calls
from kineverse_studies.bench.kinematics import CHECKED, CHECKED_FRAMES, pin_to_one_core, stack_results
from kineverse_studies.bench.workloads import BenchmarkRobot

ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class PinocchioRobot:
    def __init__(self, robot: BenchmarkRobot, reduced: bool = False) -> None:
        model = pin.buildModelFromUrdf(str(robot.file))
        moving = [symbol.path for symbol in robot.chain]
        if reduced:
            others = [k for k in range(1, model.njoints) if model.names[k] not in moving]
            model = pin.buildReducedModel(model, others, pin.neutral(model))
        self.model: Any = model
        self.data: Any = model.createData()
        self.frame: int = model.getFrameId(robot.frame, pin.FrameType.BODY)
        self.pose: Any = self.data.oMf[self.frame]
        self.columns: list[int] = [model.joints[model.getJointId(name)].idx_v for name in moving]

    def rows(self, positions: dict[str, Array]) -> list[Array]:
        """Return configurations in pinocchio's coordinates; a continuous joint has cosine and sine."""
        columns: list[Array] = []
        for name, joint in list(zip(self.model.names, self.model.joints, strict=True))[1:]:
            angle = positions[name]
            columns += [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
        return list(np.ascontiguousarray(np.column_stack(columns)))

    def pose_and_jacobian(self, row: Array) -> tuple[Array, Array]:
        """Return the frame's pose (4, 4) and world-aligned Jacobian (6, n), columns in Kineverse's order."""
        jacobian = pin.computeFrameJacobian(self.model, self.data, row, self.frame, ALIGNED)
        return self.pose.homogeneous, jacobian[:, self.columns]


def call(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
    """Yield the ways in which users of pinocchio get a pose and a Jacobian."""
    positions, compute = robot.positions(configurations), pin.computeFrameJacobian
    reduced, whole = PinocchioRobot(robot, reduced=True), PinocchioRobot(robot)

    def look_up_placement(peer: PinocchioRobot, rows: list[Array]) -> None:
        model, data, frame, aligned = peer.model, peer.data, peer.frame, ALIGNED
        for row in rows:
            compute(model, data, row, frame, aligned)
            data.oMf[frame].homogeneous  # noqa: B018 - makes an array

    def hold_placement(peer: PinocchioRobot, rows: list[Array]) -> None:
        model, data, frame, pose, aligned = peer.model, peer.data, peer.frame, peer.pose, ALIGNED
        for row in rows:
            compute(model, data, row, frame, aligned)
            pose.homogeneous  # noqa: B018 - makes an array

    def compute_all_joints(peer: PinocchioRobot, rows: list[Array]) -> None:
        model, data, frame, pose, aligned = peer.model, peer.data, peer.frame, peer.pose, ALIGNED
        for row in rows:
            pin.computeJointJacobians(model, data, row)
            pin.updateFramePlacement(model, data, frame)
            pin.getFrameJacobian(model, data, frame, aligned)
            pose.homogeneous  # noqa: B018 - makes an array

    for name, peer, run in (
        ("reduced to the chain", reduced, look_up_placement),
        ("reduced, placement held", reduced, hold_placement),
        ("path to the frame", whole, hold_placement),
        ("all joints", whole, compute_all_joints),
    ):
        rows = peer.rows(positions)
        checked = partial(map, peer.pose_and_jacobian, rows[:CHECKED])
        yield Contender(
            f"pinocchio, {name}",
            time_calls(partial(run, peer, rows), len(rows)),
            lambda checked=checked: stack_results(checked()),  # type: ignore[misc]
        )


def frames(robot: BenchmarkRobot, names: Sequence[str], configurations: Array) -> Iterator[Contender]:
    peer = PinocchioRobot(robot)
    model, data = peer.model, peer.data
    rows = peer.rows(robot.positions(configurations))
    numbers = [model.getFrameId(frame, pin.FrameType.BODY) for frame in names]

    def run() -> None:
        forward = pin.framesForwardKinematics
        for row in rows:
            forward(model, data, row)

    def results() -> Iterator[Array]:
        for row in rows[:CHECKED_FRAMES]:
            pin.framesForwardKinematics(model, data, row)
            yield np.array([data.oMf[k].homogeneous for k in numbers])

    yield Contender("pinocchio", time_calls(run, len(rows)), lambda: list(results()))


def batch(robot: BenchmarkRobot, configurations: Array) -> Iterator[Contender]:
    peer = PinocchioRobot(robot, reduced=True)
    rows = peer.rows(robot.positions(configurations))
    poses, jacobians = np.zeros((len(rows), 4, 4)), np.zeros((len(rows), 6, len(robot.chain)))

    def run() -> None:
        compute, aligned = pin.computeFrameJacobian, ALIGNED
        model, data, frame, pose = peer.model, peer.data, peer.frame, peer.pose
        for k, row in enumerate(rows):
            jacobians[k] = compute(model, data, row, frame, aligned)
            poses[k] = pose.homogeneous

    def results() -> list[Array]:
        run()
        return [poses, jacobians[:, :, peer.columns]]

    name = "pinocchio, loop over the reduced robot"
    yield Contender(name, pin_to_one_core(time_calls(run, len(rows))), results)


def document(robot: BenchmarkRobot) -> Iterator[Contender]:
    model = PinocchioRobot(robot).model
    yield Contender(
        "pinocchio, archive", time_calls(lambda: pin.Model().loadFromString(model.saveToString()))
    )


def edit(
    robot: BenchmarkRobot, moved: BenchmarkRobot, body: str, positions: dict[str, Array]
) -> Iterator[Contender]:
    """Yield the contender that reads a file with a joint moved, as pinocchio's models are immutable."""

    def edited_pose() -> Array:
        peer = PinocchioRobot(moved)
        (row,) = peer.rows(positions)
        pin.framesForwardKinematics(peer.model, peer.data, row)
        pose: Array = peer.pose.homogeneous
        return pose

    yield Contender("pinocchio, file read again", time_calls(edited_pose), lambda: [edited_pose()])
