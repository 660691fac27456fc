"""Bounds on the state as rows in the tangent space, QPs within them, and speeds held by locks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from kineverse.compilation import compile
from kineverse.estimation.linear_algebra import inverse_spd
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.model.rates import to_plain
from kineverse.symbols import Symbol

from .measurements import MeasurementModel
from .process_model import ProcessModel
from .state_space import InformationState, Layout, TangentSpace, build_layout, build_tangent_space

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView


@dataclass(frozen=True, eq=False)
class StateBounds:
    """Constraints on the estimated coordinates."""

    names: tuple[str, ...]  # all constraints in use
    lower: Array  # bounds of single free coordinates, in their order; ±inf without
    upper: Array
    curved: tuple[Constraint, ...]  # all other constraints, resolved


def collect_bounds(model: ModelView, tangent_space: TangentSpace, inputs: frozenset[Symbol]) -> StateBounds:
    """Collect the position limits: constraints without speeds on estimated coordinates and inputs alone."""
    index, by_speeds = {x: i for i, x in enumerate(tangent_space.coordinates)}, tangent_space.by_speeds
    lower, upper = np.full(len(index), -np.inf), np.full(len(index), np.inf)
    names, curved = [], []
    for name, carried in model.constraints_for(tangent_space.coordinates).items():
        below, middle, above = map(tangent_space.resolve, (carried.lower, carried.expression, carried.upper))
        constraint = Constraint(below, middle, above)
        moving = [s for s in constraint.symbols if s.has_derivative and s not in inputs]
        if any(s not in index for s in moving) or not any(s in index for s in constraint.expression.symbols):
            continue
        names.append(name)
        bound_symbols, is_free = (*below.symbols, *above.symbols), middle.symbols[0] not in by_speeds
        if constraint.line is not None and not bound_symbols and is_free:
            slope, offset = constraint.line
            low, high = sorted((float(b) - offset) / slope for b in (below, above))
            i = index[middle.symbols[0]]
            lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
        elif any(s in index for s in bound_symbols):
            # Two constraints with the constant bound 0.
            if below.symbols or np.isfinite(float(below)):
                curved.append(Constraint(as_expression(0.0), middle - below, as_expression(np.inf)))
            if above.symbols or np.isfinite(float(above)):
                curved.append(Constraint(as_expression(-np.inf), middle - above, as_expression(0.0)))
        else:
            curved.append(constraint)
    return StateBounds(tuple(names), lower, upper, tuple(curved))


def arrange_state(
    model: ModelView, observations: tuple[MeasurementModel, ...], measured: frozenset[Symbol]
) -> tuple[Layout, StateBounds]:
    """Choose the estimated coordinates, other than those measured elsewhere, and collect their limits."""
    rates = model.rates
    values = [rates.resolve(to_plain(one.value)) for one in observations]
    tangent_space = build_tangent_space(rates, values, measured, model.default_state())
    limits = collect_bounds(model, tangent_space, measured)
    dependencies = {s for value in values for s in value.symbols}
    dependencies |= {s for c in limits.curved for s in c.symbols}
    for x in tangent_space.coordinates:
        dependencies |= {s for e in rates.get(x, {}).values() for s in e.symbols}
    inputs = sorted(dependencies - set(tangent_space.coordinates), key=lambda s: s.sort_key)
    return build_layout(tangent_space, observations, limits.curved, inputs), limits


def initial_point(
    model: ModelView, tangent_space: TangentSpace, limits: StateBounds, start: Mapping[Symbol, float]
) -> Array:
    """Return the initial state: values by symbol, else the middle of the limits, else the default state."""
    default = model.default_state()
    values = []
    for x, low, high in zip(tangent_space.coordinates, limits.lower, limits.upper, strict=True):
        middle = (low + high) / 2 if np.isfinite(high - low) else default.get(x, 0.0)
        values.append(start.get(x, float(middle)))
    return np.clip(values, limits.lower, limits.upper)


def initial_deviations(
    tangent_space: TangentSpace, limits: StateBounds, periodic: frozenset[Symbol]
) -> Array:
    """Return half the width of the limits of each direction (t,); without limits, π for angles, else 10 m."""
    result = np.full(len(tangent_space.tangent), np.pi)
    for x, low, high in zip(tangent_space.coordinates, limits.lower, limits.upper, strict=True):
        if x in tangent_space.by_speeds:
            continue
        width = high - low
        deviation = np.pi if x in periodic else _UNBOUNDED_DEVIATION
        if np.isfinite(width):
            # Coinciding limits fix the coordinate; the information stays finite.
            deviation = max(width / 2, _LEAST_DEVIATION)
        result[tangent_space.tangent.index(x.derivative())] = deviation
    return result


# Initial standard deviation of a length without limits [m], and of a coordinate whose limits coincide.
_UNBOUNDED_DEVIATION, _LEAST_DEVIATION = 10.0, 1e-9
_FAR = 1e300


class BoundRows(NamedTuple):
    """Bounds on a step at a point: ``lower <= rows ξ <= upper``."""

    rows: Array
    lower: Array
    upper: Array

    @property
    def violation(self) -> float:
        """Total violation at the point itself."""
        return float(np.maximum(np.maximum(self.lower, -self.upper), 0.0).sum())


class GroupBounds:
    """Limits of one group."""

    def __init__(self, number: int, layout: Layout, limits: StateBounds) -> None:
        group = layout.groups[number]
        by_speeds = layout.tangent_space.by_speeds
        self._free = [k for k, x in enumerate(group.coordinates) if x not in by_speeds]
        places = group.x[self._free]
        self._lower, self._upper = limits.lower[places], limits.upper[places]
        self._curved = [layout.limit_slices[k] for k in group.limits]
        self._rows = np.zeros((len(self._free), len(group.tangent)))
        for row, k in enumerate(self._free):
            self._rows[row, group.tangent.index(group.coordinates[k].derivative())] = 1.0

    def rows(self, x: Array, out: Array) -> BoundRows:
        """Return the bounds on steps at a point x with evaluated limits ``out``."""
        free = x[self._free]
        rows, lower, upper = self._rows, self._lower - free, self._upper - free
        if self._curved:
            curved = np.stack([out[where] for where in self._curved])
            rows = np.concatenate([rows, curved[:, 3:]])
            # Conditional bounds are infinite while inactive, and so may be the value that they bound.
            value = np.nan_to_num(curved[:, 0], nan=np.nan, posinf=_FAR, neginf=-_FAR)
            lower = np.concatenate([lower, curved[:, 1] - value])
            upper = np.concatenate([upper, curved[:, 2] - value])
        return BoundRows(rows, lower, upper)

    def clip(self, x: Array) -> Array:
        """Clip a point to the bounds of single coordinates, against rounding errors; in place."""
        x[self._free] = np.clip(x[self._free], self._lower, self._upper)
        return x

    def remaining(self, x: Array, after: Array, step: Array) -> Array:
        """Return the tangent step that leads from x to the clipped point ``after``."""
        left = step.copy()
        for row, k in zip(self._rows, self._free, strict=True):
            left[row == 1.0] = after[k] - x[k]
        return left


# Speed bounds below this lock a coordinate [m/s], [rad/s]. At equality a condition is 0.5, which is free.
_STILL = 1e-6


class SpeedLocks:
    """Constraints that bound single speeds by expressions of estimated coordinates and inputs."""

    def __init__(self, model: ModelView, layout: Layout, process_model: ProcessModel) -> None:
        tangent_space = layout.tangent_space
        values = (*tangent_space.coordinates, *layout.inputs)
        self._speeds: list[Symbol] = []
        bounds = []
        for constraint in model.constraints_for(tangent_space.coordinates).values():
            speed = constraint.expression
            if isinstance(speed, Symbol) and str(speed) in process_model.speeds:
                low, high = tangent_space.resolve(constraint.lower), tangent_space.resolve(constraint.upper)
                if {*low.symbols, *high.symbols} <= set(values):
                    self._speeds.append(speed)
                    bounds += [low, high]
        self._bounds = compile(array(bounds), values) if bounds else None
        self._all = frozenset(process_model.speeds.values())

    def free(self, belief: InformationState, inputs: Array) -> frozenset[Symbol]:
        """Return the speeds that no lock holds at the estimate."""
        if self._bounds is None:
            return self._all
        still = np.abs(self._bounds(np.concatenate([belief.x, inputs])).reshape(-1, 2)).max(axis=1) < _STILL
        return self._all - {v for v, is_locked in zip(self._speeds, still.tolist(), strict=True) if is_locked}


_FEASIBLE = 1e-6  # largest violation of a bound, in deviations; that of a solution is a millionth of it


def solve_bounded_qp(matrix: Array, vector: Array, rows: Array, lower: Array, upper: Array) -> Array | None:
    """Minimise ½xᵀAx - vᵀx subject to lower <= rows x <= upper; return None if infeasible."""
    x: Array = inverse_spd(matrix) @ vector
    if ((rows @ x >= lower) & (rows @ x <= upper)).all():
        return x
    # Tolerances are absolute: unknowns have deviations of 1, and rows are of length 1.
    unit = np.diag(matrix) ** -0.5
    length = np.linalg.norm(rows * unit, axis=1)
    length[length == 0.0] = 1.0
    solver = _qp_solver(*rows.shape)
    a, h = rows * unit / length[:, None], matrix * np.outer(unit, unit)
    result = solver(h=h, g=-vector * unit, a=a, lba=lower / length, uba=upper / length)
    x = np.asarray(result["x"]).reshape(-1) * unit
    beyond = np.maximum(lower - rows @ x, rows @ x - upper) / length
    return x if beyond.max() < _FEASIBLE else None


@lru_cache
def _qp_solver(bounds: int, unknowns: int) -> ca.Function:
    """Return the solver DAQP (Arnström, Bemporad, Axehill 2022), which CasADi contains."""
    shapes = {"h": ca.Sparsity.dense(unknowns, unknowns), "a": ca.Sparsity.dense(bounds, unknowns)}
    options = {"primal_tol": 1e-12, "zero_tol": 1e-15, "pivot_tol": 1e-12}
    return ca.conic("qp", "daqp", shapes, {"error_on_fail": False, "daqp": options})
