"""Scenes of joints with several axes."""

from __future__ import annotations

from kineverse.articulations import Ball, Floating, Limits, Planar, Universal
from kineverse.articulations.mechanisms.mechanism import BLUE, DARK, STEEL, WOOD

from .scene_builder import SceneBuilder
from .shapes import GREEN, ORANGE, RED, WHITE, X, Y, arrow, bone, box, disc, rod, sphere


def universal(scene: SceneBuilder) -> None:
    """Show two shafts and a cross between them: the upper one leans both ways and does not twist."""
    base = disc(0.14, 0.04, (0, 0, 0.02), color=DARK) + rod((0, 0, 0.04), (0, 0, 0.24), 0.035)
    base += box((0.2, 0.06, 0.03), (0, 0, 0.25), BLUE)
    for side in (1, -1):
        base += box((0.025, 0.06, 0.14), (side * 0.09, 0, 0.31), BLUE)
    scene.frame("base", base)
    shaft = rod((-0.1, 0, 0), (0.1, 0, 0), 0.014, DARK) + rod((0, -0.1, 0), (0, 0.1, 0), 0.014, DARK)
    for side in (1, -1):
        shaft += box((0.06, 0.025, 0.14), (0, side * 0.09, 0.05), ORANGE)
    shaft += box((0.06, 0.2, 0.03), (0, 0, 0.115), ORANGE) + rod((0, 0, 0.13), (0, 0, 0.42), 0.035)
    shaft += box((0.1, 0.02, 0.02), (0.05, 0, 0.41), RED)
    bend = Limits(-0.8, 0.8, 2.0)
    scene.joint(
        Universal,
        "cross",
        shaft,
        parent="base",
        at=(0, 0, 0.35),
        first=X,
        second=Y,
        first_limits=bend,
        second_limits=bend,
    )


def ball(scene: SceneBuilder) -> None:
    """Show a stick in a socket: it leans by 0.7 rad at most, whatever the direction, and twists by 1 rad."""
    scene.frame(
        "socket", box((0.36, 0.36, 0.06), (0, 0, 0.03), DARK) + disc(0.12, 0.06, (0, 0, 0.09), color=BLUE)
    )
    stick = sphere(0.085) + rod((0, 0, 0), (0, 0, 0.4), 0.022) + sphere(0.06, (0, 0, 0.42), ORANGE)
    stick += rod((0, 0, 0.3), (0.13, 0, 0.3), 0.014, RED) + sphere(0.022, (0.13, 0, 0.3), RED)
    scene.joint(Ball, "stick", stick, parent="socket", at=(0, 0, 0.12), cone=0.7, twist=1.0, velocity=3.0)


def planar(scene: SceneBuilder) -> None:
    """Show a puck on a table: it slides both ways, 30 cm at most, and turns."""
    scene.frame(
        "table", box((1.0, 1.0, 0.04), (0, 0, -0.02), WOOD) + box((0.62, 0.62, 0.004), (0, 0, 0), WHITE)
    )
    puck = disc(0.11, 0.05, (0, 0, 0.03), color=BLUE) + arrow(0.17, 0.02, (0, 0, 0.06))
    scene.joint(Planar, "puck", puck, parent="table", lower=-0.3, upper=0.3, velocity=1.0)


def floating(scene: SceneBuilder) -> None:
    """Show a toy aeroplane, which goes anywhere and turns any way."""
    scene.frame("field", disc(0.6, 0.02, (0, 0, -0.41), color=GREEN))
    plane = bone((-0.25, 0, 0), (0.2, 0, 0), 0.05, WHITE) + sphere(0.045, (0.06, 0, 0.035), BLUE)
    plane += box((0.13, 0.7, 0.016), (0.03, 0, 0.0), RED) + box((0.08, 0.26, 0.012), (-0.27, 0, 0.02), RED)
    plane += box((0.09, 0.012, 0.13), (-0.27, 0, 0.08), RED) + disc(0.012, 0.05, (0.26, 0, 0), X, DARK)
    plane += box((0.012, 0.2, 0.024), (0.275, 0, 0), ORANGE) + disc(0.03, 0.03, (0.06, 0.09, -0.09), Y, DARK)
    plane += disc(0.03, 0.03, (0.06, -0.09, -0.09), Y, DARK) + rod(
        (0.06, -0.09, -0.09), (0.06, 0.09, -0.09), 0.006, STEEL
    )
    scene.joint(Floating, "plane", plane)


SCENES = (universal, ball, planar, floating)
