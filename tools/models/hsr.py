"""A slim one-armed robot with the degrees of freedom of an HSR: lift, four in the arm, head, a hand.

The dimensions are round figures of that class of robot, the shapes are our own. The base carries no joint:
how it drives is said by the library.
"""

from __future__ import annotations

from math import pi

from description import Description
from shapes import Material, disc, for_the_eye, mirrored, rod, rounded_slab, slab, sphere

ABOUT = """\
A slim one-armed mobile manipulator with the joints of an HSR: 8 degrees of freedom, the drive of its base
left out.
Units: m, rad, kg; x forward, y left, z up, base_footprint on the floor. torso_lift_joint rises by half of
arm_lift_joint; the fingers follow hand_motor_joint. hand_palm_link has z out of the hand; hand_tool_frame,
between the finger tips, has x out of the hand, y across the fingers.

Written for Kineverse by tools/models/hsr.py; change it there.
SPDX-License-Identifier: Apache-2.0"""

MATERIALS = {
    "shell": Material((0.95, 0.94, 0.92, 1), 430),
    "black": Material((0.13, 0.13, 0.15, 1), 430),
    "grey": Material((0.55, 0.56, 0.58, 1), 500),
    "red": Material((0.75, 0.22, 0.20, 1), 430),
    "metal": Material((0.68, 0.70, 0.72, 1), 1200),
    "rubber": Material((0.10, 0.10, 0.11, 1), 1100),
    "iris": Material((0.35, 0.70, 0.90, 1), 430),
}


def hsr() -> Description:
    """Return the robot."""
    d = Description("hsr", ABOUT, MATERIALS, root="base_footprint")
    _base(d)
    _arm(d)
    _torso(d)
    _hand(d)
    return d


def _base(d: Description) -> None:
    d.section("Base and column")
    shapes = [
        rod((0, 0, 0.02), (0, 0, 0.05), 0.195, "black"),
        rod((0, 0, 0.05), (0, 0, 0.19), 0.21, "shell"),
        rod((0, 0, 0.19), (0, 0, 0.215), 0.195, "grey"),
        *for_the_eye([rod((0, 0, 0.085), (0, 0, 0.10), 0.212, "black")]),
        *rounded_slab((-0.17, -0.06), (-0.12, 0.12), (0.215, 0.70), 0.05, "shell"),
        slab((-0.06, -0.05), (-0.05, 0.05), (0.225, 0.695), "black"),
        *for_the_eye([rod((-0.115, 0, 0.60), (-0.175, 0, 0.60), 0.03, "red")]),
        *(disc((-0.09, y, 0.04), "y", 0.03, 0.04, "rubber") for y in (-0.135, 0.135)),
        *(sphere(0.025, (0.13, y, 0.025), "rubber") for y in (-0.08, 0.08)),
    ]
    d.fixed("base_link", "base_footprint", shapes, joint="base_footprint_joint")


def _arm(d: Description) -> None:
    d.section("Arm on its lift")
    shapes = [
        *rounded_slab((-0.048, 0.06), (-0.055, 0.055), (-0.115, 0.015), 0.03, "shell"),
        slab((0.0, 0.06), (0.055, 0.145), (-0.08, 0.01), "shell"),
        *(slab((0.06, 0.15), y, (-0.035, 0.035), "grey") for y in ((0.015, 0.03), (0.13, 0.145))),
        *(rod((0.15, a, 0), (0.15, b, 0), 0.035, "grey") for a, b in ((0.015, 0.03), (0.13, 0.145))),
    ]
    d.moving(
        "arm_lift_link",
        "base_link",
        "prismatic",
        (0, 0, 1),
        shapes,
        at=(0, 0, 0.34),
        limits=(0, 0.69),
        velocity=0.2,
        effort=300,
        joint="arm_lift_joint",
    )
    shapes = [
        disc((0, 0, 0), "y", 0.094, 0.048, "black"),
        rod((0, 0, 0), (0, 0, 0.10), 0.044, "shell"),
        rod((0, 0, 0.10), (0, 0, 0.25), 0.040, "shell"),
    ]
    d.moving(
        "arm_flex_link",
        "arm_lift_link",
        "revolute",
        (0, -1, 0),
        shapes,
        at=(0.15, 0.08, 0),
        limits=(-2.6, 0),
        velocity=1.2,
        effort=100,
        joint="arm_flex_joint",
    )
    shapes = [
        rod((0, 0, -0.095), (0, 0, -0.07), 0.043, "grey"),
        rod((0, 0, -0.07), (0, 0, -0.03), 0.038, "shell"),
        *(slab((-0.025, 0.025), y, (-0.045, 0.02), "shell") for y in ((-0.046, -0.036), (0.036, 0.046))),
    ]
    d.moving(
        "arm_roll_link",
        "arm_flex_link",
        "revolute",
        (0, 0, 1),
        shapes,
        at=(0.005, 0, 0.345),
        limits=(-2.0, 3.8),
        velocity=2.0,
        effort=100,
        joint="arm_roll_joint",
    )
    shapes = [
        disc((0, 0, 0), "y", 0.068, 0.036, "black"),
        rod((0, 0, 0), (0, 0, 0.058), 0.030, "shell"),
    ]
    d.moving(
        "wrist_flex_link",
        "arm_roll_link",
        "revolute",
        (0, -1, 0),
        shapes,
        limits=(-1.9, 1.2),
        velocity=1.5,
        effort=100,
        joint="wrist_flex_joint",
    )
    d.moving(
        "wrist_roll_link",
        "wrist_flex_link",
        "revolute",
        (0, 0, 1),
        [rod((0, 0, 0.058), (0, 0, 0.07), 0.037, "grey"), rod((0, 0, 0.07), (0, 0, 0.085), 0.034, "shell")],
        limits=(-1.9, 3.6),
        velocity=1.5,
        effort=100,
        joint="wrist_roll_joint",
    )


