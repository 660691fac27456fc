"""Served joints with known motion, and the residuals of observations under them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import NoSolutionError
from kineverse.estimation.identification.least_squares import (
    InitialGuess,
    JointValuePrior,
    Solution,
    levenberg_marquardt,
)
from kineverse.estimation.identification.motion_functions import GeneratedMotion, MotionForm, generate
from kineverse.estimation.identification.native import LinearisedPoses
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.solver import solver
from kineverse.estimation.linear_algebra import invert_matrices, log_determinants, multiply_vectors
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Array, pose_difference, skew
from kineverse.model.constraint import Constraint
from kineverse.model.model import Model
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

from .report import TestableJoint

# Number of initial values of a single coordinate, and of several coordinates.
_GRID_SIZE, _SAMPLE_SIZE = 33, 256
_MARGIN = 1e-6  # relative margin to limits, where slopes may be infinite


class KnownJoint(GeneratedMotion):
    """Motion of a child in its parent by the n coordinates of a served model, without parameters.

    Where coordinates are redundant, such as quaternions, their k speeds are the joint values, else k = n.
    """

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
        self._functions = generate(pose.casadi, others, coordinates, by_joints=by_joints)
        there = _require_closed(self._functions.evaluate(np.append(self._others, self.home)[None]))
        self._turns = is_angle = _find_turns(there.by_joints[0])
        self._rates: CompiledFunction | None = None
        # Of coordinates that are not redundant only the values matter, also of those moved by wheels.
        mobility = np.linalg.matrix_rank(there.by_joints[0])
        if any(x in rates for x in coordinates) and mobility < len(coordinates):
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            none = as_expression(0.0)
            moving = array([[row.get(v, none) for v in speeds] for row in rows])
            self._rates = compile(moving, (*coordinates, *others))
            is_angle = _find_turns(self.per_joint(self.home[None], there.by_joints)[0])
        self.is_angle = is_angle
        limits = [_limits(model, x) for x in coordinates] if self.is_plain else [UNBOUNDED] * len(is_angle)
        self.lower, self.upper = (np.array([pair[side] for pair in limits]) for side in (0, 1))
        self.middle = there.pose[0, :3, 3]

    @property
    def is_plain(self) -> bool:
        """True if the joint values are the coordinates."""
        return self._rates is None

    @cached_property
    def form(self) -> MotionForm:
        """Form of the motion by coordinates within the limits."""
        count = len(self.coordinates)
        # A step turns by at most half a radian.
        limits = np.array([np.where(self._turns, 0.5, math.inf), *self._inner_limits])
        each = tuple(range(count))
        return MotionForm(self._functions, 6, (), each, (), each, limits, np.zeros(count))

    @property
    def state(self) -> Array:
        """Values of the other symbols of the pose."""
        return self._others

    def with_state(self, state: Array) -> Self:
        """Return itself: there are no parameters."""
        return self

    def log_density(self) -> float:
        """Return 0: there are no parameters."""
        return 0.0

    def retract_joints(self, values: Array, step: Array) -> Array:
        """Return coordinates (N, n) after a step, of which redundant ones follow the part by speeds."""
        if self._rates is not None:
            rates = self._evaluate_rates(values)
            back = np.asarray(np.linalg.pinv(rates), dtype=np.float64)
            step = multiply_vectors(rates, multiply_vectors(back, step))
        return super().retract_joints(values, step)

    def is_equal(self, other: KnownJoint) -> bool:
        """Return True if another joint has the same motion and limits."""
        mine, theirs = ((joint.lower, joint.upper, joint._others) for joint in (self, other))
        return self.pose == other.pose and all(map(np.array_equal, mine, theirs))

    def per_joint(self, coordinates: Array, slopes: Array) -> Array:
        """Convert slopes by coordinates (N, c, n) to slopes by joint values (N, c, k)."""
        return slopes if self._rates is None else slopes @ self._evaluate_rates(coordinates)

    def _evaluate_rates(self, coordinates: Array) -> Array:
        assert self._rates is not None
        others = np.broadcast_to(self._others, (len(coordinates), len(self._others)))
        return np.asarray(self._rates.batch(np.concatenate([coordinates, others], axis=1)))

    def solve(self, observations: Observations) -> Solution[Any]:
        """Find the most likely coordinates (N, n) inside the limits."""
        start = InitialGuess(self, self._initial_coordinates(observations))  # type: ignore[arg-type]
        if self._rates is not None:
            # The steps in C add to coordinates.
            return levenberg_marquardt(observations, self, start.values)
        return solver.solve(observations, start, observations.parent, JointValuePrior.vague(self.joints))

    def _initial_coordinates(self, observations: Observations) -> Array:
        """Return the best coordinates of a grid for each observation."""
        grid, poses = self._grid_poses
        variances = np.diagonal(observations.child_covariance.mean(axis=0))
        # ‖R - S‖² is twice the square of a small angle.
        weights = np.tile([0.5 / variances[3:].mean()] * 3 + [1.0 / variances[:3].mean()], 3)
        observed = observations.relative[:, :3].reshape(-1, 12)
        off = poses**2 @ weights - 2.0 * (observed * weights) @ poses.T
        return np.asarray(grid[np.argmin(off, axis=1)])

    @cached_property
    def _grid_poses(self) -> tuple[Array, Array]:
        """Initial values (M, n), and the rows of their poses (M, 12)."""
        grid = self._grid()
        return grid, _require_closed(self.linearise(grid)).pose[:, :3].reshape(-1, 12)

    def _grid(self) -> Array:
        if not self.joints:
            return self.home[None, :]
        low, high = self._inner_limits
        reach = np.where(self._turns, math.pi, 1.0)
        from_low = np.where(np.isfinite(low), low, self.home) + reach
        from_high = np.where(np.isfinite(high), high, self.home) - reach
        low, high = np.where(np.isfinite(low), low, from_high), np.where(np.isfinite(high), high, from_low)
        if self.joints == 1:
            return np.linspace(low, high, _GRID_SIZE)
        return np.random.default_rng(0).uniform(low, high, (_SAMPLE_SIZE, self.joints))

    @property
    def _inner_limits(self) -> tuple[Array, Array]:
        """Limits of coordinates (n,) with a margin."""
        if not self.is_plain:
            return np.full_like(self.home, -np.inf), np.full_like(self.home, np.inf)
        width = self.upper - self.lower
        margin = np.where(np.isfinite(width), _MARGIN * width, 0.0)
        return self.lower + margin, self.upper - margin


def _find_turns(by_joints: Array) -> npt.NDArray[np.bool_]:
    """Return True for each column (6, k) that turns the child."""
    return np.asarray(np.abs(by_joints[3:]).max(axis=0, initial=0.0) > 1e-9)


def _require_closed(linear: LinearisedPoses) -> LinearisedPoses:
    if not np.isfinite(linear.pose).all():
        raise NoSolutionError("A joint has no pose there: a loop of the model does not close.")
    return linear


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

    @cached_property
    def one_sided(self) -> Array:
        """All one-sided test quantities, in standard deviations, (N, 2 k + c + 2 e)."""
        parts = (self.bound_excess, self.limit_excess, self.disagreement, -self.disagreement)
        return np.concatenate(parts, axis=1)

    def select(self, rows: slice | npt.NDArray[np.int_]) -> Self:
        """Return the residuals of some of the observations."""
        return type(self)(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))


def compute_residuals(served: KnownJoint, observations: Observations) -> KnownResiduals:
    """Compute the residuals of observations under a served joint."""
    solution = served.solve(observations)
    by_joints = served.per_joint(solution.values, solution.linear.by_joints)
    whitening, error, directions = _whiten(solution, by_joints)
    transposed = np.swapaxes(directions, 1, 2)
    joints = directions.shape[2]
    covariances = invert_matrices(transposed @ directions + _PRECISION * np.eye(joints))
    pose = solution.linear.pose
    if served.is_plain:
        # At a limit, one Gauss-Newton step leads to the optimum without limits.
        values = solution.values + (covariances @ transposed @ error[:, :, None])[:, :, 0]
    else:
        # From the first pose to each, to first order.
        values = pose_difference(pose, pose[0]) @ np.linalg.pinv(by_joints[0]).T
    basis = np.linalg.qr(directions, mode="complete")[0]
    across = np.swapaxes(basis[:, :, joints:], 1, 2)
    deviations = np.sqrt(np.einsum("nii->ni", covariances))
    excess = np.concatenate([served.lower - values, values - served.upper], axis=1)
    orthogonal = (across @ error[:, :, None])[:, :, 0]
    return KnownResiduals(
        solution.values,
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
    _, error, directions = _whiten(solution, solution.linear.by_joints)
    basis = np.linalg.qr(directions)[0]
    return error - (basis @ (np.swapaxes(basis, 1, 2) @ error[:, :, None]))[:, :, 0]


def _whiten(solution: Solution[Any], by_joints: Array) -> tuple[Array, Array, Array]:
    """Return W with W S Wᵀ = I, (N, 6, 6), whitened residuals (N, 6) and joint directions (N, 6, k)."""
    whitening = np.linalg.inv(np.linalg.cholesky(solution.covariance))
    error = (whitening @ solution.residuals[:, :, None])[:, :, 0]
    return whitening, error, whitening @ by_joints


_KEPT = 60  # least number of observations that are kept of correlated ones, if there are as many
_ALMOST_ONE = 1.1  # factor on covariances that changes no verdict


@dataclass(frozen=True)
class JointObservations:
    """Observations of a tested joint, and their residuals."""

    joint: TestableJoint
    served: KnownJoint
    observations: Observations  # of both frames
    residuals: KnownResiduals
    numbers: npt.NDArray[np.int_]  # numbers and times [s] of the observations, (N,)
    stamps: Array
    displacement: Array | None = None  # covariance (12, 12) of a joint that is not known exactly

    def select(self, rows: slice | npt.NDArray[np.int_]) -> Self:
        """Return some of the observations."""
        poses, residuals = self.observations.select(rows), self.residuals.select(rows)
        numbers, stamps = self.numbers[rows], self.stamps[rows]
        return replace(self, observations=poses, residuals=residuals, numbers=numbers, stamps=stamps)

    def decorrelate(self, looks: float) -> Self:
        """Return evenly spaced observations with larger covariances, as independent ones."""
        count = len(self.numbers)
        kept = min(max(math.ceil(count / looks), _KEPT), count)
        factor = max(looks * kept / count, 1.0)
        result = self if kept == count else self.select(np.linspace(0, count - 1, kept).round().astype(int))
        if factor < _ALMOST_ONE:
            return result
        poses, before = result.observations.scaled(factor), result.residuals
        residuals = replace(
            compute_residuals(self.served, poses),
            limit_excess=before.limit_excess / math.sqrt(factor),
            disagreement=before.disagreement / math.sqrt(factor),
            other_values=before.other_values,
        )
        return replace(result, observations=poses, residuals=residuals)
