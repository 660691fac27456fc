"""Robots, start states and target trajectories of the control benchmarks, which all libraries share.

Each workload follows a published example of pink or mink in its robot, tasks and costs. Targets move along
scripted trajectories, also where the original follows the mouse.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol
from xml.etree import ElementTree

import numpy as np

from kineverse.articulations import Floating, OmniBase
from kineverse.compilation import compile
from kineverse.formats import load
from kineverse.lie import Array, translation
from kineverse.model.frame import WORLD
from kineverse.model.model import Model

from .workloads import strip_shapes

ROOT = "root_joint"  # name of floating joints; pink finds the floating base by it


class ControlLoop(Protocol):
    """Control loop of a library: controller, robot and targets."""

    def reset(self) -> None:
        """Return to the start."""

    def aim(self, time: float) -> None:
        """Move the targets to a time [s]; a script's work, which is not part of a step."""

    def step(self) -> None:
        """Compute the command at the present state, which is what is measured."""

    def advance(self) -> None:
        """Integrate the command."""

    def error(self) -> float:
        """Return the error of the most important task [m], [rad]."""


@dataclass
class PeerLoop:
    """Control loop of pink or mink, by their tasks and their configuration, which integrates velocities."""

    robot: Any  # with ``model``, ``start`` and ``configuration`` of the library
    period: float  # control period [s]
    tasks: list[Any]
    move: Callable[[float], None]  # moves the targets of the tasks to a time [s]
    error: Callable[[], float]  # returns the error of the most important position [m]

    def __post_init__(self) -> None:
        self._q = self.robot.start
        self._velocity = np.zeros(self.robot.model.nv)

    def solve(self) -> Array:
        raise NotImplementedError

    def reset(self) -> None:
        self._q = self.robot.start
        self.robot.configuration.update(self._q)

    def aim(self, time: float) -> None:
        self.move(time)

    def step(self) -> None:
        self.robot.configuration.update(self._q)
        self._velocity = self.solve()

    def advance(self) -> None:
        self.robot.configuration.integrate_inplace(self._velocity, self.period)
        self._q = self.robot.configuration.q


def measure_error(robot: Any, task: Any) -> Callable[[], float]:
    """Return a function that gives the error of position of a task of pink or mink [m]."""
    return lambda: float(np.linalg.norm(task.compute_error(robot.configuration)[:3]))


def hold_start(robot: Any, tasks: Iterable[Any]) -> None:
    for task in tasks:
        task.set_target_from_configuration(robot.configuration)


def split_coordinate(name: str) -> tuple[str, int]:
    """Return the joint of a coordinate, and its number in the joint: 0 to 2 for x, y and z of the root."""
    joint, _, axis = name.rpartition("/") if name.startswith(f"{ROOT}/") else (name, "", "x")
    return joint, "xyz".index(axis)


@dataclass(frozen=True)
class ControlWorkload:
    robot: Callable[[], Model]  # returns the model
    start: Mapping[str, float]  # positions of joints at the start [m], [rad] by name; the others are zero
    held: tuple[str, ...] = ()  # joints that the peers' models have as fixed ones
    period: float = 0.005  # control period [s]
    steps: int = 1000  # number of control periods of one motion

    def urdf(self) -> str:
        return export_urdf(self.robot(), self.held)


def export_urdf(model: Model, held: Iterable[str] = ()) -> str:
    with tempfile.TemporaryDirectory(prefix="kineverse-bench-") as folder:
        file = Path(folder, "robot.urdf")
        model.save(file)
        text = strip_shapes(file)
    root = ElementTree.fromstring(text)
    links = {link.get("name") for link in root.iterfind("link")}
    for joint in root.iterfind("joint"):
        name = joint.get("name", "")
        if name in held:
            joint.set("type", "fixed")
        if joint.get("type") == "fixed" and name in links:  # pink finds frames by name alone
            joint.set("name", f"{name} joint")
    return ElementTree.tostring(root, encoding="unicode")


def joint_speeds(urdf: str) -> dict[str, float]:
    """Return the speed limits [m/s], [rad/s] of a URDF's joints by name."""
    moving = (j for j in ElementTree.fromstring(urdf).iterfind("joint") if j.get("type") != "fixed")
    joints = ((j.get("name", ""), j.find("limit")) for j in moving)
    found = {name: float(limit.get("velocity", 0)) for name, limit in joints if limit is not None}
    return {name: speed for name, speed in found.items() if speed > 0.0}


# -- robots ------------------------------------------------------------------------------------------------


def _robot(file: str) -> Callable[[], Model]:
    return lambda: load(file, prefix="")


