"""How coordinates move along their rates, with derivatives: q̇ = R(q) u over a step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import ValueRejectedError
from kineverse.estimation.noise import Array
from kineverse.expressions.expression import Expression, array, as_expression
from kineverse.expressions.substitution import apply
from kineverse.symbols import Symbol

# How far rates may turn in one Runge-Kutta step: its error is below 1e-8.
_LONGEST = 0.1
_MOST_STEPS = 100_000


class Motion:
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
            return apply(matrix, dict(zip(self.coordinates, at, strict=True))) @ u

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
        ValueRejectedError
            If it cannot be followed.
        """
        largest = float((self.bends * np.abs(self.rates(q, known))).sum(axis=0) @ np.abs(speeds))
        if not math.isfinite(largest) or largest > _MOST_STEPS * _LONGEST:
            names = ", ".join(map(str, self.coordinates))
            raise ValueRejectedError(f"{names} cannot be followed so far in one step.")
        count = max(1, math.ceil(largest / _LONGEST))
        by_start, by_speeds = np.eye(len(q)), np.zeros((len(q), len(speeds)))
        for _ in range(count):
            q, slope, gain = self._step(np.concatenate([q, speeds / count, known]))
            by_start, by_speeds = slope @ by_start, slope @ by_speeds + gain / count
        return q, by_start, by_speeds
