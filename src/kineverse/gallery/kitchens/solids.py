"""Solids of furniture: boxes and rods of a material, and the bodies that they make up."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.articulations.mechanisms.simple_bodies import box_shape, rod_shape, shift
from kineverse.model.body import Body, Box, Cylinder, Inertia, Rgba, Shape, Vector3

Span: TypeAlias = tuple[float, float]
"""Ends of a range along an axis [m]."""


@dataclass(frozen=True, slots=True)
class Material:
    """Colour and density [kg/m³]."""

    color: Rgba
    density: float


STEEL = Material((0.74, 0.76, 0.78, 1.0), 450.0)
BAR = Material((0.62, 0.64, 0.66, 1.0), 2700.0)
BLACK_BAR = Material((0.13, 0.13, 0.14, 1.0), 2700.0)
BRASS_BAR = Material((0.78, 0.63, 0.36, 1.0), 2700.0)
GLASS = Material((0.06, 0.07, 0.09, 1.0), 1200.0)
ENAMEL = Material((0.16, 0.17, 0.19, 1.0), 900.0)
FOAM = Material((0.95, 0.97, 0.98, 1.0), 60.0)
PLINTH = Material((0.23, 0.24, 0.26, 1.0), 680.0)
BOARD = Material((0.93, 0.92, 0.89, 1.0), 680.0)
BIRCH = Material((0.87, 0.77, 0.62, 1.0), 620.0)
PLASTER = Material((0.90, 0.88, 0.84, 1.0), 900.0)
CLEAR = Material((0.80, 0.86, 0.90, 0.25), 2500.0)
TILE = Material((0.78, 0.84, 0.81, 1.0), 2000.0)
FLOOR = Material((0.66, 0.60, 0.53, 1.0), 1500.0)


@dataclass(frozen=True, slots=True)
class MaterialShape:
    """Shape of a material."""

    shape: Shape
    density: float


def slab(x: Span, y: Span, z: Span, material: Material) -> MaterialShape:
    """Return a box between the ends of three ranges [m]."""
    ends = (x, y, z)
    # Micrometres: equal dimensions are equal numbers, whatever was added to get them.
    a, b, c = (round(high - low, 6) for low, high in ends)
    p, q, r = (round((low + high) / 2, 7) for low, high in ends)
    return MaterialShape(box_shape((a, b, c), (p, q, r), material.color), material.density)


def cylinder_between(start: Vector3, end: Vector3, radius: float, material: Material) -> MaterialShape:
    """Return a cylinder from one point to another [m]."""
    return MaterialShape(rod_shape(start, end, radius, material.color), material.density)


def open_box(x: Span, y: Span, z: Span, wall: float, material: Material, opening: str) -> list[MaterialShape]:
    """Return the five walls of a box that is open towards ``"+x"`` or ``"+z"`` [m]."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    inner = (y0 + wall, y1 - wall)
    walls = [slab(x, (y0, y0 + wall), z, material), slab(x, (y1 - wall, y1), z, material)]
    walls.append(slab((x0, x0 + wall), inner, z, material))
    if opening == "+z":
        walls.append(slab((x1 - wall, x1), inner, z, material))
        walls.append(slab((x0 + wall, x1 - wall), inner, (z0, z0 + wall), material))
    else:
        walls += [slab((x0 + wall, x1), inner, ends, material) for ends in ((z0, z0 + wall), (z1 - wall, z1))]
    return walls


def furniture_body(solids: Iterable[MaterialShape], decoration: Iterable[MaterialShape] = ()) -> Body:
    """Return the body of solids: shapes for the eye and for collisions, and the inertia."""
    solids = tuple(solids)
    return Body(
        visuals=tuple(s.shape for s in (*solids, *decoration)),
        collisions=tuple(Shape(s.shape.geometry, s.shape.origin) for s in solids),
        inertia=compute_inertia(solids),
    )


def compute_inertia(solids: Iterable[MaterialShape]) -> Inertia:
    """Return mass and inertia of boxes and cylinders: the parallel axis theorem, Σ I + m (|d|² E - d dᵀ)."""
    parts = [(*_mass_and_tensor(s), s.shape.origin.matrix) for s in solids]
    mass = sum(m for m, _, _ in parts)
    center: npt.NDArray[np.float64] = np.sum([m * pose[:3, 3] for m, _, pose in parts], axis=0) / mass
    tensor = np.zeros((3, 3))
    for m, own, pose in parts:
        d = pose[:3, 3] - center
        tensor += pose[:3, :3] @ own @ pose[:3, :3].T + m * (d @ d * np.eye(3) - np.outer(d, d))
    xx, xy, xz, yy, yz, zz = (float(f"{tensor[i, j]:.6g}") for i in range(3) for j in range(i, 3))
    x, y, z = (round(float(c), 6) for c in center)
    return Inertia(float(f"{mass:.6g}"), (xx, xy, xz, yy, yz, zz), shift(x, y, z))


def _mass_and_tensor(solid: MaterialShape) -> tuple[float, npt.NDArray[np.float64]]:
    """Return the mass [kg], and the inertia about the centre in axes of the shape [kg m²]."""
    geometry = solid.shape.geometry
    if isinstance(geometry, Cylinder):
        r, length = geometry.radius, geometry.length
        mass = solid.density * np.pi * r**2 * length
        across = mass * (3 * r**2 + length**2) / 12
        return mass, np.diag([across, across, mass * r**2 / 2])
    assert isinstance(geometry, Box)
    a, b, c = geometry.size
    mass = solid.density * a * b * c
    return mass, mass / 12 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
