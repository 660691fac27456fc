"""Vectors of three numbers in plain Python, for single ones in control loops.

An operation of numpy on three numbers takes many times as long as its arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

Vector: TypeAlias = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


def add(a: Vector, b: Vector, factor: float = 1.0) -> Vector:
    """Return a + factor b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def subtract(a: Vector, b: Vector) -> Vector:
    """Return a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def scale(factor: float, a: Vector) -> Vector:
    """Return a vector times a factor."""
    return factor * a[0], factor * a[1], factor * a[2]


def inner_product(a: Vector, b: Vector) -> float:
    """Return the inner product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross_product(a: Vector, b: Vector) -> Vector:
    """Return the cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def length(a: Vector) -> float:
    """Return the Euclidean length of a vector."""
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


def rotate(R: Sequence[Sequence[float]], a: Vector) -> Vector:
    """Return R a for the first three columns of a matrix with three rows."""
    x, y, z = a
    r, s, t = R[0], R[1], R[2]
    return (r[0] * x + r[1] * y + r[2] * z, s[0] * x + s[1] * y + s[2] * z, t[0] * x + t[1] * y + t[2] * z)


def rotate_back(R: Sequence[Sequence[float]], a: Vector) -> Vector:
    """Return Rᵀ a for the first three columns of a matrix with three rows."""
    return rotate([*zip(*R, strict=True)], a)


def transform_point(pose: Sequence[Sequence[float]], a: Vector) -> Vector:
    """Return a point in the frame in which a pose, three rows of four numbers, is given."""
    return add(rotate(pose, a), (pose[0][3], pose[1][3], pose[2][3]))


def move_point(twist: Sequence[float], point: Vector) -> Vector:
    """Return the velocity of a point of a body with a twist (v, ω) in the world."""
    u, v, w, a, b, c = twist
    x, y, z = point
    return u + b * z - c * y, v + c * x - a * z, w + a * y - b * x
