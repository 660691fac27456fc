"""Numeric integration of a state at constant speeds: q̇ = R(q) u, close to floating-point accuracy.

Limits and other constraints are ignored here; ``model.integrate(..., clip=True)`` clips coordinates
afterwards.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.compile import compile  # noqa: A004
from kineverse.errors import (
    ExpressionError,
    InvalidValueError,
    UnknownNameError,
    duplicate_value_error,
    suggest,
)
from kineverse.expressions.evaluation import symbol_values
from kineverse.expressions.expression import Expression, array
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol

from .rates import Rates

Vector: TypeAlias = npt.NDArray[np.float64]

# Substeps of the modified midpoint rule; the extrapolation over their squares is of order 12.
_SUBSTEPS = (2, 4, 6, 8, 10, 12)
_LONGEST = 0.5
# Error tolerance of a step relative to the coordinates, and smallest step relative to the whole time.
_ERROR = 1e-13
_SHORTEST = 1e-9


def integrate(
    coordinates: tuple[Symbol, ...],
    rates: Rates,
    state: State,
    speeds: StateLike,
    dt: float,
) -> State:
    """Return the state after ``dt`` seconds at constant speeds.

    Free coordinates move linearly. The others follow their rows by extrapolated midpoint steps (Gragg,
    Bulirsch, Stoer), short enough that the error stays near the rounding of floating point; for a quaternion
    this is its exponential.

    Parameters
    ----------
    coordinates, rates
        Coordinates to integrate, and their rate table.
    state
        Values of at least all coordinates that move.
    speeds
        Values by free speed or its name; the default is 0.
    dt
        Duration [s]; may be negative.

    Raises
    ------
    UnknownNameError
        For a speed that moves none of the coordinates.
    InvalidValueError
        For NaN or an infinite step, or if coordinates diverge.
    """
    step = finite_number(dt)
    if step is None:
        raise InvalidValueError(f"The time step is a finite number of seconds, not {dt!r}.")
    dt = step
    if not isinstance(speeds, Mapping):
        raise ExpressionError(f"Speeds are given as a mapping {{name: number}}, not as {speeds!r}.")
    free = {c.derivative(): c for c in coordinates if c not in rates}
    flow = make_flow(rates) if rates else None
    wheels = flow.speeds if flow else ()
    by_name = {str(s): s for s in (*free, *wheels)}
    given: dict[Symbol, float] = {}
    for key, value in speeds.items():
        speed = by_name.get(str(key))
        if speed is None:
            if isinstance(speeds, State):
                continue  # a state may have further values
            raise UnknownNameError(f"Nothing moves with '{key}'. {suggest(str(key), by_name, 'speed')}")
        if speed in given:
            raise duplicate_value_error(speed)
        finite = finite_number(value)
        if finite is None:
            raise InvalidValueError(f"The speed '{key}' is {value!r}; it must be finite.")
        given[speed] = finite
    result = {free[v]: state[free[v]] + dt * value for v, value in given.items() if v in free}
    for coordinate, reached in result.items():
        if not math.isfinite(reached):
            raise InvalidValueError(f"'{coordinate}' runs to {reached} in {dt:g} s. Take a shorter time.")
    if flow and any(given.get(v) for v in wheels):
        try:
            after = flow.follow(state, given, dt)
        except _StuckError as error:
            raise InvalidValueError(
                f"{', '.join(map(str, flow.driven))} cannot be followed for {dt:g} s: their rates have no "
                f"bound near {error.done:.6g} s. Take a shorter time, or look for a pole in their rows."
            ) from None
        result.update(zip(flow.driven, after.tolist(), strict=True))
    stamp = None if state.stamp is None else state.stamp + dt
    return state.updated(result, stamp=stamp)


class Flow:
    """Flow of the driven coordinates at constant speeds, as a compiled function of the coordinates.

    Parameters
    ----------
    rates
        Rate table.

    Attributes
    ----------
    driven
        Coordinates with rows.
    others
        Free coordinates and parameters in the rows.
    speeds
        Speeds of the rows.
    """

    def __init__(self, rates: Rates) -> None:
        self.driven = tuple(sorted(rates, key=lambda s: s.sort_key))
        self.speeds = tuple(sorted({v for row in rates.values() for v in row}, key=lambda s: s.sort_key))
        looked_at = {s for row in rates.values() for g in row.values() for s in g.symbols if s not in rates}
        self.others = tuple(sorted(looked_at, key=lambda s: s.sort_key))
        zero = Expression(0.0)
        rows = [sum((g * v for v, g in rates[x].items()), zero) for x in self.driven]
        entries = [g for x in self.driven for g in rates[x].values()]
        # A speed may be a column of a row and occur in its entries; it is one input.
        inputs = dict.fromkeys((*self.driven, *self.others, *self.speeds))
        self._inputs = tuple(inputs)
        self._function = compile([array(rows), array(entries)], self._inputs)

    def follow(self, state: State, speeds: Mapping[Symbol, float], dt: float) -> Vector:
        """Return the driven coordinates after ``dt``.

        Raises
        ------
        _StuckError
            If they diverge.
        """
        known = {s: value for s in self._inputs if (value := state.given(s)) is not None}
        known.update({v: speeds.get(v, 0.0) for v in self.speeds})
        evaluator = self._function.bind()
        evaluator.input[:] = symbol_values(self._inputs, State(known))
        moving = len(self.driven)
        pace = np.array([speeds.get(s.derivative(), 0.0) if s.has_derivative else 0.0 for s in self.others])
        start = evaluator.input[: moving + len(self.others)].copy()
        flow, gains = evaluator.outputs

        def rate(q: Vector) -> Vector:
            evaluator.input[: len(q)] = q
            evaluator()
            return np.concatenate([flow, pace])

        # Scale of change of a row: its rate at the start, per radian or metre.
        rate(start)
        fastest = max((abs(speeds.get(v, 0.0)) for v in self.speeds), default=0.0)
        scale = fastest * float(np.abs(gains).sum())
        longest = dt / max(1, math.ceil(abs(dt) * scale / _LONGEST))
        return _follow_flow(rate, start, dt, longest)[:moving]


@functools.lru_cache(maxsize=32)
def make_flow(rates: Rates) -> Flow:
    """Return the flow of a rate table; cached, because filters integrate at every step."""
    return Flow(rates)


class _StuckError(Exception):
    """Step length below the smallest one."""

    def __init__(self, done: float) -> None:
        self.done = done


def _follow_flow(rate: Callable[[Vector], Vector], q: Vector, dt: float, longest: float) -> Vector:
    """Integrate q over dt with adaptive steps, controlled by the estimated error."""
    done, step = 0.0, longest
    while abs(done) < abs(dt):
        left = dt - done
        step = step if abs(step) < abs(left) else left
        with np.errstate(all="ignore"):  # a step that is too long may overflow; it is rejected
            after, error = _extrapolated_step(rate, q, step)
            size = max(1.0, float(np.abs([q, after]).max()))
        close = math.isfinite(error) and error <= _ERROR * size
        if close:
            q = after
            done = dt if step == left else done + step
            step = 2 * step if abs(2 * step) < abs(longest) else longest
        elif abs(step) > _SHORTEST * abs(dt):
            step /= 2
        else:
            raise _StuckError(done)
    return q


def _extrapolated_step(rate: Callable[[Vector], Vector], q: Vector, dt: float) -> tuple[Vector, float]:
    """Integrate q over one step, and estimate the error (Gragg, Bulirsch, Stoer).

    Modified midpoint rules with increasing numbers of substeps are extrapolated to substep length zero. The
    difference of the last two extrapolations estimates the error.
    """
    table: list[Vector] = []
    for k, n in enumerate(_SUBSTEPS):
        h = dt / n
        before, now = q, q + h * rate(q)
        for _ in range(n - 1):
            before, now = now, before + 2 * h * rate(now)
        value = (before + now + h * rate(now)) / 2
        row = [value]
        for j in range(k):
            ratio = (n / _SUBSTEPS[k - j - 1]) ** 2
            row.append(row[j] + (row[j] - table[j]) / (ratio - 1))
        table = row
    return table[-1], float(np.abs(table[-1] - table[-2]).max())
