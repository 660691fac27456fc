"""Scenes of transmissions: gears, racks, cams and mimicking fingers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kineverse.articulations import Cam, Continuous, Gearbox, RackAndPinion, Revolute
from kineverse.articulations.mechanisms.mechanism import BLUE, DARK, STEEL
from kineverse.spatial import rotation_y, translation

from .scene_builder import SceneBuilder
from .shapes import GREEN, ORANGE, RED, WHITE, Shapes, Y, Z, bone, box, disc, gear, perpendicular, rod


def gearbox(scene: SceneBuilder) -> None:
    """Show three gears of 16, 24 and 12 teeth: each drives the next one."""
    module, teeth = 0.016, (16, 24, 12)
    radii = [module * n / 2 for n in teeth]
    places = [0.0, radii[0] + radii[1], radii[0] + 2 * radii[1] + radii[2]]
    middle = places[2] / 2
    scene.frame("plate", box((places[2] + 0.36, 0.46, 0.03), (middle, 0, -0.03), DARK))
    names, colors, driver = ("first", "second", "third"), (BLUE, ORANGE, GREEN), "first"
    for k, (name, color) in enumerate(zip(names, colors, strict=True)):
        shapes = gear(radii[k], teeth[k], 0.04, color=color)
        place: dict[str, Any] = {"parent": "plate", "at": (places[k], 0, 0), "axis": Z}
        if not k:
            scene.joint(Continuous, name, shapes, **place)
            continue
        # The driver's tooth at x meets a gap of the next one: half a tooth, where the driver has a tooth.
        ratio = -teeth[k - 1] / teeth[k]
        offset = math.pi / teeth[1] if k == 1 else -ratio * math.pi / teeth[1]
        scene.joint(Gearbox, name, shapes, driver=driver, ratio=ratio, offset=offset, **place)
        driver = name


def rack_and_pinion(scene: SceneBuilder) -> None:
    """Show a pinion that pushes a rack along."""
    radius, teeth = 0.1, 16
    pitch = math.tau * radius / teeth
    bed = box((0.9, 0.12, 0.03), (0, 0, 0.015), DARK) + box((0.06, 0.03, 0.3), (0, 0.075, 0.15), DARK)
    scene.frame("bed", bed + rod((0, 0.075, 0.2), (0, -0.05, 0.2), 0.015, STEEL))
    # Seen from +y, along its axis, a positive rotation moves the lower side of the pinion to the left, to -x.
    scene.joint(
        Revolute,
        "pinion",
        gear(radius, teeth, 0.06, axis=Y, color=BLUE),
        parent="bed",
        at=translation(0, 0, 0.2) @ rotation_y(-math.pi / 2),  # its mark is above the shaft at 0
        axis=Y,
        lower=-2.2,
        upper=2.2,
        velocity=3.0,
    )
    size, rack = pitch / 2, box((0.5, 0.06, 0.036), (0, 0, -0.018 - 0.6 * pitch / 2), ORANGE)
    for k in range(-7, 8):
        rack += box((0.9 * size, 0.06, 1.3 * size), ((k + 0.5) * pitch, 0, 0), ORANGE)
    scene.joint(
        RackAndPinion,
        "rack",
        rack,
        parent="bed",
        at=(0, 0, 0.2 - radius),
        axis=(-1, 0, 0),
        driver="pinion",
        radius=radius,
    )


def cam(scene: SceneBuilder) -> None:
    """Show a round cam that turns off its centre and lifts a valve."""
    radius, off, height = 0.1, 0.045, 0.2
    stand = box((0.4, 0.3, 0.03), (0, 0, 0.015), DARK) + box((0.05, 0.04, 0.62), (0, 0.12, 0.31), DARK)
    stand += rod((0, 0.12, height), (0, -0.05, height), 0.016, STEEL)
    stand += box((0.05, 0.12, 0.03), (0.045, 0.06, 0.5), BLUE) + box(
        (0.05, 0.12, 0.03), (-0.045, 0.06, 0.5), BLUE
    )
    scene.frame("stand", stand)
    out = np.array(perpendicular(Y))
    shapes = disc(radius, 0.06, off * out, Y, ORANGE) + disc(0.03, 0.08, axis=Y, color=DARK)
    shapes += disc(0.014, 0.064, (off + 0.6 * radius) * out, Y, RED)
    turn = rotation_y(-math.pi / 2)  # its middle is above the shaft at 0
    scene.joint(Continuous, "cam", shapes, parent="stand", at=translation(0, 0, height) @ turn, axis=Y)
    angles = [math.tau * k / 16 for k in range(17)]
    valve = disc(0.07, 0.02, (0, 0, 0.01), Z, STEEL) + rod((0, 0, 0.02), (0, 0, 0.3), 0.018, STEEL)
    valve += disc(0.035, 0.05, (0, 0, 0.3), Z, GREEN)
    scene.joint(
        Cam,
        "valve",
        valve,
        parent="stand",
        at=(0, 0, height + radius),
        axis=Z,
        driver="cam",
        angles=tuple(angles),
        values=(*(off * math.cos(a) for a in angles[:-1]), off),
    )


def mimic(scene: SceneBuilder) -> None:
    """Show a finger whose tip bends more and more as it closes: q + 0.2 q² of the joint before it."""
    scene.frame(
        "palm",
        box((0.12, 0.16, 0.24), (0, 0, 0.12), WHITE) + rod((0, -0.07, 0.26), (0, 0.07, 0.26), 0.03, DARK),
    )
    finger = scene.position("finger")

    def phalanx(length: float, width: float, last: bool = False) -> Shapes:
        shapes = bone((0, 0, 0), (0, 0, length), width, ORANGE if last else BLUE)
        shapes += rod((0, -1.15 * width, 0), (0, 1.15 * width, 0), 0.6 * width, DARK)
        return shapes

    bends = finger + 0.2 * finger**2
    scene.joint(
        Revolute,
        "finger",
        phalanx(0.22, 0.045),
        parent="palm",
        at=(0, 0, 0.27),
        axis=Y,
        lower=0,
        upper=1.3,
        velocity=2,
    )
    scene.joint(
        Revolute, "middle", phalanx(0.16, 0.04), parent="finger", at=(0, 0, 0.22), axis=Y, position=bends
    )
    scene.joint(
        Revolute,
        "tip",
        phalanx(0.1, 0.036, last=True),
        parent="middle",
        at=(0, 0, 0.16),
        axis=Y,
        position=0.6 * bends,
    )


SCENES = (gearbox, rack_and_pinion, cam, mimic)
