"""A one-armed robot with the degrees of freedom of a Fetch: wheels, torso, head, seven in the arm, a gripper.

The dimensions are round figures of that class of robot, the shapes are our own. The wheels are joints; how
they move the robot over the floor is said by the library.
"""

from __future__ import annotations

from description import Description
from shapes import Material, Shape, Span, Vector, disc, for_the_eye, mirrored, rod, rounded_slab, slab, sphere

ABOUT = """\
A one-armed mobile manipulator with the joints of a Fetch: 13 degrees of freedom, its base's drive left out
(wheels of radius .06, .3748 apart).
Units: m, rad, kg; x forward, y left, z up, base_footprint on the floor below the wheels' axis.
gripper_link lies between the finger tips: x out of the hand, y across the fingers, each of which travels by
r_gripper_finger_joint.

Written for Kineverse by tools/models/fetch.py; change it there.
SPDX-License-Identifier: Apache-2.0"""

MATERIALS = {
    "shell": Material((0.93, 0.94, 0.95, 1), 720),
    "graphite": Material((0.22, 0.24, 0.27, 1), 720),
    "blue": Material((0.18, 0.38, 0.62, 1), 720),
    "metal": Material((0.66, 0.68, 0.70, 1), 1500),
    "rubber": Material((0.10, 0.10, 0.11, 1), 1100),
    "lens": Material((0.05, 0.07, 0.10, 1), 720),
    "light": Material((0.45, 0.80, 0.95, 1), 720),
}

WHEEL_RADIUS = 0.06
TRACK = 0.3748


def fetch() -> Description:
    """Return the robot."""
    d = Description("fetch", ABOUT, MATERIALS, root="base_footprint")
    _base(d)
    _head(d)
    _arm(d)
    _gripper(d)
    return d


def _base(d: Description) -> None:
    d.section("Base with its two wheels, and the torso that rises out of it")
    shapes = [
        rod((0, 0, 0.095), (0, 0, 0.255), 0.275, "shell"),
        rod((0, 0, 0.06), (0, 0, 0.095), 0.15, "graphite"),
        rod((0, 0, 0.255), (0, 0, 0.285), 0.262, "lens"),
        rod((0, 0, 0.285), (0, 0, 0.325), 0.275, "shell"),
        rod((0, 0, 0.325), (0, 0, 0.345), 0.25, "graphite"),
        *rounded_slab((-0.22, 0.0), (-0.15, 0.15), (0.345, 0.60), 0.06, "graphite"),
        *for_the_eye([rod((0, 0, 0.13), (0, 0, 0.14), 0.277, "blue")]),
        *(sphere(0.03, (x, y, 0.03), "rubber") for x in (-0.18, 0.18) for y in (-0.12, 0.12)),
        *(rod((x, y, 0.03), (x, y, 0.10), 0.02, "graphite") for x in (-0.18, 0.18) for y in (-0.12, 0.12)),
    ]
    d.fixed("base_link", "base_footprint", shapes, joint="base_footprint_joint")
    for side, sign in (("r", -1.0), ("l", 1.0)):
        wheel = [
            disc((0, 0, 0), "y", 0.04, WHEEL_RADIUS, "rubber"),
            *for_the_eye([disc((0, 0, 0), "y", 0.042, 0.035, "metal")]),
        ]
        d.moving(
            f"{side}_wheel_link",
            "base_link",
            "continuous",
            (0, 1, 0),
            wheel,
            at=(0, sign * TRACK / 2, WHEEL_RADIUS),
            velocity=17.4,
            effort=9,
            joint=f"{side}_wheel_joint",
        )
    shapes = [
        *rounded_slab((-0.12, 0.05), (-0.12, 0.12), (-0.02, 0.46), 0.055, "shell"),
        *rounded_slab((-0.11, 0.04), (-0.10, 0.10), (0.46, 0.50), 0.05, "graphite"),
        rod((0.03, 0, 0.50), (0.03, 0, 0.57), 0.045, "graphite"),
        *rounded_slab((0.02, 0.175), (-0.06, 0.06), (0.23, 0.29), 0.05, "graphite"),
        *for_the_eye([slab((0.049, 0.052), (-0.05, 0.05), (0.43, 0.445), "light")]),
    ]
    d.moving(
        "torso_lift_link",
        "base_link",
        "prismatic",
        (0, 0, 1),
        shapes,
        at=(-0.09, 0, 0.38),
        limits=(0, 0.38),
        velocity=0.1,
        effort=450,
        joint="torso_lift_joint",
    )


