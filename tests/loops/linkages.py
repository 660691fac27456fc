"""Linkages with closed loops, for the tests: those of the gallery, and others whose sizes and options vary."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from scenes import build_scene

import kineverse as kv

Z, Y, X = (0, 0, 1), (0, 1, 0), (1, 0, 0)


def at(x: float, y: float = 0.0, z: float = 0.0) -> kv.model.Pose:
    return kv.model.Pose.from_matrix(kv.translation(x, y, z))


def bar(
    edit: kv.model.Edit, name: str, parent: str, origin: kv.model.Pose, axis: Any = Z, **limits: Any
) -> None:
    edit.apply(kv.Revolute(name=name, parent=parent, child=name, origin=origin, axis=axis, **limits))


def scene(name: str) -> kv.Model:
    """Return a scene of the gallery, without a prefix."""
    return build_scene(name)


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


BASE, UPPER, FOREARM, PLATFORM = 0.16, 0.2, 0.42, 0.06


def delta_by_spheres(motors: np.ndarray) -> np.ndarray:
    """Return where the platform is: the lower intersection of three spheres."""
    centres = []
    for i, q in enumerate(motors):
        angle, reach = 2 * math.pi * i / 3, BASE + UPPER * math.cos(q) - PLATFORM
        centres.append([reach * math.cos(angle), reach * math.sin(angle), -UPPER * math.sin(q)])
    c = np.array(centres)
    ex = (c[1] - c[0]) / np.linalg.norm(c[1] - c[0])
    i = ex @ (c[2] - c[0])
    ey = c[2] - c[0] - i * ex
    ey /= np.linalg.norm(ey)
    d, j = np.linalg.norm(c[1] - c[0]), ey @ (c[2] - c[0])
    x, y = d / 2, (i * i + j * j) / (2 * j) - i / j * d / 2
    z, ez = math.sqrt(FOREARM**2 - x * x - y * y), np.cross(ex, ey)
    return c[0] + x * ex + y * ey - math.copysign(z, ez[2]) * ez


GALLERY = {
    "four-bar": four_bar,
    "slider-crank": slider_crank,
    "spatial four-bar": partial(scene, "spatial_four_bar"),
    "parallel gripper": partial(scene, "parallel_gripper"),
    "scissor lift": partial(scene, "scissor_linkage"),
    "desk lamp": desk_lamp,
    "folding door": folding_door,
    "delta robot": partial(scene, "delta_robot"),
    "Jansen leg": partial(scene, "jansen_leg"),
}
