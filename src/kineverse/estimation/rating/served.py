"""An articulation as it is served: its parameters are known, and only its joint values are not."""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass
from typing import Self

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import KineverseError
from kineverse.estimation.identification.motion import Linear, Prior
from kineverse.estimation.identification.observations import Observations
from kineverse.estimation.identification.rigid import Array
from kineverse.estimation.identification.solving import Solution, solve
from kineverse.estimation.tracking.chart import chart_of
from kineverse.estimation.tracking.limits import limits_of
from kineverse.expressions.expression import array, as_expression
from kineverse.model.model import Model

# How many starts there are along a single coordinate, and scattered over several.
_ALONG, _SCATTERED = 33, 256
# Limits are approached up to this part of their width: right there a slope may be infinite.
_INSIDE = 1e-6
# Poses are linearised anew so often, where coordinates are not their own tangent.
_ROUNDS = 4


class Served:
    """The pose of a child in its parent as a function of k joint values.

    Joint values are the coordinates between both, or where a quaternion is among them, turns away from a
    reference.

    Attributes
    ----------
    coordinates
        The n coordinates.
    lower, upper
        Limits of the joint values, (k,); ±inf where there are none.
    turning
        Which joint values turn the child, (k,).
    home, middle
        The coordinates in the model's default state, (n,), and where the child is then, (3,).

    Raises
    ------
    ModelError
        For coordinates that nothing can be estimated for, see :mod:`kineverse.estimation.tracking.chart`.
    """

    def __init__(self, model: Model, child: str, parent: str) -> None:
        carried = model.fk(child, parent)
        chart = chart_of(model.rates, carried.symbols, ())
        self.coordinates = chart.coordinates
        self.pose = pose = chart.plain(carried)
        slopes, still, none = chart.gradient(pose), as_expression(np.zeros((4, 4))), as_expression(0.0)
        by_joints = [slopes.get(v, still) for v in chart.tangent]
        rows = [[chart.row(x).get(v, none) for v in chart.tangent] for x in self.coordinates]
        looked_at = {s for e in (pose, *by_joints, *(e for row in rows for e in row)) for s in e.symbols}
        parameters = sorted(looked_at - set(self.coordinates), key=lambda s: s.sort_key)
        self._parameters = np.array([s.value or 0.0 for s in parameters])
        inputs = (*self.coordinates, *parameters)
        self._linear = compile([pose, *by_joints], inputs)
        self._rates = compile(array(rows), inputs) if rows else None
        default = model.default_state()
        self.home = np.array([default.get(x, 0.0) for x in self.coordinates])
        limits = limits_of(model, chart, frozenset())
        # The coordinate behind each joint value, if it is one.
        plain = {x.derivative(): i for i, x in enumerate(chart.coordinates) if x not in chart.by_speeds}
        self.own = tuple(plain.get(v) for v in chart.tangent)
        self._columns = [i for i in self.own if i is not None]
        # Of turns away from a reference no limits are known.
        whole = None not in self.own
        self.lower = np.array([limits.lower[i] if whole and i is not None else -np.inf for i in self.own])
        self.upper = np.array([limits.upper[i] if whole and i is not None else np.inf for i in self.own])
        there = self.at(self.home[None, :])
        self.middle = there.pose[0, :3, 3]
        self.turning = np.abs(there.by_joints[0, 3:]).max(axis=0, initial=0.0) > 1e-9

    @property
    def joints(self) -> int:
        """The number of joint values, k."""
        return len(self.own)

    @property
    def is_plain(self) -> bool:
        """Whether joint values are the coordinates."""
        return None not in self.own

    def same(self, other: Served) -> bool:
        """Whether another articulation moves alike within the same limits."""
        return (
            self.pose == other.pose
            and np.array_equal(self.lower, other.lower)
            and np.array_equal(self.upper, other.upper)
            and np.array_equal(self._parameters, other._parameters)
        )

    def at(self, coordinates: Array) -> Linear:
        """Return poses at coordinates (N, n), and twists per unit of each joint value."""
        points = np.concatenate(
            [coordinates, np.broadcast_to(self._parameters, (len(coordinates), len(self._parameters)))],
            axis=1,
        )
        poses, *slopes = self._linear.batch(points)
        twists = np.zeros((len(points), 6, len(slopes)))
        for j, slope in enumerate(slopes):
            turned = slope[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)
            twists[:, :3, j] = slope[:, :3, 3]
            for row, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
                twists[:, 3 + row, j] = 0.5 * (turned[:, a, b] - turned[:, b, a])
        return Linear(poses, np.zeros((len(points), 6, 0)), twists)

    def moved(self, coordinates: Array, change: Array) -> Array:
        """Return coordinates (N, n) after changes of the joint values (N, k), without limits."""
        if self._rates is None:
            return coordinates
        if self.is_plain:
            result = coordinates.copy()
            result[:, self._columns] += change
            return result
        points = np.concatenate(
            [coordinates, np.broadcast_to(self._parameters, (len(coordinates), len(self._parameters)))],
            axis=1,
        )
        moved: Array = coordinates + (self._rates.batch(points) @ change[:, :, None])[:, :, 0]
        return moved

    def solve(self, seen: Observations) -> tuple[Array, Solution[ServedMotion]]:
        """Return the most likely coordinates (N, n) inside the limits, and the quadratic around them."""
        coordinates = self._starts(seen)
        for _ in range(1 if self.is_plain else _ROUNDS):
            values = np.zeros((len(seen), self.joints))
            if self.is_plain and self.joints:
                values = coordinates[:, self._columns]
                coordinates = self.moved(coordinates, -values)
            solution = solve(seen, ServedMotion(self, coordinates), values)
            coordinates = self.moved(coordinates, solution.values)
        return coordinates, solution

    def beyond_limits(self, seen: Observations, inside: Array) -> Array:
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

    def _starts(self, seen: Observations) -> Array:
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
        nearest: Array = grid[np.argmin(off, axis=1)]
        return nearest

    def _grid(self) -> Array:
        if not self.joints:
            return self.home[None, :]
        low, high = self._inside()
        reach = np.where(self.turning, math.pi, 1.0)
        middle = np.zeros(self.joints)
        if self.is_plain:
            middle = self.home[self._columns]
        from_low = np.where(np.isfinite(low), low, middle) + reach
        from_high = np.where(np.isfinite(high), high, middle) - reach
        low, high = np.where(np.isfinite(low), low, from_high), np.where(np.isfinite(high), high, from_low)
        if self.joints == 1:
            values = np.linspace(low, high, _ALONG)
        else:
            random = np.random.default_rng(0)
            values = random.uniform(low, high, (_SCATTERED, self.joints))
        start = np.tile(self.home, (len(values), 1))
        if self.is_plain:
            start[:, self._columns] = 0.0
        return self.moved(start, values)

    def _inside(self) -> tuple[Array, Array]:
        width = self.upper - self.lower
        margin = np.where(np.isfinite(width), _INSIDE * width, 0.0)
        return self.lower + margin, self.upper - margin


@dataclass(frozen=True)
class ServedMotion:
    """What :func:`.solving.solve` takes: joint values as changes of coordinates (N, n)."""

    served: Served
    reference: Array

    size = 0

    @property
    def joints(self) -> int:
        """The number of joint values."""
        return self.served.joints

    def at(self, values: Array) -> Linear:
        """Return the poses at joint values (N, k)."""
        return self.served.at(self.served.moved(self.reference, values))

    def moved(self, step: Array) -> Self:
        """Return itself: there are no parameters."""
        return self

    def bounded(self, values: Array, step: Array) -> Array:
        """Return joint values after a step: at most half a radian at once, and inside the limits."""
        turning = self.served.turning
        step = np.where(turning, np.clip(step, -0.5, 0.5), step)
        low, high = self.served._inside()
        result: Array = np.clip(values + step, low, high)
        return result

    def prior(self) -> Prior:
        """Return that nothing is believed beforehand."""
        return Prior(np.zeros(0), np.zeros((0, 0)))
