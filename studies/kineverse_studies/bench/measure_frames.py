"""``frames``: poses of all frames at one configuration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kineverse.compilation import compile
from kineverse.lie import Array

from .harness import BenchmarkSettings, Contender, Contenders, time_calls, time_contenders
from .result import BenchmarkResult, compare_speed
from .workloads import BenchmarkRobot, find_benchmark_robot

KINEVERSE, PINOCCHIO, MUJOCO = "kineverse, bound call with input", "pinocchio", "mujoco"

_CHECKED = 10


def measure(settings: BenchmarkSettings) -> BenchmarkResult:
    """Measure the poses of all frames."""
    robot = find_benchmark_robot(settings)
    frames = list(robot.model.frames)
    configurations = robot.configurations(settings.configurations)
    participants = Contenders([_ours(robot, frames, configurations)])
    participants.add_peer("pinocchio", lambda: [_pinocchio(robot, frames, configurations)])
    participants.add_peer("mujoco", lambda: [_mujoco(robot, frames, configurations)])
    measured = time_contenders("frames", participants.contenders, settings.rounds, settings.progress)
    return BenchmarkResult(
        name="frames",
        work=(
            f"the poses of all {len(frames)} links of {robot.file.name}, one configuration, from Python; "
            f"inputs go through {len(configurations)} configurations"
        ),
        measurements=tuple(measured.values()),
        comparisons=(
            compare_speed(measured, KINEVERSE, PINOCCHIO, 2.5),
            compare_speed(measured, KINEVERSE, MUJOCO),
        ),
        missing=tuple(participants.missing),
    )


def _ours(robot: BenchmarkRobot, frames: Sequence[str], configurations: Array) -> Contender:
    function = compile([robot.model.fk(frame) for frame in frames], robot.coordinates, wait=True)
    evaluator = function.bind()
    points = list(configurations)

    def run() -> None:
        for point in points:
            evaluator(point)

    def results() -> list[Array]:
        poses = []
        for point in points[:_CHECKED]:
            evaluator(point)
            poses.append(np.array(evaluator.outputs))
        return poses

    return Contender(KINEVERSE, time_calls(run, len(points)), results)


def _pinocchio(robot: BenchmarkRobot, frames: Sequence[str], configurations: Array) -> Contender:
    import pinocchio as pin

    from .peers.pinocchio import PinocchioRobot

    peer = PinocchioRobot(robot)
    model, data = peer.model, peer.data
    rows = peer.rows(robot.positions(configurations))
    numbers = [model.getFrameId(frame, pin.FrameType.BODY) for frame in frames]

    def run() -> None:
        forward = pin.framesForwardKinematics
        for row in rows:
            forward(model, data, row)

    def results() -> list[Array]:
        poses = []
        for row in rows[:_CHECKED]:
            pin.framesForwardKinematics(model, data, row)
            poses.append(np.array([data.oMf[k].homogeneous for k in numbers]))
        return poses

    return Contender(PINOCCHIO, time_calls(run, len(rows)), results)


def _mujoco(robot: BenchmarkRobot, frames: Sequence[str], configurations: Array) -> Contender:
    import mujoco

    from .peers.mujoco_kinematics import MujocoRobot

    peer = MujocoRobot(robot)
    model, data = peer.model, peer.data
    rows = peer.rows(robot.positions(configurations))
    # The robot's root is MuJoCo's world.
    numbers = [max(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, frame), 0) for frame in frames]

    def run() -> None:
        forward, position = mujoco.mj_kinematics, data.qpos
        for row in rows:
            position[:] = row
            forward(model, data)

    def results() -> list[Array]:
        poses = []
        for row in rows[:_CHECKED]:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            poses.append(np.array([peer.pose(k) for k in numbers]))
        return poses

    return Contender(MUJOCO, time_calls(run, len(rows)), results)
