"""Reachability analysis of a rounded path: the largest squared path speeds within the limits.

The two passes of TOPP-RA (Pham & Pham 2018, IEEE T-RO 34(3), algorithm 1), with x = ṡ² and u = s̈.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array

from .blends import BlendedPath


@dataclass(frozen=True, eq=False)
class PathGrid:
    """Cells of a path: straight segments, and parts of blends."""

    lengths: Array  # (K,), in the path parameter s
    first: Array  # (K, n), q' at the beginning
    last: Array  # (K, n), q' at the end
    curvature: Array  # (K, n), q''
    start: Array  # (K, n), q at the beginning
    straight: npt.NDArray[np.bool_]  # (K,), True for straight segments
    stops: npt.NDArray[np.bool_]  # (K+1,), True for nodes where the motion is at rest


def divide_path(path: BlendedPath, cells: int) -> PathGrid:
    """Divide a path into its straight segments and some cells for each blend."""
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
    places = blended[:, None] * (cells + 1) + 1 + np.arange(cells)
    order = np.argsort(np.concatenate([np.arange(segments) * (cells + 1), places.ravel()]))
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
    stops = np.concatenate(([True], ends[keep][:-1], [True]))
    return PathGrid(lengths[keep], first[keep], last[keep], bend[keep], start[keep], kind[keep], stops)


_ITERATIONS = 12  # most steps of searches among lines, which end after some three
_ROUNDING = 1e-9  # relative difference of values that is rounding
_LARGEST_CHANGE = 0.3  # relative change of q' in a cell up to which the tangent of the limit is used
_TINY = 1e-9  # relative size of a coefficient that counts as 0: a bound divided by it is rounding


def maximal_squared_speeds(grid: PathGrid, speeds: Array, accelerations: Array) -> Array:
    """Compute the largest squared path speeds at the nodes (K+1,) by a backward and a forward pass."""
    before, after = _speed_caps(grid, speeds)
    with np.errstate(divide="ignore", over="ignore"):
        path_accelerations = (accelerations / np.abs(grid.first)).min(axis=1)
    caps = np.append(before, np.inf)
    caps[1:] = np.minimum(caps[1:], after)
    caps[grid.stops] = 0.0
    gains = (2 * path_accelerations * grid.lengths).tolist()
    blended = np.flatnonzero(~grid.straight)
    program = CellPrograms(grid, blended, accelerations, caps)
    place = np.full(len(grid.lengths), -1)
    place[blended] = np.arange(len(blended))
    places, x = place.tolist(), caps.tolist()
    for i in range(len(places) - 1, -1, -1):
        k = places[i]
        x[i] = max(min(x[i], x[i + 1] + gains[i] if k < 0 else program.backward(k, x[i + 1])), 0.0)
    for i, k in enumerate(places):
        x[i + 1] = max(min(x[i + 1], x[i] + gains[i] if k < 0 else program.forward(k, x[i])), 0.0)
    return np.array(x)


def _speed_caps(grid: PathGrid, speeds: Array) -> tuple[Array, Array]:
    """Bound x at both ends of each cell (K,) so that q'·√x keeps the speed limits between them.

    In a cell x and q' are linear. x has to stay below (v/q')², which is convex, and below its tangent in the
    middle of the cell it does. Where q' changes much, it stays below the smallest value instead.
    """
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        least = (speeds / np.maximum(np.abs(grid.first), np.abs(grid.last))) ** 2
        change = 2 * (grid.last - grid.first) / (grid.first + grid.last)
        middle = (2 * speeds / np.abs(grid.first + grid.last)) ** 2
        near = np.abs(change) < _LARGEST_CHANGE
        before = np.where(near, middle * (1 + change), least)
        after = np.where(near, middle * (1 - change), least)
    return before.min(axis=1), after.min(axis=1)


class CellPrograms:
    """Linear programs of the cells of blends in (x₀, x₁), prepared for the two passes.

    The rows -b <= p·x₀ + q·x₁ <= b are the limits of the accelerations at both ends, with
    u = (x₁ - x₀)/(2·h). All hold at (0, 0), so what is possible from x₀ is possible from less.
    """

    def __init__(
        self, grid: PathGrid, cells: npt.NDArray[np.intp], accelerations: Array, caps: Array
    ) -> None:
        rate = 0.5 / grid.lengths[cells, None]
        first, last, bend = grid.first[cells] * rate, grid.last[cells] * rate, grid.curvature[cells]
        p = np.concatenate([bend - first, -last], axis=1)
        q = np.concatenate([first, last + bend], axis=1)
        b = np.tile(accelerations, 2)
        # Of each pair of rows, one bounds from above and the other one from below.
        self._x0, self._x1 = _lines(p, q, b), _lines(q, p, b)
        lower = _lines(p, q, -b)
        only = (np.abs(p) <= _TINY * np.abs(q)) & (q != 0)
        alone = np.where(only, b / np.where(only, np.abs(q), 1.0), np.inf).min(axis=1)
        self._best = self._find_best(lower, np.minimum(alone, caps[cells + 1])).tolist()
        self._row = np.empty(p.shape[1])

    def backward(self, cell: int, x1: float) -> float:
        """Return the largest x₀ from which a cell can be left with at most x₁."""
        return self._least(self._x0, cell, min(x1, self._best[cell]))

    def forward(self, cell: int, x0: float) -> float:
        """Return the largest x₁ that is reached from x₀."""
        return self._least(self._x1, cell, x0)

    def _least(self, lines: tuple[Array, Array], cell: int, x: float) -> float:
        offsets, slopes = lines
        np.multiply(slopes[cell], x, out=self._row)
        np.add(self._row, offsets[cell], out=self._row)
        return float(np.minimum.reduce(self._row))

    def _find_best(self, lower: tuple[Array, Array], most: Array) -> Array:
        """Find for each cell the x₁ of the largest x₀, or a little less, at most ``most``.

        The upper bound of x₀ is concave in x₁, and the lower bound convex. Newton's method from the right
        finds where they meet, and secants of the upper bound find its maximum before that.
        """
        if not len(most):
            return most
        for _ in range(_ITERATIONS):
            up, a, slope = _extreme(self._x0, most, np.argmin)
            low, c, other = _extreme(lower, most, np.argmax)
            crossed = up < low
            if not crossed.any():
                break
            meet = np.divide(a - c, other - slope, out=most.copy(), where=crossed)
            most = np.clip(meet, 0.0, most)
        left, right = np.zeros_like(most), most
        _, a, slope = _extreme(self._x0, left, np.argmin)
        _, c, other = _extreme(self._x0, right, np.argmin)
        rising = (slope > 0) & (other < 0)
        left = np.where((slope > 0) & ~rising, right, left)
        for _ in range(_ITERATIONS):
            meet = np.divide(c - a, slope - other, out=left.copy(), where=rising)
            up, e, between = _extreme(self._x0, meet, np.argmin)
            result = up >= (a + slope * meet) * (1 - _ROUNDING)
            ahead = rising & (result | (between > 0))
            left, a = np.where(ahead, meet, left), np.where(ahead, e, a)
            slope = np.where(ahead, between, slope)
            rising &= ~result
            if not rising.any():
                break
            c, other = np.where(ahead, c, e), np.where(ahead, other, between)
        return left


def _lines(divisor: Array, other: Array, b: Array) -> tuple[Array, Array]:
    """Return offsets and slopes of the bounds (±b - other·y)/divisor, above for b > 0 and below for b < 0."""
    used = np.abs(divisor) > _TINY * np.abs(other)
    safe = np.where(used, divisor, 1.0)
    return np.where(used, b / np.abs(safe), np.copysign(np.inf, b)), np.where(used, -other / safe, 0.0)


def _extreme(
    lines: tuple[Array, Array], y: Array, choose: Callable[..., npt.NDArray[np.intp]]
) -> tuple[Array, Array, Array]:
    """Return value, offset and slope of the lowest or highest line of each cell at y (K,)."""
    offsets, slopes = lines
    rows = np.arange(len(y)), choose(offsets + slopes * y[:, None], axis=1)
    return offsets[rows] + slopes[rows] * y, offsets[rows], slopes[rows]
