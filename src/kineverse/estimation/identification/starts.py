"""Where to start: members of each family in closed form, from the observed relative poses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from kineverse.estimation.rotations import logarithm

from .groups import GROUPS, GroupMotion
from .observations import Observations
from .rigid import Array, frame_along, inverse, mean_rotation, pose
from .solving import Start


class Overview:
    """What relative poses look like as a whole."""

    def __init__(self, seen: Observations) -> None:
        self.rows = seen.rows
        self.poses = seen.relative
        self.positions = self.poses[:, :3, 3]

    @cached_property
    def mean(self) -> Array:
        """A pose in the middle."""
        rotation = mean_rotation(self.poses[:, :3, :3]) if self.rows == 6 else np.eye(3)
        return pose(rotation, self.positions.mean(axis=0))

    @cached_property
    def spread(self) -> Array:
        """Directions in which positions differ, as rows, the most first."""
        return _directions(self.positions - self.mean[:3, 3])

    @cached_property
    def turns(self) -> Array:
        """Rotation vectors from the middle, in the parent's axes, (N, 3)."""
        return logarithm(self.poses[:, :3, :3] @ self.mean[:3, :3].T)

    @cached_property
    def axes(self) -> list[Array]:
        """Directions about which the child may turn."""
        normal = self.spread[2]
        return [_directions(self.turns)[0], normal] if self.rows == 6 else [normal]

    @cached_property
    def turnings(self) -> list[_Turning]:
        """Turns about any of them."""
        return [turning for axis in self.axes for turning in _turnings(self, axis)]


def starts(name: str, overview: Overview) -> Iterator[Start]:
    """Yield starts for a family of joints."""
    mean, rows = overview.mean, overview.rows
    group = GROUPS[name]
    count = len(overview.poses)

    def start(rotation: Array, centre: Array, values: Array, pitch: float = 0.0) -> Start:
        left = pose(rotation, centre)
        return Start(GroupMotion(group, rows, left, inverse(left) @ mean, pitch), values)

    if name == "rigid":
        yield start(np.eye(3), np.zeros(3), np.zeros((count, 0)))
    elif name == "free":
        moved = mean[:3, :3].T @ (overview.positions - mean[:3, 3])[:, :, None]
        parts = [moved[:, :, 0]]
        if rows == 6:
            parts.append(logarithm(mean[:3, :3].T @ overview.poses[:, :3, :3]))
        yield start(mean[:3, :3], mean[:3, 3], np.concatenate(parts, axis=1))
    elif name == "prismatic":
        along = frame_along(overview.spread[0])
        yield start(along, mean[:3, 3], ((overview.positions - mean[:3, 3]) @ along[:, 2])[:, None])
    elif name == "planar":
        for axis in overview.axes:
            frame = frame_along(axis)
            values = (overview.positions - mean[:3, 3]) @ frame
            if rows == 6:
                values[:, 2] = overview.turns @ axis
            yield start(frame, mean[:3, 3], values[:, : len(group.freedom(rows).joints)])
    elif name == "spherical":
        yield from _about_a_point(overview, group.freedom(rows).joints, start)
    else:
        yield from _about_an_axis(name, overview, start)


class _Turning(NamedTuple):
    """Turns about an axis that fit what was seen: what hinges, screws and cylinders have in common.

    Attributes
    ----------
    frame, centre
        Whose last column is the axis, (3, 3), and where that is (3,).
    angles, along
        How far it turned and slid in each observation, (N,).
    slope
        Slides by turns.
    radius
        The mean distance from the axis.
    """

    frame: Array
    centre: Array
    angles: Array
    along: Array
    slope: float
    radius: float


def _turnings(overview: Overview, axis: Array) -> Iterator[_Turning]:
    frame = frame_along(axis)
    centred = overview.positions - overview.mean[:3, 3]
    flat, along = centred @ frame[:, :2], centred @ frame[:, 2]
    places = [_circle(flat)]
    if overview.rows == 6:
        angles = overview.turns @ axis
        places.append(_pivot(flat, angles))
    for place in places:
        lever = flat - place
        if overview.rows == 3:
            # The child's place at 0 is along x: L is turned until it is.
            middle = _mean_direction(lever)
            turned = np.column_stack([middle, [-middle[1], middle[0]]])
            frame = np.column_stack([frame[:, :2] @ turned, frame[:, 2]])
            flat, lever = flat @ turned, lever @ turned
            angles = np.arctan2(lever[:, 1], lever[:, 0])
            place = flat[0] - lever[0]
        centre = overview.mean[:3, 3] + frame[:, :2] @ place
        off = angles - angles.mean()
        variance = float(off @ off)
        slope = float(off @ along) / variance if variance > 0.0 else 0.0
        radius = float(np.mean(np.sqrt(np.sum(lever**2, axis=1))))
        yield _Turning(frame, centre, angles, along, slope, radius)


