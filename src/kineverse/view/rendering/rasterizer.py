"""Software rasterizer with a z-buffer, in numpy.

It needs no graphics library, so it runs on any machine on which the core runs. Rows of triangles are laid out
as one long list of pixels, so that the work is proportional to the covered area and no loop runs over
triangles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.view.drawables import Drawable

from .camera import Camera
from .triangle_mesh import Floats, Integers

FRAGMENTS = 1_500_000  # pixels handled at once: between numpy's overhead and the size of the caches


@dataclass(frozen=True, slots=True)
class Projection:
    """Pinhole (or, with ``scale`` set, parallel) projection on a grid of pixels.

    ``axes`` are right, up and ahead as rows; x of a pixel grows to the right, y downwards.
    """

    origin: Floats
    axes: Floats
    width: int
    height: int
    focal: float
    parallel: bool = False

    @staticmethod
    def from_camera(camera: Camera, width: int, height: int) -> Projection:
        """Return the projection of a camera to a picture of a width and height [pixels]."""
        focal = 0.5 * height / np.tan(camera.field_of_view / 2)
        return Projection(np.asarray(camera.position, dtype=float), camera.axes, width, height, float(focal))

    def to_camera(self, points: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return world points (..., 3) in the axes right, up, ahead from the origin [m]."""
        x, y, z = (points[..., k] - points.dtype.type(self.origin[k]) for k in range(3))
        local = np.empty_like(points)
        # Term by term: a matrix product with so short an axis costs several times as much.
        for k, (a, b, c) in enumerate(self.axes.astype(points.dtype)):
            local[..., k] = a * x + b * y + c * z
        return local

    def to_pixels(self, local: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return pixel coordinates (..., 2) and a nearness (...) that is linear over the picture."""
        ahead = local[..., 2]
        nearness = -ahead if self.parallel else 1.0 / ahead
        factor = self.focal if self.parallel else self.focal * nearness[..., None]
        kind = local.dtype
        xy = local[..., :2] * factor * np.array([1.0, -1.0], dtype=kind)
        return xy + np.array([self.width / 2, self.height / 2], dtype=kind), nearness

    def pixel_rays(self, pixel: Integers) -> npt.NDArray[np.float32]:
        """Return world directions (N, 3) through pixels given as y·width + x, one metre ahead."""
        y, x = np.divmod(pixel.astype(np.int32), np.int32(self.width))
        right = (x.astype(np.float32) + np.float32(0.5 - self.width / 2)) / np.float32(self.focal)
        up = (np.float32(self.height / 2 - 0.5) - y.astype(np.float32)) / np.float32(self.focal)
        rays = np.empty((len(pixel), 3), dtype=np.float32)
        for k in range(3):
            rays[:, k] = right * np.float32(self.axes[0, k])
            rays[:, k] += up * np.float32(self.axes[1, k]) + np.float32(self.axes[2, k])
        return rays


def rasterize(
    projection: Projection,
    corners: npt.NDArray[Any],
    one_sided: npt.NDArray[np.bool_] | None = None,
    opacity: Floats | None = None,
    near: float = 0.01,
) -> tuple[Integers, npt.NDArray[np.float32]]:
    """Return the visible triangle of each pixel and its nearness."""
    local, owner = projection.to_camera(corners), np.arange(len(corners))
    if not projection.parallel:
        local, owner = _clip(local, owner, near)
    xy, nearness = projection.to_pixels(local)
    u, v = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    (left, right), (top, bottom) = _extremes(xy[:, :, 0]), _extremes(xy[:, :, 1])
    keep = (np.abs(area) > 1e-9) & (right > 0) & (bottom > 0)
    keep &= (left < projection.width) & (top < projection.height)
    if one_sided is not None:
        # y grows downwards, so counter-clockwise triangles have a negative area here.
        keep &= ~one_sided[owner] | (area < 0)
    kept = np.flatnonzero(keep)
    # From near to far: later pixels are then mostly hidden and dropped at once.
    kept = kept[np.argsort(-_extremes(nearness[kept])[1])]
    edges, depth = _equations(*(part[kept].astype(float) for part in (xy, nearness, area)))
    cover = None if opacity is None else opacity[owner[kept]]
    seen, best = _fill(projection, (top[kept], bottom[kept]), edges, depth, cover)
    table = np.concatenate([owner[kept], [-1]])
    return table[seen], best


def _clip(local: npt.NDArray[Any], owner: Integers, near: float) -> tuple[npt.NDArray[Any], Integers]:
    """Cut triangles at the plane ``near`` ahead; a triangle becomes none, one or two."""
    inside = local[:, :, 2] > near
    if inside.all():
        return local, owner
    count = inside.sum(axis=1)
    parts, owners = [local[count == 3]], [owner[count == 3]]
    for corners_inside in (1, 2):
        chosen = np.flatnonzero(count == corners_inside)
        if not len(chosen):
            continue
        odd = inside[chosen] if corners_inside == 1 else ~inside[chosen]
        # The corner that is alone on its side comes first, the order stays.
        turn = (np.argmax(odd, axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(local[chosen], turn[:, :, None], axis=1), 1, 0)
        ab, ac = _intersect_near_plane(a, b, near), _intersect_near_plane(a, c, near)
        parts.append(np.stack([a, ab, ac] if corners_inside == 1 else [ab, b, c], axis=1))
        owners.append(owner[chosen])
        if corners_inside == 2:
            parts.append(np.stack([ab, c, ac], axis=1))
            owners.append(owner[chosen])
    return np.concatenate(parts), np.concatenate(owners)


def _intersect_near_plane(a: npt.NDArray[Any], b: npt.NDArray[Any], near: float) -> npt.NDArray[Any]:
    share = (near * (1 + 1e-9) - a[:, 2]) / (b[:, 2] - a[:, 2])
    return np.asarray(a + share[:, None] * (b - a))


def _equations(xy: Floats, nearness: Floats, area: Floats) -> tuple[Floats, Floats]:
    """Return (T, 3, 3) edges and (T, 3) depth as a·x + b·y + c; an edge is >= 0 inside the triangle."""
    following = np.roll(xy, -1, axis=1)
    step = following - xy
    a, b = -step[:, :, 1], step[:, :, 0]
    c = -(a * xy[:, :, 0] + b * xy[:, :, 1])
    edges = np.stack([a, b, c], axis=2) * np.sign(area)[:, None, None]
    # The edge from k to k+1 over the area is the barycentric coordinate of corner k+2.
    weights = np.roll(edges, -2, axis=1) / np.abs(area)[:, None, None]
    depth = np.einsum("tk,tkj->tj", nearness, np.roll(weights, 1, axis=1))
    return edges, depth


def _fill(
    projection: Projection,
    reach: tuple[Floats, Floats],
    edges: Floats,
    depth: Floats,
    cover: Floats | None,
) -> tuple[Integers, npt.NDArray[np.float32]]:
    """Return the visible triangle (-1 for none) and its nearness for all pixels.

    ``reach`` are the upper and lower ends of the triangles [pixels], ``edges`` and ``depth`` their equations.
    """
    width, height = projection.width, projection.height
    best = np.full(width * height, -np.inf, dtype=np.float32)
    seen = np.full(width * height, -1, dtype=np.int32)
    first = np.clip(np.ceil(reach[0] - 0.5), 0, height).astype(np.int64)
    last = np.clip(np.floor(reach[1] - 0.5), -1, height - 1).astype(np.int64)
    rows = np.maximum(last - first + 1, 0)
    triangle = np.repeat(np.arange(len(edges)), rows)
    y = np.arange(len(triangle)) - np.repeat(np.cumsum(rows) - rows, rows) + np.repeat(first, rows)
    start, stop = _spans(edges[triangle], y, width)
    length = np.maximum(stop - start, 0)
    some = length > 0
    triangle, y, start, length = triangle[some], y[some], start[some], length[some]
    ends = np.cumsum(length)
    base = depth[triangle, 1] * (y + 0.5) + depth[triangle, 2] + 0.5 * depth[triangle, 0]
    row, begin = 0, 0
    while row < len(length):
        end = int(np.searchsorted(ends, begin + FRAGMENTS, side="right"))
        end = max(end, row + 1)
        part = slice(row, end)
        n = length[part]
        x = np.arange(int(n.sum()), dtype=np.int32)
        x += np.repeat((start[part] - (ends[part] - n - begin)).astype(np.int32), n)
        pixel = x + np.repeat((y[part] * width).astype(np.int32), n)
        owner = np.repeat(triangle[part].astype(np.int32), n)
        near = np.repeat(base[part].astype(np.float32), n)
        near += np.repeat(depth[triangle[part], 0].astype(np.float32), n) * x
        ahead = near > best[pixel]
        if cover is not None:
            # Bayer's pattern of thresholds: half of a half-opaque face is drawn.
            ahead &= _PATTERN[(pixel // width) % 4, x % 4] < cover[owner]
        pixel, near, owner = pixel[ahead], near[ahead], owner[ahead]
        np.maximum.at(best, pixel, near)
        wins = near == best[pixel]
        seen[pixel[wins]] = owner[wins]
        begin, row = int(ends[end - 1]), end
    return seen.astype(np.int64), best


def _spans(edges: Floats, y: Integers, width: int) -> tuple[Integers, Integers]:
    """Return the first and one past the last pixel of rows whose centres lie inside all three edges."""
    a, rest = edges[:, :, 0], edges[:, :, 1] * (y + 0.5)[:, None] + edges[:, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = -rest / a
    low = _extremes(np.where(a > 0, crossing, -np.inf))[1]
    high = _extremes(np.where(a < 0, crossing, np.inf))[0]
    outside = (a == 0) & (rest < 0)
    empty = outside[:, 0] | outside[:, 1] | outside[:, 2]
    start = np.clip(np.ceil(low - 0.5), 0, width).astype(np.int64)
    stop = np.clip(np.floor(high - 0.5) + 1, 0, width).astype(np.int64)
    return start, np.where(empty, start, stop)


def _extremes(triples: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Return least and greatest of each row of three; far faster than a reduction over so short an axis."""
    a, b, c = triples[:, 0], triples[:, 1], triples[:, 2]
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


_PATTERN = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]]) / 16.0


