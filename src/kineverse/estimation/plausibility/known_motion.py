"""Motion of a known joint, with joint values as the only unknowns."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np

from kineverse.compile import CompiledFunction, compile  # noqa: A004
from kineverse.errors import KineverseError
from kineverse.estimation.identification.motion_model import LinearisedPoses, ParameterPrior
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.optimise import Solution, levenberg_marquardt
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Stack
from kineverse.model.constraint import Constraint
from kineverse.model.model import Model
from kineverse.model.rate_nodes import to_plain
from kineverse.symbols import Symbol

# How many starts there are along a single coordinate, and scattered over several.
_ALONG, _SCATTERED = 33, 256
# Limits are approached up to this part of their width: right there a slope may be infinite.
_INSIDE = 1e-6
# Poses are linearised anew so often, where coordinates are not their own tangent.
_ROUNDS = 4


class KnownJoint:
    """The pose of a child in its parent as a function of k joint values.

    Joint values are the coordinates between both, or where a quaternion is among them, turns away from a
    reference. If ``opened``, coordinates that loops determine are as if they were free.

    Attributes
    ----------
    coordinates
        The n coordinates.
    joints
        The number of joint values, k.
    lower, upper
        Limits of the joint values, (k,); ±inf where there are none.
    turning
        Which joint values turn the child, (k,).
    home, middle
        The coordinates in the model's default state, (n,), and where the child is then, (3,).
    """

    def __init__(self, model: Model, child: str, parent: str, opened: bool = False) -> None:
        rates = model.rates
        pose = to_plain(model.fk(child, parent))
        self.pose = pose = pose if opened else rates.resolve(pose)
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
        # Coordinates with more numbers than ways to move, such as a quaternion, move by their speeds. Others
        # are where they are, however they came there, be it on wheels.
        self._rates: CompiledFunction | None = None
        count = len(coordinates)
        if any(x in rates for x in coordinates) and self._ways() < count:
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            none = as_expression(0.0)
            self._rates = compile(array([[row.get(v, none) for v in speeds] for row in rows]), inputs)
            count = len(speeds)
        self.joints = count
        limits = [_limits(model, x) for x in coordinates] if self.is_plain else [UNBOUNDED] * count
        self.lower, self.upper = (np.array([pair[side] for pair in limits]) for side in (0, 1))
        there = self.at(self.home[None, :])
        self.middle = there.pose[0, :3, 3]
        self.turning = np.abs(there.by_joints[0, 3:]).max(axis=0, initial=0.0) > 1e-9

    @property
    def is_plain(self) -> bool:
        """Whether joint values are the coordinates."""
        return self._rates is None

    def same(self, other: KnownJoint) -> bool:
        """Whether another articulation moves alike within the same limits."""
        return (
            self.pose == other.pose
            and np.array_equal(self.lower, other.lower)
            and np.array_equal(self.upper, other.upper)
            and np.array_equal(self._others, other._others)
        )

    def at(self, coordinates: Stack) -> LinearisedPoses:
        """Return poses at coordinates (N, n), and twists per unit of each joint value."""
        poses, twists = self._twists(coordinates)
        if self._rates is not None:
            twists = twists @ self._rates.batch(self._points(coordinates))
        return LinearisedPoses(poses, np.zeros((len(poses), 6, 0)), twists)

    def moved(self, coordinates: Stack, change: Stack) -> Stack:
        """Return coordinates (N, n) after changes of the joint values (N, k), without limits."""
        if self._rates is not None:
            rates = self._rates.batch(self._points(coordinates))
            change = (rates @ change[:, :, None])[:, :, 0]
        result: Stack = coordinates + change
        return result

    def per_joint(self, coordinates: Stack, slopes: Stack) -> Stack:
        """Return slopes (N, c, k) by joint values, of those by coordinates, (N, c, n)."""
        return slopes if self._rates is None else slopes @ self._rates.batch(self._points(coordinates))

    def _ways(self) -> int:
        """Return in how many ways the child can move at home."""
        _, twists = self._twists(self.home[None, :])
        return int(np.linalg.matrix_rank(twists[0]))

    def _points(self, coordinates: Stack) -> Stack:
        others = np.broadcast_to(self._others, (len(coordinates), len(self._others)))
        return np.concatenate([coordinates, others], axis=1)

    def _twists(self, coordinates: Stack) -> tuple[Stack, Stack]:
        """Return poses, and twists per unit of each coordinate (N, 6, n)."""
        poses, *slopes = self._linear.batch(self._points(coordinates))
        twists = np.zeros((len(poses), 6, len(slopes)))
        for j, slope in enumerate(slopes):
            turned = slope[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)
            twists[:, :3, j] = slope[:, :3, 3]
            for row, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
                twists[:, 3 + row, j] = 0.5 * (turned[:, a, b] - turned[:, b, a])
        return poses, twists

    def solve(self, seen: Observations) -> tuple[Stack, Solution[KnownMotion]]:
        """Return the most likely coordinates (N, n) inside the limits, and the quadratic around them."""
        coordinates = self._starts(seen)
        for _ in range(1 if self.is_plain else _ROUNDS):
            values = np.zeros((len(seen), self.joints))
            if self.is_plain:
                coordinates, values = values, coordinates
            solution = levenberg_marquardt(seen, KnownMotion(self, coordinates), values)
            coordinates = self.moved(coordinates, solution.values)
        return coordinates, solution

    def beyond_limits(self, seen: Observations, inside: Stack) -> Stack:
        """Return the most likely coordinates (N, n) as if there were no limits.

        Where the pose means nothing beyond them, those inside stay.
        """
        free = copy(self)
        free.lower, free.upper = np.full(self.joints, -np.inf), np.full(self.joints, np.inf)
        try:
            coordinates, _ = free.solve(seen)
        except (KineverseError, np.linalg.LinAlgError):
            return inside
        return coordinates if np.isfinite(coordinates).all() else inside

    def _starts(self, seen: Observations) -> Stack:
        """Return coordinates near each observation: the best of some that are tried."""
        grid = self._grid()
        poses = self.at(grid).pose
        observed = seen.relative
        covariance = np.einsum("nii->i", seen.child_covariance) / len(seen)
        place, turn = covariance[:3].sum() / 3.0, covariance[3:].sum() / 3.0
        # ‖R - S‖² = 6 - 2 tr(RᵀS) is twice the square of a small angle.
        flat, tried = observed[:, :3, :3].reshape(-1, 9), poses[:, :3, :3].reshape(-1, 9)
        off = (3.0 - flat @ tried.T) / turn
        p, q = observed[:, :3, 3], poses[:, :3, 3]
        off += (np.sum(p**2, axis=1)[:, None] - 2.0 * p @ q.T + np.sum(q**2, axis=1)) / place
        nearest: Stack = grid[np.argmin(off, axis=1)]
        return nearest

    def _grid(self) -> Stack:
        if not self.joints:
            return self.home[None, :]
        low, high = self._inside()
        reach = np.where(self.turning, math.pi, 1.0)
        middle = self.home if self.is_plain else np.zeros(self.joints)
        from_low = np.where(np.isfinite(low), low, middle) + reach
        from_high = np.where(np.isfinite(high), high, middle) - reach
        low, high = np.where(np.isfinite(low), low, from_high), np.where(np.isfinite(high), high, from_low)
        if self.joints == 1:
            values = np.linspace(low, high, _ALONG)
        else:
            random = np.random.default_rng(0)
            values = random.uniform(low, high, (_SCATTERED, self.joints))
        start = np.zeros_like(self.home) if self.is_plain else self.home
        return self.moved(np.tile(start, (len(values), 1)), values)

    def _inside(self) -> tuple[Stack, Stack]:
        width = self.upper - self.lower
        margin = np.where(np.isfinite(width), _INSIDE * width, 0.0)
        return self.lower + margin, self.upper - margin


UNBOUNDED = (-math.inf, math.inf)


def _limits(model: Model, coordinate: Symbol) -> tuple[float, float]:
    """Return the limits of a coordinate by itself; those that depend on others may be narrower."""
    lower, upper = UNBOUNDED
    for constraint in model.constraints_for([coordinate]).values():
        if is_own_limit(constraint, coordinate):
            slope, offset = constraint.line or (1.0, 0.0)
            low, high = sorted((float(b) - offset) / slope for b in (constraint.lower, constraint.upper))
            lower, upper = max(lower, low), min(upper, high)
    return lower, upper


def is_own_limit(constraint: Constraint, coordinate: Symbol) -> bool:
    """Whether a constraint holds a coordinate between two numbers."""
    bounds = (*constraint.lower.symbols, *constraint.upper.symbols)
    return constraint.line is not None and constraint.expression.symbols == (coordinate,) and not bounds


@dataclass(frozen=True)
class KnownMotion:
    """What :func:`.solving.solve` takes: joint values as changes of coordinates (N, n)."""

    served: KnownJoint
    reference: Stack

    size = 0

    @property
    def joints(self) -> int:
        """The number of joint values."""
        return self.served.joints

    def linearise(self, values: Stack) -> LinearisedPoses:
        """Return the poses at joint values (N, k)."""
        return self.served.at(self.served.moved(self.reference, values))

    def retract(self, step: Stack) -> Self:
        """Return itself: there are no parameters."""
        return self

    def retract_joints(self, values: Stack, step: Stack) -> Stack:
        """Return joint values after a step: at most half a radian at once, and inside the limits."""
        turning = self.served.turning
        step = np.where(turning, np.clip(step, -0.5, 0.5), step)
        low, high = self.served._inside()
        result: Stack = np.clip(values + step, low, high)
        return result

    def prior(self) -> ParameterPrior:
        """Return that nothing is believed beforehand."""
        return ParameterPrior(np.zeros(0), np.zeros((0, 0)))
