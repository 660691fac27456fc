"""Speed constraints as linear rows and norm bounds, and the speeds that they admit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TypeAlias

import casadi as ca
from msgspec import Struct

from kineverse.expressions.expression import Expression, array, as_expression, binary, unary
from kineverse.expressions.functions import norm
from kineverse.expressions.gradient import partial
from kineverse.expressions.implicit import clamp_to_domains
from kineverse.expressions.nonsmooth import Norm
from kineverse.model.constraint import Constraint
from kineverse.model.rates import Rates
from kineverse.symbols import Symbol

SIDES = 16


def find_norm_components(expression: Expression) -> tuple[float, list[Expression]] | None:
    """Return factor and components of ``factor·norm(components)``; None for any other expression."""
    if len(expression.nodes) != 1:
        return None
    (node,) = expression.nodes
    if not isinstance(node, Norm):
        return None
    factor = ca.jacobian(expression.sx, node.sx)
    rest = ca.simplify(ca.substitute(expression.sx, node.sx, 0))
    if not factor.is_constant() or not float(factor) > 0 or not rest.is_zero():
        return None
    return float(factor), list(node.arguments[0])


def facet_normals(dimensions: int) -> list[tuple[float, ...]]:
    """Return the normals of a regular polygon, or of a polyhedron with faces along latitudes and longitudes.

    In the plane, the angle from any direction to the nearest normal is at most half a step, π/16. In space it
    is at most half a step in latitude and in longitude. So the cosine of the angle is at least
    :func:`inscribed_radius`, and a polyhedron with faces at that distance from 0 lies inside the unit sphere.
    """
    if dimensions == 1:
        return [(1.0,), (-1.0,)]
    step = 2 * math.pi / SIDES
    ring = [(math.cos(a), math.sin(a)) for a in (step * (k + 0.5) for k in range(SIDES))]
    if dimensions == 2:
        return list(ring)
    latitudes = [step * (k + 0.5) for k in range(-SIDES // 4, SIDES // 4)]
    return [(x * math.cos(b), y * math.cos(b), math.sin(b)) for b in latitudes for x, y in ring]


def inscribed_radius(dimensions: int) -> float:
    """Return the radius of the inscribed ball of the body with these normals whose corners have radius 1."""
    return math.cos(math.pi / SIDES) ** (dimensions - 1)


Weights: TypeAlias = Mapping[Symbol, Expression]
SpeedBox: TypeAlias = dict[Symbol, tuple[Expression, Expression]]

ZERO = as_expression(0.0)
INFINITE = as_expression(math.inf)
_ONE = as_expression(1.0)


class SpeedRow(Struct, frozen=True):
    """Row ``lower <= Σ weight·speed <= upper`` of a constraint."""

    name: str  # name of the constraint
    weights: Weights  # coefficients by speed
    lower: Expression  # scalar bounds
    upper: Expression
    violation: Expression = ZERO  # signed excess of a position constraint

    @property
    def is_simple(self) -> bool:
        """True if the row bounds a single speed, by a constant coefficient."""
        return len(self.weights) == 1 and not any(w.symbols for w in self.weights.values())


class SpeedBounds(Struct, frozen=True):
    """Bounds ``lower <= v <= upper`` of single speeds v, those of several constraints merged.

    The greatest of the lower bounds counts, and the least of the upper bounds. At states where constraints on
    one speed contradict each other, a lower bound is above the upper one: where two speed limits exclude each
    other, or one excludes zero speed and another constraint allows no other.
    """

    speeds: tuple[Symbol, ...]  # n speeds
    lower: Expression  # expressions of shape (n,) in units of the speeds; ∓infinity for none
    upper: Expression
    violation: Expression  # (n,)
    names: tuple[tuple[str, ...], ...]  # names of the constraints of each speed


class NormBound(Struct, frozen=True):
    """Upper bound on the norm of components ``Σ weight·speed``."""

    components: tuple[Weights, ...]
    radius: Expression


class AdmissibleSpeeds(Struct, frozen=True):
    """Set of admissible speeds while all other speeds are zero; zero speed is assumed to be admissible."""

    box: SpeedBox  # lower limits <= 0 and upper limits >= 0 of single speeds
    coupled: list[SpeedRow]  # rows that the box does not imply
    balls: list[NormBound]  # norm bounds; rows describe their inscribed polygons


class SpeedLimits:
    """Rows and norm bounds of the speed constraints of a model."""

    def __init__(self, rates: Rates) -> None:
        self.rows: list[SpeedRow] = []
        self._rates = rates
        self._affine: list[SpeedRow] = []
        self._balls: list[NormBound] = []

    def add(self, name: str, constraint: Constraint) -> str | None:
        """Append the rows of a constraint of order 1, or return the reason if it has none."""
        lower, upper = constraint.lower, constraint.upper
        if any(s.order for s in (*lower.symbols, *upper.symbols)):
            return "its bounds depend on speeds"
        found = find_norm_components(constraint.expression)
        if found is not None:
            factor, components = found
            return self._add_norm(
                name, _divide_bound(lower, factor), components, _divide_bound(upper, factor)
            )
        affine = _affine(self._rates.eliminate(constraint.expression))
        if affine is None:
            return "it is neither affine in the speeds nor a norm of speeds"
        weights, offset = affine
        row = SpeedRow(
            name,
            weights,
            subtract_offset(clamp_to_domains(lower), offset),
            subtract_offset(clamp_to_domains(upper), offset),
        )
        self.rows.append(row)
        self._affine.append(row)
        return None

    def admissible_speeds(self, moving: Collection[Symbol]) -> AdmissibleSpeeds:
        """Return the limits of some speeds while all others are zero."""
        box: SpeedBox = {}
        coupled = []
        for row in self._affine:
            weights = select_moving(row.weights, moving)
            for speed, weight in weights.items():
                if not weight.symbols:
                    # The row bounds a single speed while the other speeds are zero.
                    ends = [e if is_infinite(e) else e / weight for e in (row.lower, row.upper)]
                    _tighten(box, speed, *(ends if float(weight) > 0 else reversed(ends)))
            if len(weights) > 1 or any(w.symbols for w in weights.values()):
                coupled.append(SpeedRow(row.name, weights, row.lower, row.upper))
        balls = []
        for ball in self._balls:
            components = tuple(select_moving(c, moving) for c in ball.components)
            for component in components:
                for speed, weight in component.items():
                    if not weight.symbols:
                        end = ball.radius / abs(float(weight))
                        _tighten(box, speed, -end, end)
            if len({s for c in components for s in c}) > 1 or any(
                w.symbols for c in components for w in c.values()
            ):
                balls.append(NormBound(components, ball.radius))
        return AdmissibleSpeeds(box, coupled, balls)

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
        inner = clamp_to_domains(upper) * inscribed_radius(len(components))
        for direction in facet_normals(len(components)):
            weights: dict[Symbol, Expression] = {}
            offset = ZERO
            for factor, (own, constant) in zip(direction, parts, strict=True):
                offset = offset + factor * constant
                for speed, weight in own.items():
                    term = factor * weight
                    weights[speed] = weights[speed] + term if speed in weights else term
            self.rows.append(SpeedRow(name, weights, -INFINITE, subtract_offset(inner, offset)))
        offsets = [constant for _, constant in parts if constant != ZERO]
        radius = inner - norm(offsets) if offsets else inner
        self._balls.append(NormBound(tuple(own for own, _ in parts), radius))
        return None


def merge_bounds(speeds: Sequence[Symbol], rows: Iterable[SpeedRow]) -> SpeedBounds:
    """Merge rows of single speeds with constant coefficients to bounds of these speeds."""
    own: dict[Symbol, list[SpeedRow]] = {s: [] for s in speeds}
    for row in rows:
        ((speed, weight),) = row.weights.items()
        factor = float(weight)
        lower, upper, violation = (_divide_bound(e, factor) for e in (row.lower, row.upper, row.violation))
        ends = (lower, upper) if factor > 0 else (upper, lower)
        own[speed].append(SpeedRow(row.name, {speed: _ONE}, *ends, violation))
    return SpeedBounds(
        tuple(speeds),
        array([_raw_extreme([row.lower for row in found], -1) for found in own.values()]),
        array([_raw_extreme([row.upper for row in found], 1) for found in own.values()]),
        array([_merge_violations([row.violation for row in found]) for found in own.values()]),
        tuple(tuple(dict.fromkeys(row.name for row in found)) for found in own.values()),
    )


def _merge_violations(violations: Sequence[Expression]) -> Expression:
    found = [v for v in violations if v.symbols or float(v)]
    if len(found) < 2:
        return found[0] if found else ZERO
    return clamp_below(_raw_extreme(found, -1), ZERO) + clamp_above(_raw_extreme(found, 1), ZERO)


def is_infinite(bound: Expression) -> bool:
    """Return whether a bound is infinite at all states."""
    return not bound.symbols and math.isinf(float(bound))


def select_moving(weights: Weights, moving: Collection[Symbol]) -> dict[Symbol, Expression]:
    """Return the nonzero weights of moving speeds."""
    return {s: w for s, w in weights.items() if s in moving and (w.symbols or float(w))}


def raw_min(a: Expression, b: Expression) -> Expression:
    """Return the minimum, as CasADi's fmin: without a gradient, which bounds of rows do not need."""
    return binary(ca.OP_FMIN, a, b)