def _about_an_axis(name, overview, start) -> Iterator[Start]:  # type: ignore[no-untyped-def]
    for turning in overview.turnings:
        if name == "screw":
            yield from _in_several_turns(overview, turning, start)
        values = turning.angles[:, None]
        if name == "cylindrical":
            values = np.column_stack([turning.along, turning.angles])
        result = start(turning.frame, turning.centre, values, turning.slope if name == "screw" else 0.0)
        if overview.rows == 3:
            right = np.eye(4)
            right[0, 3] = turning.radius
            result = Start(replace(result.motion, right=right), result.values)
        yield result


def _in_several_turns(overview, turning, start) -> Iterator[Start]:  # type: ignore[no-untyped-def]
    """Yield the screw whose turns are counted by how far it has moved, if it made more than one."""
    if overview.rows == 3:
        return
    order = np.argsort(turning.along, kind="stable")
    angles = np.empty_like(turning.angles)
    angles[order] = np.unwrap(turning.angles[order])
    if np.ptp(angles) <= math.tau:
        return
    slope, offset = np.polyfit(angles, turning.along, 1)
    result = start(turning.frame, turning.centre, angles[:, None], float(slope))
    right = result.motion.right.copy()
    right[2, 3] += offset
    yield Start(replace(result.motion, right=right), result.values)


def _about_a_point(overview, joints, start) -> Iterator[Start]:  # type: ignore[no-untyped-def]
    count = len(overview.poses)
    p, mean = overview.positions, overview.mean
    if overview.rows == 6:
        # p = c + R q, linear in the centre c and the lever q.
        rotations = overview.poses[:, :3, :3]
        matrix = np.concatenate([np.tile(np.eye(3), (count, 1, 1)), rotations], axis=2).reshape(-1, 6)
        matrix = np.concatenate([matrix, 1e-3 * np.eye(6)])
        target = np.concatenate([(p - mean[:3, 3]).ravel(), np.zeros(6)])
        centre = np.linalg.lstsq(matrix, target, rcond=None)[0][:3] + mean[:3, 3]
        yield start(np.eye(3), centre, overview.turns)
        return
    centre = _sphere(p - mean[:3, 3]) + mean[:3, 3]
    lever = p - centre
    radius = float(np.mean(np.linalg.norm(lever, axis=1)))
    middle = lever.mean(axis=0)
    frame = frame_along(middle)[:, [2, 0, 1]] if np.linalg.norm(middle) > 0 else np.eye(3)
    local = lever @ frame
    turn = np.linalg.norm(local[:, 1:], axis=1)
    angle = np.arctan2(turn, local[:, 0]) / np.where(turn > 0, turn, 1.0)
    values = np.column_stack([-local[:, 2] * angle, local[:, 1] * angle])
    result = start(frame, centre, values)
    right = np.eye(4)
    right[0, 3] = radius
    yield Start(replace(result.motion, right=right), result.values)


def _directions(centred: Array) -> Array:
    """Return principal directions (3, 3) by rows, that of the largest spread first."""
    result: Array = np.linalg.eigh(centred.T @ centred)[1][:, ::-1].T
    return result


def _mean_direction(lever: Array) -> Array:
    middle = lever.mean(axis=0)
    length = np.linalg.norm(middle)
    return middle / length if length > 0 else np.array([1.0, 0.0])


def _circle(flat: Array) -> Array:
    """Return the centre of the circle through points (N, 2), by algebraic least squares."""
    return _sphere(flat)


def _sphere(points: Array) -> Array:
    """Return the centre of the circle or sphere through points: |p|² = 2 c·p + const, kept within reach."""
    size = float(np.sqrt(np.mean(np.sum(points**2, axis=1)))) or 1.0
    scaled = points / size
    matrix = np.column_stack([2.0 * scaled, np.ones(len(points))])
    width = matrix.shape[1]
    # Points on a line have no centre: a touch of regularity keeps it within some hundred times their extent.
    matrix = np.concatenate([matrix, 1e-3 * np.eye(width)])
    target = np.concatenate([np.sum(scaled**2, axis=1), np.zeros(width)])
    centre: Array = np.linalg.lstsq(matrix, target, rcond=None)[0][:-1] * size
    return centre


def _pivot(flat: Array, angles: Array) -> Array:
    """Return the fixed point of turns by known angles: p = c + rotation(angle) q, linear in c and q."""
    count = len(flat)
    c, s = np.cos(angles), np.sin(angles)
    rotation = np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)
    matrix = np.concatenate([np.tile(np.eye(2), (count, 1, 1)), rotation], axis=2).reshape(-1, 4)
    matrix = np.concatenate([matrix, 1e-3 * np.eye(4)])
    target = np.concatenate([flat.ravel(), np.zeros(4)])
    place: Array = np.linalg.lstsq(matrix, target, rcond=None)[0][:2]
    return place
