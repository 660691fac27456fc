"""What speeds may do: the rows of constraints on them, and what these leave to speeds that move."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca

from kineverse.expressions.expression import Expression, as_expression, binary, unary
from kineverse.expressions.functions import norm
from kineverse.expressions.gradient import partial
from kineverse.expressions.implicit import held
from kineverse.symbols import Symbol

from .constraint import Constraint
from .norm_of_speeds import components_of, directions, inner_radius
from .rates import Rates

Weights: TypeAlias = Mapping[Symbol, Expression]
Box: TypeAlias = dict[Symbol, tuple[Expression, Expression]]

ZERO = as_expression(0.0)
INFINITE = as_expression(math.inf)


@dataclass(frozen=True)
class Row:
    """One row ``lower <= Σ weight·speed <= upper``, with the name of the constraint it came from."""

    name: str
    weights: Weights
    lower: Expression
    upper: Expression


@dataclass(frozen=True)
class Ball:
    """Components ``Σ weight·speed``, whose norm is at most the radius."""

    components: tuple[Weights, ...]
    radius: Expression


@dataclass(frozen=True)
class Limits:
    """What speeds may do of which some move and the others stand still, which is taken to be allowed.

    Attributes
    ----------
    box
        Lower limits <= 0 and upper limits >= 0 of single speeds.
    coupled
        Rows that the box does not imply.
    balls
        Norms, of which rows are the polygon inside.
    """

    box: Box
    coupled: list[Row]
    balls: list[Ball]


class SpeedLimits:
    """Rows of the constraints on speeds, collected one by one."""

    def __init__(self, rates: Rates) -> None:
        self.rows: list[Row] = []
        self._rates = rates
        self._affine: list[Row] = []
        self._balls: list[Ball] = []

    def add(self, name: str, constraint: Constraint) -> str | None:
        """Append the rows of a constraint of order 1; return why not, if it has none."""
        lower, upper = constraint.lower, constraint.upper
        if any(s.order for s in (*lower.symbols, *upper.symbols)):
            return "its bounds depend on speeds"
        found = components_of(constraint.expression)
        if found is not None:
            factor, components = found
            return self._add_norm(name, _over(lower, factor), components, _over(upper, factor))
        affine = _affine(self._rates.eliminate(constraint.expression))
        if affine is None:
            return "it is neither affine in the speeds nor a norm of speeds"
        weights, offset = affine
        row = Row(name, weights, less(held(lower), offset), less(held(upper), offset))
        self.rows.append(row)
        self._affine.append(row)
        return None

    def of(self, moving: Collection[Symbol]) -> Limits:
        """Return the limits of speeds that move while all others stand still."""
        box: Box = {}
        coupled = []
        for row in self._affine:
            weights = only(row.weights, moving)
            for speed, weight in weights.items():
                if not weight.symbols:
                    # Alone it gets that far at most; more would need the help of others.
                    ends = [e if is_infinite(e) else e / weight for e in (row.lower, row.upper)]
                    _limit(box, speed, *(ends if float(weight) > 0 else reversed(ends)))
            if len(weights) > 1 or any(w.symbols for w in weights.values()):
                coupled.append(Row(row.name, weights, row.lower, row.upper))
        balls = []
        for ball in self._balls:
            components = tuple(only(c, moving) for c in ball.components)
            for component in components:
                for speed, weight in component.items():
                    if not weight.symbols:
                        end = ball.radius / abs(float(weight))
                        _limit(box, speed, -end, end)
            if len({s for c in components for s in c}) > 1 or any(
                w.symbols for c in components for w in c.values()
            ):
                balls.append(Ball(components, ball.radius))
        return Limits(box, coupled, balls)

    def _add_norm(
        self, name: str, lower: Expression, components: list[Expression], upper: Expression
    ) -> str | None:
        if lower.symbols or float(lower) > 0:
            return "a norm can be bounded from above only"
        if is_infinite(upper):
            return "it has no bounds"
        if len(components) > 3:
            return "a norm of more than three speeds has no rows here"
        parts = [part for c in components if (part := _affine(self._rates.eliminate(c))) is not None]
        if len(parts) < len(components):
            return "the norm is of something that is not affine in the speeds"
        inner = held(upper) * inner_radius(len(components))
        for direction in directions(len(components)):
            weights: dict[Symbol, Expression] = {}
            offset = ZERO
            for factor, (own, constant) in zip(direction, parts, strict=True):
                offset = offset + factor * constant
                for speed, weight in own.items():
                    term = factor * weight
                    weights[speed] = weights[speed] + term if speed in weights else term
            self.rows.append(Row(name, weights, -INFINITE, less(inner, offset)))
        offsets = [constant for _, constant in parts if constant != ZERO]
        radius = inner - norm(offsets) if offsets else inner
        self._balls.append(Ball(tuple(own for own, _ in parts), radius))
        return None


def is_infinite(bound: Expression) -> bool:
    """Return whether a bound is infinite whatever the state."""
    return not bound.symbols and math.isinf(float(bound))


def only(weights: Weights, moving: Collection[Symbol]) -> dict[Symbol, Expression]:
    """Return the weights of speeds that move and have one."""
    return {s: w for s, w in weights.items() if s in moving and (w.symbols or float(w))}


def smaller(a: Expression, b: Expression) -> Expression:
    """Return the minimum of two; nobody takes gradients of what rows are compared with."""
    return binary(ca.OP_FMIN, a, b)


def larger(a: Expression, b: Expression) -> Expression:
    """Return the maximum of two."""
    return binary(ca.OP_FMAX, a, b)


def at_least(value: Expression, least: Expression) -> Expression:
    """Return the maximum, or NaN where the value is NaN; that shall show, which CasADi's would hide."""
    return _instead(value, binary(ca.OP_LT, value, least), least)


def at_most(value: Expression, most: Expression) -> Expression:
    """Return the minimum, or NaN where the value is NaN."""
    return _instead(value, binary(ca.OP_LT, most, value), most)


def _instead(value: Expression, beyond: Expression, end: Expression) -> Expression:
    kept = binary(ca.OP_IF_ELSE_ZERO, unary(ca.OP_NOT, beyond), value)
    return kept + binary(ca.OP_IF_ELSE_ZERO, beyond, end)


def _limit(box: Box, speed: Symbol, low: Expression, high: Expression) -> None:
    low, high = smaller(low, ZERO), larger(high, ZERO)
    if speed in box:
        other_low, other_high = box[speed]
        low, high = larger(low, other_low), smaller(high, other_high)
    box[speed] = (low, high)


def _over(bound: Expression, factor: float) -> Expression:
    return bound if factor == 1 else bound / factor


def less(bound: Expression, offset: Expression) -> Expression:
    """Return a bound less an offset; what is infinite stays a plain infinity."""
    return bound if is_infinite(bound) else bound - offset


def _affine(expression: Expression) -> tuple[dict[Symbol, Expression], Expression] | None:
    """Return weights by speed and offset of ``Σ weight·speed + offset``; None if it is not affine."""
    speeds = [s for s in expression.symbols if s.order == 1]
    slopes = partial(expression, speeds)
    if any(s.order for s in slopes.symbols):
        return None
    offset = expression.substitute(dict.fromkeys(speeds, 0.0))
    return {s: held(slopes[i]) for i, s in enumerate(speeds)}, held(offset)
