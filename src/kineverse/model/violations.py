"""Which constraints a configuration breaks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.evaluation import assign
from kineverse.expressions.lowering import lower
from kineverse.state import State
from kineverse.symbols import Symbol

from .constraint import Constraint


class Violation(NamedTuple):
    """A broken constraint: what it is worth, its bounds there, and by how much it is outside."""

    name: str
    value: float
    lower: float
    upper: float
    excess: float


class Violations(tuple[Violation, ...]):
    """Broken constraints, worst first, with the names of those that could not be checked."""

    unchecked: tuple[str, ...]

    def __new__(cls, broken: Iterable[Violation], unchecked: Iterable[str] = ()) -> Violations:
        """Sort the violations by excess."""
        self = super().__new__(cls, sorted(broken, key=lambda v: (-v.excess, v.name)))
        self.unchecked = tuple(unchecked)
        return self

    def __repr__(self) -> str:
        lines = [
            f"  {v.name}: {v.lower:g} <= {v.value:g} <= {v.upper:g} is off by {v.excess:g}" for v in self
        ]
        return f"{len(self)} violated\n" + "\n".join(lines) if lines else "none violated"


class Checks:
    """All constraints of a model in one function over all of their symbols."""

    def __init__(self, constraints: Mapping[str, Constraint]) -> None:
        self.names = list(constraints)
        self.needs = [c.symbols for c in constraints.values()]
        self.symbols: tuple[Symbol, ...] = tuple(
            sorted({s for need in self.needs for s in need}, key=lambda s: s.sort_key)
        )
        parts = [e for c in constraints.values() for e in (c.lower, c.expression, c.upper)]
        stacked = ca.vertcat(*lower(parts)) if parts else ca.SX(0, 1)
        inputs = ca.vertcat(*(s._sx for s in self.symbols)) if self.symbols else ca.SX(0, 1)
        self._function = ca.Function("constraints", [inputs], [stacked])

    def evaluate(
        self, values: np.ndarray[Any, np.dtype[np.float64]]
    ) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Return rows (lower, value, upper) for a vector of values."""
        return np.array(self._function(values)).reshape(-1, 3)


def find_violations(
    checks: Checks, values: Mapping[Any, float], known: Iterable[Symbol], tolerance: float
) -> Violations:
    """Return the violations at ``values``, see :meth:`ModelView.violations`."""
    state = (
        values
        if isinstance(values, State)
        else _checked(values, {str(s): s for s in (*known, *checks.symbols)})
    )
    vector = np.zeros(len(checks.symbols))
    given = [s for s in checks.symbols if s in state]
    vector_of = dict(zip(given, assign(tuple(given), State({s: state[s] for s in given})), strict=True))
    for i, symbol in enumerate(checks.symbols):
        vector[i] = vector_of.get(symbol, symbol.value or 0.0)
    unchecked, checked = [], []
    for i, need in enumerate(checks.needs):
        missing = [s for s in need if s not in vector_of and s.value is None]
        if not missing:
            checked.append(i)
            continue
        untouched = not any(s in vector_of for s in need)
        if not untouched and all(s.order == 0 for s in missing):
            raise UnknownNameError(
                f"No value for '{missing[0]}', which constraint '{checks.names[i]}' needs. Start from "
                "model.default_state().updated({...}) to have a value for everything."
            )
        unchecked.append(checks.names[i])
    rows = checks.evaluate(vector)
    broken = []
    for i in checked:
        low, value, high = (float(v) for v in rows[i])
        excess = max(low - value, value - high)
        # NaN is no valid value either: it compares false with everything.
        if not excess <= tolerance:
            broken.append(Violation(checks.names[i], value, low, high, excess))
    return Violations(broken, unchecked)


def _checked(values: Mapping[Any, float], known: Mapping[str, Symbol]) -> State:
    """Return the values as a state, refusing names the model does not know."""
    result: dict[Symbol, float] = {}
    for key, value in values.items():
        name = str(key)
        if name not in known:
            raise UnknownNameError(f"Unknown symbol {name!r}. {suggest(name, known, 'symbol')}")
        result[known[name]] = value
    if not result:
        raise UnknownNameError("No values given; model.default_state() has one for everything.")
    return State(result)
