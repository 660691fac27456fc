"""Time-optimal path parameterisation within speed and acceleration limits.

A path q(s) is followed with the squared path speed x = ṡ² and the path acceleration u = s̈, so that
q̇ = q'·√x and q̈ = q'·u + q''·x. The limits are linear in (u, x). A backward pass over a grid finds the
largest controllable x at each node, and a forward pass takes the largest x that is reachable from the start:
reachability analysis, TOPP-RA (Pham & Pham 2018, IEEE T-RO 34(3), section IV).

On a :class:`.BlendedPath` this needs few nodes. A straight segment is one cell, whose profile is a trapezoid
in closed form. On a cell of a blend, u is constant, so that q̈ is linear in s, and its limits hold
everywhere in the cell if they hold at both ends: a linear program in the values (x₀, x₁) at the ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .blends import BlendedPath, Validity, round_corners
from .trajectory import Trajectory


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


_CELLS = 250  # cells of all blends together, where none is asked for
_FEWEST = 4  # fewest cells of a blend
_EXCESS = 1e-3  # error of the accelerations of cubics between knots, relative to the limits
_MOST_PHASES = 50  # most knots of a cell
_ROUNDING = 1e-9  # relative difference of values that is rounding
_SHORTEST = 4 * np.finfo(float).eps  # shortest relative time between two knots


def time_parameterize(
    points: npt.ArrayLike | BlendedPath,
    velocity_limits: npt.ArrayLike,
    acceleration_limits: npt.ArrayLike,
    symbols: Sequence[Symbol],
    *,
    deviation: npt.ArrayLike = 0.0,
    valid: Validity | None = None,
    cells: int = _CELLS,
) -> Trajectory:
    """Return the fastest motion along a path, from rest to rest, within limits of each coordinate.

    The corners of the path are rounded by :func:`.round_corners`. Where they are not, the motion stops. On a
    straight path the duration is that of the trapezoidal profile. Blends are followed with a path
    acceleration that is constant in each cell, so the duration falls a little with more of them.

    Parameters
    ----------
    points
        Polyline (N, n) [rad], [m], or a path whose corners have been rounded.
    velocity_limits
        Largest speeds (n,) [rad/s], [m/s], or a number for all; infinite for none.
    acceleration_limits
        Largest accelerations (n,) [rad/s²], [m/s²], or a number for all.
    symbols
        Coordinates (n,), the columns of the points.
    deviation
        Largest distances between the path and the corners of the polyline; see :func:`.round_corners`.
    valid
        Function that says which configurations (K, n) are valid, for the blends.
    cells
        Number of cells of all blends together, of which each has at least 4.

    Raises
    ------
    ShapeError
        For limits or symbols of another number than the columns of the points.
    InvalidValueError
        For a limit that is not positive, or an acceleration that is not finite, of a coordinate that moves;
        as :func:`.round_corners`.

    Examples
    --------
    >>> x, y = kv.position("x"), kv.position("y")
    >>> corner = [[0, 0], [1, 0], [1, 1]]
    >>> motion = kv.planning.time_parameterize(corner, 1.0, 2.0, symbols=[x, y], deviation=0.1)
    >>> round(motion.duration, 1), motion.positions[-1]
    (2.5, array([1., 1.]))
    """
    path = points if isinstance(points, BlendedPath) else round_corners(points, deviation, valid)
    n = path.points.shape[1]
    if len(symbols) != n:
        raise ShapeError(f"The path has {n} columns, and there are {len(symbols)} symbols.")
    if len(path.points) == 1:
        return Trajectory(tuple(symbols), np.zeros(1), path.points, np.zeros((1, n)))
    speeds, accelerations = _limits(path, velocity_limits, acceleration_limits, symbols)
    blends = max(int(np.count_nonzero(path.reach)), 1)
    grid = divide_path(path, max(as_count("cells", cells, 0) // blends, _FEWEST))
    x = maximal_squared_speeds(grid, speeds, accelerations)
    times, positions, velocities = _motion(grid, x, speeds, accelerations)
    positions[[0, -1]], velocities[-1] = path.points[[0, -1]], 0.0
    return Trajectory(tuple(symbols), times, positions, velocities)


def _limits(
    path: BlendedPath, velocity: npt.ArrayLike, acceleration: npt.ArrayLike, symbols: Sequence[Symbol]
) -> tuple[Array, Array]:
    """Check the limits of the coordinates (n,); infinite speeds become those that none reaches."""
    n = path.points.shape[1]
    travel = np.abs(np.diff(path.points, axis=0)).sum(axis=0)
    result = []
    for noun, values in (("speed", velocity), ("acceleration", acceleration)):
        limits = np.array(values, dtype=float)
        if limits.shape not in ((), (n,)):
            raise ShapeError(f"The {noun} limits are a number or {n} numbers, not of shape {limits.shape}.")
        limits = np.broadcast_to(limits, (n,)).copy()
        good = (limits > 0) & ((noun == "speed") | np.isfinite(limits))
        for k in np.flatnonzero(~good & (travel > 0)):
            wanted = "positive" if noun == "speed" else "positive and finite"
            raise InvalidValueError(
                f"The {noun} limit of '{symbols[int(k)]}', which moves, is {wanted}, not {limits[k]:g}."
            )
        limits[~good] = 1.0
        result.append(limits)
    speeds, accelerations = result
    # With the acceleration a over the travel S the speed stays below √(2·a·S).
    return np.minimum(speeds, 2 * np.sqrt(accelerations * travel) + np.finfo(float).tiny), accelerations


class _Phases(NamedTuple):
    """Parts of cells in which the path speed is linear in time, (P,) each."""

    cells: npt.NDArray[np.intp]
    durations: Array  # [s]
    begins: Array  # beginning within the cell, in the path parameter
    lengths: Array
    before: Array  # path speeds ṡ at both ends
    after: Array


def _straight_phases(grid: PathGrid, x: Array, speeds: Array, accelerations: Array) -> _Phases:
    """Divide each straight segment into three phases: faster, at its largest speed, slower."""
    cells = np.flatnonzero(grid.straight)
    first, last, length = x[cells], x[cells + 1], grid.lengths[cells]
    with np.errstate(divide="ignore", over="ignore"):
        cap = ((speeds / np.abs(grid.first[cells])) ** 2).min(axis=1)
        slope = (accelerations / np.abs(grid.first[cells])).min(axis=1)
    peak = np.minimum(cap, (first + last) / 2 + slope * length)
    peak = np.maximum(peak, np.maximum(first, last))
    before, fast, after = np.sqrt(first), np.sqrt(peak), np.sqrt(last)
    up, down = (peak - first) / (2 * slope), (peak - last) / (2 * slope)
    along = np.maximum(length - up - down, 0.0)
    return _Phases(
        np.repeat(cells, 3),
        np.stack([(fast - before) / slope, along / fast, (fast - after) / slope], axis=1).ravel(),
        np.stack([0 * up, up, up + along], axis=1).ravel(),
        np.stack([up, along, down], axis=1).ravel(),
        np.stack([before, fast, fast], axis=1).ravel(),
        np.stack([fast, fast, after], axis=1).ravel(),
    )


def _blend_phases(grid: PathGrid, x: Array, accelerations: Array) -> _Phases:
    """Divide the cells of blends into phases so short that cubics are near to the motion.

    The motion has the fourth derivative 3·q''·u² in time. At the ends of a phase of duration T, the second
    derivative of the cubic with the same ends differs by that times T²/12.
    """
    cells = np.flatnonzero(~grid.straight)
    rate, following = np.sqrt(x[cells]), np.sqrt(x[cells + 1])
    duration = 2 * grid.lengths[cells] / (rate + following)
    bend = np.abs(grid.curvature[cells]) / (4 * accelerations)
    error = bend.max(axis=1, initial=0.0) * (following - rate) ** 2
    counts = np.clip(np.ceil(np.sqrt(error / _EXCESS)), 1, _MOST_PHASES).astype(int)
    owner = np.repeat(np.arange(len(cells)), counts)
    number = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    step = (duration / counts)[owner]
    change = ((following - rate) / duration)[owner]
    before = rate[owner] + change * step * number
    after = before + change * step
    begins = (rate[owner] + before) / 2 * step * number
    return _Phases(cells[owner], step, begins, (before + after) / 2 * step, before, after)


def _motion(grid: PathGrid, x: Array, speeds: Array, accelerations: Array) -> tuple[Array, Array, Array]:
    """Compute times (T,), positions and velocities (T, n) of the motion with the squared path speeds x."""
    blends = _blend_phases(grid, x, accelerations)
    slower = _excess(grid, blends, speeds, accelerations)
    straight = _straight_phases(grid, x, speeds, accelerations)
    phases = _Phases(*(np.concatenate(pair) for pair in zip(straight, blends, strict=True)))
    order = np.argsort(phases.cells, kind="stable")
    order = order[(phases.durations > _SHORTEST * phases.durations.sum())[order]]
    cells, s = phases.cells[order], (phases.begins + phases.lengths)[order, None]
    tangents = grid.first[cells] + grid.curvature[cells] * s
    positions = grid.start[cells] + (grid.first[cells] + tangents) / 2 * s
    velocities = tangents * phases.after[order, None] / slower
    times = np.append(0.0, slower * np.cumsum(phases.durations[order]))
    start = grid.start[:1]
    return times, np.concatenate([start, positions]), np.concatenate([0 * start, velocities])


def _excess(grid: PathGrid, phases: _Phases, speeds: Array, accelerations: Array) -> float:
    """Return the factor on all times, at least 1, with which the cubics of blends keep the limits.

    On straight segments the cubics are the motion.
    """
    if not len(phases.cells):
        return 1.0
    first, bend = grid.first[phases.cells], grid.curvature[phases.cells]
    begin, length, dt = (values[:, None] for values in (phases.begins, phases.lengths, phases.durations))
    mean = (first + bend * (begin + length / 2)) * length / dt
    before = (first + bend * begin) * phases.before[:, None]
    after = (first + bend * (begin + length)) * phases.after[:, None]
    initial = (6 * mean - 4 * before - 2 * after) / dt
    final = (2 * before + 4 * after - 6 * mean) / dt
    factor = np.sqrt((np.maximum(np.abs(initial), np.abs(final)) / accelerations).max())
    jerk = final - initial
    inside = np.abs(initial + final) < np.abs(jerk)
    turning = np.where(inside, before - initial**2 * dt / (2 * np.where(inside, jerk, 1.0)), 0.0)
    factor = max(float(factor), float((np.abs(turning) / speeds).max()))
    return factor if factor > 1 + _ROUNDING else 1.0