def raw_max(a: Expression, b: Expression) -> Expression:
    """Return the maximum, as CasADi's fmax: without a gradient."""
    return binary(ca.OP_FMAX, a, b)


def clamp_below(value: Expression, least: Expression) -> Expression:
    """Return the maximum, or NaN if the value is NaN; CasADi's fmax would hide NaN."""
    return _replace_where(value, binary(ca.OP_LT, value, least), least)


def clamp_above(value: Expression, most: Expression) -> Expression:
    """Return the minimum, or NaN if the value is NaN."""
    return _replace_where(value, binary(ca.OP_LT, most, value), most)


def _raw_extreme(values: Sequence[Expression], sign: int) -> Expression:
    """Return the minimum (sign 1) or maximum (sign -1) of values, without a gradient; NaN if any is NaN."""
    numbers = [v for v in values if not v.symbols]
    end = sign * min((sign * float(v) for v in numbers), default=math.inf)
    others = [v for v in values if v.symbols]
    if not others:
        return as_expression(end)
    result, *others = others
    for other in others:
        least = clamp_above(result, other) if sign > 0 else clamp_below(result, other)
        # Neither comparison holds for NaN.
        ordered = binary(ca.OP_OR, binary(ca.OP_LE, result, other), binary(ca.OP_LT, other, result))
        result = least + binary(ca.OP_IF_ELSE_ZERO, unary(ca.OP_NOT, ordered), other)
    if math.isinf(end):
        return result
    bound = as_expression(end)
    return clamp_above(result, bound) if sign > 0 else clamp_below(result, bound)


