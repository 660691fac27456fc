"""Violated constraints at a configuration."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse._checks import as_tolerance
from kineverse._rich_display import element, html_table
from kineverse.compilation.function import WantedTier, compile_columns, insert_values
from kineverse.errors import UnknownNameError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import lower
from kineverse.expressions.implicit import implicit_nodes
from kineverse.expressions.layout import SX
from kineverse.expressions.printing import format_number
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .constraint import Constraint


class Violation(NamedTuple):
    """Violated constraint: value, bounds at the configuration, and excess.

    See Also
    --------
    kineverse.Model.violations
    """

    name: str
    value: float
    lower: float
    upper: float
    excess: float


class Violations(tuple[Violation, ...]):
    """Violated constraints, largest excess first, with the names of unchecked ones.

    See Also
    --------
    kineverse.Model.violations
    """

    unchecked: tuple[str, ...]

    def __new__(cls, broken: Iterable[Violation], unchecked: Iterable[str] = ()) -> Violations:
        """Sort the violations by excess, those without a value first."""
        order = [(-math.inf if math.isnan(v.excess) else -v.excess, v.name, v) for v in broken]
        self = super().__new__(cls, (v for _, _, v in sorted(order, key=lambda item: item[:2])))
        self.unchecked = tuple(unchecked)
        return self

    def __repr__(self) -> str:
        lines = [
            f"  {v.name}: {v.lower + 0:g} <= {v.value + 0:g} <= {v.upper + 0:g} "  # without the sign of -0
            + ("has no value here" if math.isnan(v.excess) else f"is off by {v.excess:g}")
            for v in self
        ]
        return f"{len(self)} violated\n" + "\n".join(lines) if lines else "none violated"

    def _repr_html_(self) -> str:
        rows = [(v.name, *(format_number(x, 6) for x in (v.lower, v.value, v.upper, v.excess))) for v in self]
        caption = f"{len(self) or 'none'} violated"
        if self.unchecked:
            caption += f", {len(self.unchecked)} unchecked"
        if not rows:
            return element("p", caption)
        return html_table(caption, ("constraint", "lower", "value", "upper", "excess"), rows)


class ConstraintChecker:
    """Constraints of a model as one compiled function of a vector; see ``model.constraint_checker``.

    A call rewrites the arrays of the object in place, so each thread needs an object of its own.

    Parameters
    ----------
    symbols
        Symbols of the vector; those of all constraints if None, and then C is not compiled.
    dependent
        Expressions of the dependent coordinates. A loop among them that does not close is a violation without
        a value, under its name.

    Attributes
    ----------
    symbols
        Symbols of the vector.
    names
        Names of the constraints, in the order of the arrays.
    needs
        Symbols of each constraint.
    unchecked
        Names of the constraints with further symbols, which are not in the arrays.
    values, lower, upper
        Values of the constraints and of their bounds at the last vector, shape (m,).
    excess
        The larger of ``lower - values`` and ``values - upper``, shape (m,): positive if the constraint is
        violated, NaN if value or bounds are.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> check = model.constraint_checker(model.degrees_of_freedom)
    >>> x = np.zeros(len(check.symbols))
    >>> x[0] = -0.1
    >>> check.violations(x)
    1 violated
      kitchen/dishwasher_door/position: 0 <= -0.1 <= 1.5708 is off by 0.1
    """

    symbols: tuple[Symbol, ...]
    names: tuple[str, ...]
    needs: tuple[tuple[Symbol, ...], ...]
    unchecked: tuple[str, ...]

    def __init__(
        self,
        constraints: Mapping[str, Constraint],
        symbols: tuple[Symbol, ...] | None = None,
        dependent: Iterable[Expression] = (),
    ) -> None:
        every = {name: (c.lower, c.expression, c.upper, c.symbols) for name, c in constraints.items()}
        for loop in implicit_nodes(tuple(dependent)):
            # All elements of a missing solution are NaN, so one element suffices.
            needed = tuple({s for a in loop.arguments for s in a.symbols})
            every[loop.label] = (_NO_LOWER, loop.value[0], _NO_UPPER, needed)
        if symbols is None:
            found = {s for *_, need in every.values() for s in need}
            self.symbols = tuple(sorted(found, key=lambda s: s.sort_key))
        else:
            self.symbols = symbols
        known = set(self.symbols)
        checked = {
            name: parts
            for name, parts in every.items()
            if all(s in known or s.value is not None for s in parts[3])
        }
        self.names = tuple(checked)
        self.needs = tuple(need for *_, need in checked.values())
        self.unchecked = tuple(name for name in every if name not in checked)
        columns = _excess_columns([parts[:3] for parts in checked.values()], known)
        tier: WantedTier = "interpreter" if symbols is None else "auto"
        self._function = compile_columns(columns, self.symbols, tier)
        self._evaluator = self._function.bind()
        self.lower, self.values, self.upper, self.excess, checks = self._evaluator.outputs
        self._checks = checks.data

    def __call__(self, x: npt.ArrayLike) -> float:
        """Return the largest excess, -inf without constraints and NaN if one has no value.

        Parameters
        ----------
        x
            Values of :attr:`symbols`, shape (n,).
        """
        self._evaluator(x)
        largest, total = self._checks
        # The sum tells NaN, which the maximum ignores; infinities of both signs add up to NaN as well.
        return float(largest) if total == total else float(self.excess.max())

    def violations(self, x: npt.ArrayLike, tolerance: float = 1e-9) -> Violations:
        """Return the violated constraints at a vector, see :meth:`.ModelView.violations`.

        Parameters
        ----------
        x
            Values of :attr:`symbols`, shape (n,).
        tolerance
            Largest excess of a satisfied constraint, in the unit of the constraint.
        """
        tolerance = as_tolerance(tolerance)
        self(x)
        rows = self.values, self.lower, self.upper, self.excess
        # NaN violates every constraint: comparisons with it are False.
        broken = np.flatnonzero(~(self.excess <= tolerance)).tolist()
        found = (Violation(self.names[i], *(float(row[i]) for row in rows)) for i in broken)
        return Violations(found, self.unchecked)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until C is ready or has failed, see :meth:`.CompiledFunction.wait`."""
        return self._function.wait(timeout)

    def __repr__(self) -> str:
        return f"ConstraintChecker({len(self.symbols)} symbols, {len(self.names)} constraints)"


