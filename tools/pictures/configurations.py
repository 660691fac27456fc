"""Configurations in which the gallery is drawn, and cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

FRONT, ELEVATION = 0.62, 0.42


@dataclass(frozen=True)
class Take:
    """A picture of a scene.

    ``states`` are values by name below the scene's own, for one panel each, or for one copy each in a single
    panel if ``together``; ``azimuth`` and ``elevation`` are those of the camera [rad], ``height`` is that of
    the picture [pixels].
    """

    states: tuple[dict[str, float], ...]
    azimuth: float = FRONT
    elevation: float = ELEVATION
    height: int = 190
    together: bool = False


def turned(name: str, roll: float, pitch: float, yaw: float, **more: float) -> dict[str, float]:
    """Return the coordinates of a quaternion."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return {
        f"{name}/qx": sr * cp * cy - cr * sp * sy,
        f"{name}/qy": cr * sp * cy + sr * cp * sy,
        f"{name}/qz": cr * cp * sy - sr * sp * cy,
        f"{name}/qw": cr * cp * cy + sr * sp * sy,
        **{f"{name}/{axis}": value for axis, value in more.items()},
    }


def through(name: str, *values: float) -> tuple[dict[str, float], ...]:
    """Return one coordinate at several values."""
    return tuple({name: value} for value in values)


BOARD = -math.pi / 2 + 0.35
"""Camera of what is drawn on an upright board."""

USER = math.pi + 0.5
"""From where one looks who uses a mechanism."""

DRIVEN = {"azimuth": 0.3, "elevation": 0.65, "height": 220, "together": True}
"""How bases are looked at: all places that they were at, in one picture."""

