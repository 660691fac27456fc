"""Cells of a rounded path: straight segments, and parts of blends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array

from .blends import BlendedPath


@dataclass(frozen=True, eq=False)
class PathGrid:
    """Cells of a path: straight segments, and parts of blends."""

    lengths: Array  # lengths in s (K,)
    first: Array  # derivatives q' at the ends (K, n)
    last: Array
    curvature: Array  # derivatives q'' (K, n)
    start: Array  # configurations at the beginning (K, n)
    straight: npt.NDArray[np.bool_]  # flags of the cells that are straight segments (K,)
    stops: npt.NDArray[np.bool_]  # flags of the nodes where the motion is at rest (K+1,)


def divide_path(path: BlendedPath, cells: int) -> PathGrid:
    """Divide a path into cells."""
    segments = len(path.lengths)
    reach = np.concatenate(([0.0], path.reach, [0.0]))
    straight = path.lengths - reach[:-1] - reach[1:]
    blended = np.flatnonzero(path.reach > 0)
    u = np.arange(cells + 1)[:, None] / cells
    before, after = path.directions[blended, None], path.directions[blended + 1, None]
    tangents = (1 - u) * before + u * after
    corner, distance = path.points[blended + 1, None], path.reach[blended, None, None]
    configurations = corner + distance * (u**2 * after - (1 - u) ** 2 * before)
    curvature = np.repeat(path.curvature[blended], cells, axis=0)
    n = path.points.shape[1]
    order = np.argsort(
        np.concatenate(
            [
                np.arange(segments) * (cells + 1),
                (blended[:, None] * (cells + 1) + 1 + np.arange(cells)).ravel(),
            ]
        )
    )
    lengths = np.concatenate([straight, np.repeat(2 * path.reach[blended] / cells, cells)])[order]
    first = np.concatenate([path.directions, tangents[:, :-1].reshape(-1, n)])[order]
    last = np.concatenate([path.directions, tangents[:, 1:].reshape(-1, n)])[order]
    bend = np.concatenate([np.zeros((segments, n)), curvature])[order]
    begin = path.points[:-1] + reach[:-1, None] * path.directions
    start = np.concatenate([begin, configurations[:, :-1].reshape(-1, n)])[order]
    kind = order < segments
    # The corner where segment k ends is a stop, unless it is blended or straight.
    stop = np.append(path.turns & (path.reach <= 0), True)
    ends = np.where(kind, np.append(stop, False)[np.minimum(order, segments)], False)
    keep = ~kind | (lengths > 8 * np.finfo(float).eps * path.lengths.max())
    ends[-1] = True
    # A segment that its blends use up ends at no stop.
    return PathGrid(
        lengths[keep],
        first[keep],
        last[keep],
        bend[keep],
        start[keep],
        kind[keep],
        np.concatenate(([True], ends[keep][:-1], [True])),
    )
