"""Constraints as joint limits: ranges of positions, of speeds, and of sums of positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.node import Augment
from kineverse.formats.description import JointDescription, RobotDescription, SumLimit
from kineverse.model.constraint import Constraint
from kineverse.symbols import Symbol

from .capabilities import FormatCapabilities, UnsupportedFeatures


@dataclass(frozen=True)
class CoordinateLimit:
    """Constraint lower <= slope · symbol + offset <= upper with constant bounds."""

    name: str
    symbol: Symbol
    slope: float
    offset: float
    lower: float
    upper: float

    @property
    def symbol_range(self) -> tuple[float, float]:
        """Range of the symbol."""
        if (self.slope, self.offset) == (1.0, 0.0):
            return self.lower, self.upper
        ends = ((self.lower - self.offset) / self.slope, (self.upper - self.offset) / self.slope)
        return min(ends), max(ends)


@dataclass(frozen=True)
class NonlinearLimit:
    """Constraint with constant bounds on any other expression, and the reason why it is no simpler limit."""

    name: str
    expression: Expression
    lower: float
    upper: float
    reason: str


def classify_constraints(
    constraints: Mapping[str, Constraint],
    resolve: Callable[[Expression], Expression],
    unsupported: UnsupportedFeatures,
) -> Iterator[CoordinateLimit | SumLimit | NonlinearLimit]:
    """Yield constraints as limits of one symbol, of a linear combination of positions, or of a curve."""
    for name, given in constraints.items():
        middle, bounds = resolve(given.expression), [resolve(b) for b in (given.lower, given.upper)]
        about = [s for b in bounds for s in b.symbols]
        if about:
            names = ", ".join(dict.fromkeys(map(str, about)))
            unsupported.leave_out(name, f"has bounds that depend on {names}")
            continue
        lower, upper = map(float, bounds)
        if (lower, upper) == (-math.inf, math.inf):
            continue
        if not middle.symbols:
            unsupported.leave_out(name, "is about nothing that moves")
        elif has_given_gradient(middle):
            unsupported.leave_out(name, "has a gradient that was given and is not the derivative")
        elif any(s.order > 1 for s in middle.symbols):
            unsupported.leave_out(name, "limits accelerations")
        else:
            yield _classify_constraint(name, middle, lower, upper)


def intersect_limits(found: Iterable[CoordinateLimit]) -> dict[Symbol, tuple[float, float]]:
    """Return the range of each symbol, the intersection of all its limits."""
    result: dict[Symbol, tuple[float, float]] = {}
    for item in found:
        low, high = item.symbol_range
        before = result.get(item.symbol, (-math.inf, math.inf))
        result[item.symbol] = max(low, before[0]), min(high, before[1])
    return result


def _classify_constraint(
    name: str, expression: Expression, lower: float, upper: float
) -> CoordinateLimit | SumLimit | NonlinearLimit:
    line = Constraint(as_expression(lower), expression, as_expression(upper)).line
    if line is not None:
        return CoordinateLimit(name, expression.symbols[0], *line, lower, upper)
    symbols = expression.symbols
    names = ", ".join(map(str, symbols))
    slopes = None if expression.nodes else expression.partial(symbols)
    if slopes is None or slopes.symbols:
        reason = f"is no multiple of one coordinate, but a curve over {names}"
        return NonlinearLimit(name, expression, lower, upper, reason)
    if any(s.order for s in symbols):
        return NonlinearLimit(name, expression, lower, upper, f"limits a mixture of speeds, {names}")
    offset = float(expression(dict.fromkeys(symbols, 0.0)))
    factors = {s: float(slopes[i]) for i, s in enumerate(symbols)}
    return SumLimit(name, factors, lower - offset, upper - offset)


def assign_limits(
    description: RobotDescription,
    found: Collection[CoordinateLimit | SumLimit],
    target: FormatCapabilities,
    unsupported: UnsupportedFeatures,
) -> None:
    """Assign limits: to the joint that a limit is named for, else to the joint of its coordinate."""
    joints = {joint.name: joint for joint in description.joints}
    independent = {joint.symbol: joint for joint in description.joints if joint.is_independent}
    for item in found:
        if isinstance(item, SumLimit):
            if not target.sum_limits:
                unsupported.leave_out(item.name, f"limits a sum of {', '.join(map(str, item.factors))}")
            elif any(s not in independent for s in item.factors):
                unsupported.leave_out(item.name, "is about coordinates of which no joint consists")
            else:
                description.sum_limits.append(item)
            continue
        coordinate = item.symbol.position if item.symbol.order else item.symbol
        owner, _, kind = item.name.rpartition("/")
        joint = joints.get(owner)
        if joint is not None and _is_about_joint(joint, coordinate, item):
            low, high = item.lower, item.upper
        elif coordinate in independent:
            joint = independent[coordinate]
            low, high = item.symbol_range
        else:
            unsupported.leave_out(
                item.name, f"is about '{item.symbol}', which is the position or speed of no joint"
            )
            continue
        bounds = joint.bounds
        if not item.symbol.order:
            if kind == "soft_limits" and joint.name == owner and bounds.soft is None:
                bounds.soft = low, high
            else:
                bounds.lower, bounds.upper = max(bounds.lower, low), min(bounds.upper, high)
        elif target.one_way_speeds or low == -high:
            bounds.min_velocity = max(bounds.min_velocity, low)
            bounds.max_velocity = min(bounds.max_velocity, high)
        else:
            unsupported.leave_out(item.name, "limits a speed differently in its two directions")
    for joint in description.joints:
        if joint.bounds.lower > joint.bounds.upper:
            ends = f"{joint.bounds.lower:g} and {joint.bounds.upper:g}"
            unsupported.refuse(joint.name, f"cannot be anywhere: its limits leave nothing between {ends}")


def _is_about_joint(joint: JointDescription, coordinate: Symbol, item: CoordinateLimit) -> bool:
    if joint.symbol != coordinate or len(joint.coefficients) != 2:
        return False
    offset = 0.0 if item.symbol.order else joint.coefficients[0]
    return (offset, joint.coefficients[1]) == (item.offset, item.slope)


def has_given_gradient(expression: Expression) -> bool:
    """Return True if an expression contains a gradient that was given rather than derived."""
    nodes = topological_order(leaves(expression)[1], lambda n: n.arguments, lambda _: False)
    return any(isinstance(node, Augment) for node in nodes)
