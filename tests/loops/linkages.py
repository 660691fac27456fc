"""Linkages with closed loops, for the tests."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

import kineverse as kv

Z, Y, X = (0, 0, 1), (0, 1, 0), (1, 0, 0)


def at(x: float, y: float = 0.0, z: float = 0.0) -> kv.Pose:
    return kv.Pose.of(kv.translation(x, y, z))


def bar(edit: kv.Edit, name: str, parent: str, origin: kv.Pose, axis: Any = Z, **limits: Any) -> None:
    edit.apply(kv.Revolute(name=name, parent=parent, child=name, origin=origin, axis=axis, **limits))


def four_bar(
    crank=0.4, coupler=1.1, rocker=0.9, ground=1.0, *, limits=None, close=True, **options
) -> kv.Model:
    """Return crank and rocker on the ground, with a coupler between them."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", at(0), **(limits or {}))
        bar(edit, "coupler", "crank", at(crank))
        edit.add_frame("coupler_tip", "coupler", kv.translation(coupler, 0, 0))
        bar(edit, "rocker", "world", at(ground))
        edit.add_frame("rocker_tip", "rocker", kv.translation(rocker, 0, 0))
        if close:
            edit.close_loop("coupler_tip", "rocker_tip", name="four-bar", **options)
    return model


def limited_four_bar() -> kv.Model:
    """Return a four-bar whose rocker has limits, of speed as well, and a constraint about all three."""
    crank, coupler, rocker = (kv.position(n) for n in ("crank", "coupler", "rocker"))
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", at(0))
        bar(edit, "coupler", "crank", at(0.4))
        edit.add_frame("coupler_tip", "coupler", kv.translation(1.1, 0, 0))
        bar(edit, "rocker", "world", at(1.0), lower=1.0, upper=2.0, velocity=0.5)
        edit.add_frame("rocker_tip", "rocker", kv.translation(0.9, 0, 0))
        edit.constrain("coupler/beside", -3, coupler - 2 * crank, rocker)
        edit.close_loop("coupler_tip", "rocker_tip", name="four-bar")
    return model


def four_bar_by_circles(crank: float, a=0.4, b=1.1, c=0.9, d=1.0, side=1) -> np.ndarray:
    """Return where coupler and rocker meet: the intersection of two circles."""
    p, q = np.array([a * math.cos(crank), a * math.sin(crank)]), np.array([d, 0.0])
    way = q - p
    distance = np.linalg.norm(way)
    along = (b * b - c * c + distance * distance) / (2 * distance)
    across = math.sqrt(b * b - along * along)
    return p + along * way / distance + side * across * np.array([-way[1], way[0]]) / distance


def slider_crank(crank=0.1, rod=0.3, **options) -> kv.Model:
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "crank", "world", at(0))
        bar(edit, "rod", "crank", at(crank))
        edit.add_frame("rod_end", "rod", kv.translation(rod, 0, 0))
        edit.apply(kv.Prismatic(name="piston", parent="world", child="piston", axis=X))
        edit.close_loop("rod_end", "piston", name="slider-crank", home={"piston": crank + rod}, **options)
    return model


