"""Closed-form initial guesses of each joint family."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np

from kineverse.lie import Array, inverse, log_so3, mean_rotation, rotation_along_z, transform, translation

from .families import JOINT_FAMILIES, GroupMotion, JointFamily
from .least_squares import InitialGuess
from .observations import Observations

ARC_RADII = (2.0, 8.0)
"""Radii of arcs that are tried, in standard deviations along the arc: 90° and 25° evenly observed."""


class MotionStatistics:
    """Mean, principal directions and rotations of the observed relative poses."""

    def __init__(self, observations: Observations) -> None:
        self.rows = observations.rows
        self.poses = observations.relative
        self.positions = self.poses[:, :3, 3]

    @cached_property
    def mean(self) -> Array:
        """Mean pose, (4, 4)."""
        rotation = mean_rotation(self.poses[:, :3, :3]) if self.rows == 6 else np.eye(3)
        return transform(rotation, self.positions.mean(axis=0))

    @cached_property
    def spread(self) -> Array:
        """Principal directions of the positions, as rows, the largest spread first."""
        return _principal_directions(self.positions - self.mean[:3, 3])

    @cached_property
    def turns(self) -> Array:
        """Rotation vectors from the mean orientation, in the parent's axes, (N, 3)."""
        return log_so3(self.poses[:, :3, :3] @ self.mean[:3, :3].T)

    @cached_property
    def axis_rotations(self) -> list[_AxisRotation]:
        """Rotations about the candidate axes, the starts of revolute, screw and cylindrical joints."""
        return [rotation for plane in self.planes for rotation in _find_rotations(self, *plane)]

    @cached_property
    def planes(self) -> list[tuple[Array, Array]]:
        """Frames with a candidate axis as z axis, and positions relative to the mean in each."""
        axes = [_principal_directions(self.turns)[0]] if self.rows == 6 else []
        frames = [rotation_along_z(axis) for axis in (*axes, self.spread[2])]
        return [(frame, (self.positions - self.mean[:3, 3]) @ frame) for frame in frames]


def initial_guesses(name: str, statistics: MotionStatistics) -> Iterator[InitialGuess]:
    """Yield initial guesses for a joint family."""
    mean, rows = statistics.mean, statistics.rows
    group = JOINT_FAMILIES[name]
    count = len(statistics.poses)

    def start(rotation: Array, centre: Array, values: Array) -> InitialGuess:
        left = transform(rotation, centre)
        return InitialGuess(GroupMotion(group, rows, left, inverse(left) @ mean), values)

    if name == "rigid":
        yield start(np.eye(3), np.zeros(3), np.zeros((count, 0)))
    elif name == "free":
        parts = [(mean[:3, :3].T @ (statistics.positions - mean[:3, 3])[:, :, None])[:, :, 0]]
        if rows == 6:
            parts.append(log_so3(mean[:3, :3].T @ statistics.poses[:, :3, :3]))
        yield start(mean[:3, :3], mean[:3, 3], np.concatenate(parts, axis=1))
    elif name == "prismatic":
        along = rotation_along_z(statistics.spread[0])
        yield start(along, mean[:3, 3], ((statistics.positions - mean[:3, 3]) @ along[:, 2])[:, None])
    elif name == "planar":
        for frame, places in statistics.planes:
            values = places.copy()
            if rows == 6:
                values[:, 2] = statistics.turns @ frame[:, 2]
            yield start(frame, mean[:3, 3], values[:, : len(group.parametrisation(rows).joints)])
    elif name == "spherical":
        yield _guess_about_point(group, statistics)
    else:
        for rotation in statistics.axis_rotations:
            left, right, angles, along, slope = rotation
            if name == "screw" and rows == 6 and (many := _guess_screw_revolutions(group, rotation)):
                yield many
            values = angles[:, None] if name != "cylindrical" else np.column_stack([along, angles])
            yield InitialGuess(GroupMotion(group, rows, left, right, slope if group.pitch else 0.0), values)


class _AxisRotation(NamedTuple):
    """Rotation about a fixed axis, the common part of revolute, screw and cylindrical joints."""

    left: Array  # frames on both sides of the joint, (4, 4). The axis is the z axis of left
    right: Array
    angles: Array  # angle and displacement along the axis of each observation, (N,)
    along: Array
    slope: float  # slope of the displacement over the angle


