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
from collections.abc import Mapping, Set
from dataclasses import dataclass

import numpy as np

from kineverse.estimation.linear_algebra import inverse_spd, symmetric
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .gaussian import InformationState
from .layout import Layout
from .process_model import ProcessModel

_SETTLED = 1e-12
_MOST_STEPS = 10


@dataclass(frozen=True, eq=False)
class ConditionalSpeeds:
    """Gaussian of the speeds of a group given its state: u | ξ ~ N(m + K ξ, C).

    Attributes
    ----------
    anchor
        Coordinates (n,) in whose tangent space ξ is.
    mean, gain, covariance
        m (k,), K (k, t) and C (k, k).
    """

    anchor: Array
    mean: Array
    gain: Array
    covariance: Array


class ConstantVelocity:
    """Prediction of states and speeds.

    Parameters
    ----------
    layout, process_model
        Components of the tracker.

    Attributes
    ----------
    periodic
        Periodic coordinates, whose values are wrapped.
    """

    def __init__(self, layout: Layout, process_model: ProcessModel) -> None:
        self._layout, self._process_model = layout, process_model
        self.periodic: Set[Symbol] = frozenset()

    def initialise(self, belief: InformationState, variances: Mapping[Symbol, float]) -> None:
        """Set the speeds of all groups to 0, with variances by speed [m²/s²], [rad²/s²]; in place."""
        for number, group in enumerate(self._layout.groups):
            speeds = self._process_model.speeds_of(number)
            belief.speeds[number] = ConditionalSpeeds(
                belief.x[group.x].copy(),
                np.zeros(len(speeds)),
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
        """Predict states and speeds by ``dt`` seconds; in place.

        Parameters
        ----------
        belief
            The belief.
        inputs
            Values of the inputs.
        dt
            Time step [s].
        commands
            Speeds that are known during the step.
        noise
            Spectral density q of the acceleration of each other speed [m²/s³], [rad²/s³].
        """
        for number in range(len(self._layout.groups)):
            self._predict(number, belief, inputs, dt, commands, noise)

    def _predict(
        self,
        number: int,
        belief: InformationState,
        inputs: Array,
        dt: float,
        commands: Mapping[Symbol, float],
        noise: Mapping[Symbol, float],
    ) -> None:
        group, order = self._layout.groups[number], self._process_model.speeds_of(number)
        block, given = group.block, self.at_state(number, belief, inputs)
        covariance = inverse_spd(belief.information[block])
        mean = covariance @ belief.vector[group.t]
        speed = given.mean + given.gain @ mean
        cross = given.gain @ covariance
        spread = given.covariance + cross @ given.gain.T
        density = np.array([noise.get(v, 0.0) for v in order])
        for k, v in enumerate(order):
            if v in commands:
                speed[k], density[k] = commands[v], 0.0
                cross[k] = spread[k] = spread[:, k] = 0.0
        after, slope, gain = self._process_model.transition(number, belief.x[group.x], speed * dt, inputs)
        # [ξ; u] ← [slope, gain dt; 0, 1] [ξ; u], with the noise of an integrated white acceleration.
        moved = cross @ slope.T + dt * spread @ gain.T
        state = slope @ covariance @ slope.T + dt * (gain @ cross @ slope.T + slope @ cross.T @ gain.T)
        state += dt * dt * gain @ spread @ gain.T + (gain * (density * dt**3 / 3)) @ gain.T
        moved += (gain * (density * dt**2 / 2)).T
        information = inverse_spd(symmetric(state))
        regression = moved @ information
        mean = slope @ mean
        belief.x[group.x] = after
        belief.information[block], belief.vector[group.t] = information, information @ mean
        belief.speeds[number] = ConditionalSpeeds(
            after,
            speed - regression @ mean,
            regression,
            symmetric(spread + np.diag(density * dt) - regression @ moved.T),
        )

    def _step_between(
        self, number: int, start: Array, end: Array, inputs: Array
    ) -> tuple[Array, Array | None]:
        """Return the tangent step between two states of a group, and its transport."""
        change = end - start
        for k, x in enumerate(self._layout.groups[number].coordinates):
            if x in self.periodic:
                change[k] = math.remainder(change[k], 2 * math.pi)
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
