"""Scenes of linkages with closed loops.

Planar linkages are on an upright board: x to the right, y up, z out of it.
"""

from __future__ import annotations

import math
from typing import Any

from kineverse.articulations import Prismatic, Revolute
from kineverse.articulations.mechanisms.mechanism import BLUE, DARK, STEEL, WOOD
from kineverse.expressions.expression import Expression
from kineverse.model.body import Rgba
from kineverse.spatial import rotation_x, rotation_z, translation

from .scene_builder import SceneBuilder
from .shapes import GREEN, ORANGE, RED, Point, Shapes, X, Y, Z, box, disc, link, rod, sphere


def four_bar(scene: SceneBuilder) -> None:
    """Show a crank that goes round, and a rocker that swings to and fro."""
    crank, coupler, rocker, ground = 0.12, 0.33, 0.27, 0.3
    _board(scene, 0.28, _foot(0, 0.24) + _foot(ground, 0.24) + box((0.6, 0.03, 0.2), (0.15, -0.27, 0), DARK))
    _bar(scene, "crank", "board", (0, 0), crank, 1, RED)
    _bar(scene, "coupler", "crank", (crank, 0), coupler, 2, ORANGE)
    _bar(scene, "rocker", "board", (ground, 0), rocker, 1, BLUE)
    scene.loop("four_bar", "coupler_end", "rocker_end")


def slider_crank(scene: SceneBuilder) -> None:
    """Show a crank, a rod, and a slider on a rail."""
    crank, length = 0.1, 0.3
    rail = box((0.5, 0.03, 0.08), (0.32, -0.055, 0), DARK) + box((0.8, 0.03, 0.2), (0.2, -0.24, 0), DARK)
    _board(scene, 0.255, rail + _foot(0, 0.22) + box((0.04, 0.17, 0.05), (0.5, -0.15, 0), DARK))
    scene.joint(
        Revolute,
        "crank",
        disc(0.13, 0.02, (0, 0, 0.02), color=STEEL) + _between(crank, 2, RED),
        parent="board",
        axis=Z,
    )
    _bar(scene, "rod", "crank", (crank, 0), length, 3, ORANGE)
    slider = box((0.13, 0.08, 0.08), (0, 0, 0.02), BLUE) + disc(0.012, 0.1, (0, 0, 0.06), color=DARK)
    scene.joint(Prismatic, "slider", slider, parent="board", axis=X)
    scene.loop("slider_crank", "rod_end", "slider", home={"slider": crank + length})


def spatial_four_bar(scene: SceneBuilder) -> None:
    """Show a crank about one axis and a rocker about another, with a rod between two balls."""
    ground = box((0.74, 0.56, 0.03), (0.2, 0.16, -0.205), DARK) + rod((0, 0, -0.2), (0, 0, 0), 0.03, STEEL)
    for x in (0.34, 0.46):
        ground += box((0.02, 0.06, 0.24), (x, 0.3, -0.09), STEEL)
    scene.frame("ground", ground, at=(0, 0, 0.22))
    drive = (
        disc(0.13, 0.025, color=BLUE)
        + box((0.1, 0.03, 0.01), (0.05, 0, 0.015), RED)
        + sphere(0.022, (0.1, 0, 0.03), DARK)
    )
    scene.joint(Revolute, "drive", drive, parent="ground", axis=Z)
    scene.frame("drive_ball", parent="drive", at=(0.1, 0, 0.03))
    scene.joint(Revolute, "rod_turn", parent="drive_ball", axis=Z)
    scene.joint(Revolute, "rod", rod((0, 0, 0), (0.55, 0, 0), 0.012, ORANGE), parent="rod_turn", axis=Y)
    scene.frame("rod_end", parent="rod", at=(0.55, 0, 0))
    driven = link((0, 0, 0), (0, 0.25, 0), X, GREEN, 0.04, 0.025) + sphere(0.022, (0, 0.25, 0), DARK)
    driven += rod((-0.08, 0, 0), (0.08, 0, 0), 0.012, DARK)
    scene.joint(Revolute, "driven", driven, parent="ground", at=(0.4, 0.3, 0), axis=X)
    scene.frame("driven_ball", parent="driven", at=(0, 0.25, 0))
    scene.loop("spatial_four_bar", "rod_end", "driven_ball")