def spatial_four_bar() -> kv.Model:
    """Return two hinges with different axes and a rod with a ball at either end."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "drive", "world", at(0), Z)
        edit.add_frame("drive_ball", "drive", kv.translation(0.1, 0, 0))
        bar(edit, "rod_a", "drive_ball", at(0), Z)
        bar(edit, "rod_b", "rod_a", at(0), Y)
        edit.add_frame("rod_end", "rod_b", kv.translation(0.55, 0, 0))
        bar(edit, "driven", "world", at(0.4, 0.3, 0), X)
        edit.add_frame("driven_ball", "driven", kv.translation(0, 0.25, 0))
        edit.close_loop("rod_end", "driven_ball", name="rod")
    return model


def parallel_gripper() -> kv.Model:
    """Return two fingers on parallelograms, the second of which mirrors the first."""
    model = kv.Model()
    with model.edit() as edit:
        for side, sign in (("left", 1), ("right", -1)):
            position = {} if side == "left" else {"position": -kv.position("left_inner")}
            limits = {"lower": 0.1, "upper": 1.2} if side == "left" else {}
            bar(edit, f"{side}_inner", "world", at(0, sign * 0.02), **limits, **position)
            bar(edit, f"{side}_outer", "world", at(0, sign * 0.05))
            bar(edit, f"{side}_finger", f"{side}_inner", at(0.08))
            edit.add_frame(f"{side}_tip", f"{side}_finger", kv.translation(0.06, -sign * 0.02, 0))
            edit.add_frame(f"{side}_pin", f"{side}_finger", kv.translation(0, sign * 0.03, 0))
            edit.add_frame(f"{side}_outer_end", f"{side}_outer", kv.translation(0.08, 0, 0))
            edit.close_loop(
                f"{side}_pin",
                f"{side}_outer_end",
                dependent=(f"{side}_finger", f"{side}_outer"),
                home={f"{side}_finger": -sign * 0.5, f"{side}_outer": sign * 0.5, "left_inner": 0.5},
                name=side,
            )
    return model


def scissor_lift(stages: int = 3, length: float = 0.5) -> kv.Model:
    """Return crossing bars: at the bottom one end slides, and so up to the platform."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "bar_a0", "world", at(0), (0, -1, 0), lower=0.15, upper=1.3)
        edit.apply(
            kv.Prismatic(name="slide", parent="world", child="slide", axis=X, lower=0.05, upper=length)
        )
        bar(edit, "bar_b0", "slide", at(0), Y)
        edit.add_frame("cross_a0", "bar_a0", kv.translation(length / 2, 0, 0))
        edit.add_frame("cross_b0", "bar_b0", kv.translation(-length / 2, 0, 0))
        edit.close_loop(
            "cross_a0", "cross_b0", ("x", "z"), home={"bar_a0": 0.5, "bar_b0": 0.5, "slide": 0.44}
        )
        for i in range(1, stages):
            # Where a bar ends, one of the other direction begins.
            bar(edit, f"bar_a{i}", f"bar_b{i - 1}", at(-length), (0, -1, 0))
            bar(edit, f"bar_b{i}", f"bar_a{i - 1}", at(length), Y)
            edit.add_frame(f"cross_a{i}", f"bar_a{i}", kv.translation(length / 2, 0, 0))
            edit.add_frame(f"cross_b{i}", f"bar_b{i}", kv.translation(-length / 2, 0, 0))
            edit.close_loop(
                f"cross_a{i}",
                f"cross_b{i}",
                ("x", "z"),
                home={f"bar_a{i}": 1.0, f"bar_b{i}": 1.0, "bar_a0": 0.5},
            )
        edit.add_frame("platform", f"bar_a{stages - 1}", kv.translation(length, 0, 0))
    return model


def desk_lamp() -> kv.Model:
    """Return two parallelograms on one another: the head keeps its direction."""
    model = kv.Model()
    with model.edit() as edit:
        base, height = "world", 0.0
        for arm, length in (("lower", 0.4), ("upper", 0.35)):
            bar(edit, f"{arm}_front", base, at(0.03, 0, height), Y, lower=-1.0, upper=1.0)
            bar(edit, f"{arm}_back", base, at(-0.03, 0, height), Y)
            bar(edit, f"{arm}_link", f"{arm}_front", at(0, 0, length), Y)
            edit.add_frame(f"{arm}_pin", f"{arm}_link", kv.translation(-0.06, 0, 0))
            edit.add_frame(f"{arm}_end", f"{arm}_back", kv.translation(0, 0, length))
            edit.close_loop(f"{arm}_pin", f"{arm}_end", ("x", "z"), name=arm)
            edit.add_frame(f"{arm}_top", f"{arm}_link", kv.translation(-0.03, 0, 0))
            base, height = f"{arm}_top", 0.05
        edit.add_frame("head", base, kv.translation(0.1, 0, 0))
    return model


def folding_door() -> kv.Model:
    """Return the cupboard's door, a four-bar in x and z."""
    model = kv.Model()
    with model.edit() as edit:
        bar(edit, "door", "world", at(-0.18562, 0, 0.34566), Y, lower=0.0, upper=1.84)
        bar(edit, "between", "door", at(-0.00039, 0, -0.37012), Y)
        edit.add_frame("lower_panel", "between", kv.translation(0.0031, 0, -0.15621))
        edit.add_frame("handle", "lower_panel", kv.translation(-0.008, 0, -0.0985))
        edit.add_frame("pivot", "between", kv.translation(0.0671, 0, -0.17871))
        bar(edit, "arm", "world", at(-0.085, 0, 0.168), Y)
        edit.add_frame("arm_end", "arm", kv.translation(0, 0, -0.372))
        edit.close_loop("pivot", "arm_end", ("x", "z"), name="folding door", home={"between": 0.009})
    return model


BASE, UPPER, FOREARM, PLATFORM = 0.2, 0.2, 0.45, 0.05


