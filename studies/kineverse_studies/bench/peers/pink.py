"""Control and inverse kinematics by pink, and inverse kinematics by pinocchio's example loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pink
import pinocchio as pin
from pink.barriers import PositionBarrier
from pink.limits import ConfigurationLimit
from pink.tasks import (
    ComTask,
    FrameTask,
    LinearHolonomicTask,
    LowAccelerationTask,
    PostureTask,
    RelativeFrameTask,
)

from kineverse.lie import Array
from kineverse_studies.bench import control_workloads as workloads
from kineverse_studies.bench.control import DOOR, DOOR_GAIN, GRASP, GRIPPERS, OPENING
from kineverse_studies.bench.inverse_kinematics import ReachingProblem, TaskReaching

SOLVER = "daqp"


class PinkRobot:
    def __init__(self, workload: workloads.ControlWorkload) -> None:
        self.model: Any = pin.buildModelFromXML(workload.urdf())
        q = pin.neutral(self.model)
        for name, value in workload.start.items():
            joint, number = workloads.split_coordinate(name)
            entry = self.model.joints[self.model.getJointId(joint)]
            if entry.nq == 2:  # a continuous joint has cosine and sine
                q[entry.idx_q : entry.idx_q + 2] = np.cos(value), np.sin(value)
            else:
                q[entry.idx_q + number] = value
        self.start = np.array(q)
        self.configuration: Any = pink.Configuration(self.model, self.model.createData(), self.start)

    def pose(self, frame: str) -> Any:
        return self.configuration.get_transform_frame_to_world(frame)


@dataclass
class PinkLoop(workloads.PeerLoop):
    options: dict[str, Any] = field(default_factory=dict)  # further options of ``pink.solve_ik``
    after: Callable[[Array], None] | None = None  # called with the velocity of each step

    def solve(self) -> Array:
        configuration = self.robot.configuration
        return np.array(pink.solve_ik(configuration, self.tasks, self.period, solver=SOLVER, **self.options))

    def advance(self) -> None:
        super().advance()
        if self.after is not None:
            self.after(self._velocity)


def make_loop(name: str, workload: workloads.ControlWorkload) -> PinkLoop:
    return PINK_LOOPS[name](PinkRobot(workload), workload.period)


def _distance(robot: PinkRobot, task: Any) -> Callable[[], float]:
    def error() -> float:
        target = task.transform_target_to_world.translation
        return float(np.linalg.norm(robot.pose(task.frame).translation - target))

    return error


def _swing(*tasks: Any) -> Callable[[float], None]:
    def move(time: float) -> None:
        for task in tasks:
            task.transform_target_to_world.translation[1:] = workloads.swing(time)

    return move


def _reach(robot: PinkRobot, period: float) -> PinkLoop:
    gripper = FrameTask("ee_link", position_cost=1.0, orientation_cost=1.0, lm_damping=1.0)
    posture = PostureTask(cost=1e-3)
    workloads.hold_start(robot, (gripper, posture))
    return PinkLoop(robot, period, [gripper, posture], _swing(gripper), _distance(robot, gripper))


def _reach_smoothly(robot: PinkRobot, period: float) -> PinkLoop:
    gripper = FrameTask("ee_link", position_cost=1.0, orientation_cost=1.0, lm_damping=1.0)
    smooth = LowAccelerationTask(cost=0.1)
    workloads.hold_start(robot, (gripper,))

    def after(velocity: Array) -> None:
        smooth.set_last_integration(velocity, period)

    after(np.zeros(robot.model.nv))
    return PinkLoop(robot, period, [gripper, smooth], _swing(gripper), _distance(robot, gripper), after=after)


def _fly(robot: PinkRobot, period: float) -> PinkLoop:
    base = FrameTask("base", position_cost=1.0, orientation_cost=1.0, lm_damping=0.1)
    arms = [
        FrameTask(f"{side}/ee_link", position_cost=1.0, orientation_cost=1.0, lm_damping=1.0)
        for side in ("left", "right")
    ]
    tasks = [base, *arms, PostureTask(cost=1e-3)]
    workloads.hold_start(robot, tasks)
    swing_arms = _swing(*arms)

    def move(time: float) -> None:
        swing_arms(time)
        base.transform_target_to_world.translation[2] = 0.3 * np.sin(2.0 * time)

    return PinkLoop(robot, period, tasks, move, _distance(robot, arms[0]))


def _squat_on_two_legs(robot: PinkRobot, period: float) -> PinkLoop:
    centre = ComTask(cost=200.0)
    hands = [FrameTask(hand, position_cost=4.0, orientation_cost=0.0) for hand in workloads.HANDS]
    tasks = [
        FrameTask("pelvis", position_cost=0.0, orientation_cost=10.0),
        PostureTask(cost=0.1),
        centre,
        *(FrameTask(foot, position_cost=200.0, orientation_cost=10.0) for foot in workloads.FEET),
        *hands,
    ]
    workloads.hold_start(robot, tasks)
    for hand in hands:
        hand.transform_target_to_world.translation += np.array([-0.1, 0.0, -0.2])

    def move(time: float) -> None:
        centre.set_target(np.array([0.0, 0.0, 0.55 + 0.05 * np.sin(np.pi * time)]))

    options = {"damping": 0.01, "safety_break": False}
    return PinkLoop(robot, period, tasks, move, workloads.measure_error(robot, centre), options)


def _squat_on_four_legs(robot: PinkRobot, period: float) -> PinkLoop:
    trunk = FrameTask("base", position_cost=50.0, orientation_cost=1.0)
    feet = [FrameTask(foot, position_cost=200.0, orientation_cost=0.0) for foot in workloads.QUADRUPED_FEET]
    barrier = PositionBarrier(
        "base",
        indices=[1, 2],
        p_max=np.array([0.0, 0.35]),
        gain=np.array([100.0, 100.0]),
        safe_displacement_gain=1.0,
    )
    tasks = [trunk, PostureTask(cost=1e-5), *feet]
    workloads.hold_start(robot, tasks)

    def move(time: float) -> None:
        trunk.transform_target_to_world.translation[1:] = workloads.squat(time)

    return PinkLoop(robot, period, tasks, move, _distance(robot, feet[0]), {"barriers": [barrier]})


class PinkTargetLoop(PinkLoop):
    """Iterated inverse kinematics: a step is one target, reached within 1e-8 from the zero position."""

    def advance(self) -> None:
        """Stay at the solution."""

    def step(self) -> None:
        self.reset()
        (task,) = self.tasks
        for _ in range(1000):
            velocity = pink.solve_ik(
                self.robot.configuration, self.tasks, self.period, solver=SOLVER, damping=1e-8
            )
            self.robot.configuration.integrate_inplace(velocity, self.period)
            if np.linalg.norm(task.compute_error(self.robot.configuration)) < 1e-8:
                return


def _solve(robot: PinkRobot, period: float) -> PinkLoop:
    name = "inverse_kinematics_ur10"
    targets = [
        pin.SE3(pose)
        for pose in workloads.reachable_targets(name, "wrist_3_link", workloads.WORKLOADS[name].steps)
    ]
    gripper = FrameTask("wrist_3_link", position_cost=1.0, orientation_cost=1.0)

    def move(time: float) -> None:
        gripper.set_target(targets[round(time / period) % len(targets)])

    return PinkTargetLoop(robot, period, [gripper], move, _distance(robot, gripper))


def _open_fridge(robot: PinkRobot, period: float) -> PinkLoop:
    model = robot.model
    door = model.joints[model.getJointId(DOOR)]
    row = np.zeros((1, model.nv))
    row[0, door.idx_v] = 1.0
    # The gain of a task is the part of its error that one step removes.
    opening = LinearHolonomicTask(
        row, np.array([0.5 * np.pi]), pin.neutral(model), cost=np.array([1.0]), gain=DOOR_GAIN * period
    )
    posture = PostureTask(cost=0.01)
    held = RelativeFrameTask(GRIPPERS["pr2"], GRASP, position_cost=1.0, orientation_cost=1.0, gain=0.5)
    held.set_target(pin.SE3.Identity())
    workloads.hold_start(robot, (posture,))

    options = {"constraints": [held], "damping": 1e-6}
    return PinkLoop(
        robot, period, [opening, posture], lambda time: None, workloads.measure_error(robot, held), options
    )


PINK_LOOPS: Mapping[str, Callable[[PinkRobot, float], PinkLoop]] = {
    OPENING: _open_fridge,
    "arm_ur5": _reach,
    "arm_ur3_velocity_smoothing": _reach_smoothly,
    "flying_dual_arm_ur3": _fly,
    "humanoid_g1_com": _squat_on_two_legs,
    "go2_squat": _squat_on_four_legs,
    "inverse_kinematics_ur10": _solve,
}
"""Control loops by the name of the workload, each as in the example that it follows."""


class _PinocchioArm:
    def __init__(self, problem: ReachingProblem) -> None:
        self.model: Any = pin.buildModelFromXML(problem.urdf())
        self._joints = [self.model.joints[self.model.getJointId(name)] for name in problem.names()]
        self._neutral = pin.neutral(self.model)

    def to_pinocchio(self, positions: Array) -> Array:
        """Return pinocchio's coordinates; a continuous joint has cosine and sine."""
        q = self._neutral.copy()
        for joint, value in zip(self._joints, positions, strict=True):
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                value if joint.nq == 1 else (np.cos(value), np.sin(value))
            )
        return np.array(q)

    def from_pinocchio(self, q: Array) -> Array:
        return np.array(
            [q[j.idx_q] if j.nq == 1 else np.arctan2(q[j.idx_q + 1], q[j.idx_q]) for j in self._joints]
        )


