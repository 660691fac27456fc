"""Scenes of mobile bases with rolling wheels."""

from __future__ import annotations

import math

import numpy as np

from kineverse.articulations import Ackermann, Continuous, DifferentialDrive, Mecanum, OmniBase, Revolute
from kineverse.articulations.mechanisms.mechanism import BLUE, DARK, STEEL

from .scene_builder import SceneBuilder
from .shapes import GREEN, ORANGE, RED, WHITE, Shapes, Y, Z, arrow, bone, box, disc, rod, sphere, wheel


def omni_base(scene: SceneBuilder) -> None:
    """Show a round base that goes any way and turns: all its coordinates are free."""
    _floor(scene)
    base = disc(0.25, 0.14, (0, 0, 0.13), color=BLUE) + arrow(0.36, 0.02, (0, 0, 0.21), WHITE)
    for k in range(3):
        angle = math.tau * k / 3 + math.pi
        out = (math.cos(angle), math.sin(angle), 0.0)
        at = (0.24 * out[0], 0.24 * out[1], 0.06)
        base += disc(0.06, 0.03, at, out, DARK)
        for j in range(8):
            turn = math.tau * j / 8
            side = np.cross(out, (0, 0, 1))
            rim = np.add(at, 0.055 * (math.cos(turn) * side + math.sin(turn) * np.array((0, 0, 1))))
            base += sphere(0.016, rim, ORANGE)
    scene.joint(OmniBase, "base", base)


def differential_drive(scene: SceneBuilder) -> None:
    """Show two driven wheels and a caster: it turns on the spot and never goes sideways."""
    _floor(scene)
    radius, track = 0.08, 0.34
    base = disc(0.2, 0.09, (-0.03, 0, 0.11), color=GREEN) + arrow(0.28, 0.02, (0, 0, 0.165), WHITE)
    base += sphere(0.03, (-0.17, 0, 0.03), DARK) + rod((-0.17, 0, 0.05), (-0.17, 0, 0.08), 0.02)
    left, right = "base/left_wheel", "base/right_wheel"
    scene.joint(
        DifferentialDrive, "base", base, radius=radius, track=track, left=left, right=right, wheel_speed=6.0
    )
    for side, name in ((1, left), (-1, right)):
        at = (0.0, side * track / 2, radius)
        scene.joint(Continuous, name, wheel(radius, 0.035), parent="base", at=at, axis=Y)


def ackermann(scene: SceneBuilder) -> None:
    """Show a car: it goes where its front wheels point, each on its own circle about one centre."""
    _floor(scene)
    length, track, radius = 0.5, 0.34, 0.075
    car = box((0.78, 0.2, 0.09), (0.25, 0, 0.13), RED) + box((0.3, 0.23, 0.1), (0.19, 0, 0.22), WHITE)
    car += box((0.02, 0.2, 0.06), (0.345, 0, 0.22), DARK) + box((0.24, 0.24, 0.055), (0.2, 0, 0.225), DARK)
    for side in (1, -1):
        car += disc(0.025, 0.02, (0.64, side * 0.09, 0.14), (1, 0, 0), WHITE)
    car += rod((0, -0.15, radius), (0, 0.15, radius), 0.014) + rod(
        (length, -0.12, radius), (length, 0.12, radius), 0.014
    )
    scene.joint(Ackermann, "car", car, wheelbase=length, steering=0.5, steering_speed=1.0, speed=1.0)
    rolled = scene.position("car/drive") / radius
    bend = np.tan(scene.position("car/steering"))
    for side, name in ((1, "left"), (-1, "right")):
        at = (0.0, side * track / 2, radius)
        scene.joint(
            Revolute, f"rear_{name}", wheel(radius, 0.05), parent="car", at=at, axis=Y, position=rolled
        )
        # The wheel is at right angles to the line from it to the centre of the circle.
        angle = np.arctan(bend / (1 - side * track / (2 * length) * bend))
        at = (length, side * track / 2, radius)
        scene.joint(Revolute, f"steered_{name}", parent="car", at=at, axis=Z, position=angle)
        scene.joint(
            Revolute, f"front_{name}", wheel(radius, 0.05), parent=f"steered_{name}", axis=Y, position=rolled
        )


def mecanum(scene: SceneBuilder) -> None:
    """Show four wheels with oblique rollers: it goes sideways as well."""
    _floor(scene)
    radius, track, length = 0.08, 0.42, 0.44
    base = box((0.62, 0.32, 0.1), (0, 0, 0.13), ORANGE) + arrow(0.4, 0.02, (0, 0, 0.19), WHITE)
    for x in (length / 2, -length / 2):
        base += rod((x, -0.19, radius), (x, 0.19, radius), 0.016)
    scene.joint(
        Mecanum, "base", base, radius=radius, track=track, wheelbase=length, wheel_speed=6.0, speed=0.5
    )
    for name, x, y in (
        ("front_left", 1, 1),
        ("front_right", 1, -1),
        ("rear_left", -1, 1),
        ("rear_right", -1, -1),
    ):
        at = (x * length / 2, y * track / 2, radius)
        shapes = _oblique(radius, -x * y)
        scene.joint(Continuous, f"base/{name}_wheel", shapes, parent="base", at=at, axis=Y)


def _floor(scene: SceneBuilder) -> None:
    """Add a floor with a mark at the start."""
    plate = box((2.2, 2.2, 0.02), (0, 0, -0.01), (0.84, 0.86, 0.87, 1.0))
    lines = box((0.5, 0.015, 0.002), (0, 0, 0), STEEL) + box((0.015, 0.5, 0.002), (0, 0, 0), STEEL)
    scene.frame("floor", plate + lines)


def _oblique(radius: float, hand: int) -> Shapes:
    """Return a mecanum wheel about y with rollers at 45°; ``hand`` is 1 or -1 for the two directions."""
    shapes = disc(0.72 * radius, 0.07, axis=Y, color=DARK)
    for k in range(9):
        angle = math.tau * k / 9
        c, s = 0.8 * radius * math.cos(angle), 0.8 * radius * math.sin(angle)
        half = 0.034 * np.array((-hand * math.sin(angle), 1.0, hand * math.cos(angle)))
        middle = np.array((c, 0.0, s))
        shapes += bone(middle - half, middle + half, 0.2 * radius, RED if k == 0 else STEEL)
    return shapes


SCENES = (omni_base, differential_drive, ackermann, mecanum)
