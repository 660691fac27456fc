"""Served joints with known motion, and the residuals of observations under them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import KineverseError
from kineverse.estimation.identification.least_squares import CLOSE, Solution, levenberg_marquardt
from kineverse.estimation.identification.motion_model import LinearisedPoses, ParameterPrior
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.linear_algebra import invert_matrices, log_determinants
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Array, exp_so3, log_so3, pose_difference, skew, transform
from kineverse.model.constraint import Constraint
from kineverse.model.model import Model
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

# Number of initial values of a single coordinate, and of several coordinates.
_GRID_SIZE, _SAMPLE_SIZE = 33, 256
_MARGIN = 1e-6  # relative margin to limits, where slopes may be infinite
_ROUNDS = 4  # number of relinearisations where coordinates are not their own tangent


class KnownJoint:
    """Pose of a child in its parent by k joint values: coordinates, or displacements with a quaternion."""

    def __init__(self, model: Model, child: str, parent: str, open_loops: bool = False) -> None:
        rates = model.rates
        pose = to_plain(model.fk(child, parent))
        self.pose = pose = pose if open_loops else rates.resolve(pose)
        self.coordinates = coordinates = tuple(s for s in pose.symbols if s.has_derivative)
        slopes, still = pose.gradient(heuristic=False), as_expression(np.zeros((4, 4)))
        by_coordinate = [slopes.get(x.derivative(), still) for x in coordinates]
        rows = [rates.get(x) or {x.derivative(): as_expression(1.0)} for x in coordinates]
        mentioned = (pose, *by_coordinate, *(entry for row in rows for entry in row.values()))
        others = sorted({s for e in mentioned for s in e.symbols} - {*coordinates}, key=lambda s: s.sort_key)
        default = model.default_state()
        self._others = np.array([default.get(s, s.value or 0.0) for s in others])
        inputs = (*coordinates, *others)
        self._linear = compile([pose, *by_coordinate], inputs)
        self.home = np.array([default.get(x, 0.0) for x in coordinates])
        # Redundant coordinates, such as quaternions, move by their speeds. For others, also those moved by
        # wheels, only their values matter.
        self._rates: CompiledFunction | None = None
        count = len(coordinates)
        mobility = np.linalg.matrix_rank(self._twists(self.home[None, :])[1][0])
        if any(x in rates for x in coordinates) and mobility < count:
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            none = as_expression(0.0)
            self._rates = compile(array([[row.get(v, none) for v in speeds] for row in rows]), inputs)
            count = len(speeds)
        self.joints = count
        limits = [_limits(model, x) for x in coordinates] if self.is_plain else [UNBOUNDED] * count
        self.lower, self.upper = (np.array([pair[side] for pair in limits]) for side in (0, 1))
        there = self.linearise(self.home[None, :])
        self.middle = there.pose[0, :3, 3]
        self.is_angle = np.abs(there.by_joints[0, 3:]).max(axis=0, initial=0.0) > 1e-9

    @property
    def is_plain(self) -> bool:
        """True if the joint values are the coordinates."""
        return self._rates is None

    def is_equal(self, other: KnownJoint) -> bool:
        """Return True if another joint has the same motion and limits."""
        mine, theirs = ((joint.lower, joint.upper, joint._others) for joint in (self, other))
        return self.pose == other.pose and all(map(np.array_equal, mine, theirs))

    def linearise(self, coordinates: Array) -> LinearisedPoses:
        """Evaluate poses at coordinates (N, n), and twists per unit of each joint value."""
        poses, twists = self._twists(coordinates)
        if self._rates is not None:
            twists = twists @ self._rates.batch(self._points(coordinates))
        return LinearisedPoses(poses, np.zeros((len(poses), 6, 0)), twists)

    def evaluate(self, coordinates: Array) -> tuple[Array, Array]:
        """Return the pose (4, 4) at one set of coordinates (n,), and twists per unit of each (6, n)."""
        if not len(coordinates):
            return self._constant
        pose, *slopes = self._linear(np.concatenate([coordinates, self._others]))
        return pose, _twists(pose, slopes)

    @cached_property
    def _constant(self) -> tuple[Array, Array]:
        (pose,) = self._linear(self._others)
        return pose, np.zeros((6, 0))

    def retract(self, coordinates: Array, change: Array) -> Array:
        """Return coordinates (N, n) after changes of the joint values (N, k), without limits."""
        if self._rates is not None:
            change = (self._rates.batch(self._points(coordinates)) @ change[:, :, None])[:, :, 0]
        return np.asarray(coordinates + change)

    def per_joint(self, coordinates: Array, slopes: Array) -> Array:
        """Convert slopes by coordinates (N, c, n) to slopes by joint values (N, c, k)."""
        return slopes if self._rates is None else slopes @ self._rates.batch(self._points(coordinates))

    def _points(self, coordinates: Array) -> Array:
        others = np.broadcast_to(self._others, (len(coordinates), len(self._others)))
        return np.concatenate([coordinates, others], axis=1)

    def _twists(self, coordinates: Array) -> tuple[Array, Array]:
        poses, *slopes = self._linear.batch(self._points(coordinates))
        return poses, _twists(poses, slopes)

    def solve(self, observations: Observations) -> tuple[Array, Solution[KnownMotion]]:
        """Find the most likely coordinates (N, n) inside the limits, and the solution around them."""
        coordinates = self.initial_coordinates(observations)
        for _ in range(1 if self.is_plain else _ROUNDS):
            values = np.zeros((len(observations), self.joints))
            if self.is_plain:
                coordinates, values = values, coordinates
            solution = levenberg_marquardt(observations, KnownMotion(self, coordinates), values)
            coordinates = self.retract(coordinates, solution.values)
        return coordinates, solution

    def solve_unbounded(self, observations: Observations, inside: Array) -> Array:
        """Find the most likely coordinates (N, n) without limits; those inside if the pose is undefined."""
        free = copy(self)
        for name in ("_grid_poses", "inner_limits"):
            free.__dict__.pop(name, None)
        free.lower, free.upper = np.full(self.joints, -np.inf), np.full(self.joints, np.inf)
        try:
            coordinates, _ = free.solve(observations)
        except (KineverseError, np.linalg.LinAlgError):
            return inside
        return coordinates if np.isfinite(coordinates).all() else inside

    def initial_coordinates(self, observations: Observations) -> Array:
        """Return the best coordinates of a grid for each observation."""
        grid, flat, positions, squares = self._grid_poses
        observed = observations.relative
        covariance = observations.child_covariance
        covariance = covariance[0] if len(covariance) == 1 else covariance.mean(axis=0)
        x, y, z, *turns = np.diagonal(covariance).tolist()
        # ‖R - S‖² = 6 - 2 tr(RᵀS) is twice the square of a small angle.
        off = (3.0 - observed[:, :3, :3].reshape(-1, 9) @ flat) * (3.0 / sum(turns))
        p = observed[:, :3, 3]
        off += (squares - 2.0 * p @ positions) * (3.0 / (x + y + z))
        return np.asarray(grid[np.argmin(off, axis=1)])

    @cached_property
    def _grid_poses(self) -> tuple[Array, Array, Array, Array]:
        """Initial values (M, n), their rotations (9, M), positions (3, M) and squared norms of these (M,)."""
        grid = self._grid()
        poses = self.linearise(grid).pose
        flat = np.ascontiguousarray(poses[:, :3, :3].reshape(-1, 9).T)
        positions = np.ascontiguousarray(poses[:, :3, 3].T)
        return grid, flat, positions, np.sum(positions**2, axis=0)

    def _grid(self) -> Array:
        if not self.joints:
            return self.home[None, :]
        low, high = self.inner_limits
        reach = np.where(self.is_angle, math.pi, 1.0)
        middle = self.home if self.is_plain else np.zeros(self.joints)
        from_low = np.where(np.isfinite(low), low, middle) + reach
        from_high = np.where(np.isfinite(high), high, middle) - reach
        low, high = np.where(np.isfinite(low), low, from_high), np.where(np.isfinite(high), high, from_low)
        if self.joints == 1:
            values = np.linspace(low, high, _GRID_SIZE)
        else:
            values = np.random.default_rng(0).uniform(low, high, (_SAMPLE_SIZE, self.joints))
        start = np.zeros_like(self.home) if self.is_plain else self.home
        return self.retract(np.tile(start, (len(values), 1)), values)

    @cached_property
    def inner_limits(self) -> tuple[Array, Array]:
        """Limits of joint values with a margin."""
        width = self.upper - self.lower
        margin = np.where(np.isfinite(width), _MARGIN * width, 0.0)
        return self.lower + margin, self.upper - margin


def _twists(poses: Array, slopes: Sequence[Array]) -> Array:
    """Return twists (..., 6, n) per unit of each coordinate, from slopes of poses (..., 4, 4)."""
    twists = np.empty((*poses.shape[:-2], 6, len(slopes)))
    rows, columns = (2, 0, 1), (1, 2, 0)
    for j, slope in enumerate(slopes):
        turned = slope[..., :3, :3] @ np.swapaxes(poses[..., :3, :3], -1, -2)
        twists[..., :3, j] = slope[..., :3, 3]
        twists[..., 3:, j] = 0.5 * (turned[..., rows, columns] - turned[..., columns, rows])
    return twists


UNBOUNDED = (-math.inf, math.inf)


def _limits(model: Model, coordinate: Symbol) -> tuple[float, float]:
    """Return the constant limits of a coordinate; limits that depend on others may be narrower."""
    lower, upper = UNBOUNDED
    for constraint in model.constraints_for([coordinate]).values():
        if is_own_limit(constraint, coordinate):
            slope, offset = constraint.line or (1.0, 0.0)
            low, high = sorted((float(b) - offset) / slope for b in (constraint.lower, constraint.upper))
            lower, upper = max(lower, low), min(upper, high)
    return lower, upper


def is_own_limit(constraint: Constraint, coordinate: Symbol) -> bool:
    """Return True if a constraint bounds a coordinate by two numbers."""
    bounds = (*constraint.lower.symbols, *constraint.upper.symbols)
    return constraint.line is not None and constraint.expression.symbols == (coordinate,) and not bounds


@dataclass(frozen=True)
class KnownMotion:
    """Motion model of a served joint: joint values are changes of coordinates (N, n), without parameters."""

    served: KnownJoint
    reference: Array

    size = 0

    @property
    def joints(self) -> int:
        """Number of joint values."""
        return self.served.joints

    def linearise(self, values: Array) -> LinearisedPoses:
        """Return the poses at joint values (N, k)."""
        return self.served.linearise(self.served.retract(self.reference, values))

    def retract(self, step: Array) -> Self:
        """Return itself: there are no parameters."""
        return self

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return joint values after a step: at most half a radian at once, and inside the limits."""
        step = np.where(self.served.is_angle, np.clip(step, -0.5, 0.5), step)
        return np.asarray(np.clip(values + step, *self.served.inner_limits))

    def prior(self) -> ParameterPrior:
        """Return the empty prior of no parameters."""
        return ParameterPrior(np.zeros(0), np.zeros((0, 0)))


