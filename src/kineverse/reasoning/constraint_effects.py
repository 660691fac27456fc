"""Effects of one constraint: blocked speeds, ranges of positions, and their regions."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import casadi as ca

from kineverse.expressions.expression import Expression, as_expression, binary, unary
from kineverse.expressions.functions import maximum, minimum, where
from kineverse.expressions.gradient import partial
from kineverse.expressions.piecewise import piecewise
from kineverse.expressions.substitution import apply_substitution
from kineverse.intervals.graph import SATURATED, Term, TermGraph, reachable_terms
from kineverse.logic import less
from kineverse.model.constraint import Constraint
from kineverse.symbols import Symbol

from .abstract_values import live_arguments
from .boxes import Interval, IntervalBox, Region, merge_boxes
from .case_split import Case, Unanswered, Unclear, distinguish
from .domain import Domain
from .interlock_records import Hold
from .polynomial import Polynomial


def express_bound(case: Case, term: Term, names: Mapping[int, Symbol]) -> Expression:
    """Return a term as an expression simplified for a case; ``names`` maps terms to symbols for them."""
    result: dict[int, Expression] = {}
    for part in reachable_terms((term,)):
        value = case.value(part)
        if value.polynomial is not None:
            result[part.index] = _sum_of(value.polynomial)
        elif part.index in names:
            result[part.index] = names[part.index]
        elif part.op == ca.OP_CONST:
            result[part.index] = as_expression(part.data)
        elif part.op == "implicit":
            node, element = part.data
            result[part.index] = node.value.ravel()[element] if node.value.shape else node.value
        else:
            chosen = live_arguments(part, case.values, case.sign)
            result[part.index] = _step(part, chosen, result)
    return result[term.index]


def _sum_of(polynomial: Polynomial) -> Expression:
    total: Expression | None = None
    for monomial, factor in sorted(polynomial.terms.items(), key=lambda item: (not item[0], str(item[0]))):
        term: Expression | None = None
        for symbol, power in monomial:
            part = symbol if power == 1 else symbol**power
            term = part if term is None else term * part
        number = float(factor)
        term = as_expression(number) if term is None else term if number == 1 else number * term
        total = term if total is None else total + term
    return as_expression(0.0) if total is None else total


def _step(term: Term, chosen: tuple[Term, ...], found: dict[int, Expression]) -> Expression:
    args = [found[a.index] for a in term.args]
    op = term.op
    if op == "select":
        return found[chosen[0].index] if len(chosen) == 1 else where(*args)
    if op in (ca.OP_FMIN, ca.OP_FMAX):
        if len(chosen) == 1:
            return found[chosen[0].index]
        return minimum(*args) if op == ca.OP_FMIN else maximum(*args)
    if op == "less":
        return less(0.0, args[0], term.data)
    if op == "piecewise":
        return piecewise(args[0], *term.data)
    assert isinstance(op, int)
    if op == ca.OP_IF_ELSE_ZERO and len(chosen) == 1 and args[0].is_constant:
        return args[1]
    return unary(op, args[0]) if len(args) == 1 else binary(op, *args)


@dataclass
class SpeedEffect:
    """Regions in which a quantity cannot increase or decrease, or is forced to do the opposite."""

    held: Expression
    blocks_increase: Region = field(default_factory=Region)
    blocks_decrease: Region = field(default_factory=Region)
    forces_decrease: Region = field(default_factory=Region)
    forces_increase: Region = field(default_factory=Region)


def find_speed_effect(
    constraint: Constraint,
    dependent: Mapping[Symbol, Expression],
    given: Mapping[Symbol, float],
    domain: Domain,
    unknown: list[tuple[str, IntervalBox]],
) -> SpeedEffect:
    """Find the effect of a constraint of order 1 or higher, in plain coordinates."""
    terms = TermGraph(given)
    held, weight, offset = _isolate_speed(constraint)
    ends = (constraint.lower, constraint.upper, offset, weight)
    lower, upper, rest, factor = (terms.term(apply_substitution(part, dependent)) for part in ends)
    upper_slack, lower_slack = terms.subtract(upper, rest), terms.subtract(rest, lower)
    effect = SpeedEffect(held)
    whole = terms.term(held) if not isinstance(held, Symbol) else None
    start = Case((factor, upper_slack, lower_slack, *([] if whole is None else [whole])), domain)
    sides = [
        (upper_slack, lower_slack, effect.blocks_increase, effect.forces_decrease),
        (lower_slack, upper_slack, effect.blocks_decrease, effect.forces_increase),
    ]
    if whole is not None and start.value(whole).range[0] >= -1e-300:
        # A norm is never negative: an upper bound of 0 makes the quantity stand still.
        _collect_regions(start, factor, sides[0], unknown)
        effect.blocks_decrease = effect.blocks_increase
        return effect
    for side in sides:
        _collect_regions(start, factor, side, unknown)
    return effect


def _isolate_speed(constraint: Constraint) -> tuple[Expression, Expression, Expression]:
    """Return (held, weight, offset): the constrained expression is ``weight·held + offset``.

    The held quantity is a single speed if the expression is affine in one, and otherwise the expression
    itself.
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


