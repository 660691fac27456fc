"""``kineverse reproduce calibration``: its drives, its bounds and its report."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from kineverse_studies.experiments.calibration import (
    METHODS,
    SETTINGS,
    SeenArm,
    WheelSpeeds,
    arm_model,
    bound_of,
    camera_mount,
    integrate_drive,
    measure,
    report,
)

pytest.importorskip("pinocchio")
pytest.importorskip("cv2")


def test_a_drive_is_that_of_scipy():
    rng = np.random.default_rng(0)
    speeds = WheelSpeeds(*(rng.uniform(*ends, (2, 4)) for ends in ((0.02, 0.15), (0.0, 6.0), (0.5, 2.0))))
    wheels, start, at = np.array([0.061, 0.059, 0.38]), np.array([0.3, 0.2, 0.1]), np.arange(0.3, 20, 2.1)

    def rates(t, state):
        left, right = speeds.at(np.array([t]))[0]
        forward, angle = (wheels[0] * left + wheels[1] * right) / 2, state[2]
        turn = (wheels[1] * right - wheels[0] * left) / wheels[2]
        return [forward * math.cos(angle), forward * math.sin(angle), turn, left, right]

    found = solve_ivp(rates, (0, at[-1]), [*start, 0, 0], "DOP853", at, rtol=1e-10, atol=1e-12).y.T
    assert np.abs(integrate_drive(speeds, wheels, start, at) - found).max() < 1e-8


def test_the_arm_in_pinocchio_is_that_of_the_model():
    arm, model = SeenArm(), arm_model()
    joints = np.random.default_rng(1).uniform(-0.5, 0.5, (3, 9))
    numbers = np.zeros(13)
    pose = model.fk("pr2/r_gripper_tool_frame", relative_to="camera")
    names = [f"pr2/r_{n}_joint" for n in ("shoulder_pan", "shoulder_lift", "upper_arm_roll", "elbow_flex",
                                          "forearm_roll", "wrist_flex", "wrist_roll")]  # fmt: skip
    names += ["pr2/head_pan_joint", "pr2/head_tilt_joint"]
    for row, seen in zip(joints, arm.seen(joints, numbers), strict=True):
        assert np.abs(pose(dict(zip(names, row, strict=True))) - seen).max() < 1e-12
    assert (
        np.abs(camera_mount(np.zeros(6)) - model.fk("camera", relative_to="pr2/head_tilt_link")({})).max()
        < 1e-15
    )


def test_a_bound_of_parameters_in_unlike_units():
    rng = np.random.default_rng(2)
    jacobian = rng.normal(size=(40, 3)) * [1e-5, 1.0, 1e4]
    information = jacobian.T @ jacobian / 0.25
    expected = np.linalg.inv(information * np.outer([1e5, 1, 1e-4], [1e5, 1, 1e-4])) * np.outer(
        [1e5, 1, 1e-4], [1e5, 1, 1e-4]
    )
    assert np.allclose(bound_of(jacobian, np.full(40, 0.5)), expected, rtol=1e-9)


def test_the_report():
    made = report(*measure(lambda items, what, unit: items, 1, 1, 1))
    errors, hand_eye = made.tables
    assert errors.rows[0][0] == "arm and camera"
    assert len(errors.rows) == 5
    assert all(0.2 < float(row[3]) < 3.0 for row in errors.rows)
    assert len(hand_eye.rows) == 2 * len(SETTINGS)
    assert hand_eye.head[3:] == METHODS
    assert made.numbers["noise"]["position"] == 0.003
