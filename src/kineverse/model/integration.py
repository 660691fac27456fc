"""Moving a state along constant speeds: q̇ = R(q) u, exactly enough that nobody writes a rule by hand."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import UnknownNameError, ValueRejectedError, suggest
from kineverse.expressions.evaluation import assign
from kineverse.expressions.lowering import lower
from kineverse.state import State
from kineverse.symbols import Symbol

from .rates import Rates

Vector: TypeAlias = npt.NDArray[np.float64]

# Substeps of the modified midpoint rule; the extrapolation over their squares is of order 12.
_SUBSTEPS = (2, 4, 6, 8, 10, 12)
_LONGEST = 0.5


def integrate(
    coordinates: tuple[Symbol, ...],
    rates: Rates,
    state: Mapping[Any, float],
    speeds: Mapping[Any, float],
    dt: float,
) -> State:
    """Return the state after ``dt`` seconds at constant speeds.

    Free coordinates move linearly. The others follow their rows by extrapolated midpoint steps (Gragg,
    Bulirsch, Stoer), short enough that the error stays near the rounding of floating point; for a quaternion
    this is its exponential.

    Parameters
    ----------
    coordinates, rates
        What moves, and how.
    state
        A state, or a mapping from symbols or names to numbers: values of at least all coordinates that move.
    speeds
        From free speeds or their names to numbers; those not given are 0.
    dt
        [s]; may be negative.

    Raises
    ------
    UnknownNameError
        For a speed that moves nothing here.
    ValueRejectedError
        For NaN or an infinite step.
    """
    if not math.isfinite(dt):
        raise ValueRejectedError(f"The time step is a finite number of seconds, not {dt!r}.")
    state = state if isinstance(state, State) else State(state)
    free = {c.derivative(): c for c in coordinates if c not in rates}
    driven = sorted(rates, key=lambda s: s.sort_key)
    wheels = sorted({v for row in rates.values() for v in row}, key=lambda s: s.sort_key)
    by_name = {str(s): s for s in (*free, *wheels)}
    given: dict[Symbol, float] = {}
    for key, value in speeds.items():
        if str(key) not in by_name:
            raise UnknownNameError(f"Nothing moves with '{key}'. {suggest(str(key), by_name, 'speed')}")
        given[by_name[str(key)]] = float(value)
        if not math.isfinite(given[by_name[str(key)]]):
            raise ValueRejectedError(f"The speed '{key}' is {value!r}; it must be finite.")
    result = {free[v]: state[free[v]] + dt * value for v, value in given.items() if v in free}
    if driven and any(given.get(v) for v in wheels):
        result.update(_driven(driven, wheels, rates, state, given, dt))
    stamp = None if state.stamp is None else state.stamp + dt
    return state.updated(result, stamp=stamp)


def _driven(
    driven: list[Symbol],
    wheels: list[Symbol],
    rates: Rates,
    state: State,
    given: Mapping[Symbol, float],
    dt: float,
) -> dict[Symbol, float]:
    """Integrate the coordinates that have rows, together with the free ones their rows look at."""
    wanted = {s for x in driven for g in rates[x].values() for s in g.symbols}
    beside = sorted((s for s in wanted if s not in rates and s.order == 0), key=lambda s: s.sort_key)
    flow = []
    for x in driven:
        total = ca.SX(0)
        for v, g in rates[x].items():
            total = total + lower([g])[0] * given.get(v, 0.0)
        flow.append(total)
    flow += [ca.SX(given.get(s.derivative(), 0.0) if s.has_derivative else 0.0) for s in beside]
    symbols = (*driven, *beside)
    function = ca.Function("flow", [ca.vertcat(*(s._sx for s in symbols))], [ca.densify(ca.vertcat(*flow))])
    start = assign(symbols, State({s: state[s] for s in symbols if s in state}))

    def rate(q: Vector) -> Vector:
        return np.array(function(q)).ravel()

    # A row's scale of change: its rate where it starts, per radian or metre.
    pace = max((abs(given.get(v, 0.0)) for v in wheels), default=0.0) * _gain(rates, driven, state, symbols)
    steps = max(1, math.ceil(abs(dt) * pace / _LONGEST))
    q = start
    for _ in range(steps):
        q = _extrapolated_step(rate, q, dt / steps)
    return {x: float(q[i]) for i, x in enumerate(driven)}


def _gain(rates: Rates, driven: list[Symbol], state: State, symbols: tuple[Symbol, ...]) -> float:
    """Return the largest magnitude of an entry of R at the state."""
    entries = [g for x in driven for g in rates[x].values()]
    function = ca.Function("gain", [ca.vertcat(*(s._sx for s in symbols))], [ca.vertcat(*lower(entries))])
    values = np.abs(np.array(function(assign(symbols, State({s: state[s] for s in symbols if s in state})))))
    return float(values.sum())


def _extrapolated_step(rate: Callable[[Vector], Vector], q: Vector, dt: float) -> Vector:
    """Return q after dt: modified midpoint rules with more and more substeps, extrapolated to none."""
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
    return table[-1]