_NO_LOWER, _NO_UPPER = as_expression(-math.inf), as_expression(math.inf)


def _excess_columns(
    parts: Sequence[tuple[Expression, Expression, Expression]], known: set[Symbol]
) -> list[SX]:
    """Return lower bounds, values, upper bounds, excesses, and the largest excess with the sum of all."""
    others = [s for s in {s for three in parts for e in three for s in e.symbols} if s not in known]
    columns = insert_values(lower([e for three in parts for e in three]), others)
    lows, values, highs = columns[::3], columns[1::3], columns[2::3]
    excess = [_excess(*three) for three in zip(lows, values, highs, strict=True)]
    most = excess or [ca.SX(-math.inf)]
    while len(most) > 1:  # pairwise, because a processor computes independent maxima at the same time
        pairs = [ca.fmax(a, b) for a, b in zip(most[::2], most[1::2], strict=False)]
        most = [*pairs, most[-1]] if len(most) % 2 else pairs
    total = ca.sum1(ca.vertcat(*excess)) if excess else ca.SX(0.0)
    rows = [ca.vertcat(*row) if row else ca.SX(0, 1) for row in (lows, values, highs, excess)]
    return [*rows, ca.vertcat(most[0], total)]


def _excess(low: SX, value: SX, high: SX) -> SX:
    """Return the larger of low - value and value - high; NaN if one of the three is."""
    if _is_infinite(low) and _is_infinite(high):
        return ca.if_else(value <= math.inf, -math.inf, value)
    if _is_infinite(low) or _is_infinite(high):
        return value - high if _is_infinite(low) else low - value
    below, above = low - value, value - high
    # CasADi's maximum ignores NaN, and the sum does not.
    return ca.if_else(above <= below, below, ca.if_else(below < above, above, below + above))


def _is_infinite(bound: SX) -> bool:
    return bound.is_constant() and math.isinf(float(bound))


def find_violations(
    checker: ConstraintChecker, values: StateLike, known: Iterable[Symbol], tolerance: float
) -> Violations:
    """Return the violations at ``values``, see :meth:`.ModelView.violations`."""
    tolerance = as_tolerance(tolerance)
    if not isinstance(values, State):
        known = (*known, *checker.symbols)
        values = as_state(values, known)
        if known and not len(values):
            raise UnknownNameError("No values given; model.default_state() has one for everything.")
    given = [values.given(s) for s in checker.symbols]
    unchecked: dict[str, None] = {}
    without = {s for s, value in zip(checker.symbols, given, strict=True) if value is None}
    missing = {s for s in without if s.value is None}
    if missing:
        for name, need in zip(checker.names, checker.needs, strict=True):
            lacking = [s for s in need if s in missing]
            if not lacking:
                continue
            nowhere = [s for s in lacking if s.order == 0]
            if nowhere and any(s not in without for s in need):
                raise UnknownNameError(
                    f"No value for '{nowhere[0]}', which constraint '{name}' needs. Start from "
                    "model.default_state().updated({...}) to have a value for everything."
                )
            unchecked[name] = None
    x = [s.value or 0.0 if value is None else value for s, value in zip(checker.symbols, given, strict=True)]
    broken = checker.violations(np.array(x), tolerance)
    return Violations((v for v in broken if v.name not in unchecked), unchecked)