def _collect_regions(
    start: Case, factor: Term, side: tuple[Term, Term, Region, Region], unknown: list[tuple[str, IntervalBox]]
) -> None:
    slack, opposite, blocks, forces = side
    if start.sign(factor) == 1:
        parts = _nonnegative_factors(start, slack)
        if len(parts) > 1:
            # A product of these is 0 where one of them is, so that n conditions make n cases, and not 2ⁿ.
            doubts: list[tuple[str, IntervalBox]] = []
            result = Region()
            for part in parts:
                own = Case((factor, part), start.domain)
                _collect_regions(own, factor, (part, opposite, result, forces), doubts)
            if not doubts:
                blocks.boxes += result.boxes
                blocks.reported += result.reported
                return

    def ask(case: Case) -> int | str | Unclear:
        factor_sign = case.sign(factor)
        if factor_sign is None:
            return Unclear((*case.doubts((factor,)), factor))
        if factor_sign == 0:
            return 1
        chosen = slack if factor_sign > 0 else opposite
        value = case.value(chosen)
        sign = case.sign(chosen)
        if sign is not None:
            return sign
        if value.void:
            return "a bound is not a number"
        fallback = 0 if value.range[1] <= 0 and not value.doubtful else None
        return Unclear((*case.doubts((chosen,)), chosen), fallback)

    for case, answer in distinguish(start, ask):
        if isinstance(answer, Unanswered):
            unknown.append((_ramp_reason(case, (slack, opposite)) or answer.reason, case.box()))
        elif isinstance(answer, str):
            unknown.append((answer, case.box()))
        elif isinstance(answer, int) and answer <= 0:
            reported = not case.is_at_equality((factor, slack if case.sign(factor) == 1 else opposite))
            blocks.add(case.box(), reported)
            if answer < 0:
                forces.add(case.box(), reported)


def _nonnegative_factors(case: Case, term: Term) -> list[Term]:
    """Return the factors of a product without constants if all are finite and >= 0, else the term."""
    result: dict[int, Term] = {}
    positive, stack = True, [term]
    while stack:
        part = stack.pop()
        if part.op in (ca.OP_MUL, ca.OP_NEG):
            positive = positive != (part.op == ca.OP_NEG)
            stack += part.args
            continue
        value = case.value(part)
        if value.number is not None and value.number != 0:
            positive = positive == (value.number > 0)
        elif value.void or value.doubtful or value.range[0] < 0 or math.isinf(value.range[1]):
            return [term]
        else:
            result[part.index] = part
    return list(result.values()) if positive else [term]


def _ramp_reason(case: Case, terms: tuple[Term, ...]) -> str | None:
    """Return the reason for an unknown sign if a smooth step is on its ramp, else None."""
    for term in reachable_terms(terms):
        if term.op == "less" and len(term.deciders) == 2 and case.value(term).range == (0.0, 1.0):
            width = 2 * SATURATED / term.data
            return f"a comparison of contrast {term.data:g} is on its ramp, {width:g} wide"
    return None


_SAME = 1e-9


@dataclass(frozen=True)
class PositionEffect:
    """Restriction of a position in a region; ``range`` is set if its bounds are numbers."""

    held: Expression
    hold: Hold
    boxes: tuple[IntervalBox, ...]
    lower: Expression | None
    upper: Expression | None
    range: tuple[float, float] | None


@dataclass(frozen=True)
class _Query:
    """Context of all case splits for one constraint."""

    terms: TermGraph
    domain: Domain
    names: Mapping[int, Symbol]
    unknown: list[tuple[str, IntervalBox]]


@dataclass(frozen=True)
class _Leaf:
    box: IntervalBox
    hold: Hold
    lower: Expression
    upper: Expression
    tighter: tuple[bool, bool]
    reported: bool


