"""Automatic choice of a camera, and its framing for each browser window."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.model.model_view import ModelView
from kineverse.view.drawables import Drawable

from .camera import Camera, fit_camera
from .rasterizer import Projection, TriangleSoup, rasterize
from .triangle_mesh import Floats

ELEVATION = 0.42

FRONT = 0.62  # preferred direction: in front of the model and a little to its left [rad]

TRIALS = 12

TRIAL_HEIGHT = 80  # height of trial pictures [pixels]: enough to show a handle, small enough for a dozen
AZIMUTHS, PART_ELEVATION = 8, 0.45  # directions from which single parts are looked at [rad]
MOVING_WEIGHT = 4.0  # weight of a part that moves, relative to one that does not


def weigh_drawables(model: ModelView, items: Sequence[Drawable]) -> Floats:
    """Return the weight of each part in the choice of a camera: parts that move count more."""
    moves = {frame: bool(model.fk(frame).symbols) for frame in {part.frame for part in items}}
    return np.array([MOVING_WEIGHT if moves[part.frame] else 1.0 for part in items])


def choose_camera(
    scene: TriangleSoup,
    weights: npt.NDArray[np.float64],
    poses: Mapping[str, Floats],
    aspect: float,
    field_of_view: float = 0.6,
) -> Camera:
    """Return the camera that shows most of a scene."""
    if not len(scene.corners):
        origins = np.array([pose[:3, 3] for pose in poses.values()])
        return fit_camera(np.concatenate([origins, origins + 0.2]), FRONT, ELEVATION, aspect, field_of_view)
    points = scene.corners.reshape(-1, 3)
    extreme, corners = find_extreme_points(points), scene.corners.astype(np.float32)
    trials = []
    for k in range(TRIALS):
        azimuth = FRONT + 2 * np.pi * k / TRIALS
        camera = fit_camera(extreme, azimuth, ELEVATION, aspect, field_of_view)
        projection = Projection.from_camera(camera, max(int(TRIAL_HEIGHT * aspect), 8), TRIAL_HEIGHT)
        seen, _ = rasterize(projection, corners, scene.closed)
        area = np.bincount(scene.source[seen[seen >= 0]], minlength=len(weights))
        # The logarithm weighs many visible parts above one large wall; the cosine breaks ties.
        score = float(weights @ np.log1p(area)) * (1.0 + 0.06 * np.cos(azimuth - FRONT))
        trials.append((score, -k))
    azimuth = FRONT - 2 * np.pi * max(trials)[1] / TRIALS
    return fit_camera(points, azimuth, ELEVATION, aspect, field_of_view)


def choose_camera_for_parts(
    items: Sequence[Drawable],
    places: Sequence[Mapping[str, Floats]],
    weights: npt.NDArray[np.float64],
    aspect: float,
    margin: float = 0.08,
) -> Camera:
    """Return the camera that has the parts with weights in view in some states, and shows most of them."""
    scenes = [TriangleSoup.from_drawables(items, place) for place in places]
    corners = [scene.corners.astype(np.float32) for scene in scenes]
    points = np.concatenate([scene.corners[weights[scene.source] > 0.0].reshape(-1, 3) for scene in scenes])
    extreme = find_extreme_points(points)
    best, chosen = -1.0, None
    for azimuth in np.linspace(0.0, 2 * np.pi, AZIMUTHS, endpoint=False).tolist():
        camera = fit_camera(extreme, azimuth, PART_ELEVATION, aspect, margin=margin)
        projection = Projection.from_camera(camera, int(TRIAL_HEIGHT * aspect), TRIAL_HEIGHT)
        score = 0.0
        for scene, triangles in zip(scenes, corners, strict=True):
            seen, _ = rasterize(projection, triangles, scene.closed)
            area = np.bincount(scene.source[seen[seen >= 0]], minlength=len(weights))
            score += float(weights @ np.log1p(area))
        if score > best:
            best, chosen = score, camera
    assert chosen is not None
    return chosen


def reframe(camera: Camera, points: Floats, aspect: float) -> Camera:
    """Return the nearest camera of the same direction that has points (N, 3) in view, for another aspect."""
    away = np.subtract(camera.position, camera.target)
    azimuth = float(np.arctan2(away[1], away[0]))
    elevation = float(np.arctan2(away[2], np.hypot(away[0], away[1])))
    return fit_camera(points, azimuth, elevation, aspect, camera.field_of_view)


def find_extreme_points(points: Floats) -> Floats:
    """Return the points that lie farthest out in some hundred directions."""
    k = np.arange(128)
    z, angle = 1.0 - (2.0 * k + 1.0) / len(k), 2.399963 * k
    flat = np.sqrt(1.0 - z * z)
    directions = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1).astype(np.float32)
    farthest = np.argmax(directions @ points.astype(np.float32).T, axis=1)
    return np.asarray(points[np.unique(farthest)])


logger = logging.getLogger(__name__)

CAMERA_TOLERANCE = 1e-3  # tolerance for equal camera poses, as a fraction of the distance to the target


class ClientCameras:
    """Cameras of all browsers that show a page, each fitted to the shape of its window."""

    def __init__(self, server: Any) -> None:
        self._lock = threading.Lock()
        self._first: Camera | None = None
        self._placed: dict[int, Camera] = {}
        server.on_client_connect(self._add_client)
        server.on_client_disconnect(lambda client: self._placed.pop(client.client_id, None))

    def set_framing(self, first: Camera, framing: Callable[[float], Camera]) -> None:
        """Set the first camera, and the framing of later placements for the aspects of windows."""
        with self._lock:
            self._first, self._framing = first, framing

    def _add_client(self, client: Any) -> None:
        client.camera.on_update(self._place)
        self._place(client.camera)

    def _place(self, camera: Any) -> None:
        """Move a camera to the framing of its window, unless a user has moved it."""
        try:
            with self._lock:
                if self._first is None or not camera.image_height or not camera.image_width:
                    return
                client = camera.client
                wanted = self._framing(camera.image_width / camera.image_height)
                ours = (self._first, self._placed.get(client.client_id, self._first))
                if any(_is_at(camera, place) for place in ours) and not _is_at(camera, wanted):
                    self._placed[client.client_id] = wanted
                    with client.atomic():
                        camera.position = np.array(wanted.position)
                        camera.look_at = np.array(wanted.target)
        except Exception:
            # The browser may be closing; its user can still move the camera.
            logger.debug("a camera could not be placed", exc_info=True)


def _is_at(camera: Any, place: Camera) -> bool:
    off = np.abs(np.concatenate([camera.position - place.position, camera.look_at - place.target])).max()
    return bool(off < CAMERA_TOLERANCE * np.linalg.norm(np.subtract(place.position, place.target)))