_STEPS, _STEP = 12, 0.5  # largest number of steps, and largest step of an angle [rad]
# Squared residual beyond which the true pose of the parent stays at the observed one. The pose that explains
# a gross error best is many steps away, and of no use.
_GROSS = 1e3
_EYE_6 = np.eye(6)


class PoseSolution(NamedTuple):
    """Most likely joint values of one observation inside the limits."""

    values: Array  # (k,)
    pose: Array  # pose of the joint there, (4, 4), and twists per unit of each joint value, (6, k)
    by_joints: Array
    residual: Array  # residual of the relative pose in the parent's axes, (6,), and its covariance, (6, 6)
    covariance: Array


def solve_observation(
    served: KnownJoint, observations: Observations, start: Array, precision: float
) -> PoseSolution | None:
    """Return the solution for one observation of a joint; None if the steps do not converge."""
    parent, child = observations.parent[0], observations.child[0]
    of_parent = None if observations.parent_covariance is None else observations.parent_covariance[0]
    of_child = observations.child_covariance[0]
    low, high = served.inner_limits
    values, true = np.clip(start, low, high), parent
    turned, lever, error, parent_error = np.zeros((6, 6)), np.eye(6), np.empty(6), np.empty(6)
    covariance = weights = _EYE_6
    curbed = bool(np.any(served.is_angle))
    for count in range(_STEPS):
        pose, by_joints = served.evaluate(values)
        rotation = true[:3, :3].T
        error[:3] = rotation @ (child[:3, 3] - true[:3, 3]) - pose[:3, 3]
        error[3:] = _rotation_vector(rotation @ child[:3, :3] @ pose[:3, :3].T)
        if of_parent is not None or not count:
            turned[:3, :3] = turned[3:, 3:] = rotation
            covariance = turned @ of_child @ turned.T
            if of_parent is not None:
                parent_error[:3] = rotation @ (parent[:3, 3] - true[:3, 3])
                parent_error[3:] = _rotation_vector(rotation @ parent[:3, :3])
                lever[:3, 3:] = -skew(pose[:3, 3])
                lifted = turned @ of_parent @ turned.T @ lever.T
                covariance += lever @ lifted
                error -= lever @ parent_error
            weights = np.linalg.inv(covariance)
        gain, left, there = 0.0, error, values
        if served.joints:
            weighted = by_joints.T @ weights
            curvature = weighted @ by_joints + precision * np.eye(served.joints)
            slope = weighted @ error - precision * values
            change = slope / curvature[0] if served.joints == 1 else np.linalg.solve(curvature, slope)
            if curbed and np.abs(change).max() > _STEP:
                change = np.where(served.is_angle, np.clip(change, -_STEP, _STEP), change)
            there = np.minimum(np.maximum(values + change, low), high)
            # At a limit the step is shorter than the one that the slope asks for.
            change = there - values
            gain += float(change @ curvature @ change)
            left = error - by_joints @ change
        if of_parent is not None and float(error @ weights @ error) < _GROSS:
            blame = parent_error + lifted @ (weights @ left)
            gain += float(np.sum(blame**2 / np.diagonal(of_parent)))
            if gain >= CLOSE:
                true = true @ transform(exp_so3(blame[3:]), blame[:3])
        if gain < CLOSE:
            return PoseSolution(values, pose, by_joints, error, covariance)
        values = there
        if not math.isfinite(gain):
            return None
    return None