def _find_rotations(statistics: MotionStatistics, frame: Array, places: Array) -> Iterator[_AxisRotation]:
    flat, along, centre = places[:, :2], places[:, 2], statistics.mean[:3, 3]
    if statistics.rows == 6:
        angles = statistics.turns @ frame[:, 2]
        for place in (_fit_centre(flat), _fit_pivot(flat, angles)):
            left = transform(frame, centre + frame[:, :2] @ place)
            yield _AxisRotation(left, inverse(left) @ statistics.mean, angles, along, _slope(angles, along))
        return
    # The centre of the circle through noisy points is biased towards them. If the arc is no higher than the
    # noise, no step leads from there to the circle on which the points lie. So centres on both sides are
    # tried, too.
    directions = _principal_directions(flat)
    deviation = math.sqrt(float(np.mean((flat @ directions[0]) ** 2)))
    offsets = [sign * radius * deviation for radius in ARC_RADII for sign in (1.0, -1.0)]
    for place in (_fit_centre(flat), *(offset * directions[1] for offset in offsets)):
        lever = flat - place
        # At joint value 0 the child lies on the x axis of L.
        middle = lever.mean(axis=0)
        length = np.linalg.norm(middle)
        middle = middle / length if length > 0 else np.array([1.0, 0.0])
        turned = np.column_stack([middle, [-middle[1], middle[0]]])
        x, y = (lever @ turned).T
        left = transform(np.column_stack([frame[:, :2] @ turned, frame[:, 2]]), centre + frame[:, :2] @ place)
        right = transform(np.eye(3), np.array([float(np.mean(np.hypot(x, y))), 0.0, 0.0]))
        angles = np.arctan2(y, x)
        yield _AxisRotation(left, right, angles, along, _slope(angles, along))


def _slope(angles: Array, along: Array) -> float:
    off = angles - angles.mean()
    variance = float(off @ off)
    return float(off @ along) / variance if variance > 0.0 else 0.0


def _guess_screw_revolutions(group: JointFamily, rotation: _AxisRotation) -> InitialGuess | None:
    """Return a screw whose revolutions are counted along its displacement, or None for less than one."""
    order = np.argsort(rotation.along, kind="stable")
    angles = rotation.angles[order]
    if np.abs(np.diff(angles)).max() <= math.pi:
        return None
    unwrapped = np.empty_like(angles)
    unwrapped[order] = np.unwrap(angles)
    if np.ptp(unwrapped) <= math.tau:
        return None
    slope, offset = np.polyfit(unwrapped, rotation.along, 1)
    right = rotation.right.copy()
    right[2, 3] += offset
    return InitialGuess(GroupMotion(group, 6, rotation.left, right, float(slope)), unwrapped[:, None])


def _guess_about_point(group: JointFamily, statistics: MotionStatistics) -> InitialGuess:
    p, mean = statistics.positions, statistics.mean
    if statistics.rows == 6:
        # p = c + R q, linear in the centre c and the lever q.
        rotations = statistics.poses[:, :3, :3]
        matrix = np.concatenate([np.tile(np.eye(3), (len(p), 1, 1)), rotations], axis=2).reshape(-1, 6)
        left = translation(_solve_ridge(matrix, (p - mean[:3, 3]).ravel())[:3] + mean[:3, 3])
        return InitialGuess(GroupMotion(group, 6, left, inverse(left) @ mean), statistics.turns)
    centre = _fit_centre(p - mean[:3, 3]) + mean[:3, 3]
    lever = p - centre
    radius = float(np.mean(np.linalg.norm(lever, axis=1)))
    middle = lever.mean(axis=0)
    frame = rotation_along_z(middle)[:, [2, 0, 1]] if np.linalg.norm(middle) > 0 else np.eye(3)
    local = lever @ frame
    turn = np.linalg.norm(local[:, 1:], axis=1)
    angle = np.arctan2(turn, local[:, 0]) / np.where(turn > 0, turn, 1.0)
    values = np.column_stack([-local[:, 2] * angle, local[:, 1] * angle])
    right = translation(np.array([radius, 0.0, 0.0]))
    return InitialGuess(GroupMotion(group, 3, transform(frame, centre), right), values)


def _principal_directions(centred: Array) -> Array:
    """Return the principal directions (3, 3) as rows, the largest spread first."""
    return np.asarray(np.linalg.eigh(centred.T @ centred)[1][:, ::-1].T)


def _fit_centre(points: Array) -> Array:
    """Return the centre of the circle or sphere through points, from |p|² = 2 c·p + const (regularised)."""
    size = math.sqrt(float(np.mean(np.sum(points**2, axis=1)))) or 1.0
    scaled = points / size
    # Points on a line have no centre. The scale and the regularisation bound it by some hundred extents.
    matrix = np.column_stack([2.0 * scaled, np.ones(len(points))])
    return _solve_ridge(matrix, np.sum(scaled**2, axis=1))[:-1] * size


def _fit_pivot(flat: Array, angles: Array) -> Array:
    """Return the fixed point of rotations by known angles, from p = c + rotation(angle) q."""
    matrix = np.zeros((len(flat), 2, 4))
    matrix[:, 0, 0] = matrix[:, 1, 1] = 1.0
    matrix[:, 0, 2] = matrix[:, 1, 3] = np.cos(angles)
    matrix[:, 1, 2] = np.sin(angles)
    matrix[:, 0, 3] = -matrix[:, 1, 2]
    return _solve_ridge(matrix.reshape(-1, 4), flat.ravel())[:2]


def _solve_ridge(matrix: Array, target: Array) -> Array:
    normal = matrix.T @ matrix
    normal.flat[:: len(normal) + 1] += 1e-6
    return np.asarray(np.linalg.solve(normal, matrix.T @ target), dtype=np.float64)
