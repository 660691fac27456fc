"""Samples of the estimation grid: noisy poses of two parts with a joint between them.

The axis has a random direction and a distance of 0.5 m from the origin of the parent. The origin of the child
is 0.4 m from the axis at the joint's zero. The child's pose in the parent is ``motion(q) · C``, with a motion
about or along the axis. The observer has a random pose at each observation. Both poses are measured with
errors in the observer's axes: ``(p + δp, Exp(δθ) R)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kineverse.lie import Array, exp_so3, quaternion, retract, transform, translation, unit_vector

Joint = Literal["prismatic", "revolute"]

TO_AXIS, LEVER = 0.5, 0.4
"""Distance from the parent's origin to the axis, and from the axis to the child's origin [m]."""


@dataclass(frozen=True)
class Cell:
    """Cell of the grid: joint, noise, number and range of observations."""

    joint: Joint
    position: float  # standard deviations of each coordinate of both poses [m], [rad]
    orientation: float
    count: int  # number of observations
    range: float  # range of the joint [rad] or [m]


@dataclass(frozen=True, eq=False)
class JointSamples:
    """Random recordings of one cell, with the true joints."""

    cell: Cell
    axis: Array  # unit vectors of the axes in the parent's frame, (S, 3)
    point: Array
    zero: Array  # poses of the child in the parent at the joint's zero, (S, 4, 4)
    joint_values: Array  # joint values, evenly over the range, (S, N)
    parents: Array  # true poses of the parent in the observer's frame, (S, N, 4, 4)
    seen_parents: Array  # measured poses of both, (S, N, 4, 4)
    seen_children: Array


def draw_samples(cell: Cell, count: int, rng: np.random.Generator) -> JointSamples:
    """Draw random samples of a cell."""
    axis = _random_directions(rng, count)
    to_axis, lever = _random_orthogonal(rng, axis), _random_orthogonal(rng, axis)
    point = TO_AXIS * to_axis
    turn = rng.uniform(-math.pi, math.pi, (count, 1)) * _random_directions(rng, count)
    zero = transform(exp_so3(turn), point + LEVER * lever)
    values = np.tile(np.linspace(0.0, cell.range, cell.count), (count, 1))
    parents = _random_poses(rng, (count, cell.count))
    children = parents @ joint_motions(cell.joint, axis, point, values) @ zero[:, None]
    if cell.joint == "prismatic":
        point = zero[:, :3, 3] + 0.5 * cell.range * axis
    seen = [_observe(poses, cell, rng) for poses in (parents, children)]
    return JointSamples(cell, axis, point, zero, values, parents, seen[0], seen[1])


def joint_motions(joint: Joint, axis: Array, point: Array, values: Array) -> Array:
    """Return the motions (S, N, 4, 4) of joints with axes and points (S, 3) at joint values (S, N)."""
    along = values[..., None] * axis[:, None]
    if joint == "prismatic":
        return translation(along)
    turned = exp_so3(along)
    return transform(turned, point[:, None] - (turned @ point[:, None, :, None])[..., 0])


def _observe(poses: Array, cell: Cell, rng: np.random.Generator) -> Array:
    shape = (*poses.shape[:2], 3)
    moved, turned = cell.position * rng.standard_normal(shape), cell.orientation * rng.standard_normal(shape)
    return retract(poses, np.concatenate([moved, turned], axis=-1))


def _random_directions(rng: np.random.Generator, count: int) -> Array:
    return unit_vector(rng.standard_normal((count, 3)))


def _random_orthogonal(rng: np.random.Generator, axis: Array) -> Array:
    """Return random unit vectors orthogonal to axes, (S, 3)."""
    return unit_vector(np.cross(axis, _random_directions(rng, len(axis))))


def _random_poses(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    wxyz = rng.standard_normal((*shape, 4))
    return transform(quaternion(np.roll(wxyz, -1, axis=-1)), rng.uniform(-1.0, 1.0, (*shape, 3)))
