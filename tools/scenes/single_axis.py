"""Scenes of joints with one axis."""

from __future__ import annotations

import math

from kineverse.articulations import Continuous, Cylindrical, Fixed, Limits, Prismatic, Revolute, Screw
from kineverse.articulations.mechanisms.mechanism import BLUE, DARK, STEEL, WOOD

from .scene_builder import SceneBuilder
from .shapes import GREEN, ORANGE, RED, WHITE, X, Y, Z, box, disc, rod, sphere, wheel


def fixed(scene: SceneBuilder) -> None:
    """Show a sign on a post, which stays where it is."""
    scene.frame("post", disc(0.16, 0.04, (0, 0, 0.02), color=DARK) + rod((0, 0, 0), (0, 0, 0.9), 0.03))
    shapes = box((0.03, 0.5, 0.28), (0.045, 0, 0), BLUE) + box((0.01, 0.36, 0.05), (0.062, 0, 0), WHITE)
    scene.joint(Fixed, "sign", shapes, parent="post", at=(0, 0, 0.74))


def revolute(scene: SceneBuilder) -> None:
    """Show a door that turns about its hinges and stops at both ends."""
    frame = box((0.08, 0.06, 1.1), (0, -0.07, 0.55), WOOD) + box((0.08, 0.06, 1.1), (0, 0.65, 0.55), WOOD)
    scene.frame("frame", frame + box((0.08, 0.78, 0.08), (0, 0.29, 1.14), WOOD))
    leaf = box((0.03, 0.56, 1.06), (0, 0.31, 0.55), WHITE) + sphere(0.03, (0.045, 0.53, 0.55), ORANGE)
    leaf += sphere(0.03, (-0.045, 0.53, 0.55), ORANGE)
    for z in (0.2, 0.9):
        leaf += disc(0.02, 0.12, (0, 0, z), Z, DARK)
    scene.joint(Revolute, "door", leaf, axis=(0, 0, -1), lower=0.0, upper=2.0, velocity=1.0)


def continuous(scene: SceneBuilder) -> None:
    """Show a wheel on a stand, which turns without end."""
    stand = box((0.4, 0.3, 0.03), (0, 0, 0.015), DARK)
    for side in (1, -1):
        stand += rod((0.12, side * 0.12, 0.02), (0, side * 0.07, 0.4), 0.015)
        stand += rod((-0.12, side * 0.12, 0.02), (0, side * 0.07, 0.4), 0.015)
    scene.frame("stand", stand + rod((0, -0.1, 0.4), (0, 0.1, 0.4), 0.018, DARK))
    scene.joint(Continuous, "wheel", wheel(0.3, 0.05), parent="stand", at=(0, 0, 0.4), axis=Y)


def prismatic(scene: SceneBuilder) -> None:
    """Show a drawer that slides out of its case."""
    case = box((0.5, 0.02, 0.4), (0, 0.31, 0.2), WOOD) + box((0.5, 0.02, 0.4), (0, -0.31, 0.2), WOOD)
    case += box((0.5, 0.64, 0.02), (0, 0, 0.01), WOOD) + box((0.5, 0.64, 0.02), (0, 0, 0.41), WOOD)
    scene.frame("case", case + box((0.02, 0.6, 0.4), (-0.24, 0, 0.2), WOOD))
    drawer = box((0.02, 0.59, 0.36), (0.24, 0, 0), BLUE) + box((0.44, 0.55, 0.01), (0.01, 0, -0.15), WHITE)
    for side in (1, -1):
        drawer += box((0.44, 0.01, 0.24), (0.01, side * 0.27, -0.03), WHITE)
    drawer += box((0.01, 0.55, 0.24), (-0.21, 0, -0.03), WHITE)
    drawer += rod((0.29, -0.1, 0.08), (0.29, 0.1, 0.08), 0.012, DARK)
    for y in (0.1, -0.1):
        drawer += rod((0.25, y, 0.08), (0.29, y, 0.08), 0.012, DARK)
    scene.joint(Prismatic, "drawer", drawer, parent="case", at=(0, 0, 0.2), axis=X, lower=0.0, upper=0.4)


def screw(scene: SceneBuilder) -> None:
    """Show a bolt that moves 4 cm along its axis with each turn."""
    pitch = 0.04
    block = box((0.3, 0.3, 0.1), (0, 0, 0.07), WOOD) + disc(0.075, 0.02, (0, 0, 0.125), Z, DARK)
    for x, y in ((0.11, 0.11), (0.11, -0.11), (-0.11, 0.11), (-0.11, -0.11)):
        block += box((0.04, 0.04, 0.2), (x, y, -0.08), WOOD)
    scene.frame("block", block, at=(0, 0, 0.18))
    bolt = disc(0.035, 0.3, (0, 0, -0.15)) + disc(0.09, 0.06, (0, 0, 0.03), Z, STEEL)
    bolt += box((0.15, 0.03, 0.02), (0.0, 0, 0.06), RED) + sphere(0.02, (0.075, 0, 0.06), RED)
    for k in range(84):
        angle = math.tau * k / 14
        bolt += sphere(
            0.011, (0.036 * math.cos(angle), 0.036 * math.sin(angle), -0.02 - pitch * k / 14), ORANGE
        )
    scene.joint(
        Screw,
        "bolt",
        bolt,
        parent="block",
        at=(0, 0, 0.14),
        axis=Z,
        pitch=pitch,
        lower=0.0,
        upper=4 * math.tau,
    )


def cylindrical(scene: SceneBuilder) -> None:
    """Show a rod in a sleeve, which slides and turns."""
    stand = box((0.3, 0.2, 0.03), (0, 0, 0.015), DARK)
    for x in (0.1, -0.1):
        stand += box((0.04, 0.12, 0.2), (x, 0, 0.1), DARK)
    scene.frame("sleeve", stand + disc(0.055, 0.26, (0, 0, 0.2), X, BLUE))
    shaft = disc(0.03, 0.9, axis=X) + rod((0.42, 0, -0.12), (0.42, 0, 0.12), 0.016, RED)
    shaft += sphere(0.028, (0.42, 0, 0.12), RED) + disc(0.045, 0.03, (-0.44, 0, 0), X, GREEN)
    shaft += sphere(0.028, (0.42, 0, -0.12), DARK)
    scene.joint(
        Cylindrical, "rod", shaft, parent="sleeve", at=(0, 0, 0.2), axis=X, slide=Limits(-0.24, 0.24, 0.5)
    )


SCENES = (fixed, revolute, continuous, prismatic, screw, cylindrical)
