"""Links of a planner: bodies that move, covered by spheres, as tables for the compiled collision check."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from kineverse.geometry.objects import CollisionObject
from kineverse.lie import Array

from .bindings import COARSE, LINK
from functools import lru_cache
from .spheres import cover_solid, make_sphere_tree

_C = lru_cache(4096)(cover_solid)


def cover_object(item, protrusion):
    return _C(item.make_solid(), protrusion)


class LinkTable:
    """Spheres of the bodies that move, each in the frame of its pose.

    Parameters
    ----------
    members
        Of each body, its objects with their poses in the frame, (4, 4).
    poses
        Of each body, the number of its pose.
    protrusion
        Largest distance of a sphere from the shape that it covers [m]; None for what suits the shape.

    Attributes
    ----------
    links, coarse, fine
        Tables as C reads them.
    spheres
        Of each body, the centres in the frame and radii of its spheres, (N, 4) [m].
    """

    def __init__(
        self,
        members: Sequence[Sequence[tuple[CollisionObject, Array]]],
        poses: Sequence[int],
        protrusion: float | None,
    ) -> None:
        self.links = np.zeros(len(members), dtype=LINK)
        coarse: list[tuple[Array, int, int]] = []
        fine: list[Array] = []
        self.spheres: list[Array] = []
        count = 0
        for k, (items, pose) in enumerate(zip(members, poses, strict=True)):
            spheres = np.concatenate([_placed_cover(item, T, protrusion) for item, T in items])
            tree = make_sphere_tree(spheres[:, :3], spheres[:, 3])
            spheres = np.column_stack([tree.centres, tree.radii])
            link = self.links[k]
            link["pose"], link["body"], link["first"] = pose, k, len(coarse)
            link["coarse"] = len(tree.coarse_radii)
            link["ball"] = *tree.ball_centre, tree.ball_radius
            link["low"], link["high"] = tree.centres.min(axis=0), tree.centres.max(axis=0)
            ends = tree.first.tolist()
            for j, (centre, radius) in enumerate(zip(tree.coarse_centres, tree.coarse_radii, strict=True)):
                coarse.append((np.array([*centre, radius]), count + ends[j], ends[j + 1] - ends[j]))
            fine.append(spheres)
            count += len(spheres)
            self.spheres.append(spheres)
        self.coarse = np.zeros(len(coarse), dtype=COARSE)
        for j, (sphere, first, number) in enumerate(coarse):
            self.coarse[j] = sphere, first, number
        self.fine = np.concatenate(fine or [np.zeros((0, 4))]).astype(np.float32)

    def widen(self, link: int, points: Array) -> None:
        """Extend the box of a link, whose motion bounds that of its shapes, to (N, 3) points in its frame."""
        row = self.links[link]
        row["low"] = np.minimum(row["low"], points.min(axis=0))
        row["high"] = np.maximum(row["high"], points.max(axis=0))


def _placed_cover(item: CollisionObject, T: Array, protrusion: float | None) -> Array:
    cover = cover_object(item, protrusion)
    centres = cover.centres @ T[:3, :3].T + T[:3, 3]
    return np.column_stack([centres, cover.radii])


def box_corners(low: Iterable[float], high: Iterable[float]) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
