"""An axis that was learned, and how sure that is."""

from __future__ import annotations

import numpy as np

from kineverse.estimation import Fit
from kineverse.view.triangle_mesh import Floats

TURNING = ("revolute", "screw", "cylindrical")
"""Families with an axis that is somewhere."""

WITH_AXIS = (*TURNING, "prismatic")
"""Families with a direction."""


def spread(fit: Fit, heights: Floats) -> Floats:
    """Return covariances (M, 2, 2) of where an axis is at heights above its point [m].

    They are those of the crossing with planes across the axis, in the first two columns of ``fit.frame``. A
    line along which something slides is nowhere; its direction is taken to turn about its point.
    """
    turns, shifts = ("axis.x", "axis.y"), ("point.x", "point.y")
    chosen = [*(shifts if fit.family in TURNING else ()), *turns]
    index = [fit.coordinates.index(name) for name in chosen]
    by_chosen = np.zeros((len(heights), 2, 4))
    by_chosen[:, 0, 0] = by_chosen[:, 1, 1] = 1.0
    # A turn about y moves what is above the point along x, one about x against y.
    by_chosen[:, 0, 3], by_chosen[:, 1, 2] = heights, -heights
    by_chosen = by_chosen[:, :, -len(index) :]
    return by_chosen @ fit.covariance[np.ix_(index, index)] @ np.swapaxes(by_chosen, 1, 2)


def error(fit: Fit, point: Floats, direction: Floats) -> tuple[float, float, float]:
    """Return how far a fit is off a true axis, which is given in the parent.

    Returns
    -------
    The angle between them [rad], the distance of the true axis from the point of the fit [m] (0 where it is
    nowhere), and both as a multiple of what the covariance has one expect: 1 on average.
    """
    rotation, origin = fit.frame[:3, :3], fit.frame[:3, 3]
    way = rotation.T @ direction
    way = way if way[2] > 0.0 else -way
    off = [-way[1], way[0]]
    names = ["axis.x", "axis.y"]
    distance = 0.0
    if fit.family in TURNING:
        start = rotation.T @ (point - origin)
        crossing = start - way * (start[2] / way[2])
        off, names = [*crossing[:2], *off], ["point.x", "point.y", *names]
        distance = float(np.linalg.norm(crossing[:2]))
    index = [fit.coordinates.index(name) for name in names]
    delta = np.array(off)
    square = float(delta @ np.linalg.solve(fit.covariance[np.ix_(index, index)], delta)) / len(delta)
    return float(np.arccos(np.clip(way[2], -1.0, 1.0))), distance, float(np.sqrt(square))
