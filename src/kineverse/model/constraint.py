"""Constraints: ``lower <= expression <= upper`` (2022 paper, III-A2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import Expression, ExpressionLike, access_listener, as_expression
from kineverse.expressions.graph import gradient_keys, has_infinite_product
from kineverse.symbols import Symbol

ConstraintLike: TypeAlias = "Constraint | Sequence[ExpressionLike]"

TOLERANCE = 1e-9  # excess or residual up to which a constraint is satisfied, in its unit


@dataclass(frozen=True)
class Constraint:
    """Two-sided inequality between scalars; bounds may be expressions, ±infinity means unbounded.

    The symbols of ``expression`` determine its type: a limit on positions, on velocities, or on several.

    Examples
    --------
    >>> q = kv.position("door")
    >>> limit = kv.Constraint.from_expressions(0, q, 1.5)
    >>> limit.symbols, limit.order
    ((door,), 0)
    >>> kv.Constraint.from_expressions(-1, q.derivative(), 1).order
    1
    """

    lower: Expression
    expression: Expression
    upper: Expression

    @staticmethod
    def from_expressions(
        lower: ExpressionLike, expression: ExpressionLike, upper: ExpressionLike
    ) -> Constraint:
        """Build a constraint from expressions and numbers.

        Raises
        ------
        ShapeError
            If one of the three is not a scalar.
        InvalidValueError
            If the expression is constant, or constant bounds leave nothing between them, or one is NaN; also
            for a bound with a product of infinity and an expression, which is NaN where that is 0.

        Examples
        --------
        >>> kv.Constraint.from_expressions(0, kv.position("a") + kv.position("b"), np.inf)
        Constraint(lower=0, expression=a + b, upper=inf)
        """
        low, middle, high = as_expression(lower), as_expression(expression), as_expression(upper)
        if low.shape or middle.shape or high.shape:
            for part, name in ((low, "lower bound"), (middle, "expression"), (high, "upper bound")):
                if part.shape:
                    raise ShapeError(f"The {name} of a constraint is a scalar, not of shape {part.shape}.")
        if any(access_listener(part) is not None for part in (low, middle, high)):
            return Constraint(low, middle, high)  # a trace checks it once the values are known
        if not middle.symbols:
            raise InvalidValueError(
                f"The constrained expression ({middle!r}) depends on no symbol. "
                "The order is lower, expression, upper."
            )
        check_bound(low, "lower bound")
        check_bound(high, "upper bound")
        if not low.symbols and not high.symbols:
            a, b = float(low), float(high)
            if a > b or a == math.inf or b == -math.inf:
                raise InvalidValueError(
                    f"No value lies between the lower bound {a:g} and the upper bound {b:g}."
                )
        return Constraint(low, middle, high)

    @cached_property
    def symbols(self) -> tuple[Symbol, ...]:
        """Free symbols of expression and bounds, sorted."""
        found = {*self.lower.symbols, *self.expression.symbols, *self.upper.symbols}
        return tuple(sorted(found, key=lambda s: s.sort_key))

    @cached_property
    def line(self) -> tuple[float, float] | None:
        """Slope and offset of an expression that is linear in one symbol; None for any other."""
        if isinstance(self.expression, Symbol):
            return 1.0, 0.0
        if not self.expression.nodes and len(self.expression.symbols) == 1:
            (symbol,) = self.expression.symbols
            slope = self.expression.partial([symbol])[0]
            if not slope.symbols:
                found = float(slope), float(self.expression({symbol: 0.0}))
                return found if found[0] and all(map(math.isfinite, found)) else None
        return None

    def nearest(self, value: float, lower: float, upper: float) -> float:
        """Return the feasible value of the only symbol that is nearest to a given value."""
        slope, offset = self.line or (1.0, 0.0)
        low, high = sorted(((lower - offset) / slope, (upper - offset) / slope))
        return min(max(value, low), high)

    @property
    def order(self) -> int:
        """Highest order of a symbol in the expression: 0 for limits on positions, 1 for limits on speeds."""
        return max((s.order for s in self.expression.symbols), default=0)


def check_bound(bound: Expression, name: str) -> None:
    """Check that a bound has no product of infinity and an expression.

    In the papers, eq. 10 and 11, such a product with a condition means 0 where the condition is false; as a
    product of floating-point numbers it is NaN there.
    """
    if bound.symbols and has_infinite_product(bound):
        raise InvalidValueError(
            f"The {name} {bound!r} of a constraint is infinity times something that can be 0, where it would "
            "be NaN. For no bound where a condition holds, and 0 elsewhere, write "
            "kv.where(condition, np.inf, 0), or kv.where(condition, -np.inf, 0) as the lower bound."
        )


def as_constraint(value: ConstraintLike) -> Constraint:
    """Convert a constraint, or a triple (lower, expression, upper), to a constraint."""
    if isinstance(value, Constraint):
        if all(isinstance(part, Expression) for part in (value.lower, value.expression, value.upper)):
            for bound, name in ((value.lower, "lower bound"), (value.upper, "upper bound")):
                if access_listener(bound) is None:
                    check_bound(bound, name)
            return value
        return Constraint.from_expressions(value.lower, value.expression, value.upper)
    if isinstance(value, Expression) or not isinstance(value, Sequence) or len(value) != 3:
        raise InvalidValueError(f"A constraint is a triple (lower, expression, upper), not {value!r}.")
    return Constraint.from_expressions(*value)


def coordinates(*expressions: Expression) -> frozenset[str]:
    """Return the paths of all symbols of expressions, and of every key of their gradients."""
    paths: set[str] = set()
    for expression in expressions:
        paths.update(s.path for s in expression.symbols)
        if expression.nodes:
            paths.update(s.path for s in gradient_keys(expression))
    return frozenset(paths)