def find_position_effects(
    constraint: Constraint,
    dependent: Mapping[Symbol, Expression],
    given: Mapping[Symbol, float],
    domain: Domain,
    unknown: list[tuple[str, IntervalBox]],
) -> list[PositionEffect]:
    """Find the restrictions of positions by a constraint of order 0, in plain coordinates.

    The parameters are those of :func:`find_speed_effect`.
    """
    terms = TermGraph(given)
    query = _Query(terms, domain, {terms.term(e).index: s for s, e in dependent.items()}, unknown)
    expression = terms.term(constraint.expression)
    lower, upper = (
        terms.term(apply_substitution(end, dependent)) for end in (constraint.lower, constraint.upper)
    )
    form = Case((expression,), domain).value(expression).polynomial
    moves = bool(constraint.lower.symbols or constraint.upper.symbols)
    result: list[PositionEffect] = []
    if form is not None and form.degree == 1 and all(s.has_derivative for s in form.symbols):
        for symbol in sorted(form.symbols, key=lambda s: s.sort_key):
            weight = form.terms[((symbol, 1),)]
            rest = as_expression(float(form.offset))
            for monomial, factor in form.terms.items():
                if monomial and monomial[0][0] != symbol:
                    rest = rest + float(factor) * monomial[0][0]
            other, scale = terms.term(apply_substitution(rest, dependent)), terms.constant(float(weight))
            low, high = (terms.divide(terms.subtract(end, other), scale) for end in (lower, upper))
            if weight < 0:
                low, high = high, low
            result += _find_effects(query, symbol, low, high)
    elif moves:
        result += _find_effects(query, constraint.expression, lower, upper)
    elif len(constraint.expression.symbols) > 1:
        whole = terms.term(apply_substitution(constraint.expression, dependent))
        result += _joint_limit_effects(query, constraint, whole)
    return result


def _joint_limit_effects(query: _Query, constraint: Constraint, expression: Term) -> list[PositionEffect]:
    """Return the effects of constant limits on an expression that is not linear in its coordinates.

    There is no effect if the limits always hold. There is none to report if they limit one orientation, as a
    cone does, and leave it a range.
    """
    low, high = float(constraint.lower), float(constraint.upper)
    value = Case((expression,), query.domain).value(expression)
    least, most = value.range
    if not value.doubtful:
        if low <= least and most <= high:
            return []
        if most < low or high < least:
            everywhere = (IntervalBox({}),)
            return [PositionEffect(constraint.expression, "has no value", everywhere, None, None, None)]
    p = value.polynomial
    sphere = query.domain.sphere(value.live)
    if p is not None and query.domain.form_range(p) is not None:
        # All values between the extremes occur, so the limits leave a range if they overlap with it.
        if min(high, most) - max(low, least) > _SAME:
            return []
        reason = f"it leaves next to no room to the orientation of {_list_names(sphere)}"
    elif sphere is not None:
        reason = f"it limits the orientation of {_list_names(sphere)} by more than products of two of these"
    else:
        reason = "it limits several coordinates at once, and they are not just added"
    query.unknown.append((reason, IntervalBox({})))
    return []


def _list_names(symbols: Iterable[Symbol] | None) -> str:
    return ", ".join(str(s) for s in symbols or ())


def _find_effects(query: _Query, held: Expression, low: Term, high: Term) -> list[PositionEffect]:
    limit = query.domain.limits_of(held) if isinstance(held, Symbol) else Interval()
    leaves = list(_leaves(query, low, high, limit))
    free = _free_range(leaves, limit)
    groups: dict[tuple[Hold, Expression, Expression], list[_Leaf]] = {}
    for leaf in leaves:
        if leaf.hold != "stays within" or _is_narrower(leaf, free):
            groups.setdefault((leaf.hold, leaf.lower, leaf.upper), []).append(leaf)
    empty = _merge_leaves([leaf for leaf in leaves if leaf.hold == "has no value"])
    result = [PositionEffect(held, "has no value", empty, None, None, None)] if empty else []
    _join_points(groups)
    for (hold, lower, upper), group in groups.items():
        where = _merge_leaves(group)
        if hold == "has no value" or not where:
            continue
        # A bound that is never tighter than the limit is reported as the limit.
        if not any(leaf.tighter[0] for leaf in group) and not math.isinf(limit.lower):
            lower = as_expression(float(limit.lower))
        if not any(leaf.tighter[1] for leaf in group) and not math.isinf(limit.upper):
            upper = as_expression(float(limit.upper))
        fixed = None if lower.symbols or upper.symbols else (float(lower), float(upper))
        result.append(PositionEffect(held, hold, where, lower, upper, fixed))
    return result