def _head(d: Description) -> None:
    d.section("Head")
    shapes = [
        rod((0, 0, -0.03), (0, 0, 0.03), 0.06, "shell"),
        slab((0, 0.16), (-0.045, 0.045), (-0.01, 0.03), "shell"),
        rod((0.14, -0.06, 0.045), (0.14, 0.06, 0.045), 0.025, "graphite"),
    ]
    d.moving(
        "head_pan_link",
        "torso_lift_link",
        "revolute",
        (0, 0, 1),
        shapes,
        at=(0.03, 0, 0.60),
        limits=(-1.57, 1.57),
        velocity=1.57,
        effort=1,
        joint="head_pan_joint",
    )
    shapes = [
        *rounded_slab((-0.12, 0.06), (-0.125, 0.125), (0.02, 0.10), 0.06, "shell"),
        *for_the_eye([slab((0.059, 0.063), (-0.065, 0.065), (0.03, 0.09), "graphite")]),
        *for_the_eye(disc((0.063, y, 0.062), "x", 0.008, 0.02, "lens") for y in (-0.035, 0.035)),
        slab((-0.02, 0.02), (-0.06, -0.03), (-0.02, 0.02), "graphite"),
        slab((-0.02, 0.02), (0.03, 0.06), (-0.02, 0.02), "graphite"),
    ]
    d.moving(
        "head_tilt_link",
        "head_pan_link",
        "revolute",
        (0, 1, 0),
        shapes,
        at=(0.14, 0, 0.045),
        limits=(-0.76, 1.45),
        velocity=1.57,
        effort=1,
        joint="head_tilt_joint",
    )


def _arm(d: Description) -> None:
    d.section("Arm")

    def turn(
        name: str,
        parent: str,
        axis: Vector,
        at: Vector,
        shapes: list[Shape],
        limits: Span | None,
        velocity: float,
        effort: float,
    ) -> None:
        d.moving(
            f"{name}_link",
            f"{parent}_link",
            "revolute" if limits else "continuous",
            axis,
            shapes,
            at=at,
            limits=limits,
            velocity=velocity,
            effort=effort,
            joint=f"{name}_joint",
        )

    def flexing(width: float, radius: float, length: float, tube: float) -> list[Shape]:
        return [
            disc((0, 0, 0), "y", width, radius, "graphite"),
            *for_the_eye([disc((0, 0, 0), "y", width + 0.004, 0.6 * radius, "blue")]),
            rod((0, 0, 0), (length, 0, 0), tube, "shell"),
        ]

    def rolling(back: float, ahead: float, tube: float) -> list[Shape]:
        return [
            rod((-back, 0, 0), (-back + 0.03, 0, 0), tube + 0.004, "graphite"),
            rod((-back + 0.03, 0, 0), (ahead, 0, 0), tube, "shell"),
            sphere(tube, (ahead, 0, 0), "shell"),
        ]

    pitch, roll = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
    shapes = [
        rod((0, 0, -0.06), (0, 0, 0.09), 0.06, "shell"),
        sphere(0.06, (0, 0, 0.09), "shell"),
        rod((0, 0, 0.06), (0.117, 0, 0.06), 0.05, "shell"),
    ]
    turn("shoulder_pan", "torso_lift", (0, 0, 1), (0.12, 0, 0.35), shapes, (-1.6, 1.6), 1.25, 34)
    shapes = flexing(0.11, 0.064, 0.16, 0.052)
    turn("shoulder_lift", "shoulder_pan", pitch, (0.12, 0, 0.06), shapes, (-1.22, 1.52), 1.45, 132)
    shapes = rolling(0.06, 0.08, 0.05)
    turn("upperarm_roll", "shoulder_lift", roll, (0.22, 0, 0), shapes, None, 1.57, 77)
    shapes = flexing(0.11, 0.06, 0.14, 0.048)
    turn("elbow_flex", "upperarm_roll", pitch, (0.13, 0, 0), shapes, (-2.25, 2.25), 1.52, 66)
    shapes = rolling(0.06, 0.075, 0.046)
    turn("forearm_roll", "elbow_flex", roll, (0.20, 0, 0), shapes, None, 1.57, 29)
    shapes = flexing(0.10, 0.054, 0.10, 0.044)
    turn("wrist_flex", "forearm_roll", pitch, (0.125, 0, 0), shapes, (-2.16, 2.16), 2.26, 26)
    shapes = [
        rod((-0.04, 0, 0), (-0.01, 0, 0), 0.048, "graphite"),
        rod((-0.01, 0, 0), (0.03, 0, 0), 0.042, "shell"),
    ]
    turn("wrist_roll", "wrist_flex", roll, (0.14, 0, 0), shapes, None, 2.26, 7)


def _gripper(d: Description) -> None:
    shapes = [
        slab((-0.135, -0.045), (-0.055, 0.055), (-0.036, 0.036), "graphite"),
        rod((-0.095, -0.055, 0), (-0.095, 0.055, 0), 0.042, "graphite"),
        slab((-0.055, -0.036), (-0.068, 0.068), (-0.022, 0.022), "metal"),
        *for_the_eye([slab((-0.12, -0.07), (-0.02, 0.02), (0.040, 0.043), "blue")]),
    ]
    d.fixed("gripper_link", "wrist_roll_link", shapes, at=(0.165, 0, 0), joint="gripper_axis")
    left = [
        slab((-0.035, 0.028), (0.008, 0.017), (-0.012, 0.012), "metal"),
        slab((-0.022, 0.030), (0.001, 0.008), (-0.012, 0.012), "rubber"),
    ]
    for side, sign in (("r", -1.0), ("l", 1.0)):
        d.moving(
            f"{side}_gripper_finger_link",
            "gripper_link",
            "prismatic",
            (0, sign, 0),
            left if side == "l" else mirrored(left),
            limits=(0, 0.05),
            velocity=0.05,
            effort=60,
            joint=f"{side}_gripper_finger_joint",
            mimic=("r_gripper_finger_joint", 1, 0) if side == "l" else None,
        )
