"""What speeds may do: the rows of constraints on them, and limits for each that keep all of these rows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.functions import Norm, maximum, minimum
from kineverse.expressions.gradient import partial
from kineverse.symbols import Symbol

from .constraint import Constraint
from .rates import Rates

Box: TypeAlias = dict[Symbol, tuple[Expression, Expression]]

SIDES = 16
INFINITE = as_expression(math.inf)
_TINY = 1e-300


@dataclass(frozen=True)
class Row:
    """One row ``lower <= Σ weight·speed <= upper``, with the name of the constraint it came from."""

    name: str
    weights: Mapping[Symbol, Expression]
    lower: Expression
    upper: Expression


class SpeedLimits:
    """Rows of the constraints on speeds, collected one by one."""

    def __init__(self, rates: Rates) -> None:
        self.rows: list[Row] = []
        self._rates = rates
        self._single: Box = {}
        self._coupled: list[Row] = []

    def add(self, name: str, constraint: Constraint) -> str | None:
        """Append the rows of a constraint of order 1; return why not, if it has none."""
        lower, upper = constraint.lower, constraint.upper
        if any(s.order for s in (*lower.symbols, *upper.symbols)):
            return "its bounds depend on speeds"
        norm = _norm_of(constraint.expression)
        if norm is not None:
            return self._add_norm(name, lower, norm, upper)
        affine = _affine(self._rates.eliminate(constraint.expression))
        if affine is None:
            return "it is neither affine in the speeds nor a norm of speeds"
        weights, offset = affine
        self._append(Row(name, weights, _less(lower, offset), _less(upper, offset)))
        return None

    def box(self) -> Box:
        """Return limits of single speeds, such that rows about several hold wherever these limits hold.

        The limits that speeds have themselves are shrunk until they fit: all speeds of a row by the share of
        its bound in the most that they could make of it. A row with a speed that has no limits is left out
        of account, and standing still is taken to be allowed.
        """
        shares: dict[Symbol, Expression] = {}
        for row in self._coupled:
            share = as_expression(1.0)
            for sign, bound in ((1, row.upper), (-1, -row.lower)):
                most = least({s: -sign * w for s, w in row.weights.items()}, self._single)
                if most is not None and not is_infinite(bound):
                    share = minimum(share, maximum(bound, 0) / maximum(maximum(bound, -most), _TINY))
            for speed in row.weights:
                shares[speed] = minimum(shares[speed], share) if speed in shares else share
        box = dict(self._single)
        for speed, share in shares.items():
            if speed in box:
                low, high = box[speed]
                box[speed] = (_scaled(low, share), _scaled(high, share))
        return box

    def _append(self, row: Row) -> None:
        self.rows.append(row)
        if len(row.weights) != 1:
            self._coupled.append(row)
            return
        ((speed, weight),) = row.weights.items()
        if weight.symbols or not float(weight):
            self._coupled.append(row)
        elif float(weight) > 0:
            self._limit(speed, row.lower / weight, row.upper / weight)
        else:
            self._limit(speed, row.upper / weight, row.lower / weight)

    def _limit(self, speed: Symbol, low: Expression, high: Expression) -> None:
        if speed in self._single:
            other_low, other_high = self._single[speed]
            low, high = maximum(low, other_low), minimum(high, other_high)
        self._single[speed] = (low, high)

    def _add_norm(
        self, name: str, lower: Expression, norm: list[Expression], upper: Expression
    ) -> str | None:
        if lower.symbols or float(lower) > 0:
            return "a norm can be bounded from above only"
        if is_infinite(upper):
            return "it has no bounds"
        if len(norm) > 3:
            return "a norm of more than three speeds has no rows here"
        parts = [part for c in norm if (part := _affine(self._rates.eliminate(c))) is not None]
        if len(parts) < len(norm):
            return "the norm is of something that is not affine in the speeds"
        inner = upper * math.cos(math.pi / SIDES) ** (len(norm) - 1)
        plain = [_speed_itself(part) for part in parts]
        for direction in _directions(len(norm)):
            weights: dict[Symbol, Expression] = {}
            offset = as_expression(0.0)
            for factor, (own, constant) in zip(direction, parts, strict=True):
                offset = offset + factor * constant
                for speed, weight in own.items():
                    term = factor * weight
                    weights[speed] = weights[speed] + term if speed in weights else term
            row = Row(name, weights, -INFINITE, _less(inner, offset))
            self.rows.append(row)
            if None in plain:
                self._coupled.append(row)
        # The largest cube inside is what counts for single speeds.
        side = inner / math.sqrt(len(norm))
        for symbol in plain:
            if symbol is not None and None not in plain:
                self._limit(symbol, -side, side)
        return None


def least(weights: Mapping[Symbol, Expression], box: Box) -> Expression | None:
    """Return the least value of ``Σ weight·speed`` within limits, None if there is, or may be, none."""
    total = as_expression(0.0)
    for speed, weight in weights.items():
        if speed not in box:
            return None
        low, high = box[speed]
        if not weight.symbols:
            end = low if float(weight) > 0 else high
            if is_infinite(end):
                return None
            total = total + weight * end
        elif is_infinite(low) or is_infinite(high):
            return None
        else:
            total = total + minimum(weight * low, weight * high)
    return total


def is_infinite(bound: Expression) -> bool:
    """Return whether a bound is infinite whatever the state."""
    return not bound.symbols and math.isinf(float(bound))


def _less(bound: Expression, offset: Expression) -> Expression:
    return bound if is_infinite(bound) else bound - offset


def _scaled(bound: Expression, share: Expression) -> Expression:
    return bound if is_infinite(bound) else bound * share


def _directions(dimensions: int) -> list[tuple[float, ...]]:
    """Return the normals of a regular polygon, or of its faces turned about to cover a sphere.

    The nearest normal is at most at half a step from any direction in the plane, π/16, and at half a step in
    latitude and in longitude in space. So the cosine between the two is at least cos(π/16) to the power of
    the dimensions less one: a polyhedron at that distance from 0 lies inside the unit sphere.
    """
    if dimensions == 1:
        return [(1.0,), (-1.0,)]
    step = 2 * math.pi / SIDES
    ring = [(math.cos(a), math.sin(a)) for a in (step * (k + 0.5) for k in range(SIDES))]
    if dimensions == 2:
        return list(ring)
    latitudes = [step * (k + 0.5) for k in range(-SIDES // 4, SIDES // 4)]
    return [(x * math.cos(b), y * math.cos(b), math.sin(b)) for b in latitudes for x, y in ring]


def _norm_of(expression: Expression) -> list[Expression] | None:
    """Return the components if the expression is a norm and nothing else."""
    if len(expression._nodes) != 1:
        return None
    (node,) = expression._nodes
    if not isinstance(node, Norm) or expression._sx.element_hash() != node.sx.element_hash():
        return None
    return list(node.arguments[0])


def _affine(expression: Expression) -> tuple[dict[Symbol, Expression], Expression] | None:
    """Return weights by speed and offset of ``Σ weight·speed + offset``; None if it is not affine."""
    speeds = [s for s in expression.symbols if s.order == 1]
    slopes = partial(expression, speeds)
    if any(s.order for s in slopes.symbols):
        return None
    offset = expression.substitute(dict.fromkeys(speeds, 0.0))
    return {s: slopes[i] for i, s in enumerate(speeds)}, offset


def _speed_itself(part: tuple[dict[Symbol, Expression], Expression]) -> Symbol | None:
    """Return the speed if an affine expression is just one, None otherwise."""
    weights, offset = part
    if len(weights) != 1 or offset != as_expression(0.0):
        return None
    ((speed, weight),) = weights.items()
    return speed if weight == as_expression(1.0) else None
