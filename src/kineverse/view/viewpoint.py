"""Choosing where to stand: the side from which most of what moves is seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from kineverse.model.view import ModelView
from kineverse.view.camera import Camera, framing
from kineverse.view.parts import Part
from kineverse.view.raster import Projection, visible
from kineverse.view.surfaces import Surfaces
from kineverse.view.triangles import Floats

ELEVATION = 0.42

FRONT = 0.62
"""The direction preferred when all are as good: before the model and a little to its left [rad]."""

TRIALS = 12

LOOK = 80
"""Pixels along the height of the trial pictures: enough to see a handle, small enough to make a dozen."""

MOVES = 4.0
"""How much more a part that moves is worth seeing than one that does not."""


def importance(model: ModelView, items: Sequence[Part]) -> Floats:
    """Return how much each part is worth seeing: what moves counts more."""
    moves = {frame: bool(model.fk(frame).symbols) for frame in {part.frame for part in items}}
    return np.array([MOVES if moves[part.frame] else 1.0 for part in items])


def automatic(
    scene: Surfaces,
    weights: npt.NDArray[np.float64],
    poses: Mapping[str, Floats],
    aspect: float,
    field_of_view: float = 0.6,
) -> Camera:
    """Return the camera from which a scene is best seen.

    Parameters
    ----------
    scene
        The triangles.
    weights
        How much each of its parts is worth seeing.
    poses
        The poses of the frames, looked at if there are no triangles.
    aspect
        Width of the picture divided by its height.
    field_of_view
        Vertical, full angle [rad].
    """
    if not len(scene.corners):
        origins = np.array([pose[:3, 3] for pose in poses.values()])
        return framing(np.concatenate([origins, origins + 0.2]), FRONT, ELEVATION, aspect, field_of_view)
    points = scene.corners.reshape(-1, 3)
    extreme, corners = outermost(points), scene.corners.astype(np.float32)
    trials = []
    for k in range(TRIALS):
        azimuth = FRONT + 2 * np.pi * k / TRIALS
        camera = framing(extreme, azimuth, ELEVATION, aspect, field_of_view)
        projection = Projection.of(camera, max(int(LOOK * aspect), 8), LOOK)
        seen, _ = visible(projection, corners, scene.closed)
        area = np.bincount(scene.source[seen[seen >= 0]], minlength=len(weights))
        # The logarithm makes many parts in view worth more than one large wall; the cosine breaks ties.
        score = float(weights @ np.log1p(area)) * (1.0 + 0.06 * np.cos(azimuth - FRONT))
        trials.append((score, -k))
    azimuth = FRONT - 2 * np.pi * max(trials)[1] / TRIALS
    return framing(points, azimuth, ELEVATION, aspect, field_of_view)


def reframed(camera: Camera, points: Floats, aspect: float) -> Camera:
    """Return the nearest camera of the same direction that sees points (N, 3), for another aspect."""
    away = np.subtract(camera.position, camera.target)
    azimuth = float(np.arctan2(away[1], away[0]))
    elevation = float(np.arctan2(away[2], np.hypot(away[0], away[1])))
    return framing(points, azimuth, elevation, aspect, camera.field_of_view)


def outermost(points: Floats) -> Floats:
    """Return those of many points that lie farthest out in some hundred directions."""
    k = np.arange(128)
    z, angle = 1.0 - (2.0 * k + 1.0) / len(k), 2.399963 * k
    flat = np.sqrt(1.0 - z * z)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1).astype(np.float32)
    farthest = np.argmax(directions @ points.astype(np.float32).T, axis=1)
    return np.asarray(points[np.unique(farthest)])
