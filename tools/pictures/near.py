"""Picture of nearest points: the hands of the shipped robot at the fridge of the shipped kitchen."""

from __future__ import annotations

import numpy as np

import kineverse as kv
from kineverse.geometry import RULES, Rule, rules_as_data
from kineverse.view import Camera, picture

STATE = {
    "kitchen/fridge_door": 0.6,
    "pr2/base/x": 0.19,
    "pr2/base/y": -1.0,
    "pr2/head_pan_joint": -0.4,
    "pr2/head_tilt_joint": 0.35,
    "pr2/l_elbow_flex_joint": -0.8,
    "pr2/l_gripper_joint": 0.05,
    "pr2/l_shoulder_lift_joint": 0.2,
    "pr2/l_wrist_flex_joint": -0.4,
    "pr2/r_elbow_flex_joint": -0.75,
    "pr2/r_gripper_joint": 0.07,
    "pr2/r_shoulder_lift_joint": 0.1,
    "pr2/r_shoulder_pan_joint": -0.55,
    "pr2/r_wrist_flex_joint": -0.35,
    "pr2/torso_lift_joint": 0.15,
}

EYE = Camera((-0.75, -2.5, 1.75), (0.74, -1.53, 1.02), field_of_view=0.3)


def draw_proximity() -> np.ndarray:
    """Return the picture, (height, width, 3) bytes."""
    model = kv.Model()
    for name in ("kitchen", "pr2"):
        model.include(name)
    with model.edit() as edit:  # The drawers are near to each other, and the links of the robot.
        rules = [Rule(f"{name}/*", f"{name}/*", why="of one kind") for name in ("kitchen", "pr2")]
        edit.write(RULES, rules_as_data(rules))
    return picture(model, STATE, (480, 330), EYE, near=0.1)
