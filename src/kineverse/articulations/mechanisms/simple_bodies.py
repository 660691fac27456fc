"""Boxes, rods and panels for the bodies of mechanisms."""

from __future__ import annotations

import math

import numpy as np

from kineverse.articulations.multi_axis import rotation_from_z
from kineverse.model.body import Body, Box, Cylinder, Pose, Rgba, Shape, Vector3

WOOD: Rgba = (0.72, 0.53, 0.34, 1.0)
PALE: Rgba = (0.90, 0.88, 0.84, 1.0)
STEEL: Rgba = (0.62, 0.65, 0.69, 1.0)
DARK: Rgba = (0.22, 0.24, 0.27, 1.0)
RED: Rgba = (0.80, 0.22, 0.18, 1.0)
BLUE: Rgba = (0.20, 0.42, 0.70, 1.0)
YELLOW: Rgba = (0.95, 0.77, 0.20, 1.0)


def box_shape(size: Vector3, at: Vector3, color: Rgba) -> Shape:
    """Return a box with its centre at a point [m]."""
    return Shape(Box(size), shift(*at), color=color)


def rod_shape(start: Vector3, end: Vector3, radius: float, color: Rgba) -> Shape:
    """Return a cylinder from one point to another [m]."""
    along = np.subtract(end, start)
    pose = rotation_from_z((float(along[0]), float(along[1]), float(along[2])))
    pose[:3, 3] = np.add(start, end) / 2
    return Shape(Cylinder(radius, math.dist(start, end)), Pose.from_matrix(pose), color=color)


def panel(width: float, height: float, thickness: float, color: Rgba) -> Shape:
    """Return a panel on the plane z = 0 that reaches from a hinge along z to y = width [m]."""
    return box_shape((thickness, width, height), (0.0, width / 2, height / 2), color)


def case(size: Vector3, wall: float, color: Rgba, at: Vector3 = (0.0, 0.0, 0.0)) -> tuple[Shape, ...]:
    """Return the five walls of a box that is centred at a point and open towards -x [m]."""
    depth, width, height = size
    x, y, z = at
    return (
        box_shape((wall, width, height), (x + depth / 2 - wall / 2, y, z), color),
        *(box_shape((depth, wall, height), (x, y + side * (width - wall) / 2, z), color) for side in (-1, 1)),
        *(box_shape((depth, width, wall), (x, y, z + side * (height - wall) / 2), color) for side in (-1, 1)),
    )


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    """Return a translation [m]."""
    return Pose((1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z))


def solid_body(shapes: tuple[Shape, ...]) -> Body:
    """Return a body whose visual shapes are its collision shapes."""
    return Body(shapes, tuple(Shape(shape.geometry, shape.origin) for shape in shapes))