def _torso(d: Description) -> None:
    d.section("Torso and head")
    shapes = [
        *rounded_slab((-0.155, -0.075), (-0.10, 0.10), (-0.44, -0.04), 0.03, "grey"),
        *rounded_slab((-0.17, 0.055), (-0.115, 0.115), (-0.04, -0.005), 0.06, "shell"),
    ]
    d.moving(
        "torso_lift_link",
        "base_link",
        "prismatic",
        (0, 0, 1),
        shapes,
        at=(0, 0, 0.75),
        limits=(0, 0.345),
        velocity=0.1,
        effort=300,
        joint="torso_lift_joint",
        mimic=("arm_lift_joint", 0.5, 0),
    )
    shapes = [
        rod((0, 0, -0.005), (0, 0, 0.025), 0.05, "black"),
        slab((-0.03, 0.035), (-0.05, 0.05), (0.025, 0.065), "black"),
    ]
    d.moving(
        "head_pan_link",
        "torso_lift_link",
        "revolute",
        (0, 0, 1),
        shapes,
        limits=(-3.8, 1.75),
        velocity=1.0,
        effort=100,
        joint="head_pan_joint",
    )
    shapes = [
        *rounded_slab((-0.11, 0.06), (-0.125, 0.125), (0.0, 0.15), 0.06, "shell"),
        *rounded_slab((-0.09, 0.03), (-0.07, 0.07), (0.15, 0.19), 0.035, "black"),
        *for_the_eye(disc((0.06, y, 0.085), "x", 0.012, 0.040, "black") for y in (-0.06, 0.06)),
        *for_the_eye(disc((0.064, y, 0.085), "x", 0.008, 0.022, "iris") for y in (-0.06, 0.06)),
        *for_the_eye(disc((0.03, y, 0.17), "x", 0.006, 0.012, "grey") for y in (-0.035, 0.0, 0.035)),
    ]
    d.moving(
        "head_tilt_link",
        "head_pan_link",
        "revolute",
        (0, -1, 0),
        shapes,
        at=(0.02, 0, 0.065),
        limits=(-1.5, 0.5),
        velocity=1.0,
        effort=100,
        joint="head_tilt_joint",
    )


def _hand(d: Description) -> None:
    d.section("Hand: two fingers of two links; their tips stay parallel and meet at hand_motor_joint = -.3")
    shapes = [
        *rounded_slab((-0.034, 0.034), (-0.058, 0.058), (-0.055, -0.012), 0.03, "shell"),
        slab((-0.02, 0.02), (-0.046, 0.046), (-0.012, 0.0), "black"),
        *for_the_eye([disc((0.034, 0, -0.033), "x", 0.006, 0.012, "black")]),
    ]
    d.fixed("hand_palm_link", "wrist_roll_link", shapes, at=(0, 0, 0.14), joint="hand_palm_joint")
    forward = (0, -pi / 2, 0)
    d.fixed("hand_tool_frame", "hand_palm_link", at=(0, 0, 0.10), rpy=forward, joint="hand_tool_joint")
    proximal = [
        disc((0, 0, 0), "x", 0.026, 0.011, "grey"),
        slab((-0.010, 0.010), (-0.007, 0.007), (0, 0.07), "shell"),
    ]
    distal = [
        disc((0, 0, 0), "x", 0.024, 0.009, "grey"),
        rod((0, 0, 0), (0, 0, 0.018), 0.008, "shell"),
        slab((-0.011, 0.011), (-0.0088, -0.004), (0.012, 0.054), "rubber"),
        slab((-0.011, 0.011), (-0.004, 0.006), (0.012, 0.052), "shell"),
    ]
    for side, sign in (("l", 1.0), ("r", -1.0)):
        first = side == "l"
        d.moving(
            f"hand_{side}_proximal_link",
            "hand_palm_link",
            "revolute",
            (-sign, 0, 0),
            proximal if first else mirrored(proximal),
            at=(0, 0.03 * sign, 0),
            limits=(-0.3, 1.2),
            velocity=1.0,
            effort=100,
            joint="hand_motor_joint" if first else "hand_r_proximal_joint",
            mimic=None if first else ("hand_motor_joint", 1, 0),
        )
        d.moving(
            f"hand_{side}_distal_link",
            f"hand_{side}_proximal_link",
            "revolute",
            (-sign, 0, 0),
            distal if first else mirrored(distal),
            at=(0, 0, 0.07),
            limits=(-1.2, 0.3),
            velocity=1.0,
            effort=100,
            joint=f"hand_{side}_distal_joint",
            mimic=("hand_motor_joint", -1, 0),
        )
