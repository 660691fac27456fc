"""What is drawn of observations and beliefs: axes, ways along which something may be, an uncertain axis."""

from __future__ import annotations

import numpy as np

from kineverse.estimation import Fit
from kineverse.view.triangle_mesh import Floats, TriangleMesh, normalize_rows

from .axis_uncertainty import TURNING, spread

MARKER, THICK = 0.18, 0.02
"""The length and thickness of a marker's axes [m]."""

BAR, CAP = 0.018, 0.04
"""The radii of ways along which something may be, and of their ends [m]."""

REACH, LINE = 0.75, 0.012
"""Half the length of an axis, and its radius [m]."""

SIGMAS = 2.0
"""How many standard deviations wide an uncertain axis is."""

AROUND = 16
"""Corners of a circle."""

AXES = ((0.86, 0.16, 0.16), (0.13, 0.62, 0.20), (0.16, 0.33, 0.88))
BARS, AXIS, TUBE, CLOUD = (0.92, 0.30, 0.05), (0.80, 0.05, 0.32), (0.93, 0.35, 0.60), (0.45, 0.20, 0.60)
"""Colours: of markers, of error bars, of a learned axis and what surrounds it, of places seen before."""


def loft(rings: Floats) -> TriangleMesh:
    """Return the surface through closed rings of corners (K, S, 3), counter-clockwise seen from the last."""
    count, around = rings.shape[:2]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    quads = np.stack([a, b, b + around, a + around], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    normals = normalize_rows((rings - rings.mean(axis=1, keepdims=True)).reshape(-1, 3))
    return TriangleMesh(rings.reshape(-1, 3), faces, normals)


def rod(points: Floats, radius: float | Floats) -> TriangleMesh:
    """Return a tube of a radius, or of one at each point, along points (K, 3) [m]."""
    ways = np.gradient(points, axis=0)
    ways[np.linalg.norm(ways, axis=1) < 1e-9] = (0.0, 0.0, 1.0)
    z = normalize_rows(ways)
    # The same aside all along, or the tube would be twisted.
    aside = np.eye(3)[int(np.argmin(np.abs(z).sum(axis=0)))]
    x = normalize_rows(np.cross(np.broadcast_to(aside, z.shape), z))
    y = np.cross(z, x)
    angle = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)[:, None]
    ring = np.cos(angle) * x[:, None] + np.sin(angle) * y[:, None]
    return loft(points[:, None] + np.broadcast_to(radius, len(points))[:, None, None] * ring)


def marker(pose: Floats) -> list[TriangleMesh]:
    """Return the three axes of a pose 4×4, as rods."""
    origin = pose[:3, 3]
    return [rod(np.stack([origin, origin + MARKER * pose[:3, k]]), THICK / 2) for k in range(3)]


def bar(way: Floats) -> TriangleMesh:
    """Return a rod along places (K, 3) at which something may be, with thick ends [m]."""
    fine = np.linspace(0.0, len(way) - 1.0, 4 * len(way))
    points = np.stack([np.interp(fine, np.arange(len(way)), way[:, k]) for k in range(3)], axis=1)
    radius = np.full(len(points), BAR)
    first, last = points[:1], points[-1:]
    step = BAR * normalize_rows(last - first)
    points = np.concatenate([first - step, first, points, last, last + step])
    return rod(points, np.concatenate([[CAP, CAP], radius, [CAP, CAP]]))


def axis_line(fit: Fit, near: Floats) -> Floats:
    """Return the ends of a learned axis (2, 3) in the parent; its middle is next to a point (3,) [m]."""
    middle, direction = _middle(fit, near), fit.frame[:3, 2]
    return np.stack([middle - REACH * direction, middle + REACH * direction])


def axis_tube(fit: Fit, near: Floats, points: int = 13) -> TriangleMesh:
    """Return what surrounds a learned axis within two standard deviations, in the parent."""
    heights = np.linspace(-REACH, REACH, points)
    middle = _middle(fit, near)
    above = float((middle - fit.frame[:3, 3]) @ fit.frame[:3, 2]) if fit.family in TURNING else 0.0
    roots = np.linalg.cholesky(spread(fit, heights + above) + 1e-6 * np.eye(2))
    angle = np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    across = SIGMAS * np.swapaxes(roots @ circle, 1, 2) @ fit.frame[:3, :2].T
    centres: Floats = middle + heights[:, None] * fit.frame[:3, 2]
    return loft(centres[:, None] + across)


def _middle(fit: Fit, near: Floats) -> Floats:
    """Return the point of an axis next to a point; a direction goes through that point itself."""
    origin, direction = fit.frame[:3, 3], fit.frame[:3, 2]
    if fit.family not in TURNING:
        return near
    middle: Floats = origin + ((near - origin) @ direction) * direction
    return middle
