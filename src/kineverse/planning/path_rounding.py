"""Trajectories of paths: corners are rounded as far as the way stays free."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse.lie import Array
from kineverse.symbols import Symbol

from .state_validity import PathChecks, dense_places, lengths_along
from .trajectories import BlendedPath, Trajectory, round_corners, time_parameterize
from .trajectories.blends import each_deviation
from .trajectories.kinematic_limits import MotionLimits

RESIDUAL = 1e-5  # largest residual of holds on rounded corners [m], [rad]
_SAGITTA = 1e-4  # distance between a blend and the chords that are checked in its place [m], [rad]
_SAME = 1e-5  # distance below which two points count as one [rad], [m]
_ROUNDS, _LAST_ROUNDS = 8, 4
_STEP = 0.02  # largest distance of samples of a trajectory [rad], [m]


class PathSection(NamedTuple):
    """Part of a path with holds of its own, from one of its points to another; the motion rests at both."""

    first: int  # index of its first and last point
    last: int
    checks: PathChecks


TimedSection: TypeAlias = tuple[PathSection, BlendedPath, Trajectory]  # with the motion along it


def parameterize_sections(
    points: Array,
    symbols: Sequence[Symbol],
    limits: MotionLimits,
    deviation: npt.ArrayLike,
    sections: Sequence[PathSection],
) -> list[TimedSection]:
    """Compute the motions along the sections of a path (N, n), see :func:`parameterize_path`."""
    deviations, result = each_deviation(deviation, len(points)), []
    for section in sections:
        part = slice(section.first, section.last + 1)
        motion = parameterize_path(points[part], symbols, limits, deviations[part], section.checks)
        result.append((section, *motion))
    return result


def section_times(points: Array, sections: Sequence[TimedSection]) -> Array:
    """Compute the times (N,) at which a motion along sections is nearest to points of a path (N, n)."""
    times, begin = np.zeros(len(points)), 0.0
    for (first, last, _), path, trajectory in sections:
        times[first : last + 1] = begin + passing_times(points[first : last + 1], path, trajectory)
        begin += trajectory.duration
    return times


def parameterize_path(
    points: Array,
    symbols: Sequence[Symbol],
    limits: MotionLimits,
    deviations: Array,
    checks: PathChecks,
) -> tuple[BlendedPath, Trajectory]:
    """Round a path and find its fastest motion, which is certainly free wherever the path is.

    The motion is checked, and corners are rounded less where it collides, down to a stop.
    """
    with checks.placed(points):
        path = _round_valid(*_drop_near(points, deviations), checks)
        for attempt in range(_LAST_ROUNDS):
            trajectory = time_parameterize(path, *limits, symbols)
            corner = _find_collision(path, trajectory, checks)
            if corner is None:
                return path, trajectory
            if attempt == 0:
                path = _round_free(path, checks)
            else:
                allowed = _deviations(path)
                allowed[corner] = 0.0
                path = round_corners(path.points, allowed)
    # The path itself, with a stop at each corner: nothing is left that has not been judged.
    path = round_corners(points)
    return path, time_parameterize(path, *limits, symbols)


def passing_times(points: Array, path: BlendedPath, trajectory: Trajectory) -> Array:
    """Compute the times (N,) at which a motion along a rounded path is nearest to its points (N, n)."""
    times = _fine_times(trajectory)
    travelled = lengths_along(trajectory.positions_at(times))
    # The way along the rounded path to the middle of each blend, and along the polyline to its corner.
    halves = np.array([lengths_along(path.blend(k, 65))[32] for k in range(len(path.reach))])
    cut = np.concatenate([[0.0], path.reach - halves, [0.0]])
    way = np.concatenate([[0.0], np.cumsum(path.lengths - cut[:-1] - cut[1:])])
    at_corners = np.interp(way * (travelled[-1] / max(way[-1], 1e-300)), travelled, times)
    corners = np.concatenate([[0.0], np.cumsum(path.lengths)])
    result: Array = np.interp(lengths_along(points), corners, at_corners)
    result[-1] = trajectory.duration
    return result


def _drop_near(points: Array, deviations: Array) -> tuple[Array, Array]:
    """Drop inner points (N, n), and their deviations, that practically equal the one before.

    Such a short edge has a direction of its own, for which the motion would slow down.
    """
    keep = np.ones(len(points), dtype=bool)
    keep[1:] = np.linalg.norm(np.diff(points, axis=0), axis=1) > _SAME
    if len(points) > 2 and not keep[-1]:
        keep[[-2, -1]] = False, True
    keep[0] = True
    return points[keep], deviations[keep]


def _round_valid(points: Array, deviations: Array, checks: PathChecks) -> BlendedPath:
    """Round corners as far as samples of the blends are valid."""
    path = round_corners(points, deviations, lambda Q: checks.valid(Q, RESIDUAL))
    if len(path.points) < 3:
        return path
    allowed = _deviations(path)
    # At the ends the way may be free by the scene only: nothing vouches for a shortcut there.
    edges = range(len(path.lengths))
    for order in (edges, reversed(edges)):
        for k in order:
            if checks.find_collision(path.points[k : k + 2]) is None:
                break
            allowed[[k, k + 1]] = 0.0
    return round_corners(path.points, allowed)


def _round_free(path: BlendedPath, checks: PathChecks) -> BlendedPath:
    """Shrink blends until each is certainly free."""
    allowed = _deviations(path)
    unchecked = np.flatnonzero(allowed).tolist()
    for attempt in range(_ROUNDS):
        # Chords so short that they are near to the blend.
        counts = 3 + np.ceil(np.sqrt(2 * path.deviation / _SAGITTA)).astype(int)
        blends = {k: path.blend(k - 1, int(counts[k - 1])) for k in unchecked}
        unchecked = [k for k, chords in blends.items() if checks.find_collision(chords) is not None]
        if not unchecked:
            break
        allowed[unchecked] = allowed[unchecked] / 3 if attempt < _ROUNDS - 1 else 0.0
        path = round_corners(path.points, allowed)
    return path


def _find_collision(path: BlendedPath, trajectory: Trajectory, checks: PathChecks) -> int | None:
    """Find the point whose blend is nearest to the first collision of a motion; None without a collision."""
    corners = np.flatnonzero(path.reach) + 1
    if not len(corners):
        return None
    positions = trajectory.positions_at(_fine_times(trajectory))
    # Between the corners and beyond their blends the motion is on the path.
    first = path.points[corners[0]] - path.reach[corners[0] - 1] * path.directions[corners[0] - 1]
    last = path.points[corners[-1]] + path.reach[corners[-1] - 1] * path.directions[corners[-1]]
    begin = int(np.linalg.norm(positions - first, axis=1).argmin())
    end = int(np.linalg.norm(positions - last, axis=1).argmin())
    positions = positions[begin : end + 1]
    edge = checks.find_collision(positions)
    if edge is None:
        return None
    return int(corners[np.linalg.norm(path.points[corners] - positions[edge], axis=1).argmin()])


def _fine_times(trajectory: Trajectory) -> Array:
    """Return the times of the knots, and others between distant ones."""
    places = dense_places(trajectory.positions, _STEP)
    return np.asarray(np.interp(places, np.arange(len(trajectory)), trajectory.times))


def _deviations(path: BlendedPath) -> Array:
    return np.pad(path.deviation, 1)