def _floating(file: str, base: str) -> Callable[[], Model]:
    def build() -> Model:
        model = load(file, prefix="")
        with model.edit() as edit:
            edit.apply(Floating(name=ROOT, parent=WORLD, child="free"))
            edit.attach(base, "free", np.eye(4))
        return model

    return build


def _flying_arms() -> Model:
    model = Model()
    with model.edit() as edit:
        edit.apply(Floating(name=ROOT, parent=WORLD, child="base"))
        for name, x in (("left", 0.3), ("right", -0.3)):
            edit.include("ur_description/urdf/ur3_robot.urdf", name)
            edit.attach(f"{name}/world", "base", translation(np.array((x, 0.0, 0.0))))
    return model


def _arm_with_hand() -> Model:
    model = load("xarm_description/urdf/xarm7.urdf", prefix="")
    with model.edit() as edit:
        edit.include("allegro_hand_description/urdf/allegro_left_hand.urdf", "hand")
        edit.attach("hand/palm_link", "link_eef", translation(np.array((0.0, 0.0, 0.095))))
    return model


def _arm_with_camera() -> Model:
    model = load("ur_description/urdf/ur5_robot.urdf", prefix="")
    with model.edit() as edit:
        edit.add_frame("camera", "tool0", translation(np.array((0.0, 0.0, 0.06))))
    return model


def _mobile_arm() -> Model:
    model = load("tiago_description/robots/tiago_no_hand.urdf", prefix="")
    with model.edit() as edit:
        edit.apply(OmniBase(name="base", parent=WORLD, child="platform"))
        edit.attach("base_footprint", "platform", np.eye(4))
    return model


HANDS = ("left_rubber_hand", "right_rubber_hand")
FEET = ("left_ankle_roll_link", "right_ankle_roll_link")
QUADRUPED_FEET = ("FL_foot", "FR_foot", "RL_foot", "RR_foot")
FINGERS = ("hand/link_3.0_tip", "hand/link_7.0_tip", "hand/link_11.0_tip", "hand/link_15.0_tip")
_BENT = {"shoulder_lift_joint": 1.0, "shoulder_pan_joint": 1.0, "elbow_joint": 1.0}
_PANDA = {"panda_joint4": -1.5708, "panda_joint6": 1.5708, "panda_joint7": -0.7854}
_SQUAT = {
    f"{leg}_{joint}_joint": angle
    for leg in ("FL", "FR", "RL", "RR")
    for joint, angle in (("thigh", 0.8), ("calf", -1.57))
}
_STANDING = {
    f"{side}_{joint}_joint": angle
    for side in ("left", "right")
    for joint, angle in (
        ("hip_pitch", -0.3),
        ("knee", 0.6),
        ("ankle_pitch", -0.3),
        ("shoulder_pitch", 0.2),
        ("elbow", 0.6),
    )
}
_TIAGO = {
    "torso_lift_joint": 0.15,
    "arm_1_joint": 1.3,
    "arm_2_joint": 0.2,
    "arm_3_joint": -1.2,
    "arm_4_joint": 1.6,
    "arm_5_joint": -0.5,
    "arm_6_joint": 0.4,
    "arm_7_joint": 0.3,
}
_XARM = {
    "joint2": -0.247,
    "joint4": 0.909,
    "joint6": 1.15644,
    **{f"hand/joint_{k}.0": 0.5 for k in (1, 2, 3, 5, 6, 7, 9, 10, 11)},
    "hand/joint_12.0": 0.8,
    "hand/joint_13.0": 0.4,
    "hand/joint_14.0": 0.4,
    "hand/joint_15.0": 0.5,
}
_CAMERA = {
    "shoulder_pan_joint": 0.3,
    "shoulder_lift_joint": -1.6,
    "elbow_joint": 1.8,
    "wrist_1_joint": -0.4,
    "wrist_2_joint": 1.3,
}
G1, GO2 = "g1_description/urdf/g1_29dof_rev_1_0.urdf", "go2_description/urdf/go2.urdf"
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")
WORKLOADS: Mapping[str, ControlWorkload] = {
    "arm_ur5": ControlWorkload(_robot("ur_description/urdf/ur5_robot.urdf"), _BENT),
    "arm_ur3_velocity_smoothing": ControlWorkload(_robot("ur_description/urdf/ur3_robot.urdf"), _BENT),
    "flying_dual_arm_ur3": ControlWorkload(
        _flying_arms,
        {f"{side}/{joint}": angle for side in ("left", "right") for joint, angle in _BENT.items()},
    ),
    "humanoid_g1_com": ControlWorkload(_floating(G1, "pelvis"), {f"{ROOT}/z": 0.72}),
    "go2_squat": ControlWorkload(_floating(GO2, "base"), {f"{ROOT}/z": 0.3, **_SQUAT}),
    "inverse_kinematics_ur10": ControlWorkload(
        _robot("ur_description/urdf/ur10_robot.urdf"), {}, period=0.01, steps=20
    ),
    "arm_panda_dof_freezing": ControlWorkload(
        _robot("panda_description/urdf/panda.urdf"), _PANDA, FINGER_JOINTS, steps=2000
    ),
    "humanoid_g1_teleop": ControlWorkload(_floating(G1, "pelvis"), {f"{ROOT}/z": 0.76, **_STANDING}),
    "biped_cassie": ControlWorkload(
        _floating("cassie_description/robots/cassie_v2.sdf", "pelvis"), {f"{ROOT}/z": 1.0}
    ),
    "arm_hand_xarm": ControlWorkload(_arm_with_hand, _XARM),
    "arm_ur5_wrist_cam_lookat": ControlWorkload(_arm_with_camera, _CAMERA),
    "mobile_tiago": ControlWorkload(
        _mobile_arm, _TIAGO, ("wheel_right_joint", "wheel_left_joint", "head_1_joint", "head_2_joint")
    ),
}
"""Workloads by the name of the example of pink or mink that they follow.

``arm_hand_xarm`` has an Allegro for a LEAP hand, ``arm_ur5_wrist_cam_lookat`` a UR5 for a UR5e, and
``mobile_tiago`` a TIAGo on an omnidirectional base for a Kinova arm on one.
"""


