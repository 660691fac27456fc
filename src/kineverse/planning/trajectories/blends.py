"""Polylines with rounded corners: parabolic blends between straight segments.

A corner c between segments of the directions d₁ and d₂ is replaced by the quadratic Bézier curve with the
control points c - l·d₁, c, c + l·d₂. With the parameter s, which grows by 2·l on it and by their length on
straight segments, the derivative q'(s) is continuous and piecewise linear, and q''(s) is piecewise constant:
0 on segments, (d₂ - d₁)/(2·l) on the blend. The curve stays in the triangle of its control points, and is
nearest to the corner in its middle, at the distance l·|d₂ - d₁|/4.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.lie import Array

Validity: TypeAlias = Callable[[Array], npt.NDArray[np.bool_]]
"""Function that returns (N,) flags for configurations (N, n): True for those that are valid."""

_HALVINGS = 8  # number of times that a blend is halved before the path stops at the corner

_STRAIGHT = 1e-9
"""Norm of d₂ - d₁ below which there is no corner; and the length of a step, relative to that of the path,
below which it has no direction."""

_ROUNDING = 1e-12
"""Error of points, relative to 1 and to their largest coordinate: some thousand units in the last place, as
computations leave them."""

_RESOLUTION = 1 / 32  # largest distance between two configurations of a blend that are checked [rad], [m]


@dataclass(frozen=True, eq=False)
class BlendedPath:
    """Polyline in configuration space with parabolic blends at its corners.

    Attributes
    ----------
    points
        Corners, first and last point (N, n), no two successive ones equal.
    directions
        Unit vectors of the segments (N-1, n), in the Euclidean norm of the coordinates.
    lengths
        Lengths of the segments (N-1,).
    reach
        Distances l from the inner corners at which their blends begin and end (N-2,); 0 for none.

    See Also
    --------
    kineverse.planning.round_corners
    """

    points: Array
    directions: Array
    lengths: Array
    reach: Array

    @property
    def turns(self) -> npt.NDArray[np.bool_]:
        """Flags of the inner corners where the direction changes (N-2,)."""
        return _find_turns(self.points, self.directions, self.lengths)

    @property
    def deviation(self) -> Array:
        """Distances between the inner corners and their blends (N-2,)."""
        return np.asarray(self.reach * np.linalg.norm(np.diff(self.directions, axis=0), axis=1) / 4)

    @property
    def curvature(self) -> Array:
        """Second derivatives q'' of the blends (N-2, n); 0 where there is none."""
        change: Array = np.diff(self.directions, axis=0)
        reach = self.reach[:, None]
        return np.where(reach > 0, change / np.where(reach > 0, 2 * reach, 1.0), 0.0)

    def blend(self, corner: int, count: int) -> Array:
        """Return ``count`` configurations on the blend of an inner corner, both ends included."""
        return np.asarray(_blend_points(self, np.array([corner]), count)[0])


def round_corners(
    points: npt.ArrayLike,
    deviation: npt.ArrayLike = 0.0,
    valid: Validity | None = None,
    *,
    resolution: float = _RESOLUTION,
) -> BlendedPath:
    """Return a polyline with rounded corners.

    Successive points that are equal up to rounding count once, and points on the line between their
    neighbours take no room from blends. A blend takes at most half of an inner segment. It is halved until
    all its configurations are valid, at most 8 times; after that, the path goes through the corner, and has
    to stop there.

    Parameters
    ----------
    points
        Polyline (N, n) [rad], [m].
    deviation
        Largest distances between path and corners, in the Euclidean norm of the coordinates: a number, or
        one for each point of the polyline (N,), of which the first and last do not count. 0 for no blend.
    valid
        Function that says which of (K, n) configurations are valid; None to accept all blends.
    resolution
        Largest distance between two configurations that are checked.

    Raises
    ------
    ShapeError, InvalidValueError
        For points that are not an (N, n) array of finite numbers, N >= 1, or a deviation that is not a number
        from 0 or of another shape.

    Examples
    --------
    >>> path = kv.planning.round_corners([[0, 0], [1, 0], [1, 1]], deviation=0.1)
    >>> path.deviation
    array([0.1])
    """
    polyline = np.array(points, dtype=float)
    if polyline.ndim != 2 or not polyline.size:
        raise ShapeError(f"A path is an array (N, n) of N >= 1 points, not of shape {polyline.shape}.")
    if not np.isfinite(polyline).all():
        raise InvalidValueError("The points of a path are finite; there is a NaN or an infinity among them.")
    keep = _find_distinct(polyline)
    # Of points that count once, the strictest deviation counts; and the path ends at the last one.
    allowed = np.minimum.reduceat(each_deviation(deviation, len(polyline)), keep)
    allowed[[0, -1]] = 0.0
    keep[1:][-1:] = len(polyline) - 1
    if len(keep) > 2 and allowed.any():
        corners = _find_corners(polyline[keep], allowed)
        keep, allowed = keep[corners], allowed[corners]
    kept = polyline[keep]
    directions, lengths = _segments(kept)
    if len(kept) == 1:
        return BlendedPath(*map(_read_only, (kept, directions, lengths, np.zeros(0))))
    turn = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    turns = _find_turns(kept, directions, lengths)
    room = lengths / 2
    room[[0, -1]] = lengths[[0, -1]]  # no blend takes the other half
    reach = np.minimum(room[:-1], room[1:])
    reach = np.where(turns, np.minimum(reach, 4 * allowed[1:-1] / np.where(turns, turn, 1.0)), 0.0)
    path = BlendedPath(*map(_read_only, (kept, directions, lengths, reach)))
    return path if valid is None else _shrink(path, valid, resolution)


def each_deviation(deviation: npt.ArrayLike, count: int) -> Array:
    """Return the largest distances (N,) from the points of a polyline."""
    allowed = np.asarray(deviation, dtype=float)
    if allowed.shape not in ((), (count,)):
        raise ShapeError(
            f"deviation= is a number or an array of one for each of the {count} points, not of shape "
            f"{allowed.shape}."
        )
    if not (allowed >= 0).all():
        raise InvalidValueError(f"deviation= is a distance from 0, not {allowed}.")
    return np.broadcast_to(allowed, count)


def _segments(points: Array) -> tuple[Array, Array]:
    """Return the directions (N-1, n) and lengths (N-1,) of a polyline (N, n)."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    return steps / lengths[:, None], lengths


