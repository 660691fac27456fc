"""Violated constraints at a configuration."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from kineverse._checks import as_tolerance
from kineverse.errors import UnknownNameError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import lower
from kineverse.expressions.implicit import implicit_nodes
from kineverse.expressions.printing import html_table
from kineverse.state import State, StateLike, as_state
from kineverse.symbols import Symbol

from .constraint import Constraint


class Violation(NamedTuple):
    """Violated constraint: value, bounds at the configuration, and excess."""

    name: str
    value: float
    lower: float
    upper: float
    excess: float


class Violations(tuple[Violation, ...]):
    """Violated constraints, largest excess first, with the names of unchecked ones."""

    unchecked: tuple[str, ...]

    def __new__(cls, broken: Iterable[Violation], unchecked: Iterable[str] = ()) -> Violations:
        """Sort the violations by excess, those without a value first."""
        order = [(-math.inf if math.isnan(v.excess) else -v.excess, v.name, v) for v in broken]
        self = super().__new__(cls, (v for _, _, v in sorted(order, key=lambda item: item[:2])))
        self.unchecked = tuple(unchecked)
        return self

    def __repr__(self) -> str:
        lines = [
            f"  {v.name}: {v.lower:g} <= {v.value:g} <= {v.upper:g} "
            + ("has no value here" if math.isnan(v.excess) else f"is off by {v.excess:g}")
            for v in self
        ]
        return f"{len(self)} violated\n" + "\n".join(lines) if lines else "none violated"

    def _repr_html_(self) -> str:
        rows = [(v.name, f"{v.lower:g}", f"{v.value:g}", f"{v.upper:g}", f"{v.excess:g}") for v in self]
        caption = f"{len(self) or 'none'} violated"
        if self.unchecked:
            caption += f", {len(self.unchecked)} unchecked"
        return html_table(caption, ("constraint", "lower", "value", "upper", "excess"), rows)


class Checks:
    """Constraints of a model as one function of all their symbols.

    Parameters
    ----------
    constraints
        Constraints by name.
    dependent
        Expressions of the dependent coordinates. A loop among them that does not close is a violation without
        a value, under its name.
    """

    def __init__(self, constraints: Mapping[str, Constraint], dependent: Iterable[Expression] = ()) -> None:
        loops = implicit_nodes(tuple(dependent))
        self.names = [*constraints, *(loop.label for loop in loops)]
        self.needs = [c.symbols for c in constraints.values()]
        self.needs += [tuple({s for a in loop.arguments for s in a.symbols}) for loop in loops]
        self.symbols: tuple[Symbol, ...] = tuple(
            sorted({s for need in self.needs for s in need}, key=lambda s: s.sort_key)
        )
        parts = [e for c in constraints.values() for e in (c.lower, c.expression, c.upper)]
        for loop in loops:
            # All elements of a missing solution are NaN, so one element suffices.
            parts += [as_expression(-math.inf), loop.value[0], as_expression(math.inf)]
        stacked = ca.vertcat(*lower(parts)) if parts else ca.SX(0, 1)
        inputs = ca.vertcat(*(s.sx for s in self.symbols)) if self.symbols else ca.SX(0, 1)
        self._function = ca.Function("constraints", [inputs], [stacked])

    def evaluate(
        self, values: np.ndarray[Any, np.dtype[np.float64]]
    ) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return rows (lower, value, upper) for a vector of values."""
        return np.array(self._function(values)).reshape(-1, 3)


def find_violations(
    checks: Checks, values: StateLike, known: Iterable[Symbol], tolerance: float
) -> Violations:
    """Return the violations at ``values``, see :meth:`.ModelView.violations`."""
    tolerance = as_tolerance(tolerance)
    known = (*known, *checks.symbols)
    state = as_state(values, known)
    if known and not len(state) and not isinstance(values, State):
        raise UnknownNameError("No values given; model.default_state() has one for everything.")
    vector = np.zeros(len(checks.symbols))
    vector_of = {s: value for s in checks.symbols if (value := state.given(s)) is not None}
    for i, symbol in enumerate(checks.symbols):
        vector[i] = vector_of.get(symbol, symbol.value or 0.0)
    unchecked, checked = [], []
    for i, need in enumerate(checks.needs):
        missing = [s for s in need if s not in vector_of and s.value is None]
        if not missing:
            checked.append(i)
            continue
        nowhere = [s for s in missing if s.order == 0]
        if nowhere and any(s in vector_of for s in need):
            raise UnknownNameError(
                f"No value for '{nowhere[0]}', which constraint '{checks.names[i]}' needs. Start from "
                "model.default_state().updated({...}) to have a value for everything."
            )
        unchecked.append(checks.names[i])
    rows = checks.evaluate(vector)
    broken = []
    for i in checked:
        low, value, high = (float(v) for v in rows[i])
        # NaN violates every constraint, as value and as bound: comparisons with it are False.
        excess = max(low - value, value - high) if not np.isnan(rows[i]).any() else math.nan
        if not excess <= tolerance:
            broken.append(Violation(checks.names[i], value, low, high, excess))
    return Violations(broken, unchecked)
