"""Two parts with a joint between them, seen with noise: the samples of the estimation grid.

In the parent's frame lies an axis of any direction, half a metre from its origin; the child's origin is .4 m
off it at the joint's zero. The child's pose in the parent is ``motion(q) · C``, with a motion about or along
that axis. The observer stands somewhere else each time, and sees both poses with errors in the observer's
axes: ``(p + δp, Exp(δθ) R)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from kineverse.lie import Array, exp_so3, quaternion, retract, transform, translation, unit_vector

Joint = Literal["prismatic", "revolute"]

TO_AXIS, LEVER = 0.5, 0.4
"""From the parent's origin to the axis, and from the axis to the child's origin [m]."""


@dataclass(frozen=True)
class Cell:
    """Parameters common to the samples of one cell of the grid.

    Attributes
    ----------
    joint
        What the joint is.
    position, orientation
        Standard deviations of each coordinate of both poses [m], [rad].
    count
        How many observations there are.
    range
        How far the joint moves [rad] or [m].
    """

    joint: Joint
    position: float
    orientation: float
    count: int
    range: float


@dataclass(frozen=True, eq=False)
class JointSamples:
    """Several recordings of different objects, and what is true of them.

    Attributes
    ----------
    cell
        What they have in common.
    axis
        Directions of length one in the parent's frame, (S, 3).
    point
        Of the axis, the nearest to the middle of the child's way, (S, 3) [m]. A slider has no place, and this
        is the middle itself.
    zero
        Poses of the child in the parent at the joint's zero, (S, 4, 4).
    joint_values
        (S, N), evenly over the range.
    parents
        True poses of the parent in the observer's frame, (S, N, 4, 4).
    seen_parents, seen_children
        What was seen of both, (S, N, 4, 4).
    """

    cell: Cell
    axis: Array
    point: Array
    zero: Array
    joint_values: Array
    parents: Array
    seen_parents: Array
    seen_children: Array


def draw_samples(cell: Cell, count: int, rng: np.random.Generator) -> JointSamples:
    """Return so many samples of a cell."""
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
    """Return how joints have moved things, (S, N, 4, 4), by axes (S, 3), points on them and values (S, N)."""
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
    """Return directions across axes, (S, 3)."""
    return unit_vector(np.cross(axis, _random_directions(rng, len(axis))))


def _random_poses(rng: np.random.Generator, shape: tuple[int, int]) -> Array:
    wxyz = rng.standard_normal((*shape, 4))
    return transform(quaternion(np.roll(wxyz, -1, axis=-1)), rng.uniform(-1.0, 1.0, (*shape, 3)))
