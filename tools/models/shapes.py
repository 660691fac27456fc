"""Shapes to build a model from, and the ways to say where they are. Lengths in [m], angles in [rad]."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import atan2, hypot

Vector = tuple[float, float, float]
Span = tuple[float, float]
ZERO: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Material:
    """A colour and a density [kg/m^3]."""

    rgba: tuple[float, float, float, float]
    density: float


@dataclass(frozen=True)
class Shape:
    """A box (size), cylinder (radius, length along z) or sphere (radius) in the frame of its link."""

    kind: str
    size: tuple[float, ...]
    at: Vector
    material: str
    rpy: Vector = ZERO
    seen: bool = True
    collides: bool = True


def slab(x: Span, y: Span, z: Span, material: str, **flags: bool) -> Shape:
    """Return the box between these bounds."""
    size = (x[1] - x[0], y[1] - y[0], z[1] - z[0])
    if min(size) <= 0:
        raise ValueError(f"empty slab {x} {y} {z}")
    return Shape("box", size, ((x[0] + x[1]) / 2, (y[0] + y[1]) / 2, (z[0] + z[1]) / 2), material, **flags)


def rounded_slab(x: Span, y: Span, z: Span, radius: float, material: str) -> list[Shape]:
    """Return a box with round vertical edges to look at and a plain box to collide with."""
    inner_x, inner_y = (x[0] + radius, x[1] - radius), (y[0] + radius, y[1] - radius)
    seen = [slab(x, inner_y, z, material)]
    seen += [slab(inner_x, side, z, material) for side in ((y[0], inner_y[0]), (inner_y[1], y[1]))]
    seen += [rod((a, b, z[0]), (a, b, z[1]), radius, material) for a in inner_x for b in inner_y]
    return [*for_the_eye(seen), slab(x, y, z, material, seen=False)]


def box(size: Vector, at: Vector, material: str, rpy: Vector = ZERO) -> Shape:
    """Return a box about `at`, turned by `rpy`."""
    return Shape("box", size, at, material, rpy)


def sphere(radius: float, at: Vector, material: str) -> Shape:
    """Return a sphere about `at`."""
    return Shape("sphere", (radius,), at, material)


def rod(start: Vector, end: Vector, radius: float, material: str) -> Shape:
    """Return the cylinder from `start` to `end`."""
    d = tuple(b - a for a, b in zip(start, end, strict=True))
    middle = tuple((a + b) / 2 for a, b in zip(start, end, strict=True))
    if d[0] == 0:
        rpy = (atan2(-d[1], d[2]), 0.0, 0.0)
    else:
        rpy = (0.0, atan2(hypot(d[0], d[1]), d[2]), atan2(d[1], d[0]))
    return Shape("cylinder", (radius, hypot(*d)), middle, material, rpy)


def disc(at: Vector, axis: str, width: float, radius: float, material: str) -> Shape:
    """Return the cylinder of this width about `at`, along "x", "y" or "z"."""
    half = tuple(width / 2 if name == axis else 0.0 for name in "xyz")
    start = tuple(a - h for a, h in zip(at, half, strict=True))
    end = tuple(a + h for a, h in zip(at, half, strict=True))
    return rod(start, end, radius, material)


def pipe(points: Sequence[Vector], radius: float, material: str) -> list[Shape]:
    """Return rods through `points`, with a ball of the same radius at each of them for the eye."""
    rods = [rod(a, b, radius, material) for a, b in pairwise(points)]
    return rods + for_the_eye(sphere(radius, p, material) for p in points)


def for_the_eye(shapes: Iterable[Shape]) -> list[Shape]:
    """Return the shapes for the eye only."""
    return [replace(shape, collides=False) for shape in shapes]


def mirrored(shapes: Iterable[Shape]) -> list[Shape]:
    """Return the shapes reflected in the x-z plane."""
    return [replace(s, at=(s.at[0], -s.at[1], s.at[2]), rpy=(-s.rpy[0], s.rpy[1], -s.rpy[2])) for s in shapes]
