"""Closed-form initial guesses of each joint family."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from kineverse.lie import Array, inverse, log_so3, mean_rotation, rotation_along_z, transform, translation

from .families import JOINT_FAMILIES, VZ, WZ, GroupMotion, JointFamily
from .least_squares import InitialGuess, Solution
from .motion_functions import FamilyMember
from .observations import Observations

ARC_RADII = (2.0, 8.0)
"""Radii of arcs that are tried, in standard deviations along the arc: 90° and 25° evenly observed."""

# Directions of a half sphere that are tried as the axis of a cylinder, and cosine of the least angle between
# those that are chosen.
_DIRECTIONS, _APART = 100, math.cos(math.radians(25.0))


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
    def cylinder_rotations(self) -> list[_AxisRotation]:
        """Rotations about the axes of cylinders near the positions, further starts where no turn was seen."""
        if self.rows == 6:
            return []
        planes = (
            self._plane(rotation_along_z(axis)) for axis in _find_cylinder_axes(self.positions, self.spread)
        )
        return [next(_find_rotations(self, *plane)) for plane in planes]

    @cached_property
    def planes(self) -> list[tuple[Array, Array]]:
        """Frames with a candidate axis as z axis, and positions relative to the mean in each."""
        axes = [_principal_directions(self.turns)[0]] if self.rows == 6 else []
        return [self._plane(rotation_along_z(axis)) for axis in (*axes, self.spread[2])]

    def _plane(self, frame: Array) -> tuple[Array, Array]:
        return frame, (self.positions - self.mean[:3, 3]) @ frame


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
        cylinders = statistics.cylinder_rotations if name != "revolute" else []
        for rotation in (*statistics.axis_rotations, *cylinders):
            left, right, angles, along, slope = rotation
            if name == "screw":
                yield from _guess_screw_revolutions(group, rows, rotation)
            values = angles[:, None] if name != "cylindrical" else np.column_stack([along, angles])
            yield InitialGuess(GroupMotion(group, rows, left, right, slope if group.pitch else 0.0), values)


CONTAINED: Mapping[Any, tuple[str, ...]] = {"screw": ("revolute",), "cylindrical": ("prismatic", "screw")}
"""Families that others contain, and from whose solutions these start as well."""


def widened_guess(name: str, narrower: Solution[FamilyMember]) -> InitialGuess:
    """Return the guess of a family that is a solution of a family that it contains."""
    motion, group = narrower.motion, JOINT_FAMILIES[name]
    assert isinstance(motion, GroupMotion)
    twist = np.zeros((len(narrower.values), 6))
    twist[:, motion.parametrisation.joints] = narrower.values
    twist[:, VZ] += motion.pitch * twist[:, WZ]
    wider = GroupMotion(group, motion.rows, motion.left, motion.right)
    return InitialGuess(wider, twist[:, wider.parametrisation.joints])


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
        angles = _cut(statistics.turns @ frame[:, 2])
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
        angles = _cut(np.arctan2(y, x))
        yield _AxisRotation(left, right, angles, along, _slope(angles, along))


def _cut(angles: Array) -> Array:
    """Return angles up to whole revolutions, within the revolution that begins after their largest gap."""
    increasing = np.sort(angles % math.tau)
    gaps = np.diff(increasing, append=increasing[0] + math.tau)
    first = increasing[(int(np.argmax(gaps)) + 1) % len(angles)]
    cut = first + (angles - first) % math.tau
    return np.asarray(cut - math.tau * round(float(cut.mean()) / math.tau))


def _slope(angles: Array, along: Array) -> float:
    off = angles - angles.mean()
    variance = float(off @ off)
    return float(off @ along) / variance if variance > 0.0 else 0.0


def _guess_screw_revolutions(
    group: JointFamily, rows: int, rotation: _AxisRotation
) -> Iterator[InitialGuess]:
    """Yield a screw whose revolutions are counted along its displacement, if there are several."""
    order = np.argsort(rotation.along, kind="stable")
    unwrapped = np.empty_like(rotation.angles)
    unwrapped[order] = np.unwrap(rotation.angles[order])
    if np.array_equal(unwrapped, rotation.angles):
        return
    slope = _slope(unwrapped, rotation.along)
    right = rotation.right.copy()
    right[2, 3] += float(np.mean(rotation.along)) - slope * float(np.mean(unwrapped))
    yield InitialGuess(GroupMotion(group, rows, rotation.left, right, slope), unwrapped[:, None])


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


def _find_cylinder_axes(points: Array, principal: Array) -> Array:
    """Return the axes (3, 3) of the best cylinders through points, each at a distance from the others.

    The projection along the axis is a circle, whose algebraic fit is linear (Eberly, "Fitting 3D Data with a
    Cylinder"). So the axis is searched among the principal directions, as the rows of a matrix, and a grid.
    """
    frames = np.concatenate([_half_sphere(), [rotation_along_z(axis) for axis in principal]])
    axes, centred = frames[:, :, 2], points - points.mean(axis=0)
    flat = centred / (math.sqrt(float(np.mean(centred**2))) or 1.0) @ frames[:, :, :2]
    matrix = np.concatenate([2.0 * flat, np.ones((*flat.shape[:2], 1))], axis=2)
    squares = np.sum(flat**2, axis=2)
    right = np.einsum("mni,mn->mi", matrix, squares)
    circles = np.linalg.solve(np.swapaxes(matrix, 1, 2) @ matrix + 1e-6 * np.eye(3), right[:, :, None])[
        ..., 0
    ]
    # The algebraic residual is 2 r times the distance from a circle of radius r.
    radii = np.sum(circles[:, :2] ** 2, axis=1) + circles[:, 2]
    errors = np.sum((squares - np.einsum("mni,mi->mn", matrix, circles)) ** 2, axis=1) / np.maximum(
        radii, 1e-9
    )
    chosen: list[int] = []
    for _ in range(3):
        chosen.append(int(np.argmin(errors)))
        errors[np.abs(axes @ axes[chosen[-1]]) > _APART] = np.inf
    return np.asarray(axes[chosen])


@functools.cache
def _half_sphere() -> Array:
    """Return frames (M, 3, 3) whose z axes are evenly distributed over half a sphere."""
    z = (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS
    spiral, radius = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(_DIRECTIONS), np.sqrt(1.0 - z**2)
    axes = np.column_stack([radius * np.cos(spiral), radius * np.sin(spiral), z])
    return np.stack([rotation_along_z(axis) for axis in axes])


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
