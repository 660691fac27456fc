"""Case splits: intervals of coordinates with signs of terms, refined until each case has an answer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import TypeVar

import casadi as ca

from kineverse.intervals.arithmetic import RealInterval, enclose_number
from kineverse.intervals.graph import Term, reachable_terms
from kineverse.symbols import Symbol

from . import polynomial as exact
from . import root_isolation
from .abstract_values import AbstractValue, evaluate_term, find_implicit_functions, live_arguments
from .boxes import Interval, IntervalBox, Number
from .domain import Domain
from .polynomial import LinearForm, Polynomial, linear_form_expression

NEGLIGIBLE = 1e-12  # largest constant that is taken for 0 with a rounding error
_SAME = 1e-12
_CLOSE_ROOTS = 1e-9


class Case:
    """Case: intervals of coordinates and of sums of coordinates, and signs of terms."""

    def __init__(
        self,
        roots: tuple[Term, ...],
        domain: Domain,
        axes: Mapping[LinearForm, Interval] | None = None,
        signs: Mapping[int, int] | None = None,
        order: list[Term] | None = None,
        before: Mapping[int, AbstractValue] | None = None,
        narrowed: frozenset[Symbol] = frozenset(),
    ) -> None:
        self.domain = domain
        self._axes = dict(axes or {})
        self._signs = dict(signs or {})
        self._found: dict[int, int | None] = {}
        self._roots = roots
        own = {axis[0][0]: side for axis, side in self._axes.items() if len(axis) == 1}
        places = ((s, i.lower) for s, i in ({**domain.limits, **own}).items() if i.lower == i.upper)
        self._pinned = {s: Fraction(x) for s, x in places if not math.isinf(x)}
        self._order = reachable_terms(roots) if order is None else order
        self.values: dict[int, AbstractValue] = {}
        for term in self._order:
            known = None if before is None else before[term.index]
            if known is not None and known.live.isdisjoint(narrowed):
                self.values[term.index] = known
                continue
            value = self.values[term.index] = self._evaluate(term)
            if value.polynomial is None:
                self.sign(term)  # from the bottom up, as graphs may be deeper than Python's stack

    # -- values and signs ----------------------------------------------------------------------------------

    def value(self, term: Term) -> AbstractValue:
        """Return the abstract value of a term."""
        return self.values[term.index]

    def sign(self, term: Term) -> int | None:
        """Return the sign of a term if it is constant in this case, else None."""
        if term.op == ca.OP_NEG:
            inner = self.sign(term.args[0])
            return None if inner is None else -inner
        if term.index in self._signs:
            return self._signs[term.index]
        if term.index not in self._found:
            self._found[term.index] = self._sign(self.values[term.index], term)
        return self._found[term.index]

    def interval(self, axis: LinearForm) -> Interval:
        """Return the interval of a symbol or of a linear form."""
        known = self._axes.get(axis)
        if len(axis) == 1:
            return known if known is not None else self.domain.limits_of(axis[0][0])
        total = self._sum({((s, 1),): f for s, f in axis})
        return total if known is None else total.intersection(known)

    @property
    def is_empty(self) -> bool:
        """True if the interval of an axis is empty."""
        return any(self.interval(axis).is_empty for axis in self._axes)

    def box(self) -> IntervalBox:
        """Return the conditions of the case, without those implied by the limits."""
        sides = {}
        for axis, side in self._axes.items():
            limit = self.domain.limits_of(axis[0][0]) if len(axis) == 1 else Interval()
            low = side.lower == limit.lower and side.lower_closed == limit.lower_closed
            high = side.upper == limit.upper and side.upper_closed == limit.upper_closed
            sides[linear_form_expression(axis)] = Interval(
                -math.inf if low else _as_float(side.lower),
                math.inf if high else _as_float(side.upper),
                side.lower_closed and not low,
                side.upper_closed and not high,
            )
        return IntervalBox(sides)

    def is_at_equality(self, roots: tuple[Term, ...]) -> bool:
        """Return True if a comparison that the roots depend on has equal sides, thus the value 0.5."""
        seen, stack = set[int](), list(roots)
        while stack:
            term = stack.pop()
            if term.index in seen:
                continue
            seen.add(term.index)
            if term.op == "less":
                if len(term.deciders) == 1 and self.sign(term.deciders[0]) == 0:
                    return True
                continue
            args = live_arguments(term, self.values, self.sign)
            if term.op == ca.OP_MUL:
                zero = [a for a in args if self.values[a.index].number == 0]
                args = tuple(zero[:1]) or args
            stack += [*args, *term.deciders]
        return False

    def _evaluate(self, term: Term) -> AbstractValue:
        if term.op != ca.OP_PARAMETER:
            value = evaluate_term(term, self.values, self.sign)
        else:
            value = AbstractValue(polynomial=Polynomial.symbol(term.data), live=frozenset((term.data,)))
        if value.void:
            return value
        value = self._on_spheres(value)
        p, live = value.polynomial, value.live
        if not live.isdisjoint(self._pinned):
            live = live.difference(self._pinned)
            # A linear form is not reduced by pinned symbols, so that it is the same axis as in other cases.
            if p is not None and p.degree > 1:
                p = p.substitute(self._pinned)
        if p is None or p.degree != 1:
            span = value.range if p is None or p.symbols else enclose_number(p.offset)
            return AbstractValue(span, p, live, value.doubtful)
        side = self._sum(p.terms) if len(p.symbols) == 1 else self._line(p)
        (low, _), (_, high) = enclose_number(side.lower), enclose_number(side.upper)
        span = (max(low, value.range[0]), min(high, value.range[1]))
        return AbstractValue(span, p, live, value.doubtful)

    def _on_spheres(self, value: AbstractValue) -> AbstractValue:
        """Return the value refined by the unit length of quaternions."""
        p = value.polynomial
        if p is None or p.degree < 2 or not self.domain.spheres:
            return value
        p = self.domain.reduce(p)
        low, high = self.domain.form_range(p) or value.range
        span = (max(low, value.range[0]), min(high, value.range[1]))
        return AbstractValue(span, p, p.symbols, value.doubtful)

    def _line(self, p: Polynomial) -> Interval:
        axis, scale = p.linear_form()
        return _as_linear_form(self.interval(axis), scale, p.offset)

    def _sum(self, terms: Mapping[exact.Monomial, Fraction]) -> Interval:
        low: float | Fraction = Fraction(0)
        high: float | Fraction = Fraction(0)
        low_closed = high_closed = True
        for monomial, factor in terms.items():
            if not monomial:
                low, high = low + factor, high + factor
                continue
            part = _as_linear_form(self.interval(((monomial[0][0], Fraction(1)),)), factor, Fraction(0))
            low, high = low + part.lower, high + part.upper
            low_closed, high_closed = low_closed and part.lower_closed, high_closed and part.upper_closed
        return Interval(low, high, low_closed, high_closed)

    def _sign(self, value: AbstractValue, term: Term) -> int | None:
        if value.doubtful:
            return None
        p = value.polynomial
        if p is not None:
            if not p.symbols:
                return 0 if abs(p.offset) <= NEGLIGIBLE else 1 if p.offset > 0 else -1
            if p.degree == 1:
                side = self._sum(p.terms) if len(p.symbols) == 1 else self._line(p)
                return _sign_within(side)
            if len(p.symbols) == 1:
                (symbol,) = p.symbols
                side, coefficients = self.interval(((symbol, Fraction(1)),)), p.coefficients()
                if not exact.roots(coefficients, side):
                    return _sign_of(exact.evaluate_polynomial(coefficients, _inner_point(side)))
        if term.op in (ca.OP_MUL, ca.OP_DIV) and not p:
            signs = [self.sign(argument) for argument in term.args]
            if 0 in signs or None not in signs:
                return 0 if 0 in signs else 1 if signs[0] == signs[1] else -1
        low, high = value.range
        if low > 0 or (term.op == ca.OP_EXP and high > 0):
            return 1
        return -1 if high < 0 else 0 if low == high == 0 else None

    # -- splitting -----------------------------------------------------------------------------------------

    def doubts(self, roots: tuple[Term, ...]) -> list[Term]:
        """Return the deciding terms below the roots whose signs are unknown, inner ones first."""
        result: dict[int, Term] = {}
        seen: set[int] = set()
        stack = list(roots)
        while stack:
            term = stack.pop()
            value = self.values[term.index]
            if term.index in seen or (value.polynomial is not None and not value.doubtful):
                continue
            seen.add(term.index)
            for decider in term.deciders:
                if self.sign(decider) is None:
                    result[decider.index] = decider
                stack.append(decider)
            stack += live_arguments(term, self.values, self.sign)
        return [result[index] for index in sorted(result)]

    def split(self, term: Term) -> list[Case] | str:
        """Return the cases in which a term has a constant sign, or the reason why there is no such split."""
        while term.op == ca.OP_NEG:
            (term,) = term.args
        value = self.values[term.index]
        p = value.polynomial
        names = " and ".join(sorted(map(str, value.live)))
        if value.void:
            return "a condition is not a number"
        if value.doubtful:
            return f"a condition on {names} may be no number"
        if p is not None and p.degree == 1:
            axis, scale = p.linear_form()
            return self._divide(term, axis, [-p.offset / scale], _SAME, lambda x: scale * x + p.offset)
        if len(value.live) != 1:
            return f"{names} occur together in a condition that is not linear"
        (symbol,) = value.live
        axis = ((symbol, Fraction(1)),)
        side = self.interval(axis)
        if p is not None:
            coefficients = p.coefficients()
            at = partial(exact.evaluate_polynomial, coefficients)
            return self._divide(term, axis, exact.roots(coefficients, side), _CLOSE_ROOTS, at)
        order = reachable_terms((term,))

        def ranges(low: float, high: float) -> tuple[RealInterval, RealInterval | None]:
            span = Interval(_exact(low), _exact(high), not math.isinf(low), not math.isinf(high))
            inner = Case((term,), self.domain, {**self._axes, axis: span}, self._signs, order)
            rates = root_isolation.slope_ranges(order, inner.values, inner.sign, symbol)
            return inner.value(term).range, rates[term.index]

        # One evaluation of nested loops takes many times as long as that of a single loop.
        most = root_isolation.MAX_EVALUATIONS // max(1, len(find_implicit_functions(order))) ** 3
        crossings = root_isolation.isolate_roots(ranges, float(side.lower), float(side.upper), most)
        if crossings is None:
            endless = f"{names} has no limits, and " if side.is_everything else ""
            return f"{endless}where a condition on {names} changes cannot be made certain"
        signs = lambda x: sum(ranges(float(x), float(x))[0])  # noqa: E731
        return self._divide(term, axis, list(map(Fraction, crossings)), _CLOSE_ROOTS, signs)

    def _divide(
        self,
        term: Term,
        axis: LinearForm,
        thresholds: list[Fraction],
        same: float,
        at: Callable[[Fraction], Fraction | float],
    ) -> list[Case]:
        whole = self.interval(axis)
        cuts: list[Fraction] = []
        for cut in thresholds:
            for end in (whole.lower, whole.upper):
                cut = Fraction(end) if exact.are_close(cut, end, same) else cut
            if cut in whole and cut not in cuts:
                cuts.append(cut)
        pieces: list[tuple[Interval, int]] = []
        inner = whole
        if len(axis) > 1:  # the intervals of its symbols are no condition on the linear form
            whole = self._axes.get(axis, Interval())
        start, closed = whole.lower, whole.lower_closed
        for cut in sorted(cuts):
            pieces += [(Interval(start, cut, closed, False), 2), (Interval(cut, cut, True, True), 0)]
            start, closed = cut, False
        pieces.append((Interval(start, whole.upper, closed, whole.upper_closed), 2))
        cases = []
        for side, sign in pieces:
            if not side.is_empty:
                known = sign if sign == 0 else _sign_of(at(_inner_point(side.intersection(inner))))
                signs = {**self._signs, term.index: known}
                axes, narrowed = {**self._axes, axis: side}, frozenset(s for s, _ in axis)
                cases.append(Case(self._roots, self.domain, axes, signs, self._order, self.values, narrowed))
        return [case for case in cases if not case.is_empty]


def _as_float(number: Number) -> Number:
    """Return a number as a float if that is exact: fractions take ten times as long to compare."""
    near = float(number)
    return near if near == number else number


def _as_linear_form(side: Interval, scale: Fraction, offset: Fraction) -> Interval:
    low, high = _line_at(side.lower, scale, offset), _line_at(side.upper, scale, offset)
    if scale > 0:
        return Interval(low, high, side.lower_closed, side.upper_closed)
    return Interval(high, low, side.upper_closed, side.lower_closed)


def _line_at(x: float | Fraction, scale: Fraction, offset: Fraction) -> float | Fraction:
    return (math.inf if (x > 0) == (scale > 0) else -math.inf) if math.isinf(x) else x * scale + offset


def _sign_within(side: Interval) -> int | None:
    if side.lower > 0 or (side.lower == 0 and not side.lower_closed):
        return 1
    if side.upper < 0 or (side.upper == 0 and not side.upper_closed):
        return -1
    return 0 if side.lower == side.upper == 0 else None


def _sign_of(number: Fraction | float) -> int:
    return (number > 0) - (number < 0)


def _inner_point(side: Interval) -> Fraction:
    if math.isinf(side.lower) and math.isinf(side.upper):
        return Fraction(0)
    if math.isinf(side.lower):
        return Fraction(side.upper) - 1
    if math.isinf(side.upper):
        return Fraction(side.lower) + 1
    return (Fraction(side.lower) + Fraction(side.upper)) / 2


def _exact(number: float) -> float | Fraction:
    return number if math.isinf(number) else Fraction(number)


AnswerT = TypeVar("AnswerT")

MAX_CASES = 1000


@dataclass(frozen=True)
class Unclear:
    """Request for the signs of terms, with the answer for the case that they stay unknown."""

    terms: tuple[Term, ...]
    fallback: object = None


@dataclass(frozen=True)
class Unanswered:
    """Reason for a missing answer."""

    reason: str


def distinguish(
    start: Case, question: Callable[[Case], AnswerT | Unclear]
) -> Iterator[tuple[Case, AnswerT | Unanswered]]:
    """Split a case until each part has an answer; yield the parts with their answers."""
    stack, done = [start], 0
    while stack:
        case = stack.pop()
        done += 1
        answer = question(case)
        if not isinstance(answer, Unclear):
            yield case, answer
            continue
        if done + len(stack) > MAX_CASES:
            yield case, Unanswered(f"there are more than {MAX_CASES} cases to distinguish")
            continue
        reason: str | None = None
        for term in answer.terms:
            parts = case.split(term)
            if not isinstance(parts, str):
                stack += parts
                break
            reason = reason or parts
        else:
            if answer.fallback is not None:
                yield case, answer.fallback  # type: ignore[misc]
            else:
                yield case, Unanswered(reason or "nothing decides it")
