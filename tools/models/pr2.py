"""A two-armed robot with the degrees of freedom of a PR2: torso, head, twice seven in the arms, two grippers.

The dimensions are round figures of that class of robot, the shapes are our own. The base carries no joint:
how it drives is said by the library.
"""

from __future__ import annotations

from description import Description
from shapes import Material, Shape, Vector, disc, for_the_eye, mirrored, pipe, rod, rounded_slab, slab, sphere

ABOUT = """\
A two-armed mobile manipulator with the joints of a PR2: 19 degrees of freedom, its base's drive left out.
Units: m, rad, kg; x forward, y left, z up, base_footprint on the floor. {l,r}_gripper_joint is the gap
between the finger tips, of which each finger takes half. The tool frame of a gripper has x out of the hand,
y across the fingers.

Written for Kineverse by tools/models/pr2.py; change it there.
SPDX-License-Identifier: Apache-2.0"""

MATERIALS = {
    "shell": Material((0.92, 0.92, 0.90, 1), 600),
    "slate": Material((0.27, 0.30, 0.34, 1), 600),
    "teal": Material((0.16, 0.50, 0.55, 1), 600),
    "metal": Material((0.66, 0.68, 0.70, 1), 1500),
    "rubber": Material((0.12, 0.12, 0.13, 1), 1100),
    "lens": Material((0.05, 0.06, 0.09, 1), 600),
}


def pr2() -> Description:
    """Return the robot."""
    d = Description("pr2", ABOUT, MATERIALS, root="base_footprint")
    _base(d)
    _head(d)
    for side in ("l", "r"):
        _arm(d, side)
        _gripper(d, side)
    return d


def _base(d: Description) -> None:
    d.section("Base on four castors, and the torso that rises out of it")
    shapes = [
        *rounded_slab((-0.33, 0.33), (-0.33, 0.33), (0.05, 0.24), 0.09, "shell"),
        *rounded_slab((-0.31, 0.31), (-0.31, 0.31), (0.24, 0.26), 0.08, "slate"),
        *rounded_slab((-0.30, 0.30), (-0.30, 0.30), (0.01, 0.05), 0.08, "slate"),
        *rounded_slab((-0.33, -0.05), (-0.22, 0.22), (0.26, 0.56), 0.07, "shell"),
        rod((0.24, 0, 0.26), (0.24, 0, 0.31), 0.05, "lens"),
        rod((0.24, 0, 0.31), (0.24, 0, 0.325), 0.055, "teal"),
        *for_the_eye([slab((0.329, 0.332), (-0.22, 0.22), (0.12, 0.16), "teal")]),
    ]
    for x in (-0.225, 0.225):
        for y in (-0.225, 0.225):
            shapes += [disc((x, y + offset, 0.025), "y", 0.03, 0.075, "rubber") for offset in (-0.05, 0.05)]
    d.fixed("base_link", "base_footprint", shapes, at=(0, 0, 0.05), joint="base_footprint_joint")
    shapes = [
        *rounded_slab((-0.25, -0.04), (-0.15, 0.15), (-0.44, -0.06), 0.05, "slate"),
        *rounded_slab((-0.27, -0.07), (-0.155, 0.155), (-0.06, 0.31), 0.08, "shell"),
        *rounded_slab((-0.10, 0.035), (-0.06, 0.06), (-0.13, 0.24), 0.04, "shell"),
        *rounded_slab((-0.12, 0.08), (-0.27, 0.27), (0.155, 0.19), 0.08, "slate"),
        rod((-0.02, 0, 0.24), (-0.02, 0, 0.35), 0.055, "slate"),
        disc((0.03, 0, 0.10), "x", 0.02, 0.026, "lens"),
    ]
    d.moving(
        "torso_lift_link",
        "base_link",
        "prismatic",
        (0, 0, 1),
        shapes,
        at=(-0.05, 0, 0.74),
        limits=(0, 0.33),
        velocity=0.013,
        effort=10000,
        joint="torso_lift_joint",
    )


