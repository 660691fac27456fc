"""Equality constraints of a model, and what else limits the coordinates that they are about, as functions."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from kineverse.compile import compile  # noqa: A004
from kineverse.errors import UnsolvedError
from kineverse.expressions.expression import Expression, array

from .articulation import Articulation
from .constraint import Constraint
from .rates import Rates

Array = npt.NDArray[np.float64]

_QUATERNION = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class Row:
    """What a constraint asks for: that an expression is zero, or that it is not positive."""

    name: str
    value: Expression
    equality: bool


class Equalities:
    """The equalities of a model and what else its coordinates have to keep, as functions of numbers.

    Parameters
    ----------
    constraints
        All of a model's, plain.
    rates
        Its table.
    articulations
        Its records, which know quaternions.
    wanted
        The names of the equalities that are to hold; None for all.

    Attributes
    ----------
    rows
        The equalities, and behind them other constraints on what they are about, but for limits.
    count
        How many equalities there are.
    symbols, coordinates
        What the rows are about, and which of it is theirs to move.
    """

    def __init__(
        self,
        constraints: Mapping[str, Constraint],
        rates: Rates,
        articulations: Mapping[str, Articulation],
        wanted: Collection[str] | None = None,
    ) -> None:
        self.rates, self.articulations = rates, articulations
        rows = list(_rows(constraints, rates, wanted))
        self._simple = [row for row in rows if not row.equality and _about_one(row)]
        equal = [row for row in rows if row.equality]
        moved = {s for row in equal for s in row.value.symbols if s.has_derivative}
        self.rows: Sequence[Row] = equal + [
            row for row in rows if not row.equality and not _about_one(row) and moved & set(row.value.symbols)
        ]
        self.count = len(equal)
        self.symbols = tuple(
            sorted({s for row in self.rows for s in row.value.symbols} | moved, key=lambda s: s.sort_key)
        )
        self.coordinates = tuple(s for s in self.symbols if s in moved)

    @cached_property
    def evaluate(self) -> Any:
        """An evaluator of all rows, shape (m,), and their derivatives by the coordinates, (m, n)."""
        values = array([row.value for row in self.rows])
        return compile([values, values.partial(self.coordinates)], self.symbols, tier="interpreter").bind()

    def evaluated(self, at: Array) -> tuple[Array, Array] | None:
        """Return all rows and their derivatives; None where a closed loop among them does not close."""
        try:
            self.evaluate(at)
        except UnsolvedError:
            return None
        values, by_all = self.evaluate.outputs
        return values.copy(), by_all.copy()

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper limits of the coordinates, ±inf where there are none."""
        lower, upper = np.full(len(self.coordinates), -np.inf), np.full(len(self.coordinates), np.inf)
        for row in self._simple:
            (symbol,) = row.value.symbols
            if symbol not in self.coordinates:
                continue
            k = self.coordinates.index(symbol)
            slope, offset = _line(row.value) or (1.0, 0.0)
            end = -offset / slope
            if slope > 0:
                upper[k] = min(upper[k], end)
            else:
                lower[k] = max(lower[k], end)
        return lower, upper

    @cached_property
    def quaternions(self) -> list[list[int]]:
        """Where the four numbers of each quaternion are among the coordinates."""
        place = {s: i for i, s in enumerate(self.coordinates)}
        found = []
        for record in self.articulations.values():
            four = [s for s in record.coordinates if s.path.rpartition("/")[2] in _QUATERNION]
            if len(four) == 4 and all(s in place and s in self.rates for s in four):
                found.append([place[s] for s in four])
        return found


def is_equality(constraint: Constraint) -> bool:
    """Return whether a constraint is one on positions whose bounds are the same."""
    if constraint.order or constraint.lower != constraint.upper:
        return False
    return bool(constraint.lower.symbols) or abs(float(constraint.lower)) < np.inf


def _rows(
    constraints: Mapping[str, Constraint], rates: Rates, wanted: Collection[str] | None
) -> Iterator[Row]:
    for name, c in constraints.items():
        if any(s.order for s in c.symbols):
            continue
        if is_equality(c):
            if wanted is None or name in wanted:
                yield Row(name, rates.resolve(c.expression - c.lower), True)
            continue
        for low, high in ((c.expression, c.upper), (c.lower, c.expression)):
            difference = rates.resolve(low - high)
            if difference.symbols and not _is_infinite(low) and not _is_infinite(high):
                yield Row(name, difference, False)


def _is_infinite(bound: Expression) -> bool:
    return not bound.symbols and not abs(float(bound)) < np.inf


def _line(value: Expression) -> tuple[float, float] | None:
    return Constraint(value, value, value).line


def _about_one(row: Row) -> bool:
    """Return whether a row limits a single coordinate."""
    return len(row.value.symbols) == 1 and _line(row.value) is not None
