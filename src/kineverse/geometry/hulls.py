"""Convex hulls of points, also of points that lie in a plane."""

from __future__ import annotations

from typing import Any

import numpy as np

from kineverse.errors import ValueRejectedError

from .mesh_files import Floats

SMALLEST, GREATEST = 1e-6, 1e6
"""A mesh smaller or larger than this is a mistake in its unit or scale [m]."""

THICKNESS = 2e-5
"""What is thinner than this is made so thick: 20 µm, or 1e-5 of its size if that is more [m]."""


def hull(points: Floats) -> Any:
    """Return the convex hull of (N, 3) points [m] as a ``coal.Convex``.

    Hulls without volume make the algorithms fail, so a flat one, as of a pane of glass, is given
    :data:`THICKNESS`, half of it on each side.

    Raises
    ------
    ValueRejectedError
        If the points are too close together or too far apart, lie on a line, or are not finite.
    """
    import coal

    solid = with_thickness(points)
    vector = coal.StdVec_Vec3s()
    for point in solid:
        vector.append(point)
    try:
        return coal.Convex.convexHull(vector, True, "Qt")
    except Exception as error:  # What qhull says is pages long.
        raise ValueRejectedError("qhull finds no convex hull of its points.") from error


def with_thickness(points: Floats) -> Floats:
    """Return the points, or if they are flat, twice as many that are not; see :func:`hull`."""
    check_extent(points)
    unique = np.unique(points, axis=0)
    centred = unique - unique.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2] if len(unique) > 2 else np.eye(3)
    size, width, thickness = np.ptp(centred @ axes.T, axis=0).tolist() if len(axes) == 3 else (0.0, 0.0, 0.0)
    least = max(THICKNESS, 1e-5 * size)
    if len(unique) < 3 or width < least:
        raise ValueRejectedError("all its points lie on a line, so that there is nothing to touch.")
    if thickness >= least:
        return unique
    normal = axes[2] * (least / 2)
    return np.concatenate([unique - normal, unique + normal])


def check_extent(points: Floats) -> None:
    """Raise an error for points that no mesh can have meant [m]."""
    if not np.isfinite(points).all():
        raise ValueRejectedError("its points are not finite.")
    extent = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if not SMALLEST <= extent <= GREATEST:
        raise ValueRejectedError(
            f"its extent is {extent:g} m, and meshes from {SMALLEST:g} m to {GREATEST:g} m are taken. "
            "Is its scale right?"
        )
    if np.abs(points).max() > GREATEST:
        raise ValueRejectedError(f"it lies further than {GREATEST:g} m from its origin. Is its scale right?")
