"""Integration of coordinates at constant speeds: q̇ = R(q) u, close to floating-point accuracy.

A whole step is one compiled function with an estimate of its error: the modified midpoint rule with
increasing numbers of substeps, extrapolated to substeps of length zero (Gragg, Bulirsch, Stoer). If the
estimate is too large, the step is divided. Coordinates that move linearly, free ones and those with constant
rows, are exact. Limits and other constraints are ignored; ``model.integrate(..., clip=True)`` clips
coordinates afterwards.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse._checks import finite_number
from kineverse.compilation import CompiledFunction
from kineverse.compilation.function import compile_columns, insert_values
from kineverse.errors import (
    ExpressionError,
    InvalidValueError,
    ShapeError,
    UnknownNameError,
    duplicate_value_error,
    suggest,
)
from kineverse.expressions.evaluation import symbol_values
from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import lower
from kineverse.expressions.layout import SX
from kineverse.state import State, StateLike
from kineverse.symbols import Symbol, sort_symbols

from .rates import Rates

Vector: TypeAlias = npt.NDArray[np.float64]

# Substeps of the modified midpoint rule; the extrapolation over their squares is of order 12.
_SUBSTEPS = (2, 4, 6, 8, 10, 12)
_LONGEST = 0.5  # longest step: its product with the rate of a coordinate [m], [rad]
# Error tolerance of a step relative to the coordinates, and smallest step relative to the whole time.
_ERROR = 1e-13
_SHORTEST = 1e-9
_DURATION = Symbol("integrator/duration", 0, "parameter", 0.0)


class Integrator:
    """Motion of a vector of coordinates at constant speeds, compiled for loops; see ``model.integrator``.

    A call allocates one array at most. It uses buffers of the object, so each thread needs an object of its
    own. Limits and other constraints are ignored.

    Parameters
    ----------
    symbols
        Symbols of the vector of coordinates: coordinates, and parameters that rows contain.
    speeds
        Free speeds of the vector of speeds; all others are zero.

    Attributes
    ----------
    symbols, speeds
        Layouts of the two vectors.
    moving
        Coordinates that the speeds move; the other values of the vector stay.

    Raises
    ------
    UnknownNameError
        If a speed moves none of the symbols, or a row contains a coordinate that is not among the symbols.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(kv.articulations.OmniBase(name="base", parent="world", child="base"))
    'joint base'
    >>> move = model.integrator()
    >>> move.symbols, move.speeds
    ((base/angle, base/x, base/y), (base/angle:velocity, base/x:velocity, base/y:velocity))
    >>> move(np.zeros(3), np.array([0.5, 0.1, 0.0]), 0.1)
    array([0.05, 0.01, 0.  ])
    """

    def __init__(self, rates: Rates, symbols: Iterable[Symbol], speeds: Iterable[Symbol]) -> None:
        self.symbols = tuple(symbols)
        self.speeds = tuple(speeds)
        chosen = set(self.speeds)
        driven = [s for s in self.symbols if s in rates and not chosen.isdisjoint(rates[s])]
        free = [
            s
            for s in self.symbols
            if s not in rates and s.has_derivative and not s.order and s.derivative() in chosen
        ]
        self.moving = tuple(s for s in self.symbols if s in {*driven, *free})
        useful = {s.derivative() for s in free}.union(*(rates[s] for s in driven))
        useless = next((v for v in self.speeds if v not in useful), None)
        if useless is not None:
            raise UnknownNameError(f"The speed '{useless}' moves none of the {len(self.symbols)} symbols.")
        self._function = _compile_step(rates, self.symbols, self.speeds, tuple(driven))
        self._evaluator = self._function.bind()
        n, m = len(self.symbols), len(self.speeds)
        vector = self._evaluator.input
        self._q, self._v, self._dt = vector[:n], vector[n : n + m], vector[n + m :]
        self._q_view, self._v_view, self._dt_view = self._q.data, self._v.data, self._dt.data
        self._after, checks = self._evaluator.outputs
        self._checks = checks.data

    def __call__(self, q: npt.ArrayLike, v: npt.ArrayLike, dt: float, out: Vector | None = None) -> Vector:
        """Return the coordinates after ``dt`` seconds.

        Parameters
        ----------
        q
            Values of :attr:`symbols` [m], [rad], shape (n,).
        v
            Values of :attr:`speeds` [m/s], [rad/s], shape (m,).
        dt
            Duration [s]; may be negative.
        out
            Array of shape (n,) for the result, which may be ``q``; a new one if None.

        Raises
        ------
        InvalidValueError
            For NaN and infinite numbers, or if coordinates diverge.
        """
        try:
            self._q_view[:] = q  # type: ignore[assignment]
            self._v_view[:] = v  # type: ignore[assignment]
            self._dt_view[0] = dt  # type: ignore[call-overload]
        except (ValueError, TypeError):
            self._write(q, v, dt)
        self._evaluator()
        total, error, extent = self._checks
        # Each comparison is False for NaN.
        if not (-math.inf < total < math.inf and error <= _ERROR and extent <= _LONGEST):
            self._follow(dt)
        if out is None:
            return self._after.copy()
        out[:] = self._after
        return out

    def batch(self, q: npt.ArrayLike, v: npt.ArrayLike, dt: npt.ArrayLike) -> Vector:
        """Return the coordinates after ``dt`` seconds for many vectors, shape (N, n).

        Parameters
        ----------
        q, v, dt
            As for single calls, of shapes (N, n), (N, m) and (N,); one without N is the same for all.
        """
        n, m = len(self.symbols), len(self.speeds)
        parts = [*(np.asarray(x, dtype=float) for x in (q, v)), np.asarray(dt, dtype=float)[..., None]]
        if [part.shape[-1:] for part in parts] != [(n,), (m,), (1,)] or max(p.ndim for p in parts) > 2:
            shapes = ", ".join(str(part.shape) for part in parts[:2])
            raise ShapeError(f"A batch has coordinates (N, {n}) and speeds (N, {m}), not {shapes}.")
        try:
            rows = np.broadcast_shapes((1, 1), *((*part.shape[:-1], 1) for part in parts))[0]
        except ValueError:
            raise ShapeError(
                "The coordinates, speeds and durations of a batch have different lengths."
            ) from None
        points = np.concatenate([np.broadcast_to(p, (rows, p.shape[-1])) for p in parts], axis=1)
        after, checks = self._function.batch(points)
        fine = np.isfinite(checks[:, 0]) & (checks[:, 1] <= _ERROR) & (checks[:, 2] <= _LONGEST)
        for row in np.flatnonzero(~fine):
            after[row] = self(points[row, :n], points[row, n : n + m], points[row, -1])
        result: Vector = after
        return result

    def _write(self, q: npt.ArrayLike, v: npt.ArrayLike, dt: float) -> None:
        """Write inputs that are not vectors of doubles."""
        for given, target, what in ((q, self._q, "coordinates"), (v, self._v, "speeds")):
            try:
                numbers = np.asarray(given, dtype=float)
            except (TypeError, ValueError):
                raise ShapeError(f"The {what} are a vector of numbers, not {type(given).__name__}.") from None
            if numbers.shape != target.shape:
                raise ShapeError(
                    f"The integrator has {len(target)} {what}, and the vector is of shape {numbers.shape}."
                )
            target[:] = numbers
        self._dt[0] = _check_duration(dt)

    def _follow(self, dt: float) -> None:
        """Repeat the last step in parts, controlled by the estimated error."""
        dt = _check_duration(dt)
        named = ((self.symbols, self._q, "value"), (self.speeds, self._v, "speed"))
        for symbols, numbers, what in named:
            for place in np.flatnonzero(~np.isfinite(numbers)):
                raise InvalidValueError(
                    f"The {what} '{symbols[place]}' is {float(numbers[place])!r}; it must be finite."
                )
        done, extent = 0.0, self._checks[2]
        longest = dt / max(1, math.ceil(extent / _LONGEST)) if math.isfinite(extent) else dt
        step = longest
        while abs(done) < abs(dt):
            left = dt - done
            step = step if abs(step) < abs(left) else left
            self._dt[0] = step
            self._evaluator()
            total, error, _ = self._checks
            if math.isfinite(total) and error <= _ERROR:
                self._q[:] = self._after
                done = dt if step == left else done + step
                step = 2 * step if abs(2 * step) < abs(longest) else longest
            elif abs(step) > _SHORTEST * abs(dt):
                step /= 2
            else:
                raise self._divergence(dt, done)

    def _divergence(self, dt: float, done: float) -> InvalidValueError:
        with np.errstate(over="ignore"):
            free = self._q + dt * np.array([self._pace(s) for s in self.symbols])
        for place in np.flatnonzero(~np.isfinite(free)):
            return InvalidValueError(
                f"'{self.symbols[place]}' runs to {free[place]} in {dt:g} s. Take a shorter time."
            )
        driven = [s for s in self.moving if s.derivative() not in self.speeds]
        return InvalidValueError(
            f"{', '.join(map(str, driven))} cannot be followed for {dt:g} s: their rates have no "
            f"bound near {done:.6g} s. Take a shorter time, or look for a pole in their rows."
        )

    def _pace(self, coordinate: Symbol) -> float:
        speed = coordinate.derivative() if coordinate in self.moving else None
        return float(self._v[self.speeds.index(speed)]) if speed in self.speeds else 0.0

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until C is ready or has failed, see :meth:`.CompiledFunction.wait`."""
        return self._function.wait(timeout)

    def __repr__(self) -> str:
        return f"Integrator({len(self.symbols)} symbols, {len(self.speeds)} speeds)"


