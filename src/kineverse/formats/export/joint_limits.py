"""Constraints as joint limits: ranges of positions, of speeds, and of sums of positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass

from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.node import Augment
from kineverse.formats.description import JointBounds, JointDescription, RobotDescription, SumLimit
from kineverse.model.constraint import Constraint
from kineverse.symbols import Symbol

from .capabilities import UnsupportedFeatures


@dataclass(frozen=True)
class CoordinateLimit:
    """A constraint with numbers as bounds, on slope · symbol + offset."""

    name: str
    symbol: Symbol
    slope: float
    offset: float
    lower: float
    upper: float

    @property
    def symbol_range(self) -> tuple[float, float]:
        """What it leaves of the symbol."""
        if (self.slope, self.offset) == (1.0, 0.0):
            return self.lower, self.upper
        ends = ((self.lower - self.offset) / self.slope, (self.upper - self.offset) / self.slope)
        return min(ends), max(ends)


@dataclass(frozen=True)
class NonlinearLimit:
    """A constraint with numbers as bounds on anything else, and why it is nothing simpler."""

    name: str
    expression: Expression
    lower: float
    upper: float
    reason: str


def classify_constraints(
    constraints: Mapping[str, Constraint],
    resolve: Callable[[Expression], Expression],
    refusals: UnsupportedFeatures,
) -> Iterator[CoordinateLimit | SumLimit | NonlinearLimit]:
    """Yield constraints as ranges of one symbol, of a sum of positions or of a curve; refuse the others.

    Parameters
    ----------
    constraints
        By name.
    resolve
        Puts an expression in terms of what depends on nothing.
    refusals
        Those that are neither are left out there, with the reason.
    """
    for name, given in constraints.items():
        middle, bounds = resolve(given.expression), [resolve(b) for b in (given.lower, given.upper)]
        about = [s for b in bounds for s in b.symbols]
        if about:
            names = ", ".join(dict.fromkeys(map(str, about)))
            refusals.leave(name, f"has bounds that depend on {names}")
            continue
        lower, upper = map(float, bounds)
        if (lower, upper) == (-math.inf, math.inf):
            continue
        if not middle.symbols:
            refusals.leave(name, "is about nothing that moves")
        elif has_given_gradient(middle):
            refusals.leave(name, "has a gradient that was given and is not the derivative")
        elif any(s.order > 1 for s in middle.symbols):
            refusals.leave(name, "limits accelerations")
        else:
            yield _classify_constraint(name, middle, lower, upper)


def intersect_limits(found: Iterable[CoordinateLimit]) -> dict[Symbol, tuple[float, float]]:
    """Return between which values symbols are, by all that limits them."""
    result: dict[Symbol, tuple[float, float]] = {}
    for item in found:
        low, high = item.symbol_range
        before = result.get(item.symbol, (-math.inf, math.inf))
        result[item.symbol] = max(low, before[0]), min(high, before[1])
    return result


def _classify_constraint(
    name: str, expression: Expression, lower: float, upper: float
) -> CoordinateLimit | SumLimit | NonlinearLimit:
    """Return a constraint on a sum of multiples, or a curve with the reason why it is none."""
    line = Constraint(as_expression(lower), expression, as_expression(upper)).line
    if line is not None:
        return CoordinateLimit(name, expression.symbols[0], *line, lower, upper)
    symbols = expression.symbols
    names = ", ".join(map(str, symbols))
    slopes = None if expression._nodes else expression.partial(symbols)
    if slopes is None or slopes.symbols:
        reason = f"is no multiple of one coordinate, but a curve over {names}"
        return NonlinearLimit(name, expression, lower, upper, reason)
    if any(s.order for s in symbols):
        return NonlinearLimit(name, expression, lower, upper, f"limits a mixture of speeds, {names}")
    offset = float(expression(dict.fromkeys(symbols, 0.0)))
    factors = {s: float(slopes[i]) for i, s in enumerate(symbols)}
    return SumLimit(name, factors, lower - offset, upper - offset)


def assign_limits(
    plan: RobotDescription,
    found: Collection[CoordinateLimit | SumLimit],
    target: str,
    sums: bool,
    one_way: bool,
    refusals: UnsupportedFeatures,
) -> None:
    """Put ranges where they belong: to the joint that they are named for, else to the coordinate's joint.

    Parameters
    ----------
    plan
        Its joints receive bounds.
    found
        What was found among the constraints.
    target
        The name of the format.
    sums, one_way
        Whether it can limit sums of several coordinates, and speeds other than alike in both directions.
    refusals
        What has no place is left out there.
    """
    joints = {joint.name: joint for joint in plan.joints}
    leaders = {joint.symbol: joint for joint in plan.joints if joint.leads}
    for item in found:
        if isinstance(item, SumLimit):
            if not sums:
                refusals.leave(item.name, f"limits a sum of {', '.join(map(str, item.factors))}")
            elif any(s not in leaders for s in item.factors):
                refusals.leave(item.name, "is about coordinates of which no joint consists")
            else:
                plan.sums.append(item)
            continue
        coordinate = item.symbol.position if item.symbol.order else item.symbol
        owner, _, what = item.name.rpartition("/")
        joint = joints.get(owner)
        if joint is not None and _is_about_joint(joint, coordinate, item):
            low, high = item.lower, item.upper
        elif coordinate in leaders:
            joint = leaders[coordinate]
            low, high = item.symbol_range
        else:
            refusals.leave(item.name, f"is about '{item.symbol}', which is the position or speed of no joint")
            continue
        if not item.symbol.order:
            if what == "soft_limits" and joint.name == owner and joint.bounds.soft is None:
                joint.bounds.soft = low, high
            else:
                joint.bounds.keep(low, high)
        elif one_way or low == -high:
            joint.bounds.slow(low, high)
        else:
            refusals.leave(item.name, "limits a speed differently in its two directions")
    for joint in plan.joints:
        if joint.bounds.lower > joint.bounds.upper:
            refusals.add(joint.name, f"cannot be anywhere: {_format_bounds(joint.bounds)}")


def _is_about_joint(joint: JointDescription, coordinate: Symbol, item: CoordinateLimit) -> bool:
    """Whether a constraint is on just what the joint's position is, or on its speed."""
    if joint.symbol != coordinate or len(joint.amount) != 2:
        return False
    offset = 0.0 if item.symbol.order else joint.amount[0]
    return (offset, joint.amount[1]) == (item.offset, item.slope)


def _format_bounds(bounds: JointBounds) -> str:
    return f"its limits leave nothing between {bounds.lower:g} and {bounds.upper:g}"


def has_given_gradient(expression: Expression) -> bool:
    """Whether a gradient inside of an expression was given rather than derived."""
    nodes = topological_order(leaves(expression)[1], lambda n: n.arguments, lambda _: False)
    return any(isinstance(node, Augment) for node in nodes)
