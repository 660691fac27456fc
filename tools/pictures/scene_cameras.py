"""Cameras that have a scene in view in all its states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import kineverse as kv
from kineverse.view.drawables import collect_drawables
from kineverse.view.poses import FramePoses
from kineverse.view.rendering.camera import Camera, fit_camera
from kineverse.view.rendering.rasterizer import TriangleSoup


def fit_scene_camera(
    model: kv.Model,
    states: Sequence[dict[str, float]],
    azimuth: float,
    elevation: float,
    aspect: float,
) -> Camera:
    """Return the nearest camera of a direction [rad] that has a scene in view in all its states."""
    poses, items = FramePoses(model), collect_drawables(model)
    corners = [
        TriangleSoup.from_drawables(
            items, dict(zip(poses.names, poses.evaluate(state), strict=True))
        ).corners.reshape(-1, 3)
        for state in states
    ]
    return fit_camera(np.concatenate(corners), azimuth, elevation, aspect, 0.4, margin=0.04)
