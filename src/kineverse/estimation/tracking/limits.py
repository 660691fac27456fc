"""The limits of a state, read off the model's constraints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kineverse.estimation.noise import Array
from kineverse.expressions.expression import as_expression
from kineverse.model.constraint import Constraint
from kineverse.symbols import Symbol

from .chart import Chart

if TYPE_CHECKING:
    from kineverse.model.view import ModelView


@dataclass(frozen=True, eq=False)
class Limits:
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

    def by_symbol(self, chart: Chart) -> dict[Symbol, tuple[float, float]]:
        """Return the bounds of single coordinates."""
        bounds = zip(self.lower.tolist(), self.upper.tolist(), strict=True)
        return dict(zip(chart.coordinates, bounds, strict=True))


def limits_of(model: ModelView, chart: Chart, known: frozenset[Symbol]) -> Limits:
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
    return Limits(tuple(names), lower, upper, tuple(curved))


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


def _is_box(constraint: Constraint, chart: Chart) -> bool:
    if constraint.line is None or constraint.lower.symbols or constraint.upper.symbols:
        return False
    return constraint.expression.symbols[0] not in chart.by_speeds


def first_place(model: ModelView, chart: Chart, limits: Limits, given: Mapping[Symbol, float]) -> Array:
    """Return where a tracker begins: where it is told, else in the middle of limits, else at the default."""
    default = model.default_state()
    values = []
    for x, low, high in zip(chart.coordinates, limits.lower, limits.upper, strict=True):
        middle = (low + high) / 2 if np.isfinite(high - low) else default.get(x, 0.0)
        values.append(given.get(x, float(middle)))
    return np.clip(values, limits.lower, limits.upper)


def first_deviations(chart: Chart, limits: Limits, turning: frozenset[Symbol]) -> Array:
    """Return how uncertain the tangent is then.

    Half the width of the limits; without limits π for what comes back after a turn and for the turning of
    quaternions, else 10 m.
    """
    found = np.full(len(chart.tangent), np.pi)
    for x, low, high in zip(chart.coordinates, limits.lower, limits.upper, strict=True):
        if x in chart.by_speeds:
            continue
        width = high - low
        usual = np.pi if x in turning else UNLIMITED
        # Limits that leave nothing leave it known; the information stays finite.
        found[chart.tangent.index(x.derivative())] = max(width / 2, LEAST) if np.isfinite(width) else usual
    return found


UNLIMITED = 10.0
"""The deviation at the start of a length without limits [m]."""

LEAST = 1e-9
"""That of a coordinate whose limits leave nothing."""
