"""Curve in SE(3) with one joint value: a natural cubic spline of poses.

Between its knots u_k, at joint value u,

    parent_T_child = translation(p(u)) · rotation(h(u) / |h(u)|)

where p and h are natural cubic splines through the positions p_k and the unit quaternions h_k of the knots.
The joint value is the length along the curve [m]. A rotation by an angle φ counts as a length ℓ φ. Beyond its
ends the curve continues straight.

**Parameters.** A knot moves across the curve only, in five directions (two for positions). A move along the
curve is a change of joint values.

**Prior.** The mean pose has the density that all families share. The differences between the ends and, times
a curvature, the second differences of the knots are Gaussian. Their widths are those of the observations
along the principal directions of their positions and of their rotations: a curve in a plane pays little for
being in space.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from kineverse.expressions.expression import Expression
from kineverse.expressions.piecewise import spline
from kineverse.lie import (
    Array,
    log_so3,
    mean_rotation,
    quaternion,
    skew,
    to_quaternion,
    transform,
    unit_vector,
)
from kineverse.spatial import quaternion as rotation_of_quaternion
from kineverse.spatial import translation

from .least_squares import Solution, levenberg_marquardt
from .marginal_likelihood import Scored, laplace_evidence
from .motion_functions import FamilyMember, ParameterPrior
from .native import LinearisedPoses
from .observations import Observations

CURVE = "curve"  # name of the family
LEVER = 0.25  # length [m] of a rotation by one radian, in the joint value of a curve
KNOTS = (3, 4, 5, 7, 9, 12, 16, 21)  # numbers K of knots that are compared
_LOG_KNOT = -0.5  # log prior of a number of knots, for each knot
# Standard deviation of the second derivative of a curve of width 1 and length 1, and its bound for few knots.
_CURVATURE = 20.0
# Log density of a width, which is log-uniform over several decades, and of its direction, and least width
# relative to the largest.
_LOG_WIDTH, _LEAST_WIDTH = -3.0, 1e-4


@dataclass(frozen=True)
class NaturalSpline:
    """Natural cubic spline through equidistant knots."""

    first: float  # first knot
    step: float  # distance between two of them
    count: int  # number of knots

    @property
    def knots(self) -> Array:
        """The knots, (K,)."""
        return np.asarray(self.first + self.step * np.arange(self.count), dtype=np.float64)

    @property
    def last(self) -> float:
        """The last knot."""
        return self.first + self.step * (self.count - 1)

    @cached_property
    def knot_slopes(self) -> Array:
        """Slopes at the knots as a linear function of the values at the knots, (K, K)."""
        count, step = self.count, self.step
        system, right = 4.0 * np.eye(count), np.zeros((count, count))
        system[0, 0] = system[-1, -1] = 2.0
        for k in range(count - 1):
            system[k, k + 1] = system[k + 1, k] = 1.0
            right[k, k : k + 2] += (-3.0 / step, 3.0 / step)
            right[k + 1, k : k + 2] += (-3.0 / step, 3.0 / step)
        return np.asarray(np.linalg.solve(system, right))

    def weights(self, u: Array) -> tuple[Array, Array]:
        """Return the value and the slope at u, (N,), as linear functions of the values at the knots, (N, K).

        Beyond the ends the spline is straight.
        """
        each, step, slopes = np.eye(self.count), self.step, self.knot_slopes
        inside = np.clip(u, self.first, self.last)
        beyond = (u - inside)[:, None]
        k = np.minimum(((inside - self.first) / step).astype(int), self.count - 2)
        t = ((inside - self.first) / step - k)[:, None]
        before, after = slopes[k], slopes[k + 1]
        values = (1.0 + 2.0 * t) * (1.0 - t) ** 2 * each[k] + t**2 * (3.0 - 2.0 * t) * each[k + 1]
        values += step * t * (1.0 - t) * ((1.0 - t) * before - t * after)
        rates = 6.0 * t * (1.0 - t) / step * (each[k + 1] - each[k])
        rates += (1.0 - t) * (1.0 - 3.0 * t) * before + t * (3.0 * t - 2.0) * after
        return values + beyond * rates, rates


def whiten_path(poses: Array, rows: int) -> Array:
    """Return the matrix (m, m) that divides a twist by the widths of poses along principal directions."""
    places, turns = poses[:, :3, 3], poses[:, :3, :3]
    result = np.zeros((rows, rows))
    for k, vectors in enumerate([places - places.mean(axis=0), log_so3(turns @ mean_rotation(turns).T)]):
        if 3 * k < rows:
            _, sizes, along = np.linalg.svd(vectors, full_matrices=False)
            width = 2.0 * sizes / math.sqrt(len(vectors))
            width = np.maximum(width, _LEAST_WIDTH * max(float(width.max()), _LEAST_WIDTH))
            result[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = (along.T / width) @ along
    return result


@dataclass(frozen=True, eq=False)
class CurveMotion:
    """Curve through poses at equidistant knots. Lengths are in a unit, see :mod:`.normalisation`."""

    rows: int  # 6 for poses, 3 for positions
    spline: NaturalSpline
    positions: Array  # of the knots, (K, 3)
    quaternions: Array  # (K, 4)
    across: Array  # twists by which the parameters move each knot, (K, m, m - 1)
    whitening: Array  # (m, m), see :func:`whiten_path`
    lever: float = LEVER  # length ℓ of a rotation by one radian

    name = CURVE
    joints = 1
    kinds = (0,)

    @staticmethod
    def through(
        rows: int,
        spline: NaturalSpline,
        positions: Array,
        quaternions: Array,
        whitening: Array,
        lever: float = LEVER,
    ) -> CurveMotion:
        """Return the curve through poses at the knots."""
        none = np.zeros((spline.count, rows, 0))
        motion = CurveMotion(rows, spline, positions, unit_vector(quaternions), none, whitening, lever)
        tangents = motion.linearise(spline.knots[:, None]).by_joints[:, :, 0] * motion.lengths
        *_, directions = np.linalg.svd(tangents[:, None, :])
        across = np.swapaxes(directions[:, 1:], 1, 2)
        # Directions of neighbours are aligned, so that a common step moves the curve without bending it.
        for k in range(1, spline.count):
            u, _, vt = np.linalg.svd(across[k].T @ across[k - 1])
            across[k] = across[k] @ u @ vt
        return replace(motion, across=across / motion.lengths[:, None])

    @cached_property
    def lengths(self) -> Array:
        """Length of a unit of each component of a twist, (m,)."""
        return np.array([1.0] * 3 + [self.lever] * 3)[: self.rows]

    @property
    def size(self) -> int:
        """Number of parameters."""
        return self.spline.count * (self.rows - 1)

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, 1) and their derivatives."""
        weights, rates = self.spline.weights(values[:, 0])
        count = len(values)
        positions = weights @ self.positions
        by_knots = weights[:, :, None, None] * self.across
        if self.rows == 3:
            pose = transform(np.tile(np.eye(3), (count, 1, 1)), positions)
            by_joints = (rates @ self.positions)[:, :, None]
            return LinearisedPoses(pose, _in_rows(by_knots), by_joints)
        mixed = weights @ self.quaternions
        squared = np.sum(mixed**2, axis=1)
        omega = 2.0 * _quotient(rates @ self.quaternions, mixed)[:, :3] / squared[:, None]
        ratio = _quotient(self.quaternions[None], mixed[:, None]) / squared[:, None, None]
        turned = ratio[:, :, 3, None, None] * np.eye(3) - skew(ratio[:, :, :3])
        by_knots[:, :, 3:] = turned @ by_knots[:, :, 3:]
        by_joints = np.concatenate([rates @ self.positions, omega], axis=1)[:, :, None]
        return LinearisedPoses(transform(quaternion(mixed), positions), _in_rows(by_knots), by_joints)

    def retract(self, step: Array) -> Self:
        """Return the curve after a step in the parameters."""
        moved = (self.across @ step.reshape(self.spline.count, self.rows - 1, 1))[:, :, 0]
        positions = self.positions + moved[:, :3]
        if self.rows == 3:
            return replace(self, positions=positions)
        half = np.concatenate([0.5 * moved[:, 3:], np.ones((len(moved), 1))], axis=1)
        return replace(self, positions=positions, quaternions=unit_vector(_product(half, self.quaternions)))

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values after a step of at most a distance of two knots, not far beyond the ends."""
        length = self.spline.step
        moved = values + np.clip(step, -length, length)
        return np.asarray(np.clip(moved, self.spline.first - length, self.spline.last + length))

    def prior(self) -> ParameterPrior:
        """Return the Gaussian prior of second differences and of the difference between the ends."""
        count, rows, each = self.spline.count, self.rows, self.rows - 1
        by = np.zeros((count - 1, rows, count, each))
        steps = np.arange(count - 1)
        by[steps, :, steps] = -self.across[:-1]
        by[steps, :, steps + 1] = self.across[1:]
        whitening, bend = self.whitening, min(1.0, _CURVATURE / (count - 1) ** 2)
        moved = _steps_between(transform(quaternion(self.quaternions), self.positions), rows)
        residuals = np.concatenate([np.diff(moved, axis=0) / bend, moved.sum(axis=0)[None]])
        derivatives = np.concatenate([np.diff(by, axis=0) / bend, by.sum(axis=0)[None]])
        by_parameters = np.einsum("ij,njke->nike", whitening, derivatives)
        return ParameterPrior((residuals @ whitening).ravel(), by_parameters.reshape(-1, self.size))

    def log_prior(self, mean: Array) -> tuple[float, Array]:
        """Return the log prior of the curve beyond a mean pose, and no precision."""
        count, each = self.spline.count, self.rows - 1
        prior = self.prior()
        # The mean pose is the one half-way between the ends, which move by half of their difference each.
        shape = np.eye(self.size)[:, each:]
        shape[:each, -each:] = -0.5 * np.eye(each)
        shape[-each:, -each:] = 0.5 * np.eye(each)
        by_shape = prior.by_parameters @ shape
        log = 0.5 * float(np.linalg.slogdet(by_shape.T @ by_shape / math.tau)[1])
        log -= 0.5 * float(prior.residuals @ prior.residuals)
        # Volume of mean poses per unit of the steps that move them.
        moves = np.concatenate([self.across[count // 2], self.linearise(mean[None, :]).by_joints[0]], axis=1)
        log += float(np.linalg.slogdet(moves)[1])
        log += _LOG_WIDTH * self.rows + _LOG_KNOT * count
        log -= math.log(sum(math.exp(_LOG_KNOT * knots) for knots in KNOTS))
        return log, np.zeros(self.size + 1)

    def named_parameters(self) -> dict[str, Array | float]:
        """Return the parameters by name."""
        poses = transform(quaternion(self.quaternions), self.positions)
        return {"length": self.spline.last - self.spline.first, "knots": self.spline.knots, "poses": poses}

    def coordinates(self) -> tuple[str, ...]:
        """Return the names of the parameters: each knot moves in several directions across the curve."""
        return tuple(f"knot{k}.{j}" for k in range(self.spline.count) for j in range(self.rows - 1))

    def expression(self, joint: Expression) -> Expression:
        """Return the pose of the child in the parent as an expression of the joint value."""
        place = translation(*self._splines(joint, self.positions))
        if self.rows == 3:
            return place
        return place @ rotation_of_quaternion(*self._splines(joint, self.quaternions))

    def scaled(self, unit: float) -> Self:
        """Return the curve with lengths in another unit, which is smaller by a factor."""
        spline = replace(self.spline, first=unit * self.spline.first, step=unit * self.spline.step)
        across, whitening = self.across.copy(), self.whitening.copy()
        across[:, 3:] /= unit
        whitening[:3] /= unit
        moved = replace(self, spline=spline, across=across, whitening=whitening, lever=unit * self.lever)
        return replace(moved, positions=unit * self.positions)

    def _splines(self, joint: Expression, values: Array) -> Sequence[Expression]:
        ends, knots = (self.spline.knot_slopes @ values)[[0, -1]], self.spline.knots.tolist()
        columns = zip(values.T.tolist(), ends.T.tolist(), strict=True)
        return [spline(joint, knots, column, slopes=(first, last)) for column, (first, last) in columns]


def _steps_between(poses: Array, rows: int) -> Array:
    """Return the twists from each pose to the next, (N - 1, m)."""
    moved = np.diff(poses[:, :3, 3], axis=0)
    if rows == 3:
        return moved
    return np.concatenate([moved, log_so3(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2))], axis=1)


def _in_rows(by_knots: Array) -> Array:
    """Return derivatives (N, K, m, n) by the parameters of each knot as (N, m, K n)."""
    count, knots, rows, each = by_knots.shape
    return np.ascontiguousarray(np.swapaxes(by_knots, 1, 2).reshape(count, rows, knots * each))


def _product(a: Array, b: Array) -> Array:
    """Return the products a ⊗ b of quaternions (..., 4), the scalar last."""
    vector = a[..., 3:] * b[..., :3] + b[..., 3:] * a[..., :3] + np.cross(a[..., :3], b[..., :3])
    scalar = a[..., 3:] * b[..., 3:] - np.sum(a[..., :3] * b[..., :3], axis=-1, keepdims=True)
    return np.asarray(np.concatenate([vector, scalar], axis=-1))


def _quotient(a: Array, b: Array) -> Array:
    """Return a ⊗ b* of quaternions (..., 4), the scalar last."""
    return _product(a, b * np.array([-1.0, -1.0, -1.0, 1.0]))


FEWEST_POSES = 5  # least number of observations of a curve
# Largest number of knots of the first curve, steps of the solver in a round, and points of a curve for each
# knot among which the nearest is searched.
_COARSE, _STEPS, _SAMPLES = 7, 6, 24
_DENSEST = 0.75  # largest number of knots relative to the number of observations
# Largest numbers of observations among which paths are searched, and to which a shape is fitted.
_MOST, _MOST_FITTED = 120, 240
_EQUAL = 1e-9  # largest difference of poses that are equal


def may_be_curve(observations: Observations) -> bool:
    """Return True if there are enough observations for a curve, and not all of them are equal."""
    poses = observations.relative if observations.rows == 6 else observations.relative[:, :3, 3]
    return len(poses) >= FEWEST_POSES and float(np.ptp(poses, axis=0).max()) > _EQUAL


def fit_curve(
    observations: Observations,
    covariance: Array,
    orders: Iterable[Array],
    log_evidence: Callable[[Solution[FamilyMember]], float],
) -> Scored:
    """Return the most probable curve through observations that :func:`may_be_curve` accepts."""
    deviations = np.asarray(np.sqrt(np.einsum("nii->ni", covariance).mean(axis=0)))
    if len(observations) > _MOST_FITTED:
        some = np.linspace(0, len(observations) - 1, _MOST_FITTED).round().astype(int)
        thinned = observations.select(some), covariance[some], [order[some] for order in orders]
        solution = fit_curve(*thinned, log_evidence).solution
        return continue_curve(observations, solution, _nearest(observations, deviations, solution.motion))
    possible = [count for count in KNOTS if count <= _DENSEST * len(observations)]
    middle = max(k for k, count in enumerate(possible) if count <= _COARSE)
    points = _whitened(observations.relative, observations.relative, deviations)
    *_, directions = np.linalg.svd(points, full_matrices=False)
    in_time = np.arange(len(points), dtype=np.float64)
    candidates = [in_time, points @ directions[0], _length_along_path(points), *orders]
    begun = [
        _refine(observations, deviations, _regressed(observations, along, possible[middle]), 1)
        for along in candidates
    ]
    first = min(begun, key=lambda solution: solution.cost).motion
    best: Scored | None = None
    for counts in (possible[middle:], possible[middle - 1 :: -1] if middle else []):
        motion, worse = first, 0
        for count in counts:
            solution = _refine(observations, deviations, _with_knots(motion, count), 2)
            fitted, motion = Scored(solution, log_evidence(solution)), solution.motion
            worse = worse + 1 if best is not None and fitted.log_evidence < best.log_evidence else 0
            best = fitted if best is None or not worse else best
            if worse == 2:
                break
    assert best is not None  # there are at least three knots
    return continue_curve(observations, best.solution)


def continue_curve(
    observations: Observations, before: Solution[FamilyMember], values: Array | None = None
) -> Scored:
    """Return the curve with the knots of an earlier one, and its joint values if no others are given."""
    values = before.values if values is None else values
    solution = levenberg_marquardt(observations, before.motion, values, steps=2 * _STEPS)
    return Scored(solution, laplace_evidence(solution).log_evidence)


def _whitened(poses: Array, around: Array, deviations: Array) -> Array:
    """Return poses as points, (N, m): positions and rotations in standard deviations of their errors."""
    points = poses[:, :3, 3] - around[:, :3, 3].mean(axis=0)
    if len(deviations) == 6:
        mean = mean_rotation(around[:, :3, :3])
        points = np.concatenate([points, log_so3(poses[:, :3, :3] @ mean.T)], axis=1)
    return np.asarray(points / deviations)


def _length_along_path(points: Array) -> Array:
    """Return the length of the shortest path through near neighbours from one end to each point."""
    count = len(points)
    some = np.unique(np.linspace(0, count - 1, min(count, _MOST)).round().astype(int))
    distances = np.linalg.norm(points[:, None] - points[None, some], axis=2)
    # Long steps cost more, so the path passes through near neighbours. Steps within the noise are free.
    costs = np.maximum(distances[some] - 1.0, 1e-3) ** 2
    for k in range(len(some)):
        np.minimum(costs, costs[:, k, None] + costs[None, k], out=costs)
    first = int(np.argmax(costs[int(np.argmax(costs[0]))]))
    along = np.argsort(np.argsort(costs[first], kind="stable")).astype(np.float64)
    result = np.asarray(along[np.argsort(distances, axis=1)[:, :2]].mean(axis=1))
    result[some] = along
    return result


def _regressed(observations: Observations, along: Array, count: int) -> CurveMotion:
    spline = NaturalSpline(0.0, (len(along) - 1) / (count - 1), count)
    weights = spline.weights(np.arange(len(along), dtype=np.float64))[0]
    relative = observations.relative[np.argsort(along, kind="stable")]
    # Each quaternion is on the half of the sphere of the one before.
    turns = to_quaternion(relative[:, :3, :3])
    turns[1:] *= np.cumprod(np.where(np.sum(turns[1:] * turns[:-1], axis=1) < 0.0, -1.0, 1.0))[:, None]
    # The ridge keeps knots finite that no observation determines.
    system = np.concatenate([weights, 1e-3 * np.diff(np.eye(count), n=2, axis=0)])
    right = np.vstack([np.hstack([relative[:, :3, 3], turns]), np.zeros((count - 2, 7))])
    values = np.linalg.lstsq(system, right, rcond=None)[0]
    whitening = whiten_path(relative, observations.rows)
    return _with_knots(
        CurveMotion.through(observations.rows, spline, values[:, :3], values[:, 3:], whitening), count
    )


def _with_knots(motion: CurveMotion, count: int, ends: tuple[float, float] | None = None) -> CurveMotion:
    """Return a curve with other knots, evenly distributed over the length from one end to the other."""
    at = np.linspace(*(ends or (motion.spline.first, motion.spline.last)), _SAMPLES * count)
    steps = _steps_between(motion.linearise(at[:, None]).pose, motion.rows) * motion.lengths
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(steps, axis=1))])
    whole = max(float(lengths[-1]), 1e-6)
    knots = NaturalSpline(-0.5 * whole, whole / (count - 1), count)
    weights = motion.spline.weights(np.interp(knots.knots + 0.5 * whole, lengths, at))[0]
    new = weights @ motion.positions, weights @ motion.quaternions
    return CurveMotion.through(motion.rows, knots, *new, motion.whitening, motion.lever)


def _refine(
    observations: Observations, deviations: Array, motion: CurveMotion, rounds: int
) -> Solution[CurveMotion]:
    """Return the solution after rounds of projection onto the curve, steps of the solver and even knots."""
    while True:
        values = _nearest(observations, deviations, motion)
        solution = levenberg_marquardt(observations, motion, values, steps=_STEPS)
        rounds, used = rounds - 1, solution.values[:, 0]
        ends = float(used.min()), float(used.max())
        if not rounds or ends[1] - ends[0] < 1e-3 * (motion.spline.last - motion.spline.first):
            return solution
        motion = _with_knots(solution.motion, motion.spline.count, ends)


def _nearest(observations: Observations, deviations: Array, motion: FamilyMember) -> Array:
    """Return the joint value of the nearest point of a curve for each observation, (N, 1)."""
    assert isinstance(motion, CurveMotion)
    at = np.linspace(motion.spline.first, motion.spline.last, _SAMPLES * motion.spline.count)
    relative = observations.relative
    observed = _whitened(relative, relative, deviations)
    points = _whitened(motion.linearise(at[:, None]).pose, relative, deviations)
    squares = np.sum(points**2, axis=1) - 2.0 * observed @ points.T
    return np.asarray(at[np.argmin(squares, axis=1)][:, None])
