"""Cramér-Rao bound of joint parameters, by finite differences of the observations.

The unknowns are the axis, the child's pose at zero, and for each observation the joint value and the parent's
true pose. The measurements are both poses, twelve numbers with independent errors. Their derivatives by all
unknowns give the Fisher information. Joint values and parent poses are eliminated one observation at a time.
The computation shares nothing with the estimator.

No estimator reaches this bound for a motion that is short compared with the noise. The variance s² of the
joint values determines the axis, and each joint value has a variance c² of its own. The effective variance is
s⁴/(s² + c²), as in any regression with errors in both variables. :func:`compute_attainable_bound` is the
bound for joint values contracted accordingly. For a slider with isotropic noise it is exactly the bound of
Gaussian joint values. For large N the maximum of the likelihood reaches it, and not the Cramér-Rao bound.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
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
    cell: Cell
    axis: Array  # unit vectors of the axes in the parent's frame, (S, 3)
    point: Array
    zero: Array  # poses of the child in the parent at the joint's zero, (S, 4, 4)
    joint_values: Array  # joint values, evenly over the range, (S, N)
    parents: Array  # true poses of the parent in the observer's frame, (S, N, 4, 4)
    seen_parents: Array  # measured poses of both, (S, N, 4, 4)
    seen_children: Array


def draw_samples(cell: Cell, count: int, rng: np.random.Generator) -> JointSamples:
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


STEP = 1e-5  # step of the central differences [m], [rad]. Their error is of second order
UNKNOWNS_PER_OBSERVATION = 7  # unknowns of an observation: the parent's pose, and the joint value, last


@dataclass(frozen=True, eq=False)
class Bound:
    """Lower bounds of the covariances of the estimates of each sample."""

    direction: Array  # direction of the axis, in two directions across it, (S, 2, 2) [rad²]
    # position of the axis across it, at the middle of the child's path, (S, 2, 2) [m²]; NaN for sliders
    point: Array

    @property
    def degrees(self) -> Array:
        """Bound of the root mean square angle between the true axis and an estimate, (S,) [deg]."""
        return np.asarray(np.degrees(np.sqrt(np.trace(self.direction, axis1=1, axis2=2))))

    @property
    def metres(self) -> Array:
        """Bound of the root mean square distance of the axes, (S,) [m]; NaN for sliders."""
        return np.asarray(np.sqrt(np.trace(self.point, axis1=1, axis2=2)))


def compute_bound(samples: JointSamples) -> Bound:
    cell = samples.cell
    shared = 8 if cell.joint == "prismatic" else 10
    weighted = _derivatives(samples, shared, range(shared + UNKNOWNS_PER_OBSERVATION))
    # The joint's zero is a gauge freedom, so the first joint value may be known without loss.
    weighted[:, 0, :, -1] = 0.0
    by_shared, by_own = weighted[..., :shared], weighted[..., shared:]
    information = _transpose(by_shared) @ by_shared
    mixed = _transpose(by_own) @ by_shared
    own = _transpose(by_own) @ by_own
    own[:, 0, -1, -1] = 1.0
    reduced = (information - _transpose(mixed) @ np.linalg.solve(own, mixed)).sum(axis=1)
    covariance = np.linalg.inv(reduced)
    undefined = np.full((len(covariance), 2, 2), math.nan)
    return Bound(covariance[:, :2, :2], covariance[:, 2:4, 2:4] if cell.joint == "revolute" else undefined)


def compute_attainable_bound(samples: JointSamples) -> Bound:
    """Return the bound with contracted joint values, see the module."""
    shared = 8 if samples.cell.joint == "prismatic" else 10
    own = _derivatives(samples, shared, range(shared, shared + UNKNOWNS_PER_OBSERVATION))
    variance = np.linalg.inv(_transpose(own) @ own)[..., -1, -1]
    values = samples.joint_values
    middle, spread = values.mean(axis=1, keepdims=True), values.var(axis=1, keepdims=True)
    contraction = np.sqrt(spread / (spread + variance))
    return compute_bound(replace(samples, joint_values=middle + contraction * (values - middle)))


def orthonormal_complement(axis: Array) -> Array:
    """Return two orthonormal directions across each axis (S, 3), (S, 3, 2)."""
    least = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    first = np.cross(axis, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(axis, first)], axis=-1)


def _derivatives(samples: JointSamples, shared: int, unknowns: Sequence[int]) -> Array:
    """Return the derivatives of the measurements by some unknowns, in standard deviations, (S, N, 12, n)."""
    derivatives = np.stack([_difference(samples, shared, k) for k in unknowns], axis=-1)
    weighted: Array = derivatives / _deviations(samples.cell)[:, None]
    return weighted


def _difference(samples: JointSamples, shared: int, k: int) -> Array:
    """Return the derivatives of the measurements by the unknown k, (S, N, 12)."""
    forward, backward = (_observation_errors(samples, shared, k, sign * STEP) for sign in (1.0, -1.0))
    derivative: Array = (forward - backward) / (2.0 * STEP)
    return derivative


def _observation_errors(samples: JointSamples, shared: int, k: int, step: float) -> Array:
    """Return the errors of both poses for a step in the unknown k, (S, N, 12)."""
    change = np.zeros(shared + UNKNOWNS_PER_OBSERVATION)
    change[k] = step
    sides = orthonormal_complement(samples.axis)
    axis = samples.axis + sides @ change[:2]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    point = samples.point + (sides @ change[2:4] if shared == 10 else 0.0)
    zero = retract(samples.zero, change[shared - 6 : shared])
    parents = retract(samples.parents, change[shared : shared + 6])
    joint = samples.cell.joint
    children = parents @ joint_motions(joint, axis, point, samples.joint_values + change[-1]) @ zero[:, None]
    truth = joint_motions(joint, samples.axis, samples.point, samples.joint_values) @ samples.zero[:, None]
    return np.concatenate(
        [_pose_errors(parents, samples.parents), _pose_errors(children, samples.parents @ truth)], axis=-1
    )


def _pose_errors(poses: Array, others: Array) -> Array:
    """Return the small errors of poses relative to others, (..., 6) [m], [rad]."""
    turned = poses[..., :3, :3] @ _transpose(others[..., :3, :3])
    # Valid for small rotations. The third-order error does not affect the derivative.
    angles = 0.5 * np.stack(
        [turned[..., k - 1, k - 2] - turned[..., k - 2, k - 1] for k in range(3)], axis=-1
    )
    return np.concatenate([poses[..., :3, 3] - others[..., :3, 3], angles], axis=-1)


def _deviations(cell: Cell) -> Array:
    return np.array(([cell.position] * 3 + [cell.orientation] * 3) * 2)


def _transpose(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)
