"""Gaps between bodies of a robot and objects with their derivatives, see :mod:`.object_motion`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array

JAM = 0.5
"""Cosine of the angle between a normal and the motion that it causes, below which a contact jams."""

_PARALLEL = 1e-3
"""Least eigenvalue of directions of motion that are not parallel."""


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Gaps of near pairs of shapes and their derivatives."""

    pairs: DistanceResults  # pairs as the scene found them, nearest first
    index: npt.NDArray[np.intp]  # (K,) indices of the gaps among these pairs
    distances: Array  # (K,) gaps [m]
    rows: Array  # (K, n) derivatives by the displacement of all columns
    jammed: npt.NDArray[np.bool_]  # (K,) flags of contacts that move no object


def align_motion(normal: Array, point: Array, twists: Array) -> float:
    """Return the largest cosine of the angle between a normal and the motions of a point by twists (6, n)."""
    ways = twists[:3] + np.cross(twists[3:].T, point).T
    lengths = np.linalg.norm(ways, axis=0)
    moves = (lengths > 0.0) & np.isfinite(lengths)
    ways = ways[:, moves] / lengths[moves]
    values, directions = np.linalg.eigh(ways @ ways.T)
    return float(np.linalg.norm(normal @ directions[:, values > _PARALLEL]))


def pair_keys(pairs: DistanceResults) -> list[tuple[int, ...]]:
    """Return the numbers of bodies and shapes of pairs."""
    return [tuple(row) for row in np.hstack([pairs.body_indices, pairs.shape_indices]).tolist()]


def project_twists(normals: Array, points: Array, twists: Array) -> Array:
    """Return n·(v + ω × p) for each of K points and each column: (K, 3), (K, 3), (K, 6, n) -> (K, n)."""
    (nx, ny, nz), (px, py, pz) = normals.T, points.T
    wrench = np.empty((len(normals), 1, 6))
    wrench[:, 0, :3] = normals
    wrench[:, 0, 3] = py * nz - pz * ny
    wrench[:, 0, 4] = pz * nx - px * nz
    wrench[:, 0, 5] = px * ny - py * nx
    return np.asarray((wrench @ twists)[:, 0])