class PinkReaching(TaskReaching):
    def __init__(self, problem: ReachingProblem) -> None:
        self._arm = _PinocchioArm(problem)
        model, start = self._arm.model, self._arm.to_pinocchio(problem.starts[0, 0])
        self.configuration = pink.Configuration(model, model.createData(), start)
        self.task = FrameTask(problem.frame, position_cost=1.0, orientation_cost=1.0, lm_damping=1e-2)
        self._limits = [ConfigurationLimit(model)]

    def aim(self, target: Array) -> None:
        self.task.set_target(pin.SE3(target))

    def start(self, q: Array) -> None:
        self.configuration.update(self._arm.to_pinocchio(q))

    def solve(self) -> Array:
        options = {"damping": 1e-8, "limits": self._limits, "safety_break": False}
        return np.array(pink.solve_ik(self.configuration, [self.task], 1.0, solver=SOLVER, **options))

    def positions(self) -> Array:
        return self._arm.from_pinocchio(self.configuration.q)


class PinocchioReaching:
    """Inverse kinematics of pinocchio's example; positions are compared with limits modulo 2π."""

    def __init__(self, problem: ReachingProblem, iterations: int = 1000, rate: float = 0.1) -> None:
        self.iterations = iterations
        self._problem, self._rate = problem, rate
        self._arm = _PinocchioArm(problem)
        self._data: Any = self._arm.model.createData()
        self._frame = self._arm.model.getFrameId(problem.frame, pin.FrameType.BODY)
        self._damping = 1e-12 * np.eye(6)

    def aim(self, target: Array) -> None:
        self._target = pin.SE3(target)

    def start(self, q: Array) -> None:
        self._q = self._arm.to_pinocchio(q)
        self._look()

    def iterate(self) -> float:
        model, data = self._arm.model, self._data
        jacobian = pin.computeFrameJacobian(model, data, self._q, self._frame, pin.ReferenceFrame.LOCAL)
        jacobian = -pin.Jlog6(self._offset.inverse()) @ jacobian
        step = -jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + self._damping, self._error)
        self._q = pin.integrate(model, self._q, step * self._rate)
        self._look()
        return float(np.abs(step).max())

    def errors(self) -> tuple[float, float]:
        return float(np.linalg.norm(self._error[:3])), float(np.linalg.norm(self._error[3:]))

    def positions(self) -> Array:
        q, middle = self._arm.from_pinocchio(self._q), 0.5 * (self._problem.lower + self._problem.upper)
        turns = np.round((q - middle) / (2.0 * np.pi))
        return np.array(q - 2.0 * np.pi * turns * self._revolute)

    @property
    def _revolute(self) -> Array:
        return np.array(["Prismatic" not in joint.shortname() for joint in self._arm._joints], float)

    def _look(self) -> None:
        pin.forwardKinematics(self._arm.model, self._data, self._q)
        pose = pin.updateFramePlacement(self._arm.model, self._data, self._frame)
        self._offset = pose.actInv(self._target)
        self._error = pin.log(self._offset).vector
