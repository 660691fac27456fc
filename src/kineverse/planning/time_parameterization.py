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

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from kineverse._checks import as_count
from kineverse.errors import InvalidValueError, ShapeError
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .blends import BlendedPath, Validity, round_corners
from .path_grid import PathGrid, make_grid
from .reachability import maximal_squared_speeds
from .trajectory import Trajectory

_CELLS = 5
"""Cells of a blend."""

_PARTS = 3
"""Knots of a cell: between them a trajectory is a cubic, which differs a little from the motion."""

_ROUNDING = 1e-9
"""Relative excess of a limit that is rounding."""

_SHORTEST = 1e-12
"""Shortest time between two knots, relative to the duration."""


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
        Number of cells of a blend.

    Raises
    ------
    ShapeError
        For limits or symbols of another number than the columns of the points.
    InvalidValueError
        For a limit that is not positive, or an acceleration that is not finite, of a coordinate that moves;
        as :func:`.round_corners`.
    """
    path = points if isinstance(points, BlendedPath) else round_corners(points, deviation, valid)
    n = path.points.shape[1]
    if len(symbols) != n:
        raise ShapeError(f"The path has {n} columns, and there are {len(symbols)} symbols.")
    if len(path.points) == 1:
        return Trajectory(tuple(symbols), np.zeros(1), path.points, np.zeros((1, n)))
    speeds, accelerations = _limits(path, velocity_limits, acceleration_limits, symbols)
    grid = make_grid(path, as_count("cells", cells, 2))
    times, positions, velocities = _motion(
        grid, maximal_squared_speeds(grid, speeds, accelerations), speeds, accelerations
    )
    positions[-1], velocities[-1] = path.points[-1], 0.0
    return Trajectory(tuple(symbols), times, positions, velocities)


def _limits(
    path: BlendedPath, velocity: npt.ArrayLike, acceleration: npt.ArrayLike, symbols: Sequence[Symbol]
) -> tuple[Array, Array]:
    """Return the limits of the coordinates (n,), checked; infinite speeds become those that none reaches."""
    n = path.points.shape[1]
    travel = np.abs(np.diff(path.points, axis=0)).sum(axis=0)
    found = []
    for noun, given in (("speed", velocity), ("acceleration", acceleration)):
        limits = np.array(given, dtype=float)
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
        found.append(limits)
    speeds, accelerations = found
    # With the acceleration a over the travel S the speed stays below √(2·a·S).
    return np.minimum(speeds, 2 * np.sqrt(accelerations * travel) + np.finfo(float).tiny), accelerations


def _motion(grid: PathGrid, x: Array, speeds: Array, accelerations: Array) -> tuple[Array, Array, Array]:
    """Return times (T,), positions and velocities (T, n) of the motion with squared path speeds at the nodes.

    A straight segment has three phases: up to its largest speed, along at that, down from it. Cells of
    blends have as many parts of equal duration.
    """
    rate, following = np.sqrt(x[:-1]), np.sqrt(x[1:])
    with np.errstate(divide="ignore", over="ignore"):
        cap = ((speeds / np.abs(grid.first)) ** 2).min(axis=1)
        slope = (accelerations / np.abs(grid.first)).min(axis=1)
    peak = np.minimum(cap, (x[:-1] + x[1:]) / 2 + slope * grid.lengths)
    peak = np.where(grid.straight, np.maximum(peak, np.maximum(x[:-1], x[1:])), 1.0)
    fast = np.sqrt(peak)
    up, down = (peak - x[:-1]) / (2 * slope), (peak - x[1:]) / (2 * slope)
    along = np.maximum(grid.lengths - up - down, 0.0)
    phases = np.stack([(fast - rate) / slope, along / fast, (fast - following) / slope], axis=1)
    distances = np.stack([up, up + along, grid.lengths], axis=1)
    duration = 2 * grid.lengths / np.where(grid.straight, 1.0, rate + following)
    change = (following - rate) / duration
    parts = np.arange(1, _PARTS + 1) / _PARTS
    elapsed = duration[:, None] * parts
    curved = rate[:, None] * elapsed + change[:, None] * elapsed**2 / 2
    straight = grid.straight[:, None]
    phases = np.where(straight, phases, duration[:, None] / _PARTS)
    distances = np.where(straight, distances, curved)
    rates = np.where(
        straight, np.stack([fast, fast, following], axis=1), rate[:, None] + change[:, None] * elapsed
    )
    s = distances[..., None]
    tangents = grid.first[:, None] + grid.curvature[:, None] * s
    positions = grid.start[:, None] + (grid.first[:, None] + grid.curvature[:, None] * s / 2) * s
    velocities = tangents * rates[..., None]
    slower = _excess(grid, rate, phases, distances, velocities, speeds, accelerations)
    n = grid.first.shape[1]
    phases = phases.ravel()
    keep = phases > _SHORTEST * phases.sum()
    times = np.concatenate(([0.0], np.cumsum(phases[keep]))) * slower
    zero = np.zeros((1, n))
    return (
        times,
        np.concatenate([grid.start[:1], positions.reshape(-1, n)[keep]]),
        np.concatenate([zero, velocities.reshape(-1, n)[keep] / slower]),
    )


def _excess(
    grid: PathGrid,
    rate: Array,
    phases: Array,
    distances: Array,
    velocities: Array,
    speeds: Array,
    accelerations: Array,
) -> float:
    """Return the factor on all times with which cubics between the knots keep the limits, at least 1.

    Within a part of a blend the motion is a polynomial of degree 4 in time, and the cubic through its ends
    differs a little. On straight segments there is no difference.
    """
    curved = ~grid.straight
    if not curved.any():
        return 1.0
    first, bend = grid.first[curved, None], grid.curvature[curved, None]
    ends = distances[curved]
    begins = np.concatenate([np.zeros((len(ends), 1)), ends[:, :-1]], axis=1)
    moved = (first + bend * ((begins + ends) / 2)[..., None]) * (ends - begins)[..., None]
    after = velocities[curved]
    before = np.concatenate([first * rate[curved, None, None], after[:, :-1]], axis=1)
    dt = phases[curved][..., None]
    mean = moved / dt
    initial = (6 * mean - 4 * before - 2 * after) / dt
    final = (2 * before + 4 * after - 6 * mean) / dt
    factor = np.sqrt((np.maximum(np.abs(initial), np.abs(final)) / accelerations).max())
    jerk = final - initial
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = (np.abs(initial + final) < np.abs(jerk)) & (jerk != 0)
        turning = np.where(inside, before - initial**2 * dt / (2 * jerk), 0.0)
    factor = max(float(factor), float((np.abs(turning) / speeds).max()))
    return factor if factor > 1 + _ROUNDING else 1.0
