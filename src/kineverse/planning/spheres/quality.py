"""Measures of how well spheres cover a solid, for covers of any origin."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.geometry.mesh_files import Floats
from kineverse.geometry.shapes import Solid, import_coal

from .certificate import distances, find_uncovered
from .polytope import CoverRegion, bound_solid
from .union_volume import union_volume

_ACCURACY, _FINENESS = 2e-3, 0.01


class CoverQuality(NamedTuple):
    """Quality of a cover.

    Attributes
    ----------
    excess
        Volume of the union of the spheres over that of the solid, minus 1.
    protrusion
        Largest distance of a point of a sphere from the solid [m]; 0 if all spheres lie inside.
    uncovered
        Largest distance of a point of the solid from all spheres [m]; 0 if they cover it.
    """

    excess: float
    protrusion: float
    uncovered: float


def measure_cover(solid: Solid, centres: npt.ArrayLike, radii: npt.ArrayLike) -> CoverQuality:
    """Return the quality of spheres as a cover of a convex solid.

    Lengths are exact to some 0.2 % of the radius of the solid, 2 % for ellipsoids and capsules, and excess
    volumes to some parts in a thousand.

    Parameters
    ----------
    solid
        The solid.
    centres, radii
        (N, 3) and (N,) in the frame of the solid [m].

    Raises
    ------
    ShapeError
        If the arrays have other shapes.
    InvalidValueError
        For a triangle mesh, which has no inside, and for radii that are not positive.
    """
    where, sizes = np.asarray(centres, dtype=float), np.asarray(radii, dtype=float)
    if where.ndim != 2 or where.shape[1] != 3 or sizes.shape != where.shape[:1] or not len(sizes):
        raise ShapeError(f"Spheres have centres (N, 3) and radii (N,), not {where.shape} and {sizes.shape}.")
    if not (np.isfinite(where).all() and np.isfinite(sizes).all() and (sizes > 0.0).all()):
        raise InvalidValueError("Spheres have finite centres and positive radii.")
    polytope = bound_solid(solid, _FINENESS * solid.radius)
    region = CoverRegion([polytope])
    missed = find_uncovered(region, where, sizes, _ACCURACY * solid.radius).points
    gaps = (distances(missed, where) - sizes).min(axis=1) if len(missed) else np.zeros(1)
    depths = region.depths(where)
    for k in np.flatnonzero(depths < 0.0).tolist():
        depths[k] = -_distance_from(solid, where[k])
    return CoverQuality(
        union_volume(where, sizes) / polytope.volume - 1.0,
        max(float((sizes - depths).max()), 0.0),
        max(float(gaps.max()), 0.0),
    )


def _distance_from(solid: Solid, point: Floats) -> float:
    """Return the distance of a point (3,) from a solid [m], 0 inside."""
    coal = import_coal()
    result = coal.DistanceResult()
    # A sphere of no size is a point.
    coal.distance(
        solid.engine,
        coal.Transform3s.Identity(),
        coal.Sphere(1e-9),
        coal.Transform3s(np.eye(3), np.array(point)),
        coal.DistanceRequest(),
        result,
    )
    return max(float(result.min_distance) + 1e-9, 0.0)
