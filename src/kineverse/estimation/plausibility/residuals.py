"""Served joints with known motion, and the residuals of observations under them."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import KineverseError, NoSolutionError
from kineverse.estimation.identification.least_squares import InitialGuess, JointValuePrior, Solution
from kineverse.estimation.identification.motion_functions import GeneratedMotion, MotionForm, generate
from kineverse.estimation.identification.motion_model import LinearisedPoses
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.solver import solver
from kineverse.estimation.linear_algebra import invert_matrices, log_determinants, multiply_vectors
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Array, pose_difference, skew
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
        self.home = np.array([default.get(x, 0.0) for x in coordinates])
        by_joints = ca.horzcat(ca.SX.zeros(16, 0), *(ca.vec(slope.casadi) for slope in by_coordinate))
        self._rates: CompiledFunction | None = None
        self._functions = generate(pose.casadi, others, coordinates, by_joints=by_joints)
        self.joints = len(coordinates)
        # Redundant coordinates, such as quaternions, move by their speeds. For others, also those moved by
        # wheels, only their values matter.
        mobility = np.linalg.matrix_rank(self.linearise(self.home[None, :]).by_joints[0])
        if any(x in rates for x in coordinates) and mobility < len(coordinates):
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            none = as_expression(0.0)
            moving = array([[row.get(v, none) for v in speeds] for row in rows])
            self._rates = compile(moving, (*coordinates, *others))
            changes = [Symbol(f"plausibility/change {i}") for i in range(len(speeds))]
            here, change = (ca.vertcat(*(s.sx for s in some)) for some in (coordinates, changes))
            by_speeds = moving.casadi
            moved = ca.substitute([pose.casadi, by_joints @ by_speeds], [here], [here + by_speeds @ change])
            self._functions = generate(moved[0], [*coordinates, *others], changes, by_joints=moved[1])
            self.joints = len(speeds)
        limits = [_limits(model, x) for x in coordinates] if self.is_plain else [UNBOUNDED] * self.joints
        self.lower, self.upper = (np.array([pair[side] for pair in limits]) for side in (0, 1))
        there = self.linearise(self.home[None, :])
        self.middle = there.pose[0, :3, 3]
        self.is_angle = np.abs(there.by_joints[0, 3:]).max(axis=0, initial=0.0) > 1e-9

    @property
    def is_plain(self) -> bool:
        """True if the joint values are the coordinates."""
        return self._rates is None

    @cached_property
    def form(self) -> MotionForm:
        """Form of the motion by joint values within the limits."""
        joints = tuple(range(self.joints))
        # A step turns by at most half a radian.
        limits = np.array([np.where(self.is_angle, 0.5, math.inf), *self.inner_limits])
        return MotionForm(self._functions, 6, (), joints, (), joints, limits, np.zeros(self.joints))

    def is_equal(self, other: KnownJoint) -> bool:
        """Return True if another joint has the same motion and limits."""
        mine, theirs = ((joint.lower, joint.upper, joint._others) for joint in (self, other))
        return self.pose == other.pose and all(map(np.array_equal, mine, theirs))

    def linearise(self, coordinates: Array) -> LinearisedPoses:
        """Evaluate poses at coordinates (N, n), and twists per unit of each joint value."""
        points = self._points(coordinates)
        if self.is_plain:
            points = np.roll(points, len(self._others), axis=1)
        else:
            points = np.concatenate([points, np.zeros((len(points), self.joints))], axis=1)
        linear = self._functions.evaluate(points)
        if not np.isfinite(linear.pose).all():
            raise NoSolutionError("A joint has no pose there: a loop of the model does not close.")
        return linear

    def retract(self, coordinates: Array, change: Array) -> Array:
        """Return coordinates (N, n) after changes of the joint values (N, k), without limits."""
        if self._rates is not None:
            change = multiply_vectors(self._rates.batch(self._points(coordinates)), change)
        return np.asarray(coordinates + change)

    def per_joint(self, coordinates: Array, slopes: Array) -> Array:
        """Convert slopes by coordinates (N, c, n) to slopes by joint values (N, c, k)."""
        return slopes if self._rates is None else slopes @ self._rates.batch(self._points(coordinates))

    def _points(self, coordinates: Array) -> Array:
        others = np.broadcast_to(self._others, (len(coordinates), len(self._others)))
        return np.concatenate([coordinates, others], axis=1)

    def solve(self, observations: Observations) -> tuple[Array, Solution[Any]]:
        """Find the most likely coordinates (N, n) inside the limits, and the solution around them."""
        coordinates = self.initial_coordinates(observations)
        if self.is_plain:
            solution = _solve(KnownMotion(self, self._others), observations, coordinates)
            return solution.values, solution
        each = []
        for k in range(len(observations)):
            one, here = observations.select(slice(k, k + 1)), coordinates[k : k + 1]
            for _ in range(_ROUNDS):
                motion = KnownMotion(self, np.append(here, self._others))
                solution = _solve(motion, one, np.zeros((1, self.joints)))
                here = self.retract(here, solution.values)
            coordinates[k] = here[0]
            each.append(solution)
        linear = LinearisedPoses(*map(np.concatenate, zip(*(one.linear for one in each), strict=True)))
        names = ("values", "residuals", "covariance", "parent")
        joined: Any = {name: np.concatenate([getattr(one, name) for one in each]) for name in names}
        return coordinates, replace(solution, linear=linear, **joined)

    def solve_unbounded(self, observations: Observations, inside: Array) -> Array:
        """Find the most likely coordinates (N, n) without limits; those inside if the pose is undefined."""
        free = copy(self)
        for name in ("_grid_poses", "inner_limits", "form"):
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
class KnownMotion(GeneratedMotion):
    """Motion of a served joint without parameters, by its joint values."""

    served: KnownJoint
    others: Array  # coordinates and parameters of the model that are no joint values

    @property
    def state(self) -> Array:
        """Coordinates and parameters of the model that are no joint values."""
        return self.others

    @property
    def form(self) -> MotionForm:
        """Form of the served joint."""
        return self.served.form

    def with_state(self, state: Array) -> Self:
        """Return itself: there are no parameters."""
        return self

    def log_density(self) -> float:
        """Return 0: there are no parameters."""
        return 0.0


def _solve(motion: Any, observations: Observations, values: Array) -> Solution[Any]:
    prior = JointValuePrior.vague(motion.joints)
    return solver.solve(observations, InitialGuess(motion, values), observations.parent, prior)


def displacement_jacobian(poses: Array, middle: Array) -> Array:
    """Return the twists of the child at poses (..., 4, 4) by two unit twists, (..., 6, 12).

    The first is that of the joint in the parent, and the second that of the child on the joint.
    """
    result = np.zeros((*poses.shape[:-2], 6, 12))
    result[..., :3, :3] = result[..., 3:, 3:6] = np.eye(3)
    result[..., :3, 3:6] = -skew(poses[..., :3, 3] - middle)
    result[..., :3, 6:9] = result[..., 3:, 9:] = poses[..., :3, :3]
    return result


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