def _rounding(points: Array) -> float:
    return _ROUNDING * (1.0 + float(np.abs(points).max()))


def _find_turns(points: Array, directions: Array, lengths: Array) -> npt.NDArray[np.bool_]:
    """Return flags of the inner corners (N-2,) where the direction changes by more than rounding."""
    turn = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    shorter = np.minimum(lengths[:-1], lengths[1:])
    return np.asarray(turn > _STRAIGHT + _rounding(points) / shorter)


def _find_distinct(points: Array) -> npt.NDArray[np.intp]:
    """Return the indices of points (N, n) that differ from the one before by more than rounding."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    apart = max(_rounding(points), _STRAIGHT * float(steps.sum()))
    if (steps > apart).all():
        return np.arange(len(points))
    kept = [0]
    for k in range(1, len(points)):
        if np.linalg.norm(points[k] - points[kept[-1]]) > apart:
            kept.append(k)
    return np.array(kept)


def _find_corners(points: Array, allowed: Array) -> npt.NDArray[np.intp]:
    """Return the indices of points (N, n), no two equal in a row, that are not on a line with others.

    A curve of many points turns at none of them, so the line between the ends of a straight part decides. On
    a path that never turns all count. So do points to which the path has to come nearer than to an end of
    their line, by the allowed deviations (N,).
    """
    turns = _find_turns(points, *_segments(points))
    if not turns.any():
        return np.arange(len(points))
    ends = np.concatenate(([0], 1 + np.flatnonzero(turns), [len(points) - 1]))
    kept = [np.array([0])]
    for first, last in itertools.pairwise(ends.tolist()):
        inner = points[first + 1 : last] - points[first]
        chord = points[last] - points[first]
        length = float(np.linalg.norm(chord))
        direction = chord / max(length, np.finfo(float).tiny)
        off = np.linalg.norm(inner - (inner @ direction)[:, None] * direction, axis=1)
        straight = off.max(initial=0.0) <= _STRAIGHT * length + _rounding(points)
        near = allowed[first + 1 : last].min(initial=np.inf) < allowed[[first, last]].max()
        kept.append(np.array([last]) if straight and not near else np.arange(first + 1, last + 1))
    return np.concatenate(kept)


def _shrink(path: BlendedPath, valid: Validity, resolution: float) -> BlendedPath:
    reach = path.reach.copy()
    open_corners = np.flatnonzero(reach > 0)
    for _ in range(_HALVINGS + 1):
        if not len(open_corners):
            return path
        count = 1 + int(np.ceil(2 * path.reach[open_corners].max() / resolution))
        samples = _blend_points(path, open_corners, max(count, 3))
        flags = np.asarray(valid(samples.reshape(-1, path.points.shape[1])), dtype=bool)
        if flags.shape != (samples.shape[0] * samples.shape[1],):
            raise ShapeError(
                f"valid= returns a flag for each of the {samples.shape[0] * samples.shape[1]} "
                f"configurations, not an array of shape {flags.shape}."
            )
        open_corners = open_corners[~flags.reshape(samples.shape[:2]).all(axis=1)]
        reach[open_corners] /= 2
        path = replace(path, reach=_read_only(reach.copy()))
    reach[open_corners] = 0.0
    return replace(path, reach=_read_only(reach))


def _blend_points(path: BlendedPath, corners: npt.NDArray[np.intp], count: int) -> Array:
    u = np.linspace(0.0, 1.0, count)[:, None]
    reach = path.reach[corners, None, None]
    before, after = path.directions[corners, None], path.directions[corners + 1, None]
    return np.asarray(path.points[corners + 1, None] + reach * (u**2 * after - (1 - u) ** 2 * before))


def _read_only(array: Array) -> Array:
    array.flags.writeable = False
    return array
