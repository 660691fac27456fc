"""Collision geometry of a planner as tables for C: spheres of moving bodies, and convex obstacles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from itertools import pairwise, product

import numpy as np
import numpy.typing as npt

from kineverse.compilation.batch import allocate_aligned
from kineverse.geometry.gjk import support_values
from kineverse.geometry.objects import CollisionObject
from kineverse.geometry.shapes import Hull, Solid
from kineverse.lie import Array
from kineverse.model.body import Box, Capsule, Cylinder, Sphere

from .bindings import BOX, CAPSULE, COARSE, CYLINDER, HULL, LINK, OBSTACLE, SHAPE, SPHERE, ObstacleSetStruct
from .spheres import SphereTree, cover_objects, make_sphere_tree
from .spheres.object_covers import cover_key, find_or_make_tree


class LinkTable:
    """Spheres of the moving bodies, each in the frame of its pose."""

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
        self.shapes["pose"] = np.reshape([T[:3] for items in members for _, _, T in items], (-1, 12))
        shapes = 0
        for k, (items, pose) in enumerate(zip(members, poses, strict=True)):
            link = self.links[k]
            link["pose"], link["first"] = pose, len(coarse)
            link["first_shape"], link["shapes"] = shapes, len(items)
            shapes += len(items)
            boxes = ((box_corners(s.centre - s.half, s.centre + s.half), T) for _, s, T in items)
            corners = np.concatenate([points @ T[:3, :3].T + T[:3, 3] for points, T in boxes])
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


def box_corners(low: Iterable[float], high: Iterable[float]) -> Array:
    """Return the corners (8, 3) of a box."""
    return np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T


_SAME_PLANE = 6  # digits in which planes of a hull differ
_ALIGNED = 1e-5  # largest distance of a shape from the one along the axes that stands for it [m]
_COSTS = np.array([2.0, 3.0, 1.5, 1.0, 0.0])
_EMPTY = 1e30  # coordinate of the boxes that fill the last chunk: nothing meets them

Floats32 = npt.NDArray[np.float32]


class ObstacleSet:
    """Solids in one frame, as C reads them."""

    def __init__(
        self,
        solids: Sequence[Solid],
        bodies: npt.NDArray[np.int32],
        poses: Array,
        planes: list[Array],
        lanes: int,
        pose: int = 0,
        link: int = 0,
        objects: npt.ArrayLike = 0,
    ) -> None:
        self._lanes, count = lanes, len(solids)
        self._centre = np.array([solid.centre for solid in solids]).reshape(-1, 3)
        self._half = np.array([solid.half for solid in solids]).reshape(-1, 3)
        centres = np.einsum("kij,kj->ki", poses[:, :, :3], self._centre) + poses[:, :, 3]
        self._order = order = _spatial_order(centres, lanes)
        self._centre, self._half = self._centre[order], self._half[order]
        chunks = -(-max(count, 1) // lanes)
        padded_chunks = -(-chunks // lanes) * lanes
        self._items = np.zeros(chunks * lanes, dtype=OBSTACLE)
        self._items["body"][:count] = bodies[order]
        self._items["object"][:count] = np.broadcast_to(objects, count)[order]
        self._sizes = np.zeros((count, 3))
        for k, solid in enumerate(solids[j] for j in order):
            self._describe(k, solid, planes)
        # About the numbers of operations.
        items = self._items[:count]
        self.cost = float(np.where(items["planes"] > 0, items["planes"] / 2, _COSTS[items["kind"]]).sum())
        self._boxes = _aligned_rows(6, chunks * lanes)
        self._chunks = _aligned_rows(6, padded_chunks)
        for boxes in (self._boxes, self._chunks):
            boxes[:3], boxes[3:] = _EMPTY, -_EMPTY
        self.struct = ObstacleSetStruct(
            self._items.ctypes.data, self._boxes.ctypes.data, self._chunks.ctypes.data, count, chunks * lanes,
            padded_chunks, pose, link,
        )  # fmt: skip
        self._poses = np.full((count, 3, 4), np.nan)
        self.place(poses)

    def _describe(self, k: int, solid: Solid, planes: list[Array]) -> None:
        item, shape = self._items[k], solid.surface
        if isinstance(shape, Box):
            item["kind"], self._sizes[k] = BOX, solid.half
        elif isinstance(shape, Sphere):
            item["kind"], self._sizes[k] = SPHERE, (shape.radius, 0.0, 0.0)
        elif isinstance(shape, Cylinder | Capsule):
            item["kind"] = CYLINDER if isinstance(shape, Cylinder) else CAPSULE
            self._sizes[k] = shape.radius, shape.length / 2, 0.0
        else:
            rows = _hull_planes(solid)
            item["kind"], item["first"], item["planes"] = HULL, sum(map(len, planes)), len(rows)
            planes.append(rows)

    def place(self, poses: Array) -> None:
        """Place all solids in the frame of the set."""
        poses = poses[self._order]
        moved = np.flatnonzero((poses != self._poses).any(axis=(1, 2)))
        if not len(moved):
            return
        self._poses, poses = poses, poses[moved]
        rotation, translation = poses[:, :, :3], poses[:, :, 3]
        extent = np.einsum("kij,kj->ki", np.abs(rotation), self._half[moved])
        centre = np.einsum("kij,kj->ki", rotation, self._centre[moved]) + translation
        # A box along the axes is the same box with its edges in another order.
        items, half = self._items[moved], self._half[moved].max(axis=1)
        box_slack = 2 * half * np.sort(np.abs(rotation), axis=2)[:, :, 1].max(axis=1)
        boxes = (box_slack <= _ALIGNED) & (items["kind"] == BOX)
        slack = 2 * half * np.abs(rotation[:, :2, 2]).max(axis=1)
        round_ = (slack <= _ALIGNED) & np.isin(items["kind"], (CYLINDER, CAPSULE))
        items["aligned"] = boxes | round_
        items["rotation"], items["translation"] = rotation.reshape(-1, 9), translation
        items["size"] = np.where(boxes[:, None], extent, self._sizes[moved] + (slack * round_)[:, None])
        self._items[moved] = items
        # The largest rounding of float at these places.
        extent += 1e-6 * (1.0 + np.abs(centre) + extent)
        self._boxes[:3, moved], self._boxes[3:, moved] = (centre - extent).T, (centre + extent).T
        chunks = self._boxes.reshape(6, -1, self._lanes)
        chunks[:3].min(axis=2, out=self._chunks[:3, : chunks.shape[1]])
        chunks[3:].max(axis=2, out=self._chunks[3:, : chunks.shape[1]])


def _aligned_rows(rows: int, columns: int) -> Floats32:
    """Allocate rows of floats that begin at cache lines, for whole vectors of columns."""
    return allocate_aligned(rows * columns // 2).view(np.float32).reshape(rows, columns)


def _hull_planes(solid: Solid) -> Array:
    """Return the planes (F, 4) of a hull, or of a polytope around another solid: normals and offsets [m].

    Planes that are equal up to rounding are one, as those of triangles in one face. Large faces come first,
    since they separate most.
    """
    surface = solid.surface
    if isinstance(surface, Hull):
        rows = np.column_stack([surface.normals, surface.offsets])
    else:
        # Unit vectors towards the faces, edges and corners of a cube.
        grid = np.array([v for v in product((-1.0, 0.0, 1.0), repeat=3) if any(v)])
        normals = grid / np.linalg.norm(grid, axis=1)[:, None]
        rows = np.column_stack([normals, support_values(solid, normals)])
    _, first, count = np.unique(np.round(rows, _SAME_PLANE), axis=0, return_index=True, return_counts=True)
    return np.asarray(rows[first[np.argsort(-count, kind="stable")]])


def _spatial_order(points: Array, size: int) -> npt.NDArray[np.intp]:
    """Order points so that those of a chunk are near to each other.

    The points are halved along the axis of their largest spread, at multiples of the size.
    """
    done: list[npt.NDArray[np.intp]] = []
    waiting = [np.arange(len(points))]
    while waiting:
        group = waiting.pop()
        if len(group) <= size:
            done.append(group)
            continue
        axis = int(np.argmax(np.ptp(points[group], axis=0)))
        group = group[np.argsort(points[group, axis], kind="stable")]
        half = -(-len(group) // (2 * size)) * size
        cuts = [0, half, len(group)]
        waiting += [group[a:b] for a, b in reversed(list(pairwise(cuts))) if b > a]
    return np.concatenate(done) if done else np.zeros(0, dtype=np.intp)