def delta_robot() -> kv.Model:
    """Return three driven arms that carry a platform, which keeps its direction."""
    model = kv.Model()
    with model.edit() as edit:
        for name, parent, axis in (("px", "world", X), ("py", "px", Y), ("platform", "py", Z)):
            edit.apply(kv.Prismatic(name=name, parent=parent, child=name, axis=axis))
        for i in range(3):
            turn = kv.rotation_z(2 * math.pi * i / 3)
            where = kv.Pose.of(turn @ kv.translation(BASE, 0, 0))
            bar(edit, f"motor_{i}", "world", where, Y, lower=-0.2, upper=0.8)
            bar(edit, f"swing_{i}", f"motor_{i}", at(UPPER), Y)
            bar(edit, f"tilt_{i}", f"swing_{i}", at(0), Z)
            edit.add_frame(f"end_{i}", f"tilt_{i}", kv.translation(FOREARM, 0, 0))
            edit.add_frame(f"joint_{i}", "platform", turn @ kv.translation(PLATFORM, 0, 0))
        edit.close_loop(
            "end_0",
            "joint_0",
            name="delta",
            more=(("end_1", "joint_1"), ("end_2", "joint_2")),
            dependent=("px", "py", "platform", *(f"{j}_{i}" for i in range(3) for j in ("swing", "tilt"))),
            home={"platform": -0.4, "swing_0": 1.9, "swing_1": 1.9, "swing_2": 1.9},
        )
    return model


def delta_by_spheres(motors: np.ndarray) -> np.ndarray:
    """Return where the platform is: the lower intersection of three spheres."""
    centres = []
    for i, q in enumerate(motors):
        angle = 2 * math.pi * i / 3
        reach = BASE + UPPER * math.cos(q) - PLATFORM
        centres.append([reach * math.cos(angle), reach * math.sin(angle), -UPPER * math.sin(q)])
    c = np.array(centres)
    ex = (c[1] - c[0]) / np.linalg.norm(c[1] - c[0])
    i = ex @ (c[2] - c[0])
    ey = c[2] - c[0] - i * ex
    ey /= np.linalg.norm(ey)
    d, j = np.linalg.norm(c[1] - c[0]), ey @ (c[2] - c[0])
    x, y = d / 2, (i * i + j * j) / (2 * j) - i / j * d / 2
    z = math.sqrt(FOREARM**2 - x * x - y * y)
    ez = np.cross(ex, ey)
    return c[0] + x * ex + y * ey - math.copysign(z, ez[2]) * ez


# Theo Jansen's numbers for the leg of a beach animal.
JANSEN = dict(  # noqa: C408
    a=38.0, b=41.5, c=39.3, d=40.1, e=55.8, f=39.4, g=36.7, h=65.7, i=49.0, j=50.0, k=61.9, l=7.8, m=15.0
)


def jansen_leg() -> kv.Model:
    """Return the leg: four loops, each on what the ones before determine, driven by one crank."""
    s = {name: value / 100 for name, value in JANSEN.items()}
    model = kv.Model()
    with model.edit() as edit:
        # The crank turns at the origin, the fixed pin is at (-a, -l).
        bar(edit, "crank", "world", at(0))
        edit.add_frame("crank_pin", "crank", kv.translation(s["m"], 0, 0))
        edit.add_frame("fixed_pin", "world", kv.translation(-s["a"], -s["l"], 0))

        def two_bars(name, start, first, end, second, home):
            """Let two bars meet; the first is a frame to build on."""
            bar(edit, f"{name}_1", start, at(0))
            edit.add_frame(f"{name}", f"{name}_1", kv.translation(s[first], 0, 0))
            bar(edit, f"{name}_2", end, at(0))
            edit.add_frame(f"{name}_end", f"{name}_2", kv.translation(s[second], 0, 0))
            edit.close_loop(
                name, f"{name}_end", name=name, home={f"{name}_1": home[0], f"{name}_2": home[1]},
                dependent=(f"{name}_1", f"{name}_2"),
            )  # fmt: skip

        two_bars("top", "fixed_pin", "b", "crank_pin", "j", (1.6, 2.5))
        two_bars("bottom", "fixed_pin", "c", "crank_pin", "k", (-1.7, -2.3))
        # The triangle on bar b, then the parallelogram, then the foot.
        edit.add_frame("outer", "top_1", _triangle(s["b"], s["d"], s["e"]))
        two_bars("knee", "outer", "f", "bottom", "g", (-1.5 - 1.6, 2.9 + 1.7))
        edit.add_frame("foot", "knee_2", _triangle(s["g"], s["i"], s["h"]))
    return model


def _triangle(base: float, near: float, far: float) -> kv.Expression:
    """Return the third corner over a base along x, left of it, at distances from its begin and end."""
    x = (base**2 + near**2 - far**2) / (2 * base)
    return kv.translation(x, math.sqrt(near**2 - x * x), 0)


GALLERY = {
    "four-bar": four_bar,
    "slider-crank": slider_crank,
    "spatial four-bar": spatial_four_bar,
    "parallel gripper": parallel_gripper,
    "scissor lift": scissor_lift,
    "desk lamp": desk_lamp,
    "folding door": folding_door,
    "delta robot": delta_robot,
    "Jansen leg": jansen_leg,
}
