"""Integration of states at constant speeds.

Limits and other constraints are ignored here; ``model.integrate(..., clip=True)`` clips coordinates
afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from kineverse._checks import finite_number
from kineverse.errors import (
    ExpressionError,
    InvalidValueError,
    UnknownNameError,
    duplicate_value_error,
    suggest,
)
from kineverse.expressions.evaluation import symbol_values
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .integrator import Integrator
from .rates import Rates


class StateIntegrator:
    """Motion of states at constant speeds.

    Free coordinates move linearly. The others follow their rows by an :class:`.Integrator` of all that their
    rows contain. It is for one thread.
    """

    def __init__(self, coordinates: Iterable[Symbol], rates: Rates) -> None:
        self._free = {c.derivative(): c for c in coordinates if c not in rates}
        self._columns = _sorted({v for row in rates.values() for v in row})
        self._speeds = {str(s): s for s in (*self._free, *self._columns)}
        self._driven = set(rates)
        self._integrator: Integrator | None = None
        if rates:
            seen = {s for row in rates.values() for g in row.values() for s in g.symbols if s not in rates}
            own = {s.derivative() for s in seen if s.has_derivative and not s.order}
            speeds = _sorted(own.union(self._columns))
            self._integrator = Integrator(rates, (*_sorted(rates), *_sorted(seen.difference(speeds))), speeds)

    def integrate(self, state: State, speeds: StateLike, dt: float) -> State:
        """Return the state after ``dt`` seconds."""
        step = finite_number(dt)
        if step is None:
            raise InvalidValueError(f"The time step is a finite number of seconds, not {dt!r}.")
        dt = step
        given = self._given_speeds(speeds)
        free = self._free
        result = {free[v]: state[free[v]] + dt * value for v, value in given.items() if v in free}
        for coordinate, reached in result.items():
            if not math.isfinite(reached):
                raise InvalidValueError(f"'{coordinate}' runs to {reached} in {dt:g} s. Take a shorter time.")
        if self._integrator is not None and any(given.get(v) for v in self._columns):
            symbols = self._integrator.symbols
            known = {s: value for s in symbols if (value := state.given(s)) is not None}
            after = self._integrator(
                symbol_values(symbols, State(known)),
                np.array([given.get(v, 0.0) for v in self._integrator.speeds]),
                dt,
            )
            result.update({s: x for s, x in zip(symbols, after.tolist(), strict=True) if s in self._driven})
        return state.updated(result, stamp=None if state.stamp is None else state.stamp + dt)

    def _given_speeds(self, speeds: StateLike) -> dict[Symbol, float]:
        if not isinstance(speeds, Mapping):
            raise ExpressionError(f"Speeds are given as a mapping {{name: number}}, not as {speeds!r}.")
        given: dict[Symbol, float] = {}
        for key, value in speeds.items():
            speed = self._speeds.get(str(key))
            if speed is None:
                if isinstance(speeds, State):
                    continue  # a state may have further values
                raise UnknownNameError(
                    f"Nothing moves with '{key}'. {suggest(str(key), self._speeds, 'speed')}"
                )
            if speed in given:
                raise duplicate_value_error(speed)
            finite = finite_number(value)
            if finite is None:
                raise InvalidValueError(f"The speed '{key}' is {value!r}; it must be finite.")
            given[speed] = finite
        return given


def _sorted(symbols: Iterable[Symbol]) -> tuple[Symbol, ...]:
    return tuple(sorted(symbols, key=lambda s: s.sort_key))
