"""Control and inverse kinematics by mink."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mink
import mujoco
import numpy as np

from kineverse.lie import Array
from kineverse_studies.bench import control_workloads as workloads
from kineverse_studies.bench.control import DOOR, DOOR_GAIN, GRASP, GRIPPERS, OPENING
from kineverse_studies.bench.inverse_kinematics import ReachingProblem, TaskReaching

from .mujoco import add_mujoco_options

SOLVER = "daqp"


class MinkRobot:
    def __init__(self, model: Any, start: Mapping[str, float], speeds: Mapping[str, float]) -> None:
        self.model, self.speeds = model, speeds
        self.start: Array = model.qpos0.copy()
        for name, value in start.items():
            joint, number = workloads.split_coordinate(name)
            self.start[model.joint(joint).qposadr[0] + number] = value
        self.configuration: Any = mink.Configuration(model, self.start)

    def pose(self, frame: str) -> Any:
        return self.configuration.get_transform_frame_to_world(frame, "body")


@dataclass
class MinkLoop(workloads.PeerLoop):
    damping: float = 1e-3  # weight of squared displacements
    limits: list[Any] = field(default_factory=list)
    # returns the tasks to be kept exactly at a time [s]
    constraints: Callable[[float], list[Any] | None] = field(default=lambda time: None)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.limits = self.limits or [mink.ConfigurationLimit(self.robot.model)]
        self._options: dict[str, Any] = {"damping": self.damping, "limits": self.limits}

    def aim(self, time: float) -> None:
        self.move(time)
        self._options["constraints"] = self.constraints(time)

    def solve(self) -> Array:
        configuration = self.robot.configuration
        return np.array(mink.solve_ik(configuration, self.tasks, self.period, SOLVER, **self._options))


def make_loop(name: str, workload: workloads.ControlWorkload) -> MinkLoop:
    make_model, make = MINK_LOOPS[name]
    speeds = {} if make_model is _with_loops else workloads.joint_speeds(workload.urdf())
    return make(MinkRobot(make_model(workload), workload.start, speeds), workload.period)


# -- models ------------------------------------------------------------------------------------------------


def _plain(workload: workloads.ControlWorkload) -> Any:
    root = remove_masses(ElementTree.fromstring(workload.urdf()))
    return mujoco.MjModel.from_xml_string(add_mujoco_options(root))


def remove_masses(root: ElementTree.Element) -> ElementTree.Element:
    for link in root.iterfind("link"):
        for inertial in link.findall("inertial"):
            link.remove(inertial)
    return root


def _with_table(workload: workloads.ControlWorkload) -> Any:
    root = ElementTree.fromstring(workload.urdf())
    specification = mujoco.MjSpec.from_string(add_mujoco_options(root))
    for sphere in (*workloads.HAND_SPHERES, *workloads.THIGH_SPHERES):
        specification.body(sphere.link).add_geom(
            name=sphere.link,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=sphere.centre,
            size=(sphere.radius, 0, 0),
            mass=0,
        )
    specification.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=workloads.TABLE_CENTRE,
        size=np.array(workloads.TABLE_SIZE) / 2,
        mass=0,
    )
    return specification.compile()


def _with_loops(workload: workloads.ControlWorkload) -> Any:
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        file = Path(folder, "robot.xml")
        workload.robot().save(file)
        return mujoco.MjModel.from_xml_path(str(file))


# -- loops -------------------------------------------------------------------------------------------------


def _body_task(frame: str, position: float, orientation: float, lm_damping: float = 1.0) -> Any:
    return mink.FrameTask(
        frame, "body", position_cost=position, orientation_cost=orientation, lm_damping=lm_damping
    )


def _at(pose: Any, position: Array) -> Any:
    return mink.SE3.from_rotation_and_translation(pose.rotation(), position)


def _distance(robot: MinkRobot, task: Any) -> Callable[[], float]:
    def error() -> float:
        target = task.transform_target_to_world.translation()
        return float(np.linalg.norm(robot.pose(task.frame_name).translation() - target))

    return error


def _speed_limit(robot: MinkRobot) -> Any:
    model = robot.model
    return mink.VelocityLimit(model, {model.joint(k).name: np.pi for k in range(model.njnt)})


def _freeze(robot: MinkRobot, period: float) -> MinkLoop:
    gripper, posture = _body_task("panda_link8", 1.0, 1.0), mink.PostureTask(robot.model, cost=0.1)
    frozen = [mink.DofFreezingTask(robot.model, dof_indices=[0, 1, 2])]
    workloads.hold_start(robot, (gripper, posture))
    start = gripper.transform_target_to_world

    def move(time: float) -> None:
        gripper.set_target(_at(start, workloads.orbit(start.translation(), time)))

    def constraints(time: float) -> list[Any] | None:
        return None if (time // 5.0) % 2 else frozen

    return MinkLoop(
        robot, period, [gripper, posture], move, _distance(robot, gripper), constraints=constraints
    )


def _work_at_a_table(robot: MinkRobot, period: float) -> MinkLoop:
    model = robot.model
    centre = mink.ComTask(cost=10.0)
    feet = [_body_task(foot, 10.0, 1.0) for foot in workloads.FEET]
    hands = [_body_task(hand, 5.0, 1.0) for hand in workloads.HANDS]
    tasks = [
        _body_task("pelvis", 0.0, 1.0),
        _body_task("torso_link", 0.0, 1.0),
        mink.PostureTask(model, cost=0.1),
        centre,
        *feet,
        *hands,
    ]
    workloads.hold_start(robot, tasks)
    starts = [hand.transform_target_to_world for hand in hands]

    def names(spheres: Iterable[workloads.CollisionSphere]) -> list[str]:
        return [sphere.link for sphere in spheres]

    left, right = names(workloads.HAND_SPHERES)
    left_thigh, right_thigh = names(workloads.THIGH_SPHERES)
    avoid = mink.CollisionAvoidanceLimit(
        model,
        geom_pairs=[([left, right], ["table"]), ([left], [left_thigh]), ([right], [right_thigh])],
        minimum_distance_from_collisions=0.05,
        collision_detection_distance=0.1,
    )

    def move(time: float) -> None:
        for hand, start in zip(hands, starts, strict=True):
            hand.set_target(_at(start, start.translation() + workloads.lean(time)))

    return MinkLoop(
        robot, period, tasks, move, _distance(robot, hands[0]), 0.1, [mink.ConfigurationLimit(model), avoid]
    )


def _stand_with_closed_loops(robot: MinkRobot, period: float) -> MinkLoop:
    model = robot.model
    centre = mink.ComTask(cost=200.0)
    feet = [_body_task(f"{side}-foot", 200.0, 10.0) for side in ("left", "right")]
    tasks = [_body_task("pelvis", 0.0, 10.0, 0.0), mink.PostureTask(model, cost=1.0), centre, *feet]
    workloads.hold_start(robot, tasks)
    tasks.append(mink.EqualityConstraintTask(model, cost=500.0, gain=0.5, lm_damping=1e-3))
    start = np.array(robot.configuration.data.subtree_com[1])

    def move(time: float) -> None:
        centre.set_target(start + workloads.nod(time))

    return MinkLoop(robot, period, tasks, move, workloads.measure_error(robot, centre), 0.1)


def _grasp(robot: MinkRobot, period: float) -> MinkLoop:
    model = robot.model
    arm, posture = _body_task("link_eef", 1.0, 1.0), mink.PostureTask(model, cost=0.05)
    fingers = [
        mink.RelativeFrameTask(
            finger, "body", "hand/palm_link", "body", position_cost=1.0, orientation_cost=0.0, lm_damping=1e-3
        )
        for finger in workloads.FINGERS
    ]
    workloads.hold_start(robot, (arm, posture, *fingers))
    start: Any = arm.transform_target_to_world
    tips: list[Any] = [finger.transform_target_to_root for finger in fingers]

    def move(time: float) -> None:
        arm.set_target(_at(start, start.translation() + workloads.figure_eight(time)))
        for finger, tip in zip(fingers, tips, strict=True):
            finger.set_target(_at(tip, tip.translation() * (1.0 - 5.0 * workloads.grasp(time))))

    return MinkLoop(robot, period, [arm, posture, *fingers], move, _distance(robot, arm))


def _look_at(robot: MinkRobot, period: float) -> MinkLoop:
    model = robot.model
    gaze = mink.LookAtTask("camera", "body", axis=(0.0, 0.0, 1.0), cost=1.0, lm_damping=1e-3)
    posture = mink.PostureTask(model, cost=0.01)
    workloads.hold_start(robot, (posture,))

    def move(time: float) -> None:
        gaze.set_target(workloads.loop(time))

    limits = [mink.ConfigurationLimit(model), _speed_limit(robot)]
    return MinkLoop(robot, period, [gaze, posture], move, workloads.measure_error(robot, gaze), 1e-3, limits)


def _hold_the_base(robot: MinkRobot, period: float) -> MinkLoop:
    model = robot.model
    gripper = _body_task("wrist_ft_tool_link", 1.0, 1.0)
    base = [int(model.joint(f"base/{axis}").dofadr[0]) for axis in ("x", "y", "angle")]
    posture_cost, base_cost = np.full(model.nv, 1e-3), np.zeros(model.nv)
    posture_cost[base[:2]], base_cost[base] = 0.0, 100.0
    posture, damping = mink.PostureTask(model, posture_cost), mink.DampingTask(model, base_cost)
    workloads.hold_start(robot, (gripper, posture))
    start = gripper.transform_target_to_world
    tasks = [gripper, posture]

    def move(time: float) -> None:
        gripper.set_target(_at(start, start.translation() + workloads.drive(time)))
        tasks[2:] = [damping] if time > 4.0 else []

    return MinkLoop(robot, period, tasks, move, _distance(robot, gripper))


def _open_fridge(robot: MinkRobot, period: float) -> MinkLoop:
    model = robot.model
    door = model.joint(DOOR)
    cost = np.zeros(model.nv)
    cost[door.dofadr[0]] = 1.0
    goal = robot.start.copy()
    goal[door.qposadr[0]] = 0.5 * np.pi
    # The gain of a task is the part of its error that one step removes.
    opening, posture = mink.PostureTask(model, cost, gain=DOOR_GAIN * period), mink.PostureTask(model, 0.01)
    opening.set_target(goal)
    held = mink.RelativeFrameTask(
        GRIPPERS["pr2"], "body", GRASP, "body", position_cost=1.0, orientation_cost=1.0, gain=0.5
    )
    held.set_target(mink.SE3.identity())
    workloads.hold_start(robot, (posture,))

    limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, dict(robot.speeds))]
    tasks, error = [opening, posture], workloads.measure_error(robot, held)
    return MinkLoop(robot, period, tasks, lambda time: None, error, 1e-6, limits, lambda time: [held])


MINK_LOOPS: Mapping[
    str, tuple[Callable[[workloads.ControlWorkload], Any], Callable[[MinkRobot, float], MinkLoop]]
] = {
    OPENING: (_plain, _open_fridge),
    "arm_panda_dof_freezing": (_plain, _freeze),
    "humanoid_g1_teleop": (_with_table, _work_at_a_table),
    "biped_cassie": (_with_loops, _stand_with_closed_loops),
    "arm_hand_xarm": (_plain, _grasp),
    "arm_ur5_wrist_cam_lookat": (_plain, _look_at),
    "mobile_tiago": (_plain, _hold_the_base),
}
"""Models and control loops by the name of the workload, each as in the example that it follows."""


class MinkReaching(TaskReaching):
    def __init__(self, problem: ReachingProblem) -> None:
        root = remove_masses(ElementTree.fromstring(problem.urdf()))
        model: Any = mujoco.MjModel.from_xml_string(add_mujoco_options(root))
        self._columns = [int(model.joint(name).qposadr[0]) for name in problem.names()]
        self.configuration = mink.Configuration(model)
        self.task = mink.FrameTask(
            problem.frame, "body", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-2
        )
        self._limits = [mink.ConfigurationLimit(model)]

    def aim(self, target: Array) -> None:
        self.task.set_target(mink.SE3.from_matrix(target))

    def start(self, q: Array) -> None:
        positions = self.configuration.q
        positions[self._columns] = q
        self.configuration.update(positions)

    def solve(self) -> Array:
        options: dict[str, Any] = {"damping": 1e-8, "limits": self._limits}
        return np.array(mink.solve_ik(self.configuration, [self.task], 1.0, SOLVER, **options))

    def positions(self) -> Array:
        return np.array(self.configuration.q[self._columns])