def parallel_gripper(scene: SceneBuilder) -> None:
    """Show two fingers on parallelograms, which stay parallel; the second one mirrors the first."""
    length = 0.1
    palm = box((0.07, 0.2, 0.05), (-0.035, 0, 0), DARK) + disc(0.035, 0.12, (-0.12, 0, 0), X, STEEL)
    _board(scene, 0.0, palm, turn=translation(0, 0, 0.16) @ rotation_z(math.pi / 2))
    for side, sign in (("left", 1), ("right", -1)):
        inner = f"{side}_inner"
        given: dict[str, Any] = {"lower": 0.1, "upper": 1.2}
        if side == "right":
            given = {"position": -scene.position("left_inner")}
        _bar(scene, inner, "board", (0, sign * 0.02), length, 1, BLUE, width=0.022, **given)
        _bar(scene, f"{side}_outer", "board", (0, sign * 0.06), length, 1, BLUE, width=0.022)
        finger = box((0.03, 0.065, 0.03), (0, sign * 0.02, 0.0), ORANGE)
        finger += box((0.13, 0.02, 0.03), (0.05, -sign * 0.01, 0), ORANGE)
        finger += box((0.07, 0.006, 0.03), (0.08, -sign * 0.022, 0), DARK)
        scene.joint(Revolute, f"{side}_finger", finger, parent=inner, at=(length, 0, 0), axis=Z)
        scene.frame(f"{side}_pin", parent=f"{side}_finger", at=(0, sign * 0.04, 0))
        scene.loop(
            f"{side}_parallelogram",
            f"{side}_pin",
            f"{side}_outer_end",
            dependent=(f"{side}_finger", f"{side}_outer"),
            home={f"{side}_finger": -sign * 0.5, f"{side}_outer": sign * 0.5, "left_inner": 0.5},
        )


def scissor_linkage(scene: SceneBuilder) -> None:
    """Show three pairs of crossing bars, which stretch as the lowest one rises."""
    length, stages = 0.36, 3
    ground = box((0.5, 0.03, 0.16), (0.18, -0.035, 0), DARK)
    _board(scene, 0.05, ground)
    _cross(scene, "a0", "board", (0, 0), length, ORANGE, 1, lower=0.15, upper=1.2)
    slide = disc(0.02, 0.06, color=DARK)
    scene.joint(Prismatic, "slide", slide, parent="board", axis=X, lower=0.05, upper=length)
    _cross(scene, "b0", "slide", (0, 0), -length, BLUE, 2)
    home: dict[str, float] = {"bar_a0": 0.5, "bar_b0": -0.5, "slide": 0.88 * length}
    scene.loop("stage_0", "cross_a0", "cross_b0", ("x", "y"), home=home)
    for k in range(1, stages):
        # Where a bar ends, one of the other direction begins.
        _cross(scene, f"a{k}", f"bar_b{k - 1}", (-length, 0), length, ORANGE, 1)
        _cross(scene, f"b{k}", f"bar_a{k - 1}", (length, 0), -length, BLUE, 2)
        home = {f"bar_a{k}": 1.0, f"bar_b{k}": -1.0, "bar_a0": 0.5}
        scene.loop(f"stage_{k}", f"cross_a{k}", f"cross_b{k}", ("x", "y"), home=home)
    scene.frame("tip", sphere(0.03, color=RED), parent=f"bar_a{stages - 1}", at=(length, 0, 0.03))


