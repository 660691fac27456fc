"""Pinhole cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError

from .triangle_mesh import Floats


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera in the world.

    Attributes
    ----------
    position
        The position of the camera [m].
    target
        The point in the middle of the picture [m].
    up
        The upward direction of the picture.
    field_of_view
        The angle between the upper and the lower edge of the picture [rad].

    Examples
    --------
    >>> camera = kv.view.Camera(position=(3, -2, 2), target=(1, -1.5, 1))
    >>> kv.view.picture(kv.load("shelf_door"), size=(64, 48), camera=camera).shape
    (48, 64, 3)
    """

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    field_of_view: float = 0.6

    def __post_init__(self) -> None:
        numbers = np.array([*self.position, *self.target, *self.up, self.field_of_view])
        if not np.isfinite(numbers).all() or self.position == self.target:
            raise InvalidValueError(f"a camera needs finite numbers and a target ahead of it, got {self}")
        if not 0.0 < self.field_of_view < np.pi:
            raise InvalidValueError(f"field_of_view {self.field_of_view} is not between 0 and pi")

    @property
    def height(self) -> float:
        """Visible height of the plane through the target, from edge to edge [m]."""
        distance = np.linalg.norm(np.subtract(self.target, self.position))
        return float(2.0 * distance * np.tan(self.field_of_view / 2))

    @property
    def axes(self) -> Floats:
        """(3, 3): the directions to the right, up and ahead, as rows in world coordinates."""
        ahead = np.subtract(self.target, self.position)
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, self.up)
        if np.linalg.norm(right) < 1e-9:  # The view is along "up": any direction to the right is valid.
            right = np.cross(ahead, np.roll(self.up, 1) + np.array([0.3, 0.1, 0.2]))
        right = right / np.linalg.norm(right)
        return np.array([right, np.cross(right, ahead), ahead])


def fit_camera(
    points: npt.ArrayLike,
    azimuth: float,
    elevation: float,
    aspect: float,
    field_of_view: float = 0.6,
    margin: float = 0.08,
) -> Camera:
    """Return the nearest camera of a given direction that has all points in view.

    Notes
    -----
    In camera axes a point p is inside if |p_x - c_x| <= t (p_z - c_z), t the tangent of half the angle. Each
    pair of opposite planes gives the largest c_z, (min(t p_z - p_x) + min(t p_z + p_x)) / 2t, and the c_x
    that centres the points; the smaller c_z of both pairs is taken.
    """
    p = np.asarray(points, dtype=float).reshape(-1, 3)
    if not len(p):
        p = np.array([[-0.5, -0.5, 0.0], [0.5, 0.5, 0.5]])
    away = unit_direction(azimuth, elevation)
    axes = Camera(tuple(away), (0.0, 0.0, 0.0)).axes
    seen = p @ axes.T
    vertical = np.tan(field_of_view / 2) * (1.0 - 2.0 * margin)
    centre, depths = np.zeros(3), []
    for k, t in ((0, vertical * aspect), (1, vertical)):
        right, left = np.min(t * seen[:, 2] - seen[:, k]), np.min(t * seen[:, 2] + seen[:, k])
        depths.append((right + left) / (2 * t))
        centre[k] = (left - right) / 2
    spread = float(np.linalg.norm(p.max(axis=0) - p.min(axis=0)))
    # The distance to a single point would be zero.
    centre[2] = min(*depths, float(seen[:, 2].min()) - 0.05 - 0.1 * spread)
    position = centre @ axes
    ahead = float(np.median(seen[:, 2])) - centre[2]
    target = position + axes[2] * max(ahead, 0.1)
    return Camera(_triple(position), _triple(target), field_of_view=field_of_view)


def unit_direction(azimuth: float, elevation: float) -> Floats:
    """Return the unit vector (3,) at an azimuth around z and an elevation [rad]."""
    level = np.cos(elevation)
    return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def _triple(vector: Floats) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