def complete_basis(directions: Array) -> Array:
    """Return an orthonormal basis of the vectors that are orthogonal to k directions (6, k), (6, 6 - k)."""
    count = directions.shape[1]
    if not count:
        return _EYE_6
    if count > 1:
        return np.linalg.qr(directions, mode="complete")[0][:, count:]
    # Householder's reflection of the direction to the first axis.
    v = directions[:, 0].copy()
    v[0] += math.copysign(math.sqrt(float(v @ v)), float(v[0]))
    square = float(v @ v)
    return _EYE_6[:, 1:] - np.outer(v, (2.0 / square) * v[1:]) if square else _EYE_6[:, 1:]


def displacement_jacobian(poses: Array, middle: Array) -> Array:
    """Return the twists of the child at poses (..., 4, 4) by two unit twists, (..., 6, 12).

    The first is that of the joint in the parent, and the second that of the child on the joint.
    """
    result = np.zeros((*poses.shape[:-2], 6, 12))
    result[..., :3, :3] = result[..., 3:, 3:6] = np.eye(3)
    result[..., :3, 3:6] = -skew(poses[..., :3, 3] - middle)
    result[..., :3, 6:9] = result[..., 3:, 9:] = poses[..., :3, :3]
    return result


def _rotation_vector(rotation: Array) -> Array:
    """Return the rotation vector of one rotation, as :func:`kineverse.lie.log_so3`."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rotation.tolist()
    cosine = 0.5 * (xx + yy + zz - 1.0)
    if cosine < -0.99:
        return log_so3(rotation)
    x, y, z = 0.5 * (zy - yz), 0.5 * (xz - zx), 0.5 * (yx - xy)
    sine = math.sqrt(x * x + y * y + z * z)
    factor = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
    return np.array([factor * x, factor * y, factor * z])


SIZES = (0.01, 0.05, 0.3)  # standard deviations of a displacement, for each component of a twist [m], [rad]
_PRECISION = 1e-4  # prior information of joint values: a deviation of 100 [m] or [rad]


@dataclass(frozen=True)
class KnownResiduals:
    """Residuals of N observations under a served joint."""

    coordinates: Array  # most likely coordinates inside the limits, (N, n)
    values: Array  # most likely joint values without limits, by linearisation, (N, k)
    covariances: Array  # of the values, (N, k, k)
    orthogonal: Array  # ρ, the whitened residual orthogonal to the joint directions, (N, 6 - k)
    whitened: Array  # the same residual in the axes of the whitened pose, (N, 6)
    displacement_jacobian: Array  # G, of ρ by displacements of the joint, the child on it, (N, 6 - k, 12)
    bound_excess: Array  # values beyond their lower and upper limits, in standard deviations, (N, 2 k)
    pose_residuals: Array  # in the parent's axes, (N, 6)
    log_scale: Array  # log of the volume of the noise across the joint directions, (N,)
    limit_excess: Array  # violation of limits on several coordinates, in standard deviations, (N, c)
    disagreement: Array  # difference from the estimates of the same coordinates by others, likewise, (N, e)
    other_values: Array  # these estimates, (N, e); consistency sets the last three

    def __len__(self) -> int:
        return len(self.orthogonal)

    @property
    def one_sided(self) -> Array:
        """All one-sided test quantities, in standard deviations, (N, 2 k + c + 2 e)."""
        parts = (self.bound_excess, self.limit_excess, self.disagreement, -self.disagreement)
        return np.concatenate(parts, axis=1)

    def select(self, rows: slice | npt.NDArray[np.int_]) -> Self:
        """Return the residuals of some of the observations."""
        return type(self)(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    def scaled(self, factor: float) -> Self:
        """Return the residuals for covariances of the poses that are larger by a factor."""
        root = math.sqrt(factor)
        smaller = (
            "orthogonal", "whitened", "displacement_jacobian", "bound_excess", "limit_excess", "disagreement",
        )  # fmt: skip
        return replace(
            self,
            covariances=factor * self.covariances,
            log_scale=self.log_scale + 0.5 * self.orthogonal.shape[1] * math.log(factor),
            **{name: getattr(self, name) / root for name in smaller},
        )


def compute_residuals(served: KnownJoint, observations: Observations) -> KnownResiduals:
    """Compute the residuals of observations under a served joint."""
    if len(observations) == 1 and served.is_plain and observations.rows == 6:
        single = _compute_one(served, observations)
        if single is not None:
            return single
    coordinates, solution = served.solve(observations)
    whitening, error, directions = _whiten(solution)
    transposed = np.swapaxes(directions, 1, 2)
    joints = served.joints
    covariances = invert_matrices(transposed @ directions + _PRECISION * np.eye(joints))
    # At a limit, one Gauss-Newton step leads to the optimum without limits.
    values = solution.values + (covariances @ transposed @ error[:, :, None])[:, :, 0]
    if not served.is_plain:
        # From the first pose to each, to first order.
        linear = solution.linear
        values = pose_difference(linear.pose, linear.pose[0]) @ np.linalg.pinv(linear.by_joints[0]).T
    basis = np.linalg.qr(directions, mode="complete")[0]
    across = np.swapaxes(basis[:, :, joints:], 1, 2)
    deviations = np.sqrt(np.einsum("nii->ni", covariances))
    excess = np.concatenate([served.lower - values, values - served.upper], axis=1)
    pose = solution.linear.pose
    orthogonal = (across @ error[:, :, None])[:, :, 0]
    return KnownResiduals(
        coordinates,
        values,
        covariances,
        orthogonal,
        (basis[:, :, joints:] @ orthogonal[:, :, None])[:, :, 0],
        across @ whitening @ displacement_jacobian(pose, served.middle),
        excess / np.tile(deviations, (1, 2)),
        solution.residuals,
        0.5 * (log_determinants(math.tau * solution.covariance) - log_determinants(math.tau * covariances)),
        *(np.zeros((len(observations), 0)) for _ in range(3)),
    )


def _compute_one(served: KnownJoint, observations: Observations) -> KnownResiduals | None:
    """Compute the residuals of one observation; None if its joint values are not found."""
    start = served.initial_coordinates(observations)[0] if served.joints else np.zeros(0)
    solution = solve_observation(served, observations, start, _PRECISION)
    if solution is None:
        return None
    values, pose, by_joints, residual, covariance = solution
    joints = served.joints
    triangle = np.linalg.cholesky(covariance)
    whitening = np.linalg.inv(triangle)
    error, directions = whitening @ residual, whitening @ by_joints
    log_scale = float(np.log(np.diagonal(triangle)).sum()) + 0.5 * (6 - joints) * math.log(math.tau)
    covariances: Array = np.zeros((joints, joints))
    if joints:
        covariances = invert_matrices(directions.T @ directions + _PRECISION * np.eye(joints))
        log_scale -= 0.5 * float(np.linalg.slogdet(covariances)[1])
    unbounded = values + covariances @ (directions.T @ error)
    across = complete_basis(directions)
    orthogonal = across.T @ error
    deviations = np.sqrt(np.diagonal(covariances))
    excess = np.concatenate([served.lower - unbounded, unbounded - served.upper]) / np.tile(deviations, 2)
    displaced = across.T @ whitening @ displacement_jacobian(pose, served.middle)
    parts = (values, unbounded, covariances, orthogonal, across @ orthogonal, displaced, excess, residual)
    none = np.zeros((1, 0))
    return KnownResiduals(*[*(part[None] for part in parts), np.array([log_scale]), none, none, none])


def orthogonal_residuals(solution: Solution[Any]) -> Array:
    """Return the whitened residuals without their components along the joint directions, (N, 6)."""
    _, error, directions = _whiten(solution)
    basis = np.linalg.qr(directions)[0]
    return error - (basis @ (np.swapaxes(basis, 1, 2) @ error[:, :, None]))[:, :, 0]


def _whiten(solution: Solution[Any]) -> tuple[Array, Array, Array]:
    """Return W with W S Wᵀ = I, (N, 6, 6), whitened residuals (N, 6) and joint directions (N, 6, k)."""
    whitening = np.linalg.inv(np.linalg.cholesky(solution.covariance))
    error = (whitening @ solution.residuals[:, :, None])[:, :, 0]
    return whitening, error, whitening @ solution.linear.by_joints