def delta_robot(scene: SceneBuilder) -> None:
    """Show three motors move a platform that never tilts."""
    base, upper, forearm, platform = 0.16, 0.2, 0.42, 0.06
    frame = disc(0.2, 0.04, (0, 0, 0.03), color=DARK)
    for k in range(3):
        angle = math.tau * (k + 0.5) / 3
        foot = (0.46 * math.cos(angle), 0.46 * math.sin(angle), -0.66)
        top = (0.3 * math.cos(angle), 0.3 * math.sin(angle), 0.03)
        frame += rod(top, foot, 0.014, STEEL) + rod((0, 0, 0.03), top, 0.014, STEEL)
    scene.frame("frame", frame + disc(0.34, 0.02, (0, 0, -0.66), color=WOOD), at=(0, 0, 0.67))
    for name, parent, axis in (("px", "frame", X), ("py", "px", Y)):
        scene.joint(Prismatic, name, parent=parent, axis=axis)
    tool = disc(0.075, 0.02, color=RED) + rod((0, 0, 0), (0, 0, -0.08), 0.012, DARK)
    scene.joint(Prismatic, "platform", tool, parent="py", axis=Z)
    for k in range(3):
        turn = rotation_z(math.tau * k / 3)
        arm = link((0, 0, 0), (upper, 0, 0), Y, BLUE, 0.04, 0.03) + disc(0.035, 0.08, axis=Y, color=DARK)
        place = turn @ translation(base, 0, 0)
        scene.joint(Revolute, f"motor_{k}", arm, parent="frame", at=place, axis=Y, lower=-0.2, upper=0.8)
        scene.joint(
            Revolute, f"swing_{k}", sphere(0.02, color=DARK), parent=f"motor_{k}", at=(upper, 0, 0), axis=Y
        )
        shapes = rod((0, 0, 0), (forearm, 0, 0), 0.012, ORANGE) + sphere(0.02, (forearm, 0, 0), DARK)
        scene.joint(Revolute, f"tilt_{k}", shapes, parent=f"swing_{k}", axis=Z)
        scene.frame(f"end_{k}", parent=f"tilt_{k}", at=(forearm, 0, 0))
        scene.frame(f"joint_{k}", parent="platform", at=turn @ translation(platform, 0, 0))
    scene.loop(
        "delta",
        "end_0",
        "joint_0",
        more=(("end_1", "joint_1"), ("end_2", "joint_2")),
        dependent=("px", "py", "platform", *(f"{j}_{k}" for k in range(3) for j in ("swing", "tilt"))),
        home={"platform": -0.4, "swing_0": 1.9, "swing_1": 1.9, "swing_2": 1.9},
    )


# Lengths of Theo Jansen's linkage.
_JANSEN = {
    "a": 38.0, "b": 41.5, "c": 39.3, "d": 40.1, "e": 55.8, "f": 39.4, "g": 36.7,
    "h": 65.7, "i": 49.0, "j": 50.0, "k": 61.9, "l": 7.8, "m": 15.0,
}  # fmt: skip


def jansen_leg(scene: SceneBuilder) -> None:
    """Show Theo Jansen's leg: one crank, and a foot that walks on a flat path."""
    s = {name: value / 200 for name, value in _JANSEN.items()}
    # The crank rotates at the origin; the other fixed pin is at (-a, -l).
    post = rod((0, 0, -0.06), (0, 0, 0.03), 0.016, DARK) + rod(
        (-s["a"], -s["l"], -0.06), (-s["a"], -s["l"], 0.03), 0.016, DARK
    )
    plate = box((0.3, 0.14, 0.02), (-0.095, -0.02, -0.05), DARK) + box(
        (0.05, 0.5, 0.02), (-0.095, -0.22, -0.06), DARK
    )
    _board(scene, 0.5, post + plate + box((0.7, 0.02, 0.3), (-0.15, -0.48, 0), WOOD))
    _bar(scene, "crank", "board", (0, 0), s["m"], 4, RED)
    scene.frame("pin", parent="board", at=(-s["a"], -s["l"], 0))

    def meeting(
        name: str,
        first: tuple[str, str, int],
        second: tuple[str, str, int],
        home: tuple[float, float],
        color: Rgba,
    ) -> None:
        """Join the ends of two bars, each given by its start, its length and its layer."""
        for k, (start, bar, layer) in enumerate((first, second)):
            _bar(
                scene,
                f"{name}_{k + 1}",
                start,
                (0, 0),
                s[bar],
                layer,
                color,
                end=name if k == 0 else f"{name}_end",
            )
        bars = (f"{name}_1", f"{name}_2")
        scene.loop(name, name, f"{name}_end", home=dict(zip(bars, home, strict=True)), dependent=bars)

    meeting("top", ("pin", "b", 1), ("crank_end", "j", 3), (1.6, 2.5), BLUE)
    meeting("bottom", ("pin", "c", 2), ("crank_end", "k", 1), (-1.7, -2.3), GREEN)
    _triangle(scene, "outer", "top_1", s["b"], s["d"], s["e"], 1, BLUE)
    meeting("knee", ("outer", "f", 2), ("bottom", "g", 3), (-1.5 - 1.6, 2.9 + 1.7), ORANGE)
    _triangle(scene, "foot", "knee_2", s["g"], s["i"], s["h"], 3, ORANGE)
    scene.frame("tip", disc(0.03, 0.05, color=RED), parent="foot", at=(0, 0, 0.06))


