"""Closed-form initial guesses of each joint family."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from kineverse.lie import Array, inverse, log_so3, mean_rotation, rotation_along_z, transform

from .families import JOINT_FAMILIES, GroupMotion, JointFamily
from .observations import Observations
from .optimise import InitialGuess


class MotionStatistics:
    """What relative poses look like as a whole."""

    def __init__(self, observations: Observations) -> None:
        self.rows = observations.rows
        self.poses = observations.relative
        self.positions = self.poses[:, :3, 3]

    @cached_property
    def mean(self) -> Array:
        """A pose in the middle."""
        rotation = mean_rotation(self.poses[:, :3, :3]) if self.rows == 6 else np.eye(3)
        return transform(rotation, self.positions.mean(axis=0))

    @cached_property
    def spread(self) -> Array:
        """Directions in which positions differ, as rows, the most first."""
        return _directions(self.positions - self.mean[:3, 3])

    @cached_property
    def turns(self) -> Array:
        """Rotation vectors from the middle, in the parent's axes, (N, 3)."""
        return log_so3(self.poses[:, :3, :3] @ self.mean[:3, :3].T)

    @cached_property
    def axes(self) -> list[Array]:
        """Directions about which the child may turn."""
        normal = self.spread[2]
        return [_directions(self.turns)[0], normal] if self.rows == 6 else [normal]

    @cached_property
    def turnings(self) -> list[_Turning]:
        """Turns about any of them; what hinges, screws and cylinders begin with."""
        return [turning for plane in self.planes for turning in _turnings(self, *plane)]

    @cached_property
    def planes(self) -> list[tuple[Array, Array]]:
        """Frames whose last column any of them is, and positions in them from the middle."""
        frames = [rotation_along_z(axis) for axis in self.axes]
        return [(frame, (self.positions - self.mean[:3, 3]) @ frame) for frame in frames]


def initial_guesses(name: str, overview: MotionStatistics) -> Iterator[InitialGuess]:
    """Yield starts for a family of joints."""
    mean, rows = overview.mean, overview.rows
    group = JOINT_FAMILIES[name]
    count = len(overview.poses)

    def start(rotation: Array, centre: Array, values: Array) -> InitialGuess:
        left = transform(rotation, centre)
        return InitialGuess(GroupMotion(group, rows, left, inverse(left) @ mean), values)

    if name == "rigid":
        yield start(np.eye(3), np.zeros(3), np.zeros((count, 0)))
    elif name == "free":
        moved = mean[:3, :3].T @ (overview.positions - mean[:3, 3])[:, :, None]
        parts = [moved[:, :, 0]]
        if rows == 6:
            parts.append(log_so3(mean[:3, :3].T @ overview.poses[:, :3, :3]))
        yield start(mean[:3, :3], mean[:3, 3], np.concatenate(parts, axis=1))
    elif name == "prismatic":
        along = rotation_along_z(overview.spread[0])
        yield start(along, mean[:3, 3], ((overview.positions - mean[:3, 3]) @ along[:, 2])[:, None])
    elif name == "planar":
        for frame, places in overview.planes:
            values = places.copy()
            if rows == 6:
                values[:, 2] = overview.turns @ frame[:, 2]
            yield start(frame, mean[:3, 3], values[:, : len(group.parametrisation(rows).joints)])
    elif name == "spherical":
        yield from _about_a_point(overview, group.parametrisation(rows).joints, start)
    else:
        yield from _about_an_axis(group, overview)


class _Turning(NamedTuple):
    """Turns about an axis that fit what was seen: what hinges, screws and cylinders have in common.

    Attributes
    ----------
    left, right
        Frames on both sides, (4, 4); the axis is the z axis of the first.
    angles, along
        How far it turned and slid in each observation, (N,).
    slope
        Slides by turns.
    """

    left: Array
    right: Array
    angles: Array
    along: Array
    slope: float


def _turnings(overview: MotionStatistics, frame: Array, places: Array) -> Iterator[_Turning]:
    flat, along, centre = places[:, :2], places[:, 2], overview.mean[:3, 3]
    if overview.rows == 6:
        angles = overview.turns @ frame[:, 2]
        for place in (_sphere(flat), _pivot(flat, angles)):
            left = transform(frame, centre + frame[:, :2] @ place)
            yield _Turning(left, inverse(left) @ overview.mean, angles, along, _slope(angles, along))
        return
    place = _sphere(flat)
    lever = flat - place
    # The child's place at 0 is along x: L is turned until it is.
    middle = _mean_direction(lever)
    turned = np.column_stack([middle, [-middle[1], middle[0]]])
    x, y = (lever @ turned).T
    left = transform(np.column_stack([frame[:, :2] @ turned, frame[:, 2]]), centre + frame[:, :2] @ place)
    right = transform(np.eye(3), np.array([float(np.mean(np.hypot(x, y))), 0.0, 0.0]))
    angles = np.arctan2(y, x)
    yield _Turning(left, right, angles, along, _slope(angles, along))


