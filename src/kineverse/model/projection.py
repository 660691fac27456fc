"""Projection of a state onto the manifold of equality constraints.

The unknowns q are the free coordinates of violated equalities, and those of equalities that share coordinates
with them. With rows c(q) = 0 for the equalities and h(q) <= 0 for the other position constraints,
Gauss-Newton steps of minimum norm,

    min ‖Δq‖  subject to  J Δq = -(c, max(h, 0)),  lower <= q + Δq <= upper,

lead to a feasible point. Coordinates at a limit stay there, and the others compensate. From there, steps
along the manifold minimise the distance to the original state. Quaternions stay of unit length.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from kineverse._checks import as_tolerance
from kineverse._names import match_names
from kineverse.compilation import compile
from kineverse.errors import NoSolutionError, UnknownNameError, list_some
from kineverse.expressions.expression import Expression, array
from kineverse.lie import Array
from kineverse.state import State
from kineverse.symbols import Symbol, sort_symbols

from .articulation import Articulation
from .constraint import TOLERANCE, Constraint
from .rates import Rates

_QUATERNION = ("qx", "qy", "qz", "qw")


@dataclass(frozen=True)
class ResidualRow:
    """Residual of a constraint: an expression that has to be zero, or not positive."""

    name: str
    value: Expression
    equality: bool


class EqualityConstraints:
    """Equality constraints of a model and others on their coordinates, as numeric functions."""

    def __init__(
        self,
        constraints: Mapping[str, Constraint],
        rates: Rates,
        articulations: Mapping[str, Articulation],
        wanted: Collection[str] | None = None,
    ) -> None:
        self.rates, self.articulations = rates, articulations
        rows = list(_make_rows(constraints, rates, wanted))
        self._simple = [row for row in rows if not row.equality and _limits_single(row)]
        equal = [row for row in rows if row.equality]
        moved = {s for row in equal for s in row.value.symbols if s.has_derivative}
        others = [row for row in rows if not row.equality and not _limits_single(row)]
        others = [row for row in others if moved & set(row.value.symbols)]
        self.rows: Sequence[ResidualRow] = equal + others
        self.count = len(equal)
        self.symbols = sort_symbols({s for row in self.rows for s in row.value.symbols} | moved)
        self.coordinates = tuple(s for s in self.symbols if s in moved)

    @cached_property
    def evaluate(self) -> Any:
        """Evaluator of all rows, shape (m,), and their derivatives by the coordinates, shape (m, n)."""
        values = array([row.value for row in self.rows])
        return compile([values, values.partial(self.coordinates)], self.symbols, tier="interpreter").bind()

    def evaluate_rows(self, at: Array) -> tuple[Array, Array] | None:
        """Return all rows and their derivatives; None if a closed loop among them does not close."""
        try:
            self.evaluate(at)
        except NoSolutionError:
            return None
        values, by_all = self.evaluate.outputs
        return values.copy(), by_all.copy()

    @cached_property
    def limits(self) -> tuple[Array, Array]:
        """Lower and upper limits of the coordinates; ±inf for none."""
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
        """Indices of the four coordinates of each quaternion."""
        place = {s: i for i, s in enumerate(self.coordinates)}
        result = []
        for record in self.articulations.values():
            four = [s for s in record.coordinates if s.path.rpartition("/")[2] in _QUATERNION]
            if len(four) == 4 and all(s in place and s in self.rates for s in four):
                result.append([place[s] for s in four])
        return result


def is_equality(constraint: Constraint) -> bool:
    """Return whether a constraint is a position constraint with equal bounds."""
    if constraint.order or constraint.lower != constraint.upper:
        return False
    return bool(constraint.lower.symbols) or abs(float(constraint.lower)) < np.inf


def _make_rows(
    constraints: Mapping[str, Constraint], rates: Rates, wanted: Collection[str] | None
) -> Iterator[ResidualRow]:
    for name, c in constraints.items():
        if any(s.order for s in c.symbols):
            continue
        if is_equality(c):
            if wanted is None or name in wanted:
                yield ResidualRow(name, rates.resolve(c.expression - c.lower), True)
            continue
        for low, high in ((c.expression, c.upper), (c.lower, c.expression)):
            difference = rates.resolve(low - high)
            if difference.symbols and not _is_infinite(low) and not _is_infinite(high):
                yield ResidualRow(name, difference, False)


def _is_infinite(bound: Expression) -> bool:
    return not bound.symbols and not abs(float(bound)) < np.inf


def _line(value: Expression) -> tuple[float, float] | None:
    return Constraint(value, value, value).line


def _limits_single(row: ResidualRow) -> bool:
    return len(row.value.symbols) == 1 and _line(row.value) is not None


_STEPS, _NEARER = 100, 40
_LONGEST = 0.5  # longest step [m], [rad]. Linearisations are not valid beyond
_STARTS = 12
_SINGULAR, _AT_BOUND = 1e-9, 1e-9


def project(
    equalities: EqualityConstraints,
    state: State,
    fixed: Iterable[Symbol | str] = (),
    tolerance: float = TOLERANCE,
) -> State:
    """Project a state onto the manifold of equality constraints, see :meth:`.ModelView.project`."""
    tolerance = as_tolerance(tolerance)
    fixed_symbols = _fixed_coordinates(equalities, fixed)
    symbols = equalities.symbols
    given = [state.given(s) for s in symbols]
    missing = [s for s, value in zip(symbols, given, strict=True) if value is None and s.value is None]
    if missing:
        raise UnknownNameError(
            f"No value for '{missing[0]}', which a projection has to know. Start from "
            "model.default_state().updated({...}) to have a value for everything."
        )
    at = np.array([s.value or 0.0 if v is None else v for s, v in zip(symbols, given, strict=True)])
    search = _search(equalities, at, fixed_symbols, tolerance)
    if search is None:
        return state
    found = search.nearest()
    moved = {s: float(found[i]) for i, s in enumerate(symbols) if found[i] != at[i]}
    return state.updated(moved) if moved else state


def _fixed_coordinates(equalities: EqualityConstraints, fixed: Iterable[Symbol | str]) -> frozenset[Symbol]:
    """Return the fixed coordinates; a dependent coordinate stands for those that determine it."""
    dependent = {str(s): e for s, e in equalities.rates.dependent.items()}
    records = equalities.articulations
    by_name = {str(s): s for s in equalities.symbols}
    by_name |= {str(s): s for record in records.values() for s in record.coordinates}
    found: set[Symbol] = set()
    for name in match_names(fixed, [*by_name, *dependent, *records], "coordinate", "fixed="):
        if name in dependent:
            found.update(s for s in dependent[name].symbols if s.has_derivative)
        elif name in by_name:
            found.add(by_name[name])
        else:
            found.update(records[name].coordinates)
    return frozenset(found)


def _search(
    equalities: EqualityConstraints, at: Array, fixed_symbols: frozenset[Symbol], tolerance: float
) -> _Search | None:
    """Return the problem to solve: the violated rows, and all equalities that share their coordinates."""
    count = equalities.count
    if not count:
        return None
    equalities.evaluate(at)
    values = equalities.evaluate.outputs[0]
    about = [set(row.value.symbols) & set(equalities.coordinates) for row in equalities.rows]
    broken = {i for i in range(count) if not abs(values[i]) <= tolerance}
    moved = {s for i in range(count, len(about)) if not values[i] <= tolerance for s in about[i]}
    for symbol, lower, upper in zip(equalities.coordinates, *equalities.limits, strict=True):
        if not lower - tolerance <= at[equalities.symbols.index(symbol)] <= upper + tolerance:
            moved.add(symbol)
    if not broken and not moved - fixed_symbols:
        return None
    chosen: set[int] = set()
    while more := {
        i for i in range(count) if i not in chosen and (i in broken or about[i] & (moved - fixed_symbols))
    }:
        chosen |= more
        moved |= set[Symbol]().union(*(about[i] for i in more))
    chosen |= {i for i in range(count, len(about)) if about[i] & (moved - fixed_symbols)}
    columns = [i for i, s in enumerate(equalities.coordinates) if s in moved and s not in fixed_symbols]
    return _Search(equalities, sorted(chosen), columns, at, tolerance, fixed_symbols)


class _Search:
    """Search for one state: a subset of the rows and of the coordinates."""

    def __init__(
        self,
        equalities: EqualityConstraints,
        rows: list[int],
        columns: list[int],
        at: Array,
        tolerance: float,
        fixed_symbols: Collection[Symbol],
    ) -> None:
        self._equalities, self._rows, self._columns = equalities, rows, columns
        self._tolerance, self._fixed = tolerance, fixed_symbols
        self._equal = np.array([equalities.rows[i].equality for i in rows], dtype=bool)
        place = {s: i for i, s in enumerate(equalities.symbols)}
        self._places = [place[equalities.coordinates[c]] for c in columns]
        self._at = at
        lower, upper = equalities.limits
        self._lower, self._upper = lower[columns], upper[columns]
        of_column = {c: k for k, c in enumerate(columns)}
        self._turns = [
            [of_column[c] for c in four] for four in equalities.quaternions if set(four) <= set(columns)
        ]

    def nearest(self) -> Array:
        """Return all values at the feasible point nearest to the original state."""
        start = self._unit(np.clip(self._at[self._places], self._lower, self._upper))
        best, found = start, []
        least = np.inf
        generator = np.random.default_rng(0)
        for attempt in range(_STARTS + 1):
            begin = start if not attempt else self._random_start(start, generator, attempt)
            x, off = self._restore(begin)
            if off <= self._tolerance:
                found.append(self._minimize_distance(x, start))
                if not attempt or len(found) == 3:
                    break
            elif off < least:
                best, least = x, off
        if not found:
            raise self._no_solution_error(best)
        x = min(found, key=lambda x: float(np.linalg.norm(x - start)))
        return self._all(x)

    def _restore(self, x: Array) -> tuple[Array, float]:
        """Return a feasible point, or the point without further progress, and the largest residual there."""
        damping = 0.0
        there = self._evaluate_rows(x)
        if there is None:
            return x, np.inf
        wrong, by_x = self._residuals(there[0]), there[1]
        for _ in range(_STEPS):
            if not wrong.any():
                break
            step = self._step(x, wrong, by_x, damping)
            for scale in (1.0, 0.5, 0.1):
                tried = self._unit(np.clip(x + scale * step, self._lower, self._upper))
                there = self._evaluate_rows(tried)
                if there is not None and np.linalg.norm(self._residuals(there[0])) < np.linalg.norm(wrong):
                    break
                there = None
            if there is not None:
                x, wrong, by_x = tried, self._residuals(there[0]), there[1]
                damping = damping / 10 if damping > 1e-8 else 0.0
            elif np.abs(wrong).max() <= 0.1 * self._tolerance or damping > 1e4:
                break
            else:
                damping = max(10 * damping, 1e-6)
        return x, float(np.abs(wrong).max(initial=0.0))

    def _step(self, x: Array, wrong: Array, by_x: Array, damping: float) -> Array:
        """Return the shortest step that zeroes the rows to first order, clipped to the limits."""
        step = np.zeros(len(x))
        free = np.ones(len(x), dtype=bool)
        rows = wrong != 0.0
        target = -wrong[rows]
        for _ in range(len(x)):
            if not free.any():
                break
            matrix = by_x[rows][:, free]
            rest = target - by_x[rows][:, ~free] @ step[~free]
            if damping:
                scale = damping * max(float(np.trace(matrix @ matrix.T)) / max(len(rest), 1), 1e-12)
                step[free] = matrix.T @ np.linalg.solve(matrix @ matrix.T + scale * np.eye(len(rest)), rest)
            else:
                step[free] = np.linalg.lstsq(matrix, rest, rcond=_SINGULAR)[0]
            length = float(np.abs(step[free]).max())
            if length > _LONGEST:
                step[free] *= _LONGEST / length
            reached = np.clip(x + step, self._lower, self._upper)
            left = free & (np.abs(reached - (x + step)) > 1e-15)
            if not left.any():
                break
            step[left] = (reached - x)[left]
            free &= ~left
        return step

    def _minimize_distance(self, x: Array, start: Array) -> Array:
        """Return a feasible point nearer to the start, by steps along the manifold."""
        pull = 1.0
        for _ in range(_NEARER):
            there = self._evaluate_rows(x)
            if there is None or pull < 1e-3:
                break
            direction, (values, by_x) = start - x, there
            free = ~(((x <= self._lower) & (direction < 0)) | ((x >= self._upper) & (direction > 0)))
            along = np.zeros(len(x))
            # A coordinate at a bound may only move inwards.
            kept = self._equal | ((by_x @ direction > 0) & (values > -_AT_BOUND))
            matrix = by_x[kept][:, free]
            along[free] = (
                direction[free] - np.linalg.lstsq(matrix, matrix @ direction[free], rcond=_SINGULAR)[0]
            )
            if np.linalg.norm(along) <= 1e-9:
                break
            tried, off = self._restore(self._unit(np.clip(x + pull * along, self._lower, self._upper)))
            nearer = np.linalg.norm(tried - start) < np.linalg.norm(x - start) - 1e-14
            if off <= self._tolerance and nearer:
                x, pull = tried, min(1.0, 2 * pull)
            else:
                pull /= 2
        return x

    def _evaluate_rows(self, x: Array) -> tuple[Array, Array] | None:
        found = self._equalities.evaluate_rows(self._all(x))
        if found is None:
            return None
        values, by_x = found[0][self._rows], found[1][self._rows][:, self._columns]
        return (values, by_x) if np.isfinite(values).all() and np.isfinite(by_x).all() else None

    def _residuals(self, values: Array) -> Array:
        """Return the residuals of the rows; satisfied inequalities have none."""
        off = np.where(self._equal | (values > 0), values, 0.0)
        return np.where(np.abs(off) < 1e-15, 0.0, off)  # rounding errors are no residuals

    def _all(self, x: Array) -> Array:
        at = self._at.copy()
        at[self._places] = x
        return at

    def _unit(self, x: Array) -> Array:
        for four in self._turns:
            length = float(np.linalg.norm(x[four]))
            x[four] = x[four] / length if length > 1e-9 else [s.endswith("qw") for s in self._names(four)]
        return x

    def _names(self, columns: Iterable[int]) -> list[str]:
        return [str(self._equalities.coordinates[self._columns[k]]) for k in columns]

    def _random_start(self, start: Array, generator: np.random.Generator, attempt: int) -> Array:
        """Return another start, first near the state, later anywhere within the limits."""
        reach = np.where(np.isfinite(self._upper - self._lower), (self._upper - self._lower) / 2, np.pi)
        reach = np.minimum(reach, np.pi) * min(1.0, 0.1 * attempt)
        moved = start + generator.uniform(-1, 1, len(start)) * reach
        return self._unit(np.clip(moved, self._lower, self._upper))

    def _no_solution_error(self, x: Array) -> NoSolutionError:
        there = self._evaluate_rows(x)
        if there is None:
            return NoSolutionError(
                "The state cannot be projected: a closed loop that the equalities are about has no solution "
                "there. Begin where it closes."
            )
        off = np.abs(self._residuals(there[0]))
        worst = [i for i in np.argsort(-off) if off[i] > self._tolerance]
        sizes = {self._equalities.rows[self._rows[i]].name: off[i] for i in worst}
        listed = list_some((f"'{n}' is off by {size:.3g}" for n, size in sizes.items()), 4)
        ends = (np.isfinite(self._lower) & (x <= self._lower)) | (
            np.isfinite(self._upper) & (x >= self._upper)
        )
        moved, stopped = self._names(range(len(x))), self._names(np.flatnonzero(ends).tolist())
        fixed_symbols = sorted(str(s) for s in self._fixed if s in self._equalities.coordinates)
        tried = [f"moved were {_quote(moved)}" if moved else "nothing was free to move"]
        tried += [f"at their limits are {_quote(stopped)}"] if stopped else []
        tried += [f"fixed were {_quote(fixed_symbols)}"] if fixed_symbols else []
        return NoSolutionError(
            f"The state cannot be projected: at best {listed}, from {_STARTS + 1} starts. "
            f"{'; '.join(tried).capitalize()}. Begin nearer to where it closes, or let more coordinates move."
        )


def _quote(names: Iterable[str]) -> str:
    return list_some((f"'{name}'" for name in names), 6)