def _board(scene: SceneBuilder, height: float, shapes: Shapes, turn: Expression | None = None) -> None:
    """Add the board with its shapes, upright at a height unless a transform is given."""
    upright = translation(0, 0, height) @ rotation_x(math.pi / 2) if turn is None else turn
    scene.frame("board", shapes, at=upright)


def _foot(x: float, height: float) -> Shapes:
    """Return a post below a fixed pin."""
    return box((0.05, height, 0.03), (x, -height / 2, -0.015), DARK) + disc(
        0.014, 0.08, (x, 0, 0.02), color=DARK
    )


def _between(
    length: float, layer: int, color: Rgba, width: float = 0.034, start: Point = (0, 0, 0)
) -> Shapes:
    """Return a bar along x in a layer over the board."""
    x, y, _ = start
    z = 0.022 * layer
    return link((x, y, z), (x + length, y, z), Z, color, width, 0.016)


def _bar(
    scene: SceneBuilder,
    name: str,
    parent: str,
    at: tuple[float, float],
    length: float,
    layer: int,
    color: Rgba,
    *,
    end: str = "",
    width: float = 0.034,
    **limits: Any,
) -> None:
    """Add a bar with a hinge at its start and a frame at its end."""
    shapes = _between(length, layer, color, width)
    scene.joint(Revolute, name, shapes, parent=parent, at=(*at, 0), axis=Z, **limits)
    scene.frame(end or f"{name}_end", parent=name, at=(length, 0, 0))


def _cross(
    scene: SceneBuilder,
    name: str,
    parent: str,
    at: tuple[float, float],
    length: float,
    color: Rgba,
    layer: int,
    **limits: Any,
) -> None:
    """Add a bar of a scissor linkage, with a frame in its middle; to the left for a negative length."""
    start = (min(length, 0.0), 0.0, 0.0)
    shapes = _between(abs(length), layer, color, start=start)
    scene.joint(Revolute, f"bar_{name}", shapes, parent=parent, at=(*at, 0), axis=Z, **limits)
    scene.frame(
        f"cross_{name}",
        disc(0.012, 0.08, (0, 0, 0.033), color=DARK),
        parent=f"bar_{name}",
        at=(length / 2, 0, 0),
    )


def _triangle(
    scene: SceneBuilder, name: str, parent: str, base: float, near: float, far: float, layer: int, color: Rgba
) -> None:
    """Add the third corner of a triangle over a bar, by its distances from the bar's start and end."""
    x = (base**2 + near**2 - far**2) / (2 * base)
    y = math.sqrt(near**2 - x * x)
    z = 0.022 * layer
    # Both edges in the frame of the corner.
    edges = link((-x, -y, z), (0, 0, z), Z, color, 0.034, 0.016) + link(
        (base - x, -y, z), (0, 0, z), Z, color, 0.034, 0.016
    )
    scene.frame(name, edges, parent=parent, at=(x, y, 0))


SCENES = (
    four_bar,
    slider_crank,
    spatial_four_bar,
    parallel_gripper,
    scissor_linkage,
    delta_robot,
    jansen_leg,
)