def _slope(angles: Array, along: Array) -> float:
    off = angles - angles.mean()
    variance = float(off @ off)
    return float(off @ along) / variance if variance > 0.0 else 0.0


def _about_an_axis(group: JointFamily, overview: MotionStatistics) -> Iterator[InitialGuess]:
    rows = overview.rows
    for turning in overview.turnings:
        left, right, angles, along, slope = turning
        if group.name == "screw" and rows == 6 and (many := _in_several_turns(group, turning)):
            yield many
        values = angles[:, None] if group.name != "cylindrical" else np.column_stack([along, angles])
        yield InitialGuess(GroupMotion(group, rows, left, right, slope if group.pitch else 0.0), values)


def _in_several_turns(group: JointFamily, turning: _Turning) -> InitialGuess | None:
    """Return the screw whose turns are counted by how far it has moved, if it made more than one."""
    order = np.argsort(turning.along, kind="stable")
    angles = turning.angles[order]
    if np.abs(np.diff(angles)).max() <= math.pi:
        return None
    unwrapped = np.empty_like(angles)
    unwrapped[order] = np.unwrap(angles)
    if np.ptp(unwrapped) <= math.tau:
        return None
    slope, offset = np.polyfit(unwrapped, turning.along, 1)
    right = turning.right.copy()
    right[2, 3] += offset
    return InitialGuess(GroupMotion(group, 6, turning.left, right, float(slope)), unwrapped[:, None])


def _about_a_point(overview, joints, start) -> Iterator[InitialGuess]:  # type: ignore[no-untyped-def]
    count = len(overview.poses)
    p, mean = overview.positions, overview.mean
    if overview.rows == 6:
        # p = c + R q, linear in the centre c and the lever q.
        rotations = overview.poses[:, :3, :3]
        matrix = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), rotations], axis=2).reshape(-1, 6)
        centre = _nearest(matrix, (p - mean[:3, 3]).ravel())[:3] + mean[:3, 3]
        yield start(np.eye(3), centre, overview.turns)
        return
    centre = _sphere(p - mean[:3, 3]) + mean[:3, 3]
    lever = p - centre
    radius = float(np.mean(np.linalg.norm(lever, axis=1)))
    middle = lever.mean(axis=0)
    frame = rotation_along_z(middle)[:, [2, 0, 1]] if np.linalg.norm(middle) > 0 else np.eye(3)
    local = lever @ frame
    turn = np.linalg.norm(local[:, 1:], axis=1)
    angle = np.arctan2(turn, local[:, 0]) / np.where(turn > 0, turn, 1.0)
    values = np.column_stack([-local[:, 2] * angle, local[:, 1] * angle])
    result = start(frame, centre, values)
    right = np.eye(4)
    right[0, 3] = radius
    yield InitialGuess(replace(result.motion, right=right), result.values)


def _directions(centred: Array) -> Array:
    """Return principal directions (3, 3) by rows, that of the largest spread first."""
    result: Array = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].T
    return result


def _mean_direction(lever: Array) -> Array:
    middle = lever.mean(axis=0)
    length = np.linalg.norm(middle)
    return middle / length if length > 0 else np.array([1.0, 0.0])


def _sphere(points: Array) -> Array:
    """Return the centre of the circle or sphere through points: |p|² = 2 c·p + const, kept within reach."""
    size = math.sqrt(float(np.mean(np.sum(points**2, axis=1)))) or 1.0
    scaled = points / size
    # Points on a line have no centre: this keeps it within some hundred times their extent.
    matrix = np.column_stack([2.0 * scaled, np.ones(len(points))])
    return _nearest(matrix, np.sum(scaled**2, axis=1))[:-1] * size


def _pivot(flat: Array, angles: Array) -> Array:
    """Return the fixed point of turns by known angles: p = c + rotation(angle) q, linear in c and q."""
    matrix = np.zeros((len(flat), 2, 4))
    matrix[:, 0, 0] = matrix[:, 1, 1] = 1.0
    matrix[:, 0, 2] = matrix[:, 1, 3] = np.cos(angles)
    matrix[:, 1, 2] = np.sin(angles)
    matrix[:, 0, 3] = -matrix[:, 1, 2]
    return _nearest(matrix.reshape(-1, 4), flat.ravel())[:2]


def _nearest(matrix: Array, target: Array) -> Array:
    """Return x with A x nearest to b, and a touch nearer to nothing: what A does not tell stays small."""
    normal = matrix.T @ matrix
    normal.flat[:: len(normal) + 1] += 1e-6
    return np.asarray(np.linalg.solve(normal, matrix.T @ target), dtype=np.float64)
