"""The limits of a state, read off the model's constraints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from kineverse.estimation.noise import Array
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
            curved.append(constraint)
            continue
        slope, offset = constraint.line or (1.0, 0.0)
        low, high = sorted((float(b) - offset) / slope for b in (constraint.lower, constraint.upper))
        i = index[constraint.expression.symbols[0]]
        lower[i], upper[i] = max(lower[i], low), min(upper[i], high)
    return Limits(tuple(names), lower, upper, tuple(curved))


def _is_box(constraint: Constraint, chart: Chart) -> bool:
    if constraint.line is None or constraint.lower.symbols or constraint.upper.symbols:
        return False
    return constraint.expression.symbols[0] not in chart.by_speeds


def beginning(
    model: ModelView, chart: Chart, limits: Limits, given: Mapping[Symbol, float], turning: frozenset[Symbol]
) -> tuple[Array, Array]:
    """Return where a tracker begins without a word about it, and the variances there.

    In the middle of the limits, ± half their width. What has no limits begins at its default, ± π for what
    comes back after a turn and for the turning of quaternions, else ± 10 [m].

    Returns
    -------
    values, deviations
        Of the coordinates, and of the tangent.
    """
    default = model.default_state()
    values = np.array([given.get(x, default.get(x, 0.0)) for x in chart.coordinates])
    deviations = {}
    for i, x in enumerate(chart.coordinates):
        low, high = limits.lower[i], limits.upper[i]
        width = high - low
        if np.isfinite(width):
            if x not in given:
                values[i] = (low + high) / 2
            # Limits that leave nothing leave it known; the information stays finite.
            deviation = max(width / 2, 1e-9)
        else:
            deviation = np.pi if x in turning else UNLIMITED
        if x not in chart.by_speeds:
            deviations[x.derivative()] = deviation
    return values, np.array([deviations.get(v, np.pi) for v in chart.tangent])


UNLIMITED = 10.0
"""The deviation of a length without limits [m]."""
