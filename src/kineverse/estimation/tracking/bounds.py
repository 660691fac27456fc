"""State bounds as rows in the tangent space, and speeds held by locks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from kineverse.compile import compile  # noqa: A004
from kineverse.expressions.expression import array, as_expression
from kineverse.lie import Array
from kineverse.model.constraint import Constraint
from kineverse.symbols import Symbol

from .gaussian import InformationState
from .layout import Layout
from .process_model import ProcessModel
from .tangent import TangentSpace

if TYPE_CHECKING:
    from kineverse.model.model_view import ModelView


@dataclass(frozen=True, eq=False)
class StateBounds:
    """What is known of a state beforehand.

    Attributes
    ----------
    names
        Of all constraints that count.
    lower, upper
        Bounds of single free coordinates, in the order of the chart; ±inf where there are none.
    curved
        All others, in plain coordinates: of several coordinates, not straight, or with bounds that move.
    """

    names: tuple[str, ...]
    lower: Array
    upper: Array
    curved: tuple[Constraint, ...]

    def by_symbol(self, chart: TangentSpace) -> dict[Symbol, tuple[float, float]]:
        """Return the bounds of single coordinates."""
        bounds = zip(self.lower.tolist(), self.upper.tolist(), strict=True)
        return dict(zip(chart.coordinates, bounds, strict=True))


def collect_bounds(model: ModelView, chart: TangentSpace, known: frozenset[Symbol]) -> StateBounds:
    """Return the limits on coordinates: constraints without speeds about nothing else than what is known.

    Locks, which limit speeds, and constraints that also look at coordinates nobody watches are none.
    """
    index = {x: i for i, x in enumerate(chart.coordinates)}
    lower, upper = np.full(len(index), -np.inf), np.full(len(index), np.inf)
    names, curved = [], []
    for name, carried in model.constraints_for(chart.coordinates).items():
        constraint = Constraint(*(chart.plain(e) for e in (carried.lower, carried.expression, carried.upper)))
        moving = [s for s in constraint.symbols if s.has_derivative and s not in known]
        if any(s not in index for s in moving) or not any(s in index for s in constraint.expression.symbols):
            continue
        names.append(name)
        if not _is_box(constraint, chart):
            curved += _one_sided(constraint, index)
            continue
        slope, offset = constraint.line or (1.0, 0.0)
        low, high = sorted((float(b) - offset) / slope for b in (constraint.lower, constraint.upper))
        i = index[constraint.expression.symbols[0]]
        lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
    return StateBounds(tuple(names), lower, upper, tuple(curved))


def _one_sided(constraint: Constraint, moving: Mapping[Symbol, int]) -> list[Constraint]:
    """Return a constraint as such, or if its bounds move, as two whose bounds are 0."""
    low, middle, high = constraint.lower, constraint.expression, constraint.upper
    if not any(s in moving for s in (*low.symbols, *high.symbols)):
        return [constraint]
    sides = []
    if low.symbols or np.isfinite(float(low)):
        sides.append(Constraint(as_expression(0.0), middle - low, as_expression(np.inf)))
    if high.symbols or np.isfinite(float(high)):
        sides.append(Constraint(as_expression(-np.inf), middle - high, as_expression(0.0)))
    return sides


def _is_box(constraint: Constraint, chart: TangentSpace) -> bool:
    if constraint.line is None or constraint.lower.symbols or constraint.upper.symbols:
        return False
    return constraint.expression.symbols[0] not in chart.by_speeds


def initial_point(
    model: ModelView, chart: TangentSpace, limits: StateBounds, given: Mapping[Symbol, float]
) -> Array:
    """Return where a tracker begins: where it is told, else in the middle of limits, else at the default."""
    default = model.default_state()
    values = []
    for x, low, high in zip(chart.coordinates, limits.lower, limits.upper, strict=True):
        middle = (low + high) / 2 if np.isfinite(high - low) else default.get(x, 0.0)
        values.append(given.get(x, float(middle)))
    return np.clip(values, limits.lower, limits.upper)


def initial_deviations(chart: TangentSpace, limits: StateBounds, turning: frozenset[Symbol]) -> Array:
    """Return how uncertain the tangent is then.

    Half the width of the limits; without limits π for what comes back after a turn and for the turning of
    quaternions, else 10 m.
    """
    found = np.full(len(chart.tangent), np.pi)
    for x, low, high in zip(chart.coordinates, limits.lower, limits.upper, strict=True):
        if x in chart.by_speeds:
            continue
        width = high - low
        usual = np.pi if x in turning else UNBOUNDED_DEVIATION
        # Limits that leave nothing leave it known; the information stays finite.
        found[chart.tangent.index(x.derivative())] = (
            max(width / 2, LEAST_DEVIATION) if np.isfinite(width) else usual
        )
    return found


UNBOUNDED_DEVIATION = 10.0
"""The deviation at the start of a length without limits [m]."""

LEAST_DEVIATION = 1e-9
"""That of a coordinate whose limits leave nothing."""


_FAR = 1e300


class BoundRows(NamedTuple):
    """What a step may change at a place: ``lower <= rows ξ <= upper``."""

    rows: Array
    lower: Array
    upper: Array

    @property
    def violation(self) -> float:
        """By how much the place itself is outside."""
        return float(np.maximum(np.maximum(self.lower, -self.upper), 0.0).sum())


class GroupBounds:
    """The limits of one group.

    Parameters
    ----------
    number
        Of the group.
    layout, limits
        The parts of a tracker.
    """

    def __init__(self, number: int, layout: Layout, limits: StateBounds) -> None:
        group = layout.groups[number]
        by_speeds = layout.chart.by_speeds
        self._own = [k for k, x in enumerate(group.coordinates) if x not in by_speeds]
        places = group.x[self._own]
        self._lower, self._upper = limits.lower[places], limits.upper[places]
        self._curved = [layout.limit_slices[k] for k in group.limits]
        self._rows = np.zeros((len(self._own), len(group.tangent)))
        for row, k in enumerate(self._own):
            self._rows[row, group.tangent.index(group.coordinates[k].derivative())] = 1.0

    def room(self, x: Array, out: Array) -> BoundRows:
        """Return what steps may change at a place, where the model was evaluated."""
        own = x[self._own]
        rows, lower, upper = self._rows, self._lower - own, self._upper - own
        if self._curved:
            curved = np.stack([out[where] for where in self._curved])
            rows = np.concatenate([rows, curved[:, 3:]])
            # Bounds that hold only now and then are infinite else, and so may be what they are compared with.
            value = np.nan_to_num(curved[:, 0], nan=np.nan, posinf=_FAR, neginf=-_FAR)
            lower = np.concatenate([lower, curved[:, 1] - value])
            upper = np.concatenate([upper, curved[:, 2] - value])
        return BoundRows(rows, lower, upper)

    def clipped(self, x: Array) -> Array:
        """Return a place that rounding has not led out of the bounds of single coordinates."""
        x[self._own] = np.clip(x[self._own], self._lower, self._upper)
        return x

    def taken(self, x: Array, after: Array, step: Array) -> Array:
        """Return what is left of a step in the tangent if it was clipped on the way from x."""
        left = step.copy()
        for row, k in zip(self._rows, self._own, strict=True):
            left[row == 1.0] = after[k] - x[k]
        return left


# Slower than this in both directions is locked [m/s], [rad/s]. At equality a truth is 0.5, and free.
_STILL = 1e-6


class SpeedLocks:
    """The constraints that bound single speeds by expressions of what is estimated or known.

    Parameters
    ----------
    model, layout, charted
        What is tracked.
    """

    def __init__(self, model: ModelView, layout: Layout, charted: ProcessModel) -> None:
        chart = layout.chart
        values = (*chart.coordinates, *layout.known)
        self._speeds: list[Symbol] = []
        bounds = []
        for constraint in model.constraints_for(chart.coordinates).values():
            speed = constraint.expression
            low, high = chart.plain(constraint.lower), chart.plain(constraint.upper)
            looked_at = {*low.symbols, *high.symbols}
            if isinstance(speed, Symbol) and str(speed) in charted.speeds and looked_at <= set(values):
                self._speeds.append(speed)
                bounds += [low, high]
        self._bounds = compile(array(bounds), values) if bounds else None
        self._all = frozenset(charted.speeds.values())

    def free(self, belief: InformationState, known: Array) -> frozenset[Symbol]:
        """Return the speeds that are not locked at what is believed."""
        if self._bounds is None:
            return self._all
        bounds = self._bounds(np.concatenate([belief.x, known])).reshape(-1, 2)
        still = np.abs(bounds).max(axis=1) < _STILL
        return self._all - {v for v, is_locked in zip(self._speeds, still.tolist(), strict=True) if is_locked}
