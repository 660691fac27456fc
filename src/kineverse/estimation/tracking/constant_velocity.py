"""Constant-velocity process model: speeds are estimated beside the state.

The acceleration is white noise with the spectral density q (Bar-Shalom, Li and Kirubarajan, Estimation with
Applications to Tracking and Navigation, 2001, 6.2.2):

    ẋ = R(x) u,    u̇ = w,    Cov ∫ w dt = q dt

No measurement depends on speeds. So an update of the state alone is exact, and the speeds stay Gaussian with
fixed moments given the state:

    u | ξ ~ N(m + K ξ, C)

for a step ξ in the tangent space. Only the prediction needs the joint Gaussian of ξ and u.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.estimation.linear_algebra import (
    invert_matrices,
    multiply_vectors,
    symmetric,
    transposed,
)
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .gaussian import InformationState
from .layout import Layout
from .process_model import ProcessModel

_SETTLED = 1e-12
_MOST_STEPS = 10


@dataclass(frozen=True, eq=False)
class ConditionalSpeeds:
    """Gaussian of the speeds of a group given its state: u | ξ ~ N(m + K ξ, C)."""

    anchor: Array  # coordinates (n,) in whose tangent space ξ is
    mean: Array  # m (k,), K (k, t) and C (k, k)
    gain: Array
    covariance: Array


class ConstantVelocity:
    """Prediction of states and speeds."""

    def __init__(self, layout: Layout, process_model: ProcessModel) -> None:
        self._layout, self._process_model = layout, process_model
        self.periods: Mapping[Symbol, float] = {}
        by_size: dict[tuple[int, int], list[int]] = {}
        for number, group in enumerate(layout.groups):
            size = len(group.t), len(process_model.speeds_of(number))
            by_size.setdefault(size, []).append(number)
        self._batches = list(by_size.values())

    def initialise(
        self, belief: InformationState, means: Mapping[Symbol, float], variances: Mapping[Symbol, float]
    ) -> None:
        """Set the speeds of all groups, those without a mean to 0, independent of the state; in place."""
        for number, group in enumerate(self._layout.groups):
            speeds = self._process_model.speeds_of(number)
            belief.speeds[number] = ConditionalSpeeds(
                belief.x[group.x].copy(),
                np.array([means.get(v, 0.0) for v in speeds]),
                np.zeros((len(speeds), len(group.t))),
                np.diag([variances[v] for v in speeds]),
            )

    def at_state(self, number: int, belief: InformationState, inputs: Array) -> ConditionalSpeeds:
        """Return the speeds of a group given a step in the tangent space at its present state."""
        speeds = belief.speeds[number]
        assert speeds is not None
        x = belief.x[self._layout.groups[number].x]
        if np.array_equal(x, speeds.anchor):
            return speeds
        step, transport = self._step_between(number, speeds.anchor, x, inputs)
        gain = speeds.gain if transport is None else speeds.gain @ np.linalg.inv(transport)
        return ConditionalSpeeds(x, speeds.mean + speeds.gain @ step, gain, speeds.covariance)

    def covariance(self, number: int, belief: InformationState, inputs: Array, state: Array) -> Array:
        """Return the covariance of the speeds of a group (k, k), for a covariance of its state (t, t)."""
        speeds = self.at_state(number, belief, inputs)
        return symmetric(speeds.covariance + speeds.gain @ state @ speeds.gain.T)

    def predict(
        self,
        belief: InformationState,
        inputs: Array,
        dt: float,
        commands: Mapping[Symbol, float],
        noise: Mapping[Symbol, float],
    ) -> None:
        """Predict states and speeds by ``dt`` seconds; in place."""
        # Too long a step leads to numbers that are not finite, which the caller refuses.
        with np.errstate(over="ignore", invalid="ignore"):
            for numbers in self._batches:
                self._predict(numbers, belief, inputs, np.float64(dt), commands, noise)

    def _predict(
        self,
        numbers: Sequence[int],
        belief: InformationState,
        inputs: Array,
        dt: float,
        commands: Mapping[Symbol, float],
        noise: Mapping[Symbol, float],
    ) -> None:
        """Predict groups of equal sizes (g,), all at once."""
        groups = [self._layout.groups[n] for n in numbers]
        given = [self.at_state(n, belief, inputs) for n in numbers]
        t = np.array([group.t for group in groups])
        rows, columns = t[:, :, None], t[:, None, :]
        covariance = invert_matrices(belief.information[rows, columns])
        mean = multiply_vectors(covariance, belief.vector[t])
        gain = np.array([one.gain for one in given])
        speed = np.array([one.mean for one in given]) + multiply_vectors(gain, mean)
        cross = gain @ covariance
        spread = np.array([one.covariance for one in given]) + cross @ transposed(gain)
        orders = [self._process_model.speeds_of(n) for n in numbers]
        density = np.array([[noise.get(v, 0.0) for v in order] for order in orders])
        for g, order in enumerate(orders):
            for k, v in enumerate(order):
                if v in commands:
                    speed[g, k], density[g, k] = commands[v], 0.0
                    cross[g, k] = spread[g, k] = spread[g, :, k] = 0.0
        ends = [
            self._process_model.transition(n, belief.x[group.x], by, inputs)
            for n, group, by in zip(numbers, groups, speed * dt, strict=True)
        ]
        slope, by_speed = (np.array([end[i] for end in ends]) for i in (1, 2))
        # [ξ; u] ← [slope, by_speed dt; 0, 1] [ξ; u], with the noise of an integrated white acceleration.
        moved = cross @ transposed(slope) + dt * spread @ transposed(by_speed)
        moved += dt**2 / 2 * density[:, :, None] * transposed(by_speed)
        state = slope @ covariance @ transposed(slope)
        coupled = dt * by_speed @ cross @ transposed(slope)
        state += coupled + transposed(coupled)
        spread_and_noise = dt**2 * spread + dt**3 / 3 * density[:, :, None] * np.eye(density.shape[1])
        state += by_speed @ spread_and_noise @ transposed(by_speed)
        information = invert_matrices(symmetric(state))
        regression, mean = moved @ information, multiply_vectors(slope, mean)
        left = spread + dt * density[:, :, None] * np.eye(density.shape[1]) - regression @ transposed(moved)
        left = symmetric(left)
        belief.information[rows, columns] = information
        belief.vector[t] = multiply_vectors(information, mean)
        speed -= multiply_vectors(regression, mean)
        for g, (number, group) in enumerate(zip(numbers, groups, strict=True)):
            after = ends[g][0]
            belief.x[group.x] = after
            belief.speeds[number] = ConditionalSpeeds(after, speed[g], regression[g], left[g])

    def _step_between(
        self, number: int, start: Array, end: Array, inputs: Array
    ) -> tuple[Array, Array | None]:
        """Return the tangent step between two states of a group, and its transport."""
        change = end - start
        for k, x in enumerate(self._layout.groups[number].coordinates):
            if x in self.periods:
                change[k] = math.remainder(change[k], self.periods[x])
        if self._process_model.flow(number) is None:
            return change, None
        target = start + change
        step = np.linalg.pinv(self._process_model.basis(number, start, inputs)) @ change
        for _ in range(_MOST_STEPS):
            there, transport = self._process_model.retract(number, start, step, inputs)
            left = np.linalg.pinv(self._process_model.basis(number, there, inputs)) @ (target - there)
            step = step + left
            if float(left @ left) < _SETTLED:
                break
        return step, transport