def _replace_where(value: Expression, beyond: Expression, end: Expression) -> Expression:
    kept = binary(ca.OP_IF_ELSE_ZERO, unary(ca.OP_NOT, beyond), value)
    return kept + binary(ca.OP_IF_ELSE_ZERO, beyond, end)


def _tighten(box: SpeedBox, speed: Symbol, low: Expression, high: Expression) -> None:
    low, high = raw_min(low, ZERO), raw_max(high, ZERO)
    if speed in box:
        other_low, other_high = box[speed]
        low, high = raw_max(low, other_low), raw_min(high, other_high)
    box[speed] = (low, high)


def _divide_bound(bound: Expression, factor: float) -> Expression:
    return bound if factor == 1 else bound / factor


def subtract_offset(bound: Expression, offset: Expression) -> Expression:
    """Subtract an offset from a bound; an infinite bound stays a constant."""
    return bound if is_infinite(bound) else bound - offset


def _affine(expression: Expression) -> tuple[dict[Symbol, Expression], Expression] | None:
    """Return weights by speed and offset of ``Σ weight·speed + offset``; None if it is not affine."""
    speeds = [s for s in expression.symbols if s.order == 1]
    slopes = partial(expression, speeds)
    if any(s.order for s in slopes.symbols):
        return None
    offset = expression.substitute(dict.fromkeys(speeds, 0.0))
    return {s: clamp_to_domains(slopes[i]) for i, s in enumerate(speeds)}, clamp_to_domains(offset)