TAKES = {
    "fixed": Take(({},)),
    "revolute": Take(through("door", 0.0, 0.9, 1.8)),
    "continuous": Take(through("wheel", -0.3, -1.3, -2.3), azimuth=1.1),
    "prismatic": Take(through("drawer", 0.0, 0.2, 0.4)),
    "screw": Take(through("bolt", 0.0, 9.0, 22.0), elevation=0.3),
    "cylindrical": Take(
        (
            {"rod/slide": 0.0, "rod/turn": 0.0},
            {"rod/slide": 0.24, "rod/turn": 0.8},
            {"rod/slide": -0.2, "rod/turn": 1.9},
        ),
        azimuth=1.1,
        height=120,
    ),
    "universal": Take(
        (
            {},
            {"cross/first": 0.0, "cross/second": 0.7},
            {"cross/first": 0.7, "cross/second": 0.0},
        )
    ),
    "ball": Take((turned("stick", 0, 0, 0), turned("stick", 0.5, 0.3, 0), turned("stick", -0.3, 0.6, 0.6))),
    "planar": Take(
        (
            {},
            {"puck/x": 0.3, "puck/y": 0.1, "puck/angle": 0.8},
            {"puck/x": -0.1, "puck/y": -0.3, "puck/angle": 2.5},
        ),
        elevation=0.7,
        height=130,
    ),
    "floating": Take(
        (
            turned("plane", 0, 0, 0, z=-0.25),
            turned("plane", 0, -0.5, 0.3, x=0.1, z=0.0),
            turned("plane", 0.8, 0.1, 1.2, x=0.2, z=0.15),
        ),
        height=170,
    ),
    "gearbox": Take(through("first", 0.0, 0.6, 1.2), azimuth=-math.pi / 2, elevation=0.9, height=120),
    "rack_and_pinion": Take(through("pinion", -1.8, 0.0, 1.8), azimuth=-1.4, elevation=0.3, height=110),
    "cam": Take(through("cam", 0.0, 1.6, math.pi), azimuth=-1.2, elevation=0.2),
    "mimic": Take(through("finger", 0.0, 0.6, 1.2), azimuth=-1.2, elevation=0.2),
    "omni_base": Take(
        (
            {"base/x": -0.5, "base/y": -0.5},
            {"base/x": -0.5, "base/y": 0.4, "base/angle": 0.0},
            {"base/x": 0.5, "base/y": 0.3, "base/angle": -1.2},
        ),
        **DRIVEN,
    ),
    "differential_drive": Take(
        (
            {"base/x": -0.6, "base/y": -0.3},
            {"base/x": 0.1, "base/y": -0.15, "base/angle": 0.6, "base/left_wheel": 0.4},
            {"base/x": 0.4, "base/y": 0.4, "base/angle": 1.6, "base/left_wheel": 0.8},
        ),
        **DRIVEN,
    ),
    "ackermann": Take(
        (
            {"car/steering": 0.0, "car/x": -0.85, "car/y": -0.6},
            {"car/steering": 0.5, "car/x": 0.0, "car/y": -0.55, "car/angle": 0.2},
            {"car/steering": -0.5, "car/x": 0.2, "car/y": 0.3, "car/angle": 1.3},
        ),
        **DRIVEN,
    ),
    "mecanum": Take(
        (
            {"base/x": -0.5, "base/y": -0.5},
            {"base/x": -0.5, "base/y": 0.4},
            {"base/x": 0.4, "base/y": 0.4, "base/angle": -0.9},
        ),
        **DRIVEN,
    ),
    "garage_door": Take(
        (
            {"garage/door": 0.0, "garage/bolt": 0.0},
            {"garage/door": 0.6, "garage/bolt": 0.5},
            {"garage/door": 1.3, "garage/bolt": 0.5},
        ),
        azimuth=USER,
    ),
    "garage_door_as_published": Take(through("garage/door", 2.0, 1.6, 0.4), azimuth=USER),
    "folding_door": Take(through("door", 0.0, 0.5, 1.1, 1.84), azimuth=USER, elevation=0.15),
    "door_with_handle": Take(
        (
            {"room/door": 0.0, "room/handle": 0.0},
            {"room/door": 0.0, "room/handle": 0.8},
            {"room/door": 1.0, "room/handle": 0.0},
        ),
        azimuth=USER,
        elevation=0.25,
    ),
    "latch": Take(
        (
            {"gate/door": 0.0, "gate/bolt": 0.0},
            {"gate/door": 0.4, "gate/bolt": 0.012},
            {"gate/door": 1.2, "gate/bolt": 0.0},
        ),
        azimuth=math.pi - 0.7,
        elevation=0.25,
    ),
    "microwave": Take(
        (
            {"oven/door": 0.0, "oven/button": 0.0},
            {"oven/door": 0.3, "oven/button": 0.006},
            {"oven/door": 1.6, "oven/button": 0.0},
        ),
        azimuth=USER,
        height=150,
    ),
    "faucet": Take(
        (
            {"tap/lift": 0.0, "tap/turn": 0.0},
            {"tap/lift": 0.4, "tap/turn": -0.7},
            {"tap/lift": 0.4, "tap/turn": 0.7},
        ),
        azimuth=USER + 0.6,
    ),
    "piston": Take(through("engine", 0.3, 1.8, 3.1), azimuth=BOARD, elevation=0.15),
    "pedal_bin": Take(through("bin", 0.0, 0.1, 0.17), azimuth=USER, elevation=0.35),
    "screw_and_nut": Take(through("vise", 0.4, 10.0, 24.0), azimuth=BOARD, elevation=0.2),
    "scissor_lift": Take(through("lift", 0.15, 0.6, 1.1), azimuth=BOARD, elevation=0.2),
    "desk_lamp": Take(
        (
            {"lamp/lower": -0.3, "lamp/upper": -0.2},
            {"lamp/lower": 0.3, "lamp/upper": 0.4},
            {"lamp/lower": 0.6, "lamp/upper": -0.4},
        ),
        azimuth=BOARD,
        elevation=0.15,
    ),
    "ratchet": Take(
        (
            {"winch/wheel": 0.0},
            {"winch/wheel": 0.8},
            {"winch/wheel": 0.5, "winch/pawl": 0.4},
        ),
        azimuth=BOARD,
        elevation=0.2,
    ),
    "four_bar": Take(through("crank", 0.6, 2.4, 4.4), azimuth=BOARD, elevation=0.15),
    "slider_crank": Take(through("crank", 0.4, 1.8, 3.1), azimuth=BOARD, elevation=0.15, height=110),
    "spatial_four_bar": Take(through("drive", 0.0, 2.0, 4.0), azimuth=-0.7),
    "parallel_gripper": Take(through("left_inner", 0.15, 0.6, 1.1), azimuth=0.3, elevation=1.0),
    "scissor_linkage": Take(through("bar_a0", 0.25, 0.6, 1.1), azimuth=BOARD, elevation=0.15),
    "delta_robot": Take(
        (
            {"motor_0": 0.2, "motor_1": 0.2, "motor_2": 0.2},
            {"motor_0": 0.7, "motor_1": 0.0, "motor_2": 0.2},
            {"motor_0": 0.0, "motor_1": 0.6, "motor_2": 0.6},
        ),
        azimuth=0.0,
        elevation=0.2,
    ),
    "jansen_leg": Take(through("crank", 0.3, 2.2, 4.4), azimuth=BOARD, elevation=0.15),
}


def values(prefix: str, state: dict[str, float]) -> dict[str, float]:
    """Return values by the names that the scene has below a prefix."""
    return {f"{prefix}/{key}": value for key, value in state.items()}
