"""Shapes of the gallery: bars, discs and gears, in a few colours.

Each function returns a tuple of shapes in the frame of their body [m], so that a body is a sum of shapes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.articulations.mechanisms import mechanism
from kineverse.articulations.mechanisms.mechanism import BLUE, DARK, STEEL, WOOD
from kineverse.lie import rotation_z, transform
from kineverse.model.body import Box, Capsule, Cylinder, Geometry, Pose, Rgba, Shape, Sphere, Vector3

__all__ = [
    "BLUE",
    "DARK",
    "GREEN",
    "ORANGE",
    "RED",
    "STEEL",
    "WHITE",
    "WOOD",
    "Point",
    "Shapes",
    "X",
    "Y",
    "Z",
    "arrow",
    "bone",
    "box",
    "disc",
    "gear",
    "link",
    "perpendicular",
    "rod",
    "sphere",
    "wheel",
]

Shapes: TypeAlias = tuple[Shape, ...]
Point: TypeAlias = Sequence[float] | npt.NDArray[np.float64]

ORANGE: Rgba = (0.93, 0.56, 0.17, 1.0)
GREEN: Rgba = (0.35, 0.62, 0.38, 1.0)
WHITE = mechanism.PALE
RED = mechanism.RED
"""Colour of marks that make a rotation visible."""

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)


def box(
    size: Point, at: Point = ORIGIN, color: Rgba = STEEL, *, axis: Point = Z, turn: float = 0.0
) -> Shapes:
    """Return a box with its z along an axis, rotated about it by ``turn`` [rad]."""
    return (_placed(Box(_triple(size)), at, axis, color, turn),)


def disc(radius: float, length: float, at: Point = ORIGIN, axis: Point = Z, color: Rgba = STEEL) -> Shapes:
    """Return a cylinder around an axis, centred at a point."""
    return (_placed(Cylinder(radius, length), at, axis, color),)


def sphere(radius: float, at: Point = ORIGIN, color: Rgba = STEEL) -> Shapes:
    """Return a sphere."""
    return (_placed(Sphere(radius), at, Z, color),)


def rod(start: Point, end: Point, radius: float, color: Rgba = STEEL) -> Shapes:
    """Return a cylinder from one point to another."""
    return (mechanism.rod_shape(_triple(start), _triple(end), radius, color),)


def bone(start: Point, end: Point, radius: float, color: Rgba = STEEL) -> Shapes:
    """Return a capsule between two points, the centres of its ends."""
    axis, middle = np.subtract(end, start), np.add(start, end) / 2
    return (_placed(Capsule(radius, float(np.linalg.norm(axis))), middle, axis, color),)


def link(
    start: Point,
    end: Point,
    axis: Point = Z,
    color: Rgba = STEEL,
    width: float = 0.04,
    thickness: float = 0.02,
) -> Shapes:
    """Return a flat bar with round ends between two pins along an axis, and the pins."""
    bar, middle = np.subtract(end, start), np.add(start, end) / 2
    along, normal = bar / np.linalg.norm(bar), np.asarray(axis) / np.linalg.norm(axis)
    turn = np.column_stack([along, np.cross(normal, along), normal])
    plate = Box((float(np.linalg.norm(bar)), width, thickness))
    return (
        Shape(plate, _pose(turn, middle), color=color),
        *disc(width / 2, thickness, start, axis, color),
        *disc(width / 2, thickness, end, axis, color),
        *disc(width / 4, 1.4 * thickness, start, axis, DARK),
        *disc(width / 4, 1.4 * thickness, end, axis, DARK),
    )


def gear(
    radius: float, teeth: int, thickness: float, at: Point = ORIGIN, axis: Point = Z, color: Rgba = STEEL
) -> Shapes:
    """Return a gear of a pitch radius; its first tooth, in direction :func:`perpendicular`, has a mark."""
    size = math.pi * radius / teeth
    turn = _frame(axis)
    shapes = disc(radius - 0.5 * size, thickness, at, axis, color)
    shapes += disc(0.22 * radius, 1.5 * thickness, at, axis, DARK)
    for k in range(teeth):
        angle = math.tau * k / teeth
        out = turn @ [math.cos(angle), math.sin(angle), 0.0]
        tooth = box(
            (1.3 * size, 0.9 * size, thickness), np.add(at, radius * out), color, axis=axis, turn=angle
        )
        shapes += tooth
    mark = np.add(at, turn @ [0.68 * radius, 0.0, 0.5 * thickness])
    return shapes + disc(0.12 * radius, 0.2 * thickness, mark, axis, RED)


def wheel(radius: float, width: float, axis: Point = Y, at: Point = ORIGIN) -> Shapes:
    """Return a wheel with a hub and a red spoke on either side."""
    turn = _frame(axis)
    shapes = disc(radius, width, at, axis, DARK) + disc(0.62 * radius, 1.06 * width, at, axis, WHITE)
    spoke = np.add(at, turn @ [0.31 * radius, 0.0, 0.0])
    return shapes + box((0.62 * radius, 0.14 * radius, 1.14 * width), spoke, RED, axis=axis)


def arrow(length: float, height: float, at: Point = ORIGIN, color: Rgba = RED) -> Shapes:
    """Return a flat arrow along x, centred at a point."""
    x, y, z = at
    shaft = box((0.7 * length, 0.14 * length, height), (x - 0.1 * length, y, z), color)
    tips: Shapes = ()
    for side in (1, -1):
        tip = (x + 0.33 * length, y + side * 0.12 * length, z)
        tips += box((0.42 * length, 0.14 * length, height), tip, color, turn=-side * 0.8)
    return shaft + tips


def perpendicular(axis: Point) -> tuple[float, float, float]:
    """Return the direction of angle 0 about an axis in this module."""
    x, y, z = _frame(axis)[:, 0].tolist()
    return x, y, z


def _triple(point: Point) -> Vector3:
    x, y, z = map(float, point)
    return x, y, z


def _placed(geometry: Geometry, at: Point, axis: Point, color: Rgba, turn: float = 0.0) -> Shape:
    return Shape(geometry, _pose(_frame(axis) @ rotation_z(np.asarray(turn)), at), color=color)


def _frame(axis: Point) -> npt.NDArray[np.float64]:
    """Return a rotation whose last column is along an axis; a cyclic permutation for x, y and z."""
    n = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    if abs(n[2]) > 0.9 or abs(n[1]) > 0.9:
        first = np.array([1.0, 0.0, 0.0])
    else:
        first = np.array([0.0, 1.0, 0.0])
    first = first - (first @ n) * n
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(n, first), n])


def _pose(rotation: npt.NDArray[np.float64], at: Point) -> Pose:
    return Pose.from_matrix(transform(rotation, np.asarray(at, dtype=float)))
