"""Motion of a known joint, with joint values as the only unknowns."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from kineverse.compilation import CompiledFunction, compile
from kineverse.errors import KineverseError
from kineverse.estimation.identification.least_squares import Solution, levenberg_marquardt
from kineverse.estimation.identification.motion_model import LinearisedPoses, ParameterPrior
from kineverse.estimation.identification.observations import Observations
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.model import Model
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

# Number of initial values of a single coordinate, and of several coordinates.
_GRID_SIZE, _SAMPLE_SIZE = 33, 256
# Relative margin to limits, where slopes may be infinite.
_MARGIN = 1e-6
# Number of relinearisations where coordinates are not their own tangent.
_ROUNDS = 4


class KnownJoint:
    """Pose of a child in its parent as a function of k joint values.

    Joint values are the coordinates between both. With a quaternion among them, they are displacements from a
    reference instead. With ``open_loops``, coordinates determined by loops count as free.
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
        twists = np.empty((6, len(slopes)))
        for j, slope in enumerate(slopes):
            turned = (slope[:3, :3] @ pose[:3, :3].T).tolist()
            twists[:3, j] = slope[:3, 3]
            twists[3, j] = 0.5 * (turned[2][1] - turned[1][2])
            twists[4, j] = 0.5 * (turned[0][2] - turned[2][0])
            twists[5, j] = 0.5 * (turned[1][0] - turned[0][1])
        return pose, twists

    @cached_property
    def _constant(self) -> tuple[Array, Array]:
        (pose,) = self._linear(self._others)
        return pose, np.zeros((6, 0))

    def retract(self, coordinates: Array, change: Array) -> Array:
        """Return coordinates (N, n) after changes of the joint values (N, k), without limits."""
        if self._rates is not None:
            rates = self._rates.batch(self._points(coordinates))
            change = (rates @ change[:, :, None])[:, :, 0]
        return np.asarray(coordinates + change)

    def per_joint(self, coordinates: Array, slopes: Array) -> Array:
        """Convert slopes by coordinates (N, c, n) to slopes by joint values (N, c, k)."""
        return slopes if self._rates is None else slopes @ self._rates.batch(self._points(coordinates))

    def _points(self, coordinates: Array) -> Array:
        others = np.broadcast_to(self._others, (len(coordinates), len(self._others)))
        return np.concatenate([coordinates, others], axis=1)

    def _twists(self, coordinates: Array) -> tuple[Array, Array]:
        """Return poses, and twists per unit of each coordinate (N, 6, n)."""
        poses, *slopes = self._linear.batch(self._points(coordinates))
        twists = np.zeros((len(poses), 6, len(slopes)))
        for j, slope in enumerate(slopes):
            turned = slope[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)
            twists[:, :3, j] = slope[:, :3, 3]
            for row, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
                twists[:, 3 + row, j] = 0.5 * (turned[:, a, b] - turned[:, b, a])
        return poses, twists

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
            random = np.random.default_rng(0)
            values = random.uniform(low, high, (_SAMPLE_SIZE, self.joints))
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