def _head(d: Description) -> None:
    d.section("Head")
    shapes = [
        rod((0, 0, -0.03), (0, 0, 0.02), 0.075, "shell"),
        slab((-0.03, 0.09), (-0.075, 0.075), (-0.02, 0.015), "shell"),
        rod((0.07, -0.075, 0.01), (0.07, 0.075, 0.01), 0.028, "slate"),
    ]
    d.moving(
        "head_pan_link",
        "torso_lift_link",
        "revolute",
        (0, 0, 1),
        shapes,
        at=(-0.02, 0, 0.38),
        limits=(-3.0, 3.0),
        velocity=6,
        effort=3,
        joint="head_pan_joint",
    )
    shapes = [
        *rounded_slab((-0.11, 0.05), (-0.14, 0.14), (0.03, 0.14), 0.045, "shell"),
        *rounded_slab((-0.08, 0.0), (-0.15, 0.15), (0.17, 0.21), 0.03, "slate"),
        slab((-0.06, -0.02), (-0.03, 0.03), (0.14, 0.17), "slate"),
        slab((-0.04, 0.02), (-0.07, -0.04), (-0.01, 0.03), "slate"),
        slab((-0.04, 0.02), (0.04, 0.07), (-0.01, 0.03), "slate"),
        *for_the_eye(disc((0.05, y, 0.085), "x", 0.008, 0.034, "slate") for y in (-0.07, 0.07)),
        *for_the_eye(disc((0.053, y, 0.085), "x", 0.008, 0.020, "lens") for y in (-0.07, 0.07)),
        *for_the_eye(disc((0.0, y, 0.19), "x", 0.006, 0.013, "lens") for y in (-0.10, 0.02, 0.06)),
    ]
    d.moving(
        "head_tilt_link",
        "head_pan_link",
        "revolute",
        (0, 1, 0),
        shapes,
        at=(0.07, 0, 0.01),
        limits=(-0.47, 1.4),
        velocity=5,
        effort=18,
        joint="head_tilt_joint",
    )


def _arm(d: Description, side: str) -> None:
    d.section("Left arm" if side == "l" else "Right arm")
    sign = 1.0 if side == "l" else -1.0

    def turn(
        name: str,
        parent: str,
        axis: Vector,
        at: Vector,
        shapes: list[Shape],
        limits: tuple[float, float] | None,
        velocity: float,
        effort: float,
    ) -> None:
        d.moving(
            f"{side}_{name}_link",
            f"{side}_{parent}_link" if parent != "torso_lift" else "torso_lift_link",
            "revolute" if limits else "continuous",
            axis,
            shapes,
            at=at,
            limits=limits,
            velocity=velocity,
            effort=effort,
            joint=f"{side}_{name}_joint",
        )

    outwards = (-0.7, 2.28) if side == "l" else (-2.28, 0.7)
    rolls = (-0.8, 3.9) if side == "l" else (-3.9, 0.8)
    pitch, roll = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
    shapes = [
        rod((0, 0, -0.06), (0, 0, 0.15), 0.085, "shell"),
        rod((0, 0, -0.08), (0, 0, -0.06), 0.065, "slate"),
        slab((0, 0.10), (-0.05, 0.05), (-0.055, 0.065), "shell"),
    ]
    turn("shoulder_pan", "torso_lift", (0, 0, 1), (0, 0.19 * sign, 0), shapes, outwards, 2.1, 30)
    shapes = [
        disc((0, 0, 0), "y", 0.15, 0.082, "slate"),
        *for_the_eye([disc((0, 0, 0), "y", 0.156, 0.05, "teal")]),
        rod((0, 0, 0), (0.12, 0, 0), 0.068, "shell"),
    ]
    turn("shoulder_lift", "shoulder_pan", pitch, (0.10, 0, 0), shapes, (-0.52, 1.39), 2.1, 30)
    shapes = [rod((0.12, 0, 0), (0.17, 0, 0), 0.072, "slate")]
    turn("upper_arm_roll", "shoulder_lift", roll, (0, 0, 0), shapes, rolls, 3.3, 30)
    shapes = [
        rod((0.17, 0, 0), (0.235, 0, 0), 0.066, "shell"),
        sphere(0.066, (0.235, 0, 0), "shell"),
        rod((0.235, 0, 0), (0.37, 0, 0), 0.046, "shell"),
    ]
    d.fixed(f"{side}_upper_arm_link", f"{side}_upper_arm_roll_link", shapes, joint=f"{side}_upper_arm_joint")
    shapes = [
        disc((0, 0, 0), "y", 0.124, 0.062, "slate"),
        *for_the_eye([disc((0, 0, 0), "y", 0.130, 0.036, "teal")]),
        rod((0, 0, 0), (0.115, 0, 0), 0.048, "shell"),
    ]
    turn("elbow_flex", "upper_arm", pitch, (0.40, 0, 0), shapes, (-2.3, 0), 3.3, 30)
    shapes = [rod((0.115, 0, 0), (0.14, 0, 0), 0.055, "slate")]
    turn("forearm_roll", "elbow_flex", roll, (0, 0, 0), shapes, None, 3.6, 30)
    shapes = [
        rod((0.14, 0, 0), (0.20, 0, 0), 0.050, "shell"),
        sphere(0.050, (0.20, 0, 0), "shell"),
        rod((0.20, 0, 0), (0.30, 0, 0), 0.030, "shell"),
    ]
    d.fixed(f"{side}_forearm_link", f"{side}_forearm_roll_link", shapes, joint=f"{side}_forearm_joint")
    shapes = [disc((0, 0, 0), "y", 0.088, 0.042, "slate"), rod((0, 0, 0), (0.062, 0, 0), 0.030, "shell")]
    turn("wrist_flex", "forearm", pitch, (0.32, 0, 0), shapes, (-2.1, 0), 3.1, 10)
    shapes = [rod((0.062, 0, 0), (0.080, 0, 0), 0.042, "slate")]
    turn("wrist_roll", "wrist_flex", roll, (0, 0, 0), shapes, None, 3.6, 10)