def _merge_leaves(leaves: list[_Leaf]) -> tuple[IntervalBox, ...]:
    return merge_boxes([leaf.box for leaf in leaves], [leaf.box for leaf in leaves if leaf.reported])


def _join_points(groups: dict[tuple[Hold, Expression, Expression], list[_Leaf]]) -> None:
    """Move leaves at single values into a group whose bounds are equal there."""
    for (hold, lower, upper), leaves in list(groups.items()):
        for leaf in [] if hold != "stays within" else list(leaves):
            points = ((s, i.lower) for s, i in leaf.box.items() if i.lower == i.upper)
            at = {s: float(x) for s, x in points if isinstance(s, Symbol)}
            for other in groups if at else ():
                bounds = zip((lower, upper), other[1:], strict=True)
                if other[0] == hold and other[1:] != (lower, upper) and all(_agree(*b, at) for b in bounds):
                    leaves.remove(leaf)
                    groups[other].append(leaf)
                    break


def _agree(bound: Expression, other: Expression, at: dict[Symbol, float]) -> bool:
    there = other.substitute({s: x for s, x in at.items() if s in other.symbols})
    if bound.symbols or there.symbols:
        return bound == there
    a, b = float(bound), float(there)
    return a == b or abs(a - b) <= _SAME * max(1.0, abs(a))


def _leaves(query: _Query, low: Term, high: Term, limit: Interval) -> Iterator[_Leaf]:
    terms = query.terms
    compared = {"room": terms.subtract(high, low)}
    if not math.isinf(limit.lower):
        end = terms.constant(float(limit.lower))
        compared |= {"high above": terms.subtract(high, end), "low above": terms.subtract(low, end)}
    if not math.isinf(limit.upper):
        end = terms.constant(float(limit.upper))
        compared |= {"high below": terms.subtract(end, high), "low below": terms.subtract(end, low)}
    bounds = (low, high)

    def ask(case: Case) -> dict[str, int] | str | Unclear:
        if any(case.value(bound).void for bound in bounds):
            return "a bound is not a number"
        inner = case.doubts(bounds)
        if inner:
            return Unclear(tuple(inner))
        signs = {}
        for name, term in compared.items():
            sign = case.sign(term)
            if sign is None:
                return Unclear((*case.doubts((term,)), term))
            signs[name] = sign
        return signs

    start = Case((*bounds, *compared.values()), query.domain)
    for case, answer in distinguish(start, ask):
        if not isinstance(answer, dict):
            reason = answer.reason if isinstance(answer, Unanswered) else str(answer)
            query.unknown.append((reason, case.box()))
            continue
        lower, upper = (express_bound(case, bound, query.names) for bound in bounds)
        tighter = (answer.get("low above", 1) > 0, answer.get("high below", 1) > 0)
        rooms = [answer[n] for n in ("room", "high above", "low below") if n in answer]
        hold: Hold = "stays within"
        if min(rooms) < 0:
            hold = "has no value"
        elif min(rooms) == 0:
            if answer.get("high above") == 0:
                upper = lower = as_expression(float(limit.lower))
            elif answer.get("low below") == 0:
                upper = lower = as_expression(float(limit.upper))
            hold = "stands still" if not lower.symbols else "stays within"
            if lower.symbols:
                upper = lower
        yield _Leaf(case.box(), hold, lower, upper, tighter, not case.is_at_equality((low, high)))


def _free_range(leaves: list[_Leaf], limit: Interval) -> tuple[float, float]:
    """Return the range that is no restriction: the limits, or else the widest range that a leaf allows."""
    lows = [-math.inf if leaf.lower.symbols else float(leaf.lower) for leaf in leaves]
    highs = [math.inf if leaf.upper.symbols else float(leaf.upper) for leaf in leaves]
    low, high = float(limit.lower), float(limit.upper)
    return (
        min(lows, default=low) if math.isinf(low) else low,
        max(highs, default=high) if math.isinf(high) else high,
    )


def _is_narrower(leaf: _Leaf, free: tuple[float, float]) -> bool:
    low = leaf.tighter[0] and (bool(leaf.lower.symbols) or float(leaf.lower) > free[0])
    return low or (leaf.tighter[1] and (bool(leaf.upper.symbols) or float(leaf.upper) < free[1]))
