"""Retraction and prediction along q̇ = R(q) u."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import InvalidValueError, UnknownNameError, suggest
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.substitution import apply_substitution
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .gaussian import InformationState, inverse_spd
from .layout import CoordinateGroup, Layout

# How far rates may turn in one Runge-Kutta step: its error is below 1e-8.
_LONGEST = 0.1
_MOST_STEPS = 100_000


class RateFlow:
    """The flow of some coordinates at constant speeds, and its partial derivatives.

    Parameters
    ----------
    coordinates
        What moves; everything else that rows look at is known and stays.
    rows
        How each moves with which speeds.
    speeds
        The order of the speeds.
    known
        What is handed in.

    Attributes
    ----------
    bends
        Whether the rate of a coordinate with a speed changes on the way (n, m).
    """

    def __init__(
        self,
        coordinates: Sequence[Symbol],
        rows: Sequence[Mapping[Symbol, Expression]],
        speeds: Sequence[Symbol],
        known: Sequence[Symbol],
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
        inputs = (*self.coordinates, *self.speeds, *known)
        # What moves at a constant rate needs no short steps, however far it goes.
        self.bends = np.array([[v in row and bool(row[v].symbols) for v in speeds] for row in rows])
        self._rates = compile(matrix, (*self.coordinates, *known))
        self._step = compile([after, after.partial(self.coordinates), after.partial(self.speeds)], inputs)

    def wait(self, timeout: float | None) -> None:
        """Wait until it runs in compiled code."""
        self._rates.wait(timeout)
        self._step.wait(timeout)

    @property
    def addresses(self) -> tuple[int, int] | None:
        """Where the C of rates and steps is; None while there is none."""
        rates, step = self._rates.address, self._step.address
        return None if rates is None or step is None else (rates, step)

    def rates(self, q: Array, known: Array) -> Array:
        """Return R (n, m) at a place."""
        found: Array = self._rates(np.concatenate([q, known]))
        return found

    def along(self, q: Array, speeds: Array, known: Array) -> tuple[Array, Array, Array]:
        """Return q after a unit of time, its derivatives by q before (n, n), and by the speeds (n, m).

        Raises
        ------
        InvalidValueError
            If it cannot be followed.
        """
        largest = float((self.bends * np.abs(self.rates(q, known))).sum(axis=0) @ np.abs(speeds))
        if not math.isfinite(largest) or largest > _MOST_STEPS * _LONGEST:
            names = ", ".join(map(str, self.coordinates))
            raise InvalidValueError(f"{names} cannot be followed so far in one step.")
        count = max(1, math.ceil(largest / _LONGEST))
        by_start, by_speeds = np.eye(len(q)), np.zeros((len(q), len(speeds)))
        for _ in range(count):
            q, slope, gain = self._step(np.concatenate([q, speeds / count, known]))
            by_start, by_speeds = slope @ by_start, slope @ by_speeds + gain / count
        return q, by_start, by_speeds


class ProcessModel:
    """A layout that can move.

    Parameters
    ----------
    layout
        Where coordinates are.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        chart, rates = layout.chart, layout.chart.rates
        one = as_expression(1.0)
        self._steps: dict[int, RateFlow] = {}
        self._flows: dict[int, RateFlow] = {}
        by_name: dict[str, Symbol] = {}
        for number, group in enumerate(layout.groups):
            rows = [rates[x] if x in rates else {x.derivative(): one} for x in group.coordinates]
            speeds = sorted({v for row in rows for v in row}, key=lambda s: s.sort_key)
            by_name.update({str(v): v for v in speeds})
            if any(x in rates for x in group.coordinates):
                self._flows[number] = RateFlow(group.coordinates, rows, speeds, layout.known)
            if group.by_speeds:
                charted = [chart.row(x) for x in group.coordinates]
                self._steps[number] = RateFlow(group.coordinates, charted, group.tangent, layout.known)
        self.speeds: Mapping[str, Symbol] = by_name

    def speed(self, key: Symbol | str) -> Symbol:
        """Return the speed of a name.

        Raises
        ------
        UnknownNameError
            If it moves nothing here.
        """
        found = self.speeds.get(str(key))
        if found is None:
            raise UnknownNameError(
                f"Nothing that is estimated moves with '{key}'. {suggest(str(key), self.speeds, 'speed')}"
            )
        return found

    def only_shakes(self, number: int, speeds: Mapping[Symbol, float]) -> bool:
        """Whether a group moves by noise alone, in directions that are its coordinates."""
        group = self._layout.groups[number]
        return number not in self._flows and not any(speeds.get(v, 0.0) for v in group.tangent)

    def wait(self, timeout: float | None) -> None:
        """Wait until steps run in compiled code."""
        for motion in self._steps.values():
            motion.wait(timeout)

    def motion(self, number: int) -> RateFlow | None:
        """Return how a group moves with its tangent; None if its coordinates are that."""
        return self._steps.get(number)

    @property
    def is_driven(self) -> bool:
        """Whether some coordinates move by rates, and not by speeds of their own alone."""
        return bool(self._flows)

    def moving(self, speeds: Mapping[Symbol, float], noise: Mapping[Symbol, float]) -> list[int]:
        """Return the numbers of the groups that move at speeds or with noise."""
        active = {v for by in (speeds, noise) for v, value in by.items() if value}
        found = []
        for number, group in enumerate(self._layout.groups):
            flow = self._flows.get(number)
            if not active.isdisjoint(group.tangent if flow is None else flow.speeds):
                found.append(number)
        return found

    def step(self, number: int, x: Array, step: Array, known: Array) -> tuple[Array, Array | None]:
        """Return a group's coordinates after a step in its tangent, and how the tangent turns on the way.

        That is J with: a bit more of the step, dξ, is J dξ in the tangent where it ends; None for identity.
        """
        motion = self._steps.get(number)
        if motion is None:
            return x + step, None
        after, _, gain = motion.along(x, step, known)
        return after, np.linalg.pinv(motion.rates(after, known)) @ gain

    def basis(self, number: int, x: Array, known: Array) -> Array:
        """Return how a group's coordinates move with its tangent (n, t)."""
        motion = self._steps.get(number)
        return np.eye(len(x)) if motion is None else motion.rates(x, known)

    def predict(
        self,
        belief: InformationState,
        known: Array,
        dt: float,
        speeds: Mapping[Symbol, float],
        noise: Mapping[Symbol, float],
    ) -> None:
        """Move a belief on by ``dt`` seconds at speeds, with variances per second that add to them."""
        for number, group in enumerate(self._layout.groups):
            flow = self._flows.get(number)
            order = group.tangent if flow is None else flow.speeds
            moved = np.array([speeds.get(v, 0.0) for v in order]) * dt
            grown = np.array([noise.get(v, 0.0) for v in order]) * dt
            if moved.any() or grown.any():
                self._predict(number, group, belief, known, moved, grown)

    def _predict(
        self,
        number: int,
        group: CoordinateGroup,
        belief: InformationState,
        known: Array,
        moved: Array,
        grown: Array,
    ) -> None:
        flow, block = self._flows.get(number), np.ix_(group.t, group.t)
        x = belief.x[group.x]
        covariance = inverse_spd(belief.information[block])
        mean = covariance @ belief.vector[group.t]
        if flow is None:
            after = x + moved
            covariance = covariance + np.diag(grown)
        else:
            after, slope, gain = flow.along(x, moved, known)
            back = np.linalg.pinv(self.basis(number, after, known))
            slope, gain = back @ slope @ self.basis(number, x, known), back @ gain
            mean = slope @ mean
            covariance = slope @ covariance @ slope.T + (gain * grown) @ gain.T
        information = inverse_spd(covariance)
        belief.x[group.x] = after
        belief.information[block] = information
        belief.vector[group.t] = information @ mean
