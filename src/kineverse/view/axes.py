"""The axes of frames, drawn as thin bars: x red, y green, z blue."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from kineverse.model.body import Box
from kineverse.model.view import ModelView
from kineverse.view.geometry import triangles_of
from kineverse.view.parts import Part
from kineverse.view.triangles import Floats

COLORS = ((0.86, 0.16, 0.16, 1.0), (0.13, 0.62, 0.20, 1.0), (0.16, 0.33, 0.88, 1.0))


def axis_length(corners: Floats, poses: Mapping[str, Floats]) -> float:
    """Return a length for axes that suits the size of a scene, in [0.02, 0.5] [m]."""
    origins = np.array([pose[:3, 3] for pose in poses.values()]).reshape(-1, 3)
    points = np.concatenate([corners.reshape(-1, 3), origins])
    spread = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))) if len(points) else 1.0
    return float(np.clip(0.05 * spread, 0.02, 0.5))


def triad(model: ModelView, corners: Floats, poses: Mapping[str, Floats]) -> list[Part]:
    """Return the axes of the world and all frames of a model, three bars each."""
    length = axis_length(corners, poses)
    width = 0.07 * length
    bars = []
    for axis, color in enumerate(COLORS):
        size = np.full(3, width)
        size[axis] = length
        shift = np.eye(4)
        shift[axis, 3] = length / 2
        bars.append((triangles_of(Box((size[0], size[1], size[2]))).moved(shift), color))
    return [Part(name, surface, color, "visual") for name in poses for surface, color in bars]