# -- target trajectories -----------------------------------------------------------------------------------


def swing(time: float) -> tuple[float, float]:
    """Return y and z [m] of an arm's target, which swings sideways."""
    return 0.5 + 0.1 * np.sin(2.0 * time), 0.2


def squat(time: float) -> tuple[float, float]:
    """Return y and z [m] of a quadruped's trunk: sideways for 4 s, then up and down."""
    amplitude, wave = (time // 4.0) % 2, np.sin(0.5 * np.pi * time)
    return 0.1 * (1 - amplitude) * wave, 0.3 + 0.2 * amplitude * wave


def orbit(centre: Array, time: float) -> Array:
    """Return the target [m] on a circle around the base: from a point by 60° and back in 5 s."""
    angle = -np.deg2rad(60.0) * abs(np.sin(0.2 * np.pi * time))
    x, y, z = centre
    return np.array([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y, z])


def loop(time: float) -> Array:
    """Return the point [m] that a camera looks at."""
    return np.array([0.95 + 0.3 * np.cos(time), 0.6 * np.sin(time), 0.55 + 0.25 * np.sin(2.0 * time)])


def lean(time: float) -> Array:
    """Return the offset [m] of both hands that reach down, onto the table and back."""
    return np.array(np.array([0.12, 0.0, -0.12]) * (1.0 - np.cos(time)))


def nod(time: float) -> Array:
    """Return the offset [m] of a biped's centre of mass: sideways and down."""
    return np.array([0.0, 0.03 * np.sin(2.0 * time), -0.05 * (1.0 - np.cos(time))])


def grasp(time: float) -> float:
    """Return how far [m] fingertips have moved towards the palm."""
    return float(0.01 * (1.0 - np.cos(2.0 * time)))


def figure_eight(time: float) -> Array:
    """Return the offset [m] of a hand that draws an eight."""
    return np.array([0.1 * np.sin(2.0 * time), 0.2 * np.sin(time), 0.05 * np.sin(time)])


def drive(time: float) -> Array:
    """Return the offset [m] of a gripper that goes beyond the arm's reach and back."""
    return np.array([1.0 - np.cos(0.5 * time), 0.5 * np.sin(time), 0.0])


@dataclass(frozen=True)
class CollisionSphere:
    link: str  # link that carries it
    centre: tuple[float, float, float]  # centre in the link's frame [m]
    radius: float  # radius [m]


HAND_SPHERES = tuple(CollisionSphere(hand, (0.06, 0.0, 0.0), 0.06) for hand in HANDS)
THIGH_SPHERES = tuple(
    CollisionSphere(f"{side}_hip_yaw_link", (0.0, 0.0, -0.08), 0.09) for side in ("left", "right")
)
TABLE_CENTRE, TABLE_SIZE = (0.45, 0.0, 0.72), (0.5, 1.0, 0.04)
"""Centre and size of the table [m] in front of the humanoid."""


@cache
def reachable_targets(name: str, frame: str, count: int) -> Array:
    """Return poses (count, 4, 4) of a frame at uniform states within the limits, from a fixed seed."""
    model = WORKLOADS[name].robot()
    pose = model.fk(frame)
    limits = np.array([model.limits(symbol) for symbol in pose.symbols])
    states = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (count, len(limits)))
    function = compile(pose)
    return np.array([function(state) for state in states])