def _check_duration(dt: float) -> float:
    step = finite_number(dt)
    if step is None:
        raise InvalidValueError(f"The time step is a finite number of seconds, not {dt!r}.")
    return step


@functools.lru_cache(maxsize=32)
def _compile_step(
    rates: Rates, symbols: tuple[Symbol, ...], speeds: tuple[Symbol, ...], driven: tuple[Symbol, ...]
) -> CompiledFunction[tuple[Vector, ...]]:
    """Return the compiled step; cached, because an edit seldom changes it."""
    columns = _step_expressions(rates, symbols, speeds, driven)
    return compile_columns(columns, (*symbols, *speeds, _DURATION))


def _step_expressions(
    rates: Rates, symbols: Sequence[Symbol], speeds: Sequence[Symbol], driven: Sequence[Symbol]
) -> list[SX]:
    """Return columns of coordinates after a step and its checks: sum of the coordinates, error, and extent.

    The sum is finite if all coordinates are. The error is relative to the coordinates. The extent is the
    duration times the largest rate of a driven coordinate.
    """
    rows = {x: {v: g for v, g in rates[x].items() if v in speeds} for x in driven}
    dt = _DURATION.sx
    # Free coordinates and those with constant rows move linearly.
    linear: dict[Symbol, SX] = {
        s: s.derivative().sx
        for s in symbols
        if s not in rates and s.has_derivative and not s.order and s.derivative() in speeds
    }
    moving = {*driven, *linear}
    pieces = {x: _rate(x, rows[x], rates, {*symbols, *speeds}) for x in driven}
    curved = [x for x in driven if any(not moving.isdisjoint(g.symbols) for g in rows[x].values())]
    linear |= {x: pieces[x][0] for x in driven if x not in curved}
    after = {s: s.sx + dt * linear[s] if s in linear else s.sx for s in symbols}
    error, extent = ca.SX(0.0), ca.SX(0.0)
    if curved:
        others = list(linear)
        fixed = ca.vertcat(*(s.sx for s in (*symbols, *speeds) if s not in {*curved, *others}))
        q, start, pace = (
            ca.vertcat(*parts) if parts else ca.SX(0, 1)
            for parts in ([x.sx for x in curved], [s.sx for s in others], list(linear.values()))
        )
        flow = ca.Function("flow", [q, start, fixed], [ca.vertcat(*(pieces[x][0] for x in curved))])
        end, error = _extrapolated_step(lambda at, t: flow(at, start + t * pace, fixed), q, dt)
        size = ca.SX(1.0)
        for x, reached in zip(curved, end.elements(), strict=True):
            after[x] = reached
            size = ca.fmax(size, ca.fmax(ca.fabs(x.sx), ca.fabs(reached)))
            extent = ca.fmax(extent, pieces[x][1])
        error, extent = error / size, ca.fabs(dt) * extent
    results = ca.vertcat(*(after[s] for s in symbols)) if symbols else ca.SX(0, 1)
    checks = ca.vertcat(ca.sum1(results), error, extent)
    return [results, checks]


