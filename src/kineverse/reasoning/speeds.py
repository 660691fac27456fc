"""What a constraint on speeds stops, and where: the signs of its bounds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from kineverse.bounds.terms import SATURATED, Term, Terms, reachable
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.gradient import partial
from kineverse.expressions.substitution import apply
from kineverse.model.constraint import Constraint
from kineverse.symbols import Symbol

from .boxes import Box
from .cases import Case
from .distinguishing import Unclear, Unknown, distinguish
from .domain import Domain
from .regions import Region


@dataclass
class Blocked:
    """Where what is held cannot increase (``up``) or decrease, and where it even must do the opposite."""

    held: Expression
    up: Region = field(default_factory=Region)
    down: Region = field(default_factory=Region)
    up_beyond: Region = field(default_factory=Region)
    down_beyond: Region = field(default_factory=Region)


def on_speed(
    constraint: Constraint,
    follow: Mapping[Symbol, Expression],
    given: Mapping[Symbol, float],
    domain: Domain,
    unknown: list[tuple[str, Box]],
) -> Blocked:
    """Return what a constraint of order 1 or higher stops, in plain coordinates; note what is unknown.

    ``follow`` says by what coordinates are told that follow others.
    """
    terms = Terms(given)
    held, weight, offset = _alone(constraint)
    ends = (constraint.lower, constraint.upper, offset, weight)
    lower, upper, rest, factor = (terms.of(apply(part, follow)) for part in ends)
    above, below = terms.minus(upper, rest), terms.minus(rest, lower)
    blocked = Blocked(held)
    whole = terms.of(held) if not isinstance(held, Symbol) else None
    start = Case((factor, above, below, *([] if whole is None else [whole])), domain)
    sides = [(above, below, blocked.up, blocked.up_beyond), (below, above, blocked.down, blocked.down_beyond)]
    if whole is not None and start.value(whole).range[0] >= -1e-300:
        # A norm cannot be less than 0 in the first place: if it has no room, everything stands.
        _collect(start, factor, sides[0], unknown)
        blocked.down = blocked.up
        return blocked
    for side in sides:
        _collect(start, factor, side, unknown)
    return blocked


def _alone(constraint: Constraint) -> tuple[Expression, Expression, Expression]:
    """Return (held, weight, offset): the constrained expression is ``weight·held + offset``.

    A single speed, if the expression is affine in one; otherwise the expression itself.
    """
    expression = constraint.expression
    if isinstance(expression, Symbol):
        return expression, as_expression(1.0), as_expression(0.0)
    moving = [s for s in expression.symbols if s.order == constraint.order]
    if len(moving) == 1:
        weight = partial(expression, moving)[0]
        if moving[0] not in weight.symbols:
            return moving[0], weight, expression.substitute({moving[0]: 0.0})
    return expression, as_expression(1.0), as_expression(0.0)


def _collect(
    start: Case,
    factor: Term,
    side: tuple[Term, Term, Region, Region],
    unknown: list[tuple[str, Box]],
) -> None:
    room, other, where, beyond = side

    def ask(case: Case) -> int | str | Unclear:
        turned = case.sign(factor)
        if turned is None:
            return Unclear((*case.doubts((factor,)), factor))
        if turned == 0:
            return 1
        wanted = room if turned > 0 else other
        value = case.value(wanted)
        sign = case.sign(wanted)
        if sign is not None:
            return sign
        if value.void:
            return "a bound is not a number"
        surely = 0 if value.range[1] <= 0 and not value.doubtful else None
        return Unclear((*case.doubts((wanted,)), wanted), surely)

    for case, answer in distinguish(start, ask):
        if isinstance(answer, Unknown):
            unknown.append((_ramp(case, (room, other)) or answer.reason, case.box()))
        elif isinstance(answer, str):
            unknown.append((answer, case.box()))
        elif isinstance(answer, int) and answer <= 0:
            telling = not case.is_at_equality((factor, room if case.sign(factor) == 1 else other))
            where.add(case.box(), telling)
            if answer < 0:
                beyond.add(case.box(), telling)


def _ramp(case: Case, terms: tuple[Term, ...]) -> str | None:
    """Return the reason if a smooth step is under way."""
    for term in reachable(terms):
        if term.op == "less" and len(term.deciders) == 2 and case.value(term).range == (0.0, 1.0):
            return (
                f"a comparison of contrast {term.data:g} is on its ramp, {2 * SATURATED / term.data:g} wide"
            )
    return None
