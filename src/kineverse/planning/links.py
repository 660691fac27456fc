"""Links of a planner: bodies that move, covered by spheres, as tables for the compiled collision check."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np

from kineverse.geometry.objects import CollisionObject
from kineverse.geometry.shapes import Solid
from kineverse.lie import Array
from kineverse.model.body import Sphere

from .bindings import COARSE, LINK, SHAPE
from .spheres import SphereTree, cover_objects, make_sphere_tree
from .spheres.sphere_cache import cover_key, find_or_make_tree


class LinkTable:
    """Spheres of the bodies that move, each in the frame of its pose."""

    def __init__(
        self,
        members: Sequence[Sequence[tuple[CollisionObject, Solid, Array]]],
        poses: Sequence[int],
        protrusion: float | None,
    ) -> None:
        self.links = np.zeros(len(members), dtype=LINK)
        coarse: list[tuple[Array, int, int]] = []
        fine: list[Array] = []
        self.spheres: list[Array] = []
        count = 0
        self.shapes = np.zeros(sum(map(len, members)), dtype=SHAPE)
        placed = [T[:3] for items in members for _, _, T in items]
        self.shapes["pose"] = np.reshape(placed, (-1, 12))
        shapes = 0
        for k, (items, pose) in enumerate(zip(members, poses, strict=True)):
            link = self.links[k]
            link["pose"], link["first"] = pose, len(coarse)
            link["first_shape"], link["shapes"] = shapes, len(items)
            shapes += len(items)
            corners = np.concatenate([_placed_corners(solid, T) for _, solid, T in items])
            link["low"], link["high"] = corners.min(axis=0), corners.max(axis=0)
            key = cover_key([(solid, T) for _, solid, T in items], protrusion)
            tree = find_or_make_tree(key, partial(_make_tree, items, protrusion))
            link["coarse"] = len(tree.coarse_radii)
            link["exact"] = len(tree.radii) == len(items) and all(
                isinstance(solid.surface, Sphere) for _, solid, _ in items
            )
            link["ball"] = *tree.ball_centre, tree.ball_radius
            ends = tree.first.tolist()
            for j, (centre, radius) in enumerate(zip(tree.coarse_centres, tree.coarse_radii, strict=True)):
                coarse.append((np.array([*centre, radius]), count + ends[j], ends[j + 1] - ends[j]))
            self.spheres.append(np.column_stack([tree.centres, tree.radii]))
            fine.append(self.spheres[-1])
            count += len(tree.radii)
        self.coarse = np.zeros(max(len(coarse), 1), dtype=COARSE)
        for j, (sphere, first, number) in enumerate(coarse):
            self.coarse[j] = sphere, first, number
        self.fine = np.concatenate(fine or [np.zeros((1, 4))]).astype(np.float32)


def _make_tree(items: Sequence[tuple[CollisionObject, Solid, Array]], protrusion: float | None) -> SphereTree:
    cover = cover_objects([item for item, _, _ in items], protrusion).move(items[0][2])
    return make_sphere_tree(cover.centres, cover.radii)


def _placed_corners(solid: Solid, T: Array) -> Array:
    corners = box_corners(solid.centre - solid.half, solid.centre + solid.half)
    return np.asarray(corners @ T[:3, :3].T + T[:3, 3])


def box_corners(low: Iterable[float], high: Iterable[float]) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