def _rate(
    coordinate: Symbol, row: Mapping[Symbol, Expression], rates: Rates, given: set[Symbol]
) -> tuple[SX, SX]:
    """Return the rate of a driven coordinate, and the sum of the magnitudes of its terms.

    Parameters that are not given have their own values, and free speeds that are not given are zero.
    """
    terms = lower([g * v for v, g in row.items()])
    others = [s for s in {s for g in row.values() for s in g.symbols} if s not in given]
    for s in others:
        if s.value is None and (s.order != 1 or s.position in rates):
            raise UnknownNameError(
                f"The rate of '{coordinate}' depends on '{s}', which is not among the symbols of the "
                "integrator. Add it to them."
            )
    terms = insert_values(terms, others)
    return sum(terms, ca.SX(0.0)), sum(map(ca.fabs, terms), ca.SX(0.0))


def _extrapolated_step(rate: Callable[[SX, SX], SX], q: SX, dt: SX) -> tuple[SX, SX]:
    """Return the coordinates after one step, and the estimated error (Gragg, Bulirsch, Stoer).

    Modified midpoint rules with increasing numbers of substeps are extrapolated to substep length zero. The
    difference of the last two extrapolations estimates the error.
    """
    table: list[SX] = []
    first = rate(q, ca.SX(0.0))
    for k, n in enumerate(_SUBSTEPS):
        h = dt / n
        before, now = q, q + h * first
        for i in range(1, n):
            # Equal fractions of different rules are one expression.
            before, now = now, before + 2 * h * rate(now, dt * (i / n))
        row = [(before + now + h * rate(now, dt)) / 2]
        for j in range(k):
            ratio = (n / _SUBSTEPS[k - j - 1]) ** 2
            row.append(row[j] + (row[j] - table[j]) / (ratio - 1))
        table = row
    return table[-1], ca.norm_2(table[-1] - table[-2])


class StateIntegrator:
    """Motion of states at constant speeds.

    Free coordinates move linearly. The others follow their rows by an :class:`.Integrator` of all that their
    rows contain. It is for one thread.
    """

    def __init__(self, coordinates: Iterable[Symbol], rates: Rates) -> None:
        self._free = {c.derivative(): c for c in coordinates if c not in rates}
        self._columns = sort_symbols({v for row in rates.values() for v in row})
        self._speeds = {str(s): s for s in (*self._free, *self._columns)}
        self._driven = set(rates)
        self._integrator: Integrator | None = None
        if rates:
            seen = {s for row in rates.values() for g in row.values() for s in g.symbols if s not in rates}
            own = {s.derivative() for s in seen if s.has_derivative and not s.order}
            speeds = sort_symbols(own.union(self._columns))
            symbols = (*sort_symbols(rates), *sort_symbols(seen.difference(speeds)))
            self._integrator = Integrator(rates, symbols, speeds)

    def integrate(self, state: State, speeds: StateLike, dt: float) -> State:
        """Return the state after ``dt`` seconds."""
        dt = _check_duration(dt)
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