@dataclass(frozen=True, slots=True)
class TriangleSoup:
    """All triangles of a scene in the world, each with its colour and its part.

    ``corners`` (T, 3, 3) [m], ``normals`` (T, 3, 3), ``colors`` (T, 4), ``source`` (T,) the number of the
    part, ``group`` (T,) of the frame and colour it belongs to, ``closed`` (T,) True if the inside is never
    visible.
    """

    corners: Floats
    normals: Floats
    colors: Floats
    source: Integers
    group: Integers
    closed: npt.NDArray[np.bool_]

    @staticmethod
    def from_drawables(items: Sequence[Drawable], poses: Mapping[str, Floats]) -> TriangleSoup:
        """Place parts by the poses of their frames."""
        empty = np.zeros((0, 3, 3))
        corners, normals, colors, source, group, closed = [empty], [empty], [np.zeros((0, 4))], [], [], []
        groups: dict[object, int] = {}
        for number, part in enumerate(items):
            surface = part.surface.transform(poses[part.frame])
            count = len(surface.faces)
            corners.append(surface.vertices[surface.faces])
            normals.append(surface.normals[surface.faces])
            own = surface.colors
            colors.append(np.tile(part.color, (count, 1)) if own is None else own)
            source.append(np.full(count, number))
            group.append(np.full(count, groups.setdefault((part.frame, part.color), len(groups))))
            closed.append(np.full(count, surface.closed))
        return TriangleSoup(
            np.concatenate(corners),
            np.concatenate(normals),
            np.concatenate(colors),
            np.concatenate([np.zeros(0, dtype=np.int64), *source]),
            np.concatenate([np.zeros(0, dtype=np.int64), *group]),
            np.concatenate([np.zeros(0, dtype=np.bool_), *closed]),
        )
