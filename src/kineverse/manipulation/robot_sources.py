"""Robots that ship, as skills use them: hand, pushing link, start and mobile base."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from kineverse.articulations import DifferentialDrive, OmniBase
from kineverse.errors import UnknownNameError, suggest
from kineverse.formats import load
from kineverse.geometry.exclusions import remove_unusable_shapes
from kineverse.grasping.gripper_detection import Gripper
from kineverse.model.edit import Edit
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.model_view import ModelView
from kineverse.state import State
from kineverse.worlds import Robot

BASE_SPEED, BASE_TURN = 1.0, 0.6
WHEEL_RADIUS, TRACK, WHEEL_SPEED = 0.06, 0.3748, 17.4


@dataclass(frozen=True)
class RobotSource:
    """Robot with its file, its hand and its start."""

    name: str  # name in tables
    prefix: str
    source: str  # name or path of its file
    hand: str  # frame of the hand, without the prefix
    push_link: str  # body that pushes, without the prefix
    start: Mapping[str, float] = field(default_factory=dict)  # [m], [rad]
    omni: bool = True  # True for a base that moves in any direction, False for two wheels

    def load(self) -> Model:
        """Return the robot on its mobile base at the origin of the world."""
        model = load(self.source, prefix=self.prefix)
        name = f"{self.prefix}/base"
        if name in model.articulations:
            return model
        roots = [frame for frame, placed in model.frames.items() if placed.parent == WORLD]
        carrier = f"{name}_carrier"
        base: OmniBase | DifferentialDrive
        if self.omni:
            base = OmniBase(name=name, parent=WORLD, child=carrier, speed=BASE_SPEED, turn=BASE_TURN)
        else:
            base = DifferentialDrive(
                name=name,
                parent=WORLD,
                child=carrier,
                radius=WHEEL_RADIUS,
                track=TRACK,
                left=f"{self.prefix}/l_wheel_joint",
                right=f"{self.prefix}/r_wheel_joint",
                wheel_speed=WHEEL_SPEED,
            )
        with model.edit() as edit:
            mount(edit, base, roots)
        remove_unusable_shapes(model)
        return model

    def start_state(self, model: ModelView) -> State:
        """Return the default state of a model with the robot at its start."""
        known = {str(symbol) for symbol in model.degrees_of_freedom}
        values = {f"{self.prefix}/{joint}": value for joint, value in self.start.items()}
        return model.default_state().updated({k: v for k, v in values.items() if k in known})

    def count_freedom(self, model: ModelView) -> int:
        """Return the number of degrees of freedom of the robot in a model, its base included."""
        return len(Robot.of(model, self.prefix).coordinates)

    def gripper(self, model: Model) -> Gripper:
        """Return the gripper at the robot's hand in a model."""
        return Robot.of(model, self.prefix).gripper(f"{self.prefix}/{self.hand}")


def mount(edit: Edit, base: OmniBase | DifferentialDrive, roots: Iterable[str]) -> None:
    """Apply a mobile base, and attach the roots of a robot to it where they stand."""
    poses = {root: np.asarray(edit.model.fk(root)({})) for root in roots}
    edit.apply(base)
    for root, pose in poses.items():
        edit.attach(root, base.child, pose)


_PR2_START = {
    "l_elbow_flex_joint": -2.1213,
    "l_shoulder_lift_joint": 1.2963,
    "l_wrist_flex_joint": -1.16,
    "r_shoulder_pan_joint": -1.2963,
    "r_shoulder_lift_joint": 1.2963,
    "r_upper_arm_roll_joint": -1.2,
    "r_elbow_flex_joint": -2.1213,
    "r_wrist_flex_joint": -1.05,
    "r_forearm_roll_joint": 3.14,
    "torso_lift_joint": 0.32,
}
_FETCH_START = {
    "shoulder_pan_joint": 0.3,
    "shoulder_lift_joint": 1.4,
    "upperarm_roll_joint": -1.57,
    "elbow_flex_joint": 1.72,
    "forearm_roll_joint": -1.2,
    "wrist_flex_joint": 1.66,
    "torso_lift_joint": 0.2,
}
_HSR_START = {"arm_lift_joint": 0.4}  # the papers' torso joint; it follows the arm's lift

SHIPPED: Mapping[str, RobotSource] = MappingProxyType(
    {
        "pr2": RobotSource(
            "pr2", "pr2", "pr2", "r_gripper_palm_link", "r_gripper_r_finger_tip_link", _PR2_START
        ),
        "fetch": RobotSource(
            "fetch", "fetch", "fetch", "gripper_link", "gripper_link", _FETCH_START, omni=False
        ),
        "hsr": RobotSource("hsr", "hsr", "hsr", "hand_palm_link", "hand_l_distal_link", _HSR_START),
    }
)
"""Robots that ship, by name."""


def find_robot(name: str, robots: Mapping[str, RobotSource] = SHIPPED) -> RobotSource:
    """Return a robot by name."""
    if name not in robots:
        raise UnknownNameError(f"There is no robot {name!r} here. {suggest(name, robots, 'robot')}")
    return robots[name]
