"""Meshes of readings and estimates: axes of markers, uncertainty bars, and an uncertain joint axis."""

from __future__ import annotations

import numpy as np

from kineverse.estimation import Fit
from kineverse.view.plots import AXIAL_FAMILIES, axis_covariances
from kineverse.view.rendering.triangle_mesh import Floats, TriangleMesh, normalize_rows

MARKER, THICK = 0.18, 0.02
"""Length and thickness of a marker's axes [m]."""

BAR, CAP = 0.018, 0.04
"""Radii of uncertainty bars, and of their ends [m]."""

REACH, LINE = 0.75, 0.012
"""Half the length of a drawn axis, and its radius [m]."""

SIGMAS = 2.0
"""Half width of an uncertain axis, in standard deviations."""

CIRCLE_CORNERS = 16
"""Corners of a circle."""

BARS, AXIS, TUBE, CLOUD = (0.92, 0.30, 0.05), (0.80, 0.05, 0.32), (0.93, 0.35, 0.60), (0.45, 0.20, 0.60)
"""Colours of uncertainty bars, of an identified axis and its uncertainty, and of stored positions."""


def loft_rings(rings: Floats) -> TriangleMesh:
    """Return the surface through closed rings (K, S, 3), counter-clockwise as seen from the last."""
    count, around = rings.shape[:2]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(around), indexing="ij")
    a, b = i * around + j, i * around + (j + 1) % around
    quads = np.stack([a, b, b + around, a + around], axis=-1).reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    normals = normalize_rows((rings - rings.mean(axis=1, keepdims=True)).reshape(-1, 3))
    return TriangleMesh(rings.reshape(-1, 3), faces, normals)


def create_rod(points: Floats, radius: float | Floats) -> TriangleMesh:
    """Return a tube along points (K, 3) [m], of one radius, or of one at each point."""
    tangents = np.gradient(points, axis=0)
    tangents[np.linalg.norm(tangents, axis=1) < 1e-9] = (0.0, 0.0, 1.0)
    z = normalize_rows(tangents)
    # One reference direction for the whole tube, which would be twisted otherwise.
    aside = np.eye(3)[int(np.argmin(np.abs(z).sum(axis=0)))]
    x = normalize_rows(np.cross(np.broadcast_to(aside, z.shape), z))
    y = np.cross(z, x)
    angle = np.linspace(0.0, 2.0 * np.pi, CIRCLE_CORNERS, endpoint=False)[:, None]
    ring = np.cos(angle) * x[:, None] + np.sin(angle) * y[:, None]
    return loft_rings(points[:, None] + np.broadcast_to(radius, len(points))[:, None, None] * ring)


def create_marker(pose: Floats) -> list[TriangleMesh]:
    """Return the three axes of a pose 4×4, as rods."""
    origin = pose[:3, 3]
    return [create_rod(np.stack([origin, origin + MARKER * pose[:3, k]]), THICK / 2) for k in range(3)]


def create_bar(path: Floats) -> TriangleMesh:
    """Return a rod with thick ends along a path of positions (K, 3) [m]."""
    fine = np.linspace(0.0, len(path) - 1.0, 4 * len(path))
    points = np.stack([np.interp(fine, np.arange(len(path)), path[:, k]) for k in range(3)], axis=1)
    radius = np.full(len(points), BAR)
    first, last = points[:1], points[-1:]
    step = BAR * normalize_rows(last - first)
    points = np.concatenate([first - step, first, points, last, last + step])
    return create_rod(points, np.concatenate([[CAP, CAP], radius, [CAP, CAP]]))


def compute_axis_line(fit: Fit, near: Floats) -> Floats:
    """Return the ends (2, 3) of an identified axis in the parent, centred nearest to a point (3,) [m]."""
    middle, direction = _middle(fit, near), fit.frame[:3, 2]
    return np.stack([middle - REACH * direction, middle + REACH * direction])


def create_axis_tube(fit: Fit, near: Floats, points: int = 13) -> TriangleMesh:
    """Return the surface at two standard deviations around an identified axis, in the parent."""
    heights = np.linspace(-REACH, REACH, points)
    middle = _middle(fit, near)
    above = float((middle - fit.frame[:3, 3]) @ fit.frame[:3, 2]) if fit.family in AXIAL_FAMILIES else 0.0
    roots = np.linalg.cholesky(axis_covariances(fit, heights + above) + 1e-6 * np.eye(2))
    angle = np.linspace(0.0, 2.0 * np.pi, CIRCLE_CORNERS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    across = SIGMAS * np.swapaxes(roots @ circle, 1, 2) @ fit.frame[:3, :2].T
    centres: Floats = middle + heights[:, None] * fit.frame[:3, 2]
    return loft_rings(centres[:, None] + across)


def _middle(fit: Fit, near: Floats) -> Floats:
    """Return the point of an axis nearest to a point; that point itself if the axis has no position."""
    origin, direction = fit.frame[:3, 3], fit.frame[:3, 2]
    if fit.family not in AXIAL_FAMILIES:
        return near
    middle: Floats = origin + ((near - origin) @ direction) * direction
    return middle