def _gripper(d: Description, side: str) -> None:
    hand = f"{side}_gripper"
    palm = f"{hand}_palm_link"
    shapes = [
        slab((0.075, 0.135), (-0.045, 0.045), (-0.032, 0.032), "shell"),
        rod((0.105, -0.045, 0), (0.105, -0.072, 0), 0.03, "shell"),
        rod((0.105, 0.045, 0), (0.105, 0.072, 0), 0.03, "shell"),
        slab((0.125, 0.139), (-0.075, 0.075), (-0.02, 0.02), "slate"),
        *for_the_eye([slab((0.085, 0.12), (-0.02, 0.02), (0.032, 0.034), "teal")]),
    ]
    d.fixed(palm, f"{side}_wrist_roll_link", shapes, joint=f"{hand}_palm_joint")
    d.fixed(f"{hand}_tool_frame", palm, at=(0.18, 0, 0), joint=f"{hand}_tool_joint")
    d.moving(
        f"{hand}_motor_slider_link",
        palm,
        "prismatic",
        (1, 0, 0),
        [rod((-0.004, 0, 0), (0.004, 0, 0), 0.008, "metal")],
        at=(0.068, 0, 0),
        limits=(0, 0.09),
        velocity=0.2,
        effort=100,
        joint=f"{hand}_joint",
    )
    finger = pipe([(0.0, 0.018, 0), (0.016, 0.026, 0), (0.036, 0.016, 0)], 0.009, "metal")
    tip = [
        slab((0, 0.032), (0.001, 0.010), (-0.011, 0.011), "rubber"),
        rod((0.032, 0.0055, -0.011), (0.032, 0.0055, 0.011), 0.0045, "rubber"),
        slab((0, 0.030), (0.010, 0.017), (-0.009, 0.009), "metal"),
    ]
    for which, sign in (("l", 1.0), ("r", -1.0)):
        name = f"{hand}_{which}_finger"
        d.moving(
            f"{name}_link",
            palm,
            "prismatic",
            (0, sign, 0),
            finger if which == "l" else mirrored(finger),
            at=(0.14, 0, 0),
            limits=(0, 0.045),
            velocity=0.1,
            effort=100,
            joint=f"{name}_joint",
            mimic=(f"{hand}_joint", 0.5, 0),
        )
        d.fixed(
            f"{name}_tip_link",
            f"{name}_link",
            tip if which == "l" else mirrored(tip),
            at=(0.028, 0, 0),
            joint=f"{name}_tip_joint",
        )
