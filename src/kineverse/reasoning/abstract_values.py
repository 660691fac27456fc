"""Abstract values of graph terms in a case: exact polynomials, else ranges; closed loops by enclosure."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import casadi as ca

from kineverse.expressions.implicit import ImplicitFunction
from kineverse.intervals.arithmetic import (
    REALS,
    ZERO_INTERVAL,
    RealInterval,
    enclose_number,
    interval_add,
    interval_hull,
    interval_multiply,
    interval_negate,
    interval_polynomial,
    interval_power,
    interval_reciprocal,
    interval_square,
    interval_unary,
    round_outwards,
)
from kineverse.intervals.enclosure import Enclosures
from kineverse.intervals.graph import DOMAINS, Term, TermGraph, reachable_terms
from kineverse.intervals.taylor import TaylorSeries
from kineverse.symbols import Symbol

from .polynomial import Polynomial


def enclose_loop(term: Term, inputs: list[TaylorSeries]) -> TaylorSeries:
    """Return the Taylor series of an unknown of an implicit function, from those of its inputs."""
    node, element = term.data
    return _enclose(node.function, tuple(inputs))[element]


def find_implicit_functions(terms: Iterable[Term]) -> set[ImplicitFunction]:
    """Return the implicit functions among terms, including those in their equations."""
    result = {term.data[0].function for term in terms if term.op == "implicit"}
    return result.union(*map(_nested_loops, result))


@lru_cache(256)
def _nested_loops(function: ImplicitFunction) -> set[ImplicitFunction]:
    return find_implicit_functions(reachable_terms(tuple(TermGraph({}).elements(function.equations))))


# Bisection revisits the same intervals for every unknown and every case.
@lru_cache(10_000)
def _enclose(function: ImplicitFunction, inputs: tuple[TaylorSeries, ...]) -> tuple[TaylorSeries, ...]:
    return tuple(_enclosures(function).enclose_implicit(function, list(inputs)))


@lru_cache(64)
def _enclosures(function: ImplicitFunction) -> Enclosures:
    return Enclosures(TermGraph({}))


NO_SYMBOLS: frozenset[Symbol] = frozenset()
ZERO_POLYNOMIAL = Polynomial({})
_PRODUCT_AT_MOST = 8


@dataclass(frozen=True, slots=True)
class AbstractValue:
    """Abstract value of a term in a case."""

    range: RealInterval = REALS  # interval that contains the value
    polynomial: Polynomial | None = None  # exact value, if it is known to be a polynomial
    live: frozenset[Symbol] = NO_SYMBOLS  # symbols that the value depends on in this case
    doubtful: bool = False  # True if the value may be, or certainly is, not a number
    void: bool = False

    @property
    def number(self) -> Fraction | None:
        """The value, if it is a finite constant, else None."""
        p, (low, high) = self.polynomial, self.range
        if p is not None and not p.symbols:
            return p.offset
        return Fraction(low) if p is not None and not self.live and low == high else None


Signs = Callable[[Term], int | None]
NOT_A_NUMBER = AbstractValue(doubtful=True, void=True)


def from_number(number: float | Fraction) -> AbstractValue:
    """Return the abstract value of a number."""
    if number != number:
        return NOT_A_NUMBER
    if math.isinf(number):
        return AbstractValue((float(number), float(number)))
    return AbstractValue(enclose_number(number), Polynomial.constant(number))


def evaluate_term(term: Term, values: dict[int, AbstractValue], sign: Signs) -> AbstractValue:
    """Return the abstract value of a term, not a symbol, from those of its arguments and deciders."""
    args = [values[a.index] for a in term.args]
    chosen = live_arguments(term, values, sign)
    if any(values[a.index].void for a in (*chosen, *_needed(term))):
        return NOT_A_NUMBER
    doubtful = any(values[a.index].doubtful for a in (*chosen, *_needed(term)))
    if term.op == ca.OP_CONST:
        return from_number(term.data)
    result = _value(term, args, values, sign)
    if result.void:
        return result
    live = result.polynomial.symbols if result.polynomial is not None else result.live
    return AbstractValue(result.range, result.polynomial, live, result.doubtful or doubtful)


def live_arguments(term: Term, values: dict[int, AbstractValue], sign: Signs) -> tuple[Term, ...]:
    """Return the arguments that the value depends on in this case."""
    if term.op == "less":
        return () if _step_of(term, sign) is not None else term.args
    if term.op == "select":
        s = sign(term.deciders[0])
        return term.args[1:] if s is None else (term.args[1] if s >= 0 else term.args[2],)
    if term.op == ca.OP_IF_ELSE_ZERO:
        s = sign(term.args[0])
        return term.args[1:] if s is None or s else ()
    if term.op in (ca.OP_FMIN, ca.OP_FMAX):
        s = sign(term.deciders[0])
        if s is None:
            return term.args
        return (term.args[0] if (s <= 0) == (term.op == ca.OP_FMIN) else term.args[1],)
    if term.op in (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_SIGN):
        return ()
    return term.args


def _needed(term: Term) -> tuple[Term, ...]:
    """Return the deciders that have to be numbers for the value to be one."""
    choices = ("less", "select", ca.OP_IF_ELSE_ZERO, ca.OP_FMIN, ca.OP_FMAX, ca.OP_LT, ca.OP_LE)
    return term.deciders if term.op in (*choices, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_SIGN) else ()


def _step_of(term: Term, sign: Signs) -> float | None:
    """Return the value of ``less`` if it is a step, or constant outside of its ramp."""
    signs = [sign(d) for d in term.deciders]
    if len(signs) == 1:
        return None if signs[0] is None else (1 + signs[0]) / 2
    below, above = signs  # of excess + width and excess - width
    return 0.0 if below is not None and below <= 0 else 1.0 if above is not None and above >= 0 else None


def _value(
    term: Term, args: list[AbstractValue], values: dict[int, AbstractValue], sign: Signs
) -> AbstractValue:
    op = term.op
    live = NO_SYMBOLS.union(*(a.live for a in args))
    if op == "less":
        step = _step_of(term, sign)
        if step is not None:
            return from_number(step)
        return AbstractValue((0.0, 1.0), None, args[0].live)
    if op == "implicit":
        return AbstractValue(enclose_loop(term, [(a.range,) for a in args])[0], None, live)
    if op == "piecewise":
        return _piecewise(term, args[0], values, sign)
    if op in ("select", ca.OP_IF_ELSE_ZERO, ca.OP_FMIN, ca.OP_FMAX):
        return _choice(term, args, values, sign, live)
    if op in (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE, ca.OP_NOT, ca.OP_SIGN):
        s = sign(term.deciders[0])
        if s is None:
            return AbstractValue((-1.0 if op == ca.OP_SIGN else 0.0, 1.0), None, live)
        truth = {ca.OP_LT: s < 0, ca.OP_LE: s <= 0, ca.OP_EQ: s == 0, ca.OP_NE: s != 0, ca.OP_NOT: s == 0}
        return from_number(s if op == ca.OP_SIGN else float(truth[op]))
    if len(args) == 1:
        return _unary(term, args[0], sign, live)
    a, b = args
    if op in (ca.OP_ADD, ca.OP_SUB):
        return _sum(op, a, b, term.args[0] is term.args[1], live)
    if op == ca.OP_MUL:
        return _product(a, b, term.args[0] is term.args[1], live)
    if op == ca.OP_DIV:
        return _quotient(a, b, sign(term.args[1]), live)
    if op == ca.OP_POW:
        return _power(a, b, sign(term.args[0]), live)
    if op == ca.OP_ATAN2:
        return AbstractValue((-3.1415926535897936, 3.1415926535897936), None, live)
    if op == ca.OP_HYPOT:
        squares = interval_add(interval_square(a.range), interval_square(b.range))
        return AbstractValue(interval_unary(ca.OP_SQRT, squares), None, live)
    return AbstractValue(REALS, None, live)


def _choice(
    term: Term,
    args: list[AbstractValue],
    values: dict[int, AbstractValue],
    sign: Signs,
    live: frozenset[Symbol],
) -> AbstractValue:
    chosen = [values[a.index] for a in live_arguments(term, values, sign)]
    if not chosen:
        return from_number(0.0)
    if sign(term.deciders[0]) is not None:
        return chosen[0]
    span = chosen[0].range
    for other in chosen[1:]:
        span = interval_hull(span, other.range)
    if term.op == ca.OP_IF_ELSE_ZERO:
        span = interval_hull(span, ZERO_INTERVAL)
    elif term.op == ca.OP_FMIN:
        span = span[0], min(a.range[1] for a in args)
    elif term.op == ca.OP_FMAX:
        span = max(a.range[0] for a in args), span[1]
    return AbstractValue(span, None, live)


def _unary(term: Term, a: AbstractValue, sign: Signs, live: frozenset[Symbol]) -> AbstractValue:
    op = term.op
    assert isinstance(op, int)
    turn = sign(term.args[0]) if op == ca.OP_FABS else None
    if op == ca.OP_NEG or turn == -1:
        exact = None if a.polynomial is None else a.polynomial.scale(-1)
        return AbstractValue(interval_negate(a.range), exact, live)
    if op == ca.OP_ASSIGN or turn is not None:
        return a
    low, high = DOMAINS.get(op, REALS)
    inside = a.range[0] >= low and a.range[1] <= high
    ends = [] if op == ca.OP_FABS else [sign(d) for d in term.deciders]
    if -1 in ends:
        return NOT_A_NUMBER
    span = interval_unary(op, a.range)
    if a.number == 0 and op in (ca.OP_SIN, ca.OP_TAN, ca.OP_SQRT, ca.OP_ATAN, ca.OP_ASIN, ca.OP_TANH):
        return from_number(0.0)
    if op in (ca.OP_FLOOR, ca.OP_CEIL) and span[1] - span[0] < 1:
        return from_number(float(round((span[0] + span[1]) / 2)))
    return AbstractValue(span, None, live, doubtful=not inside and None in ends)


def _sum(
    op: int | str, a: AbstractValue, b: AbstractValue, same: bool, live: frozenset[Symbol]
) -> AbstractValue:
    if op == ca.OP_SUB and same:
        return from_number(0.0)
    other = b.range if op == ca.OP_ADD else interval_negate(b.range)
    if math.inf in (a.range[0], -a.range[1]) and a.range[0] == -other[0] and other[0] == other[1]:
        return NOT_A_NUMBER  # infinity less infinity
    exact = None
    if a.polynomial is not None and b.polynomial is not None:
        exact = a.polynomial + b.polynomial if op == ca.OP_ADD else a.polynomial - b.polynomial
    return AbstractValue(interval_add(a.range, other), exact, live)


def _product(a: AbstractValue, b: AbstractValue, same: bool, live: frozenset[Symbol]) -> AbstractValue:
    for one, other in ((a, b), (b, a)):
        if one.number == 0 and (one.polynomial == ZERO_POLYNOMIAL or other.polynomial is None):
            infinite = other.range[0] == other.range[1] and math.isinf(other.range[0])
            return NOT_A_NUMBER if infinite else from_number(0.0)
    exact = None
    if a.polynomial is not None and b.polynomial is not None:
        exact = a.polynomial.multiply(b.polynomial)
    span = interval_square(a.range) if same else interval_multiply(a.range, b.range)
    return AbstractValue(span, exact, live)


def _quotient(a: AbstractValue, b: AbstractValue, sign: int | None, live: frozenset[Symbol]) -> AbstractValue:
    if sign == 0:
        return NOT_A_NUMBER
    low, high = b.range
    if sign is None and low <= 0 <= high:
        return AbstractValue(REALS, None, live, doubtful=True)
    below = (max(low, 0.0), high) if sign == 1 else (low, min(high, 0.0)) if sign == -1 else b.range
    exact = a.polynomial.scale(1 / b.number) if a.polynomial is not None and b.number else None
    return AbstractValue(interval_multiply(a.range, interval_reciprocal(below)), exact, live)


def _power(a: AbstractValue, b: AbstractValue, sign: int | None, live: frozenset[Symbol]) -> AbstractValue:
    n = b.number
    whole = n is not None and n.denominator == 1
    if n is not None and whole and 0 <= n <= _PRODUCT_AT_MOST and a.polynomial is not None:
        exact: Polynomial | None = Polynomial.constant(1)
        for _ in range(int(n)):
            exact = None if exact is None else exact.multiply(a.polynomial)
        return AbstractValue(interval_power(a.range, b.range), exact, live)
    low, high = a.range
    if not whole and (sign == -1 or high < 0):
        return NOT_A_NUMBER
    grows = n is not None and n > 0
    safe = low > 0 or sign == 1 or (grows and (whole or low >= 0 or sign == 0)) or (whole and high < 0)
    span = interval_power((max(low, 0.0), high) if not whole else a.range, b.range)
    return AbstractValue(span, None, live, doubtful=not safe)


def _piecewise(term: Term, x: AbstractValue, values: dict[int, AbstractValue], sign: Signs) -> AbstractValue:
    periodic, knots, pieces = term.data
    starts = knots[:-1] if periodic else (knots[0], *knots)
    ends = knots[1:] if periodic else (*knots, math.inf)
    low, high = x.range
    if periodic:
        spans = [(p, 0.0, end - start) for p, start, end in zip(pieces, starts, ends, strict=True)]
        if math.isfinite(low) and math.isfinite(high):
            turn = math.floor((low - knots[0]) / (knots[-1] - knots[0])) * (knots[-1] - knots[0])
            if high - turn <= knots[-1]:
                spans = [
                    (p, max(low - turn, start) - start, min(high - turn, end) - start)
                    for p, start, end in zip(pieces, starts, ends, strict=True)
                    if start <= high - turn and end >= low - turn
                ]
    else:
        signs = [sign(d) for d in term.deciders]
        first = max((k + 1 for k, s in enumerate(signs) if s is not None and s >= 0), default=0)
        last = min((k for k, s in enumerate(signs) if s == -1), default=len(knots))
        if first == last:
            return _polynomial_of(pieces[first], starts[first], x)
        spans = []
        for k in range(first, last + 1):
            start = -math.inf if k == 0 else starts[k]
            spans.append((pieces[k], max(low, start) - starts[k], min(high, ends[k]) - starts[k]))
    result = [interval_polynomial(p, round_outwards(a, b)) for p, a, b in spans if a <= b]
    span = (min(f[0] for f in result), max(f[1] for f in result)) if result else REALS
    return AbstractValue(span, None, x.live)


def _polynomial_of(piece: tuple[float, ...], start: float, x: AbstractValue) -> AbstractValue:
    s = (x.range[0] - start, x.range[1] - start)
    span = interval_polynomial(piece, round_outwards(*s))
    if not any(piece[1:]):
        return from_number(piece[0])
    exact: Polynomial | None = None
    if x.polynomial is not None:
        distance = x.polynomial - Polynomial.constant(start)
        exact = Polynomial.constant(piece[-1])
        for coefficient in reversed(piece[:-1]):
            product = None if exact is None else exact.multiply(distance)
            exact = None if product is None else product + Polynomial.constant(coefficient)
    return AbstractValue(span, exact, x.live)
