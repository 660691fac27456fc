"""Retraction and prediction along q̇ = R(q) u."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .gaussian import InformationState
from .layout import CoordinateGroup, Layout

# Largest displacement in one Runge-Kutta step; the error is below 1e-8.
_LONGEST = 0.1
_MOST_STEPS = 100_000


class RateFlow:
    """Flow of coordinates at constant speeds, with its partial derivatives."""

    def __init__(
        self,
        coordinates: Sequence[Symbol],
        rows: Sequence[Mapping[Symbol, Expression]],
        speeds: Sequence[Symbol],
        inputs: Sequence[Symbol],
    ) -> None:
        self.coordinates, self.speeds = tuple(coordinates), tuple(speeds)
        zero = as_expression(0.0)
        matrix = array([[row.get(v, zero) for v in speeds] for row in rows])
        u, q = array(list(speeds)), array(list(coordinates))

        def rate(at: Expression) -> Expression:
            return apply_substitution(matrix, dict(zip(self.coordinates, at, strict=True))) @ u

        k1 = matrix @ u
        k2 = rate(q + k1 / 2)
        k3 = rate(q + k2 / 2)
        k4 = rate(q + k3)
        after = q + (k1 + 2 * k2 + 2 * k3 + k4) / 6
        arguments = (*self.coordinates, *self.speeds, *inputs)
        # Constant rates are integrated exactly by one step of any length.
        self.is_varying = np.array([[v in row and bool(row[v].symbols) for v in speeds] for row in rows])
        self._rates = compile(matrix, (*self.coordinates, *inputs))
        self._step = compile([after, after.partial(self.coordinates), after.partial(self.speeds)], arguments)

    def wait(self, timeout: float | None) -> None:
        """Wait until the compiled code is ready."""
        self._rates.wait(timeout)
        self._step.wait(timeout)

    @property
    def addresses(self) -> tuple[int, int] | None:
        """Addresses of the C functions of rates and steps; None before compilation ends."""
        rates, step = self._rates.address, self._step.address
        return None if rates is None or step is None else (rates, step)

    def rates(self, q: Array, inputs: Array) -> Array:
        """Return R(q) (n, m)."""
        result: Array = self._rates(np.concatenate([q, inputs]))
        return result

    def integrate(self, q: Array, speeds: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """Return q after one unit of time, and its derivatives by the initial q (n, n) and the speeds (n, m).

        Classical Runge-Kutta steps of fourth order.
        """
        largest = float((self.is_varying * np.abs(self.rates(q, inputs))).sum(axis=0) @ np.abs(speeds))
        if not math.isfinite(largest) or largest > _MOST_STEPS * _LONGEST:
            names = ", ".join(map(str, self.coordinates))
            raise InvalidValueError(
                f"{names} cannot be followed so far in one step: after a long time without measurements, "
                "reset the tracker."
            )
        count = max(1, math.ceil(largest / _LONGEST))
        by_start, by_speeds = np.eye(len(q)), np.zeros((len(q), len(speeds)))
        for _ in range(count):
            q, slope, gain = self._step(np.concatenate([q, speeds / count, inputs]))
            by_start, by_speeds = slope @ by_start, slope @ by_speeds + gain / count
        return q, by_start, by_speeds


class ProcessModel:
    """Process model of a layout: retraction and prediction."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        tangent_space, rates = layout.tangent_space, layout.tangent_space.rates
        one = as_expression(1.0)
        self._steps: dict[int, RateFlow] = {}
        self._flows: dict[int, RateFlow] = {}
        by_name: dict[str, Symbol] = {}
        for number, group in enumerate(layout.groups):
            rows = [rates[x] if x in rates else {x.derivative(): one} for x in group.coordinates]
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            by_name.update({str(v): v for v in speeds})
            if any(x in rates for x in group.coordinates):
                self._flows[number] = RateFlow(group.coordinates, rows, speeds, layout.inputs)
            if group.by_speeds:
                process_model = [tangent_space.rate_row(x) for x in group.coordinates]
                self._steps[number] = RateFlow(group.coordinates, process_model, group.tangent, layout.inputs)
        self._identities = [np.eye(len(group.t)) for group in layout.groups]
        self.speeds: Mapping[str, Symbol] = by_name

    def speed(self, key: Symbol | str) -> Symbol:
        """Return the speed of a name, or that of the coordinate of this name."""
        result = self.speeds.get(str(key))
        if result is None:
            result = self.speeds.get(f"{key}:velocity")
        if result is None:
            raise UnknownNameError(
                f"Nothing that is estimated moves with '{key}'. {suggest(str(key), self.speeds, 'speed')}"
            )
        return result

    def speeds_of(self, number: int) -> tuple[Symbol, ...]:
        """Return the speeds with which a group moves, in order."""
        flow = self._flows.get(number)
        return self._layout.groups[number].tangent if flow is None else flow.speeds

    def is_noise_only(self, number: int, speeds: Mapping[Symbol, float]) -> bool:
        """Return True if a group moves by noise alone, in directions that are its coordinates."""
        group = self._layout.groups[number]
        return number not in self._flows and not any(speeds.get(v, 0.0) for v in group.tangent)

    def wait(self, timeout: float | None) -> None:
        """Wait until retraction runs in compiled code."""
        for motion in self._steps.values():
            motion.wait(timeout)

    def flow(self, number: int) -> RateFlow | None:
        """Return the flow of a group along its tangent; None if the tangent is its coordinates."""
        return self._steps.get(number)

    @property
    def has_rates(self) -> bool:
        """True if some coordinates move by rates other than their own speeds."""
        return bool(self._flows)

    def find_moving_groups(self, speeds: Mapping[Symbol, float], noise: Mapping[Symbol, float]) -> list[int]:
        """Return the numbers of the groups that move at given speeds or with noise."""
        active = {v for by in (speeds, noise) for v, value in by.items() if value}
        numbers = range(len(self._layout.groups))
        return [number for number in numbers if not active.isdisjoint(self.speeds_of(number))]

    def retract(self, number: int, x: Array, step: Array, inputs: Array) -> tuple[Array, Array | None]:
        """Return a group's coordinates after a tangent step, and the transport J of the tangent space.

        A further step dξ at the start is J dξ in the tangent space at the end. None stands for the identity.
        """
        motion = self._steps.get(number)
        if motion is None:
            return x + step, None
        after, _, gain = motion.integrate(x, step, inputs)
        return after, np.linalg.pinv(motion.rates(after, inputs)) @ gain

    def basis(self, number: int, x: Array, inputs: Array) -> Array:
        """Return the Jacobian of a group's coordinates by its tangent (n, t)."""
        motion = self._steps.get(number)
        return np.eye(len(x)) if motion is None else motion.rates(x, inputs)

    def predict(
        self,
        belief: InformationState,
        inputs: Array,
        dt: float,
        speeds: Mapping[Symbol, float],
        noise: Mapping[Symbol, float],
    ) -> None:
        """Predict a belief by ``dt`` seconds, with speeds and variances per second; in place."""
        for number, group in enumerate(self._layout.groups):
            order = self.speeds_of(number)
            displacement = np.array([speeds.get(v, 0.0) for v in order]) * dt
            added_variance = np.array([noise.get(v, 0.0) for v in order]) * dt
            if displacement.any() or added_variance.any():
                self._predict(number, group, belief, inputs, displacement, added_variance)

    def transition(
        self, number: int, x: Array, displacement: Array, inputs: Array
    ) -> tuple[Array, Array, Array]:
        """Return a group's coordinates after a displacement by its speeds, and its derivatives.

        The derivatives by the start (t, t) and by the displacement (t, k) are in the tangent space.
        """
        flow = self._flows.get(number)
        if flow is None:
            identity = self._identities[number]
            return x + displacement, identity, identity
        after, slope, gain = flow.integrate(x, displacement, inputs)
        back = np.linalg.pinv(self.basis(number, after, inputs))
        return after, back @ slope @ self.basis(number, x, inputs), back @ gain

    def _predict(
        self,
        number: int,
        group: CoordinateGroup,
        belief: InformationState,
        inputs: Array,
        displacement: Array,
        added_variance: Array,
    ) -> None:
        block = group.block
        covariance = inverse_spd(belief.information[block])
        after, slope, gain = self.transition(number, belief.x[group.x], displacement, inputs)
        mean = slope @ (covariance @ belief.vector[group.t])
        covariance = slope @ covariance @ slope.T + (gain * added_variance) @ gain.T
        information = inverse_spd(covariance)
        belief.x[group.x] = after
        belief.information[block] = information
        belief.vector[group.t] = information @ mean
