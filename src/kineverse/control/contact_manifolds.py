"""Contact manifolds: earlier nearest points of near pairs, beside the present ones.

Parallel faces are nearest at every point, and a query returns one of them. A turn brings the other end
nearer, which no row is about: in the next step that end is the nearest one, and the turn goes back. Earlier
points are therefore kept, and their distance along the present normal has a row as well.
"""

from __future__ import annotations

import numpy as np

from kineverse.geometry import Scene
from kineverse.geometry.results import DistanceResults
from kineverse.lie import Array, inverse

_NEAR, _LEFT = 3e-3, 0.03
"""Distances beyond the one that a pair keeps, at which its points are kept and forgotten [m]."""
_OTHER = 0.02
"""Distance from which on nearest points count as other ones [m]."""
_LATERAL = 0.3
"""Distance along a face from which on two points do not face each other [m]."""
_MOST = 3
"""Largest number of earlier points of a pair."""

_Points = tuple[Array, Array]
"""Nearest points (4,) of a pair, each in the frame of its body, homogeneous [m]."""


class ContactManifolds:
    """Memory of the nearest points of pairs of bodies.

    Parameters
    ----------
    scene
        Scene of the queries.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._kept: dict[tuple[int, ...], list[_Points]] = {}

    def reset(self) -> None:
        """Forget all points."""
        self._kept.clear()

    def extend(self, found: DistanceResults, gaps: Array) -> DistanceResults:
        """Return near pairs with the earlier points of some of them, nearest first.

        Parameters
        ----------
        found
            The pairs, at the last update of the scene.
        gaps
            (K,) distances of the pairs beyond those that they keep [m]; infinite for pairs to leave out.
        """
        kept, self._kept = self._kept, {}
        rows: list[int] = []
        witnesses: list[Array] = []
        for k in np.flatnonzero(gaps < (_LEFT if kept else _NEAR)).tolist():
            key = (*found.body_indices[k].tolist(), *found.shape_indices[k].tolist())
            if key not in kept and gaps[k] > _NEAR:
                continue
            poses = [self._scene.pose(self._scene.bodies[b]) for b in key[:2]]
            points, normal = (found.points_a[k], found.points_b[k]), found.normals[k]
            a_here, b_here = (inverse(T) @ [*p, 1.0] for T, p in zip(poses, points, strict=True))
            self._kept[key] = [(a_here, b_here)]
            for earlier in kept.get(key, [])[:_MOST]:
                a, b = ((T @ p)[:3] for T, p in zip(poses, earlier, strict=True))
                distance = float(normal @ (b - a))
                aside = np.linalg.norm(b - a - distance * normal)
                if aside < _LATERAL and np.linalg.norm(a - points[0]) > _OTHER:
                    self._kept[key].append(earlier)
                    rows.append(k)
                    witnesses.append(np.hstack([a, b, normal]))
        return found.with_points(rows, np.array(witnesses)) if rows else found
