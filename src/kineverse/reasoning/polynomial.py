"""Polynomials with rational coefficients."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import TypeAlias

from kineverse.expressions.expression import Expression, as_expression
from kineverse.symbols import Symbol

from .boxes import Interval, Number

Monomial: TypeAlias = tuple[tuple[Symbol, int], ...]
LinearForm: TypeAlias = tuple[tuple[Symbol, Fraction], ...]

_DEGREE_AT_MOST = 8
_MONOMIALS_AT_MOST = 40
_DIGITS_AT_MOST = 4000


@dataclass(frozen=True)
class Polynomial:
    """Polynomial: a mapping from monomials to rational coefficients."""

    terms: Mapping[Monomial, Fraction]

    @staticmethod
    def constant(number: Number) -> Polynomial:
        """Return the constant polynomial of a finite number."""
        return Polynomial({(): Fraction(number)} if number else {})

    @staticmethod
    def symbol(symbol: Symbol) -> Polynomial:
        """Return the polynomial of a symbol."""
        return Polynomial({((symbol, 1),): Fraction(1)})

    @cached_property
    def symbols(self) -> frozenset[Symbol]:
        """Symbols of the polynomial."""
        return frozenset(s for monomial in self.terms for s, _ in monomial)

    @cached_property
    def degree(self) -> int:
        """Total degree."""
        return max((sum(power for _, power in monomial) for monomial in self.terms), default=0)

    @property
    def offset(self) -> Fraction:
        """Constant term."""
        return self.terms.get((), Fraction(0))

    def __add__(self, other: Polynomial) -> Polynomial:
        total = dict(self.terms)
        for monomial, factor in other.terms.items():
            total[monomial] = total.get(monomial, Fraction(0)) + factor
        return Polynomial({m: f for m, f in total.items() if f})

    def scale(self, factor: Number) -> Polynomial:
        """Return the polynomial multiplied by a number."""
        exact = Fraction(factor)
        return Polynomial({m: f * exact for m, f in self.terms.items()} if exact else {})

    def __sub__(self, other: Polynomial) -> Polynomial:
        return self + other.scale(-1)

    def multiply(self, other: Polynomial) -> Polynomial | None:
        """Return the product, or None if it is too large."""
        if self.degree + other.degree > _DEGREE_AT_MOST:
            return None
        total: dict[Monomial, Fraction] = {}
        for m, f in self.terms.items():
            for n, g in other.terms.items():
                powers = dict(m)
                for symbol, power in n:
                    powers[symbol] = powers.get(symbol, 0) + power
                product = tuple(sorted(powers.items(), key=lambda item: item[0].sort_key))
                total[product] = total.get(product, Fraction(0)) + f * g
        if len(total) > _MONOMIALS_AT_MOST:
            return None
        if any(f.denominator.bit_length() > _DIGITS_AT_MOST for f in total.values()):
            return None
        return Polynomial({m: f for m, f in total.items() if f})

    def substitute(self, values: Mapping[Symbol, Fraction]) -> Polynomial:
        """Return the polynomial with values substituted for some symbols."""
        total: dict[Monomial, Fraction] = {}
        for monomial, factor in self.terms.items():
            for symbol, power in monomial:
                factor *= values[symbol] ** power if symbol in values else 1
            rest = tuple((s, power) for s, power in monomial if s not in values)
            total[rest] = total.get(rest, Fraction(0)) + factor
        return Polynomial({m: f for m, f in total.items() if f})

    def linear_form(self) -> tuple[LinearForm, Fraction]:
        """Return axis and scale of a polynomial of degree 1, ``scale·axis + offset``.

        The axis is normalised: its largest weight is ±1, and its first weight is positive.
        """
        weights = sorted(((m[0][0], f) for m, f in self.terms.items() if m), key=lambda w: w[0].sort_key)
        scale = max(abs(f) for _, f in weights) * (1 if weights[0][1] > 0 else -1)
        return tuple((s, f / scale) for s, f in weights), scale

    def coefficients(self) -> list[Fraction]:
        """Return the coefficients of a polynomial in one symbol, constant first."""
        result = [Fraction(0)] * (self.degree + 1)
        for monomial, factor in self.terms.items():
            result[monomial[0][1] if monomial else 0] = factor
        return result


def linear_form_expression(axis: LinearForm) -> Expression:
    """Return a linear form as an expression: a symbol, or a weighted sum of symbols."""
    total = as_expression(0.0)
    for symbol, weight in axis:
        term = symbol if weight == 1 else float(weight) * symbol
        if len(axis) == 1:
            return term
        total = total + term
    return total


def evaluate_polynomial(coefficients: list[Fraction], x: Fraction) -> Fraction:
    """Evaluate a polynomial in one symbol by Horner's method."""
    result = Fraction(0)
    for coefficient in reversed(coefficients):
        result = result * x + coefficient
    return result


def are_close(a: Number, b: Number, share: float) -> bool:
    """Return True if two finite numbers differ by at most ``share``, relative to the larger one above 1."""
    if math.isinf(a) or math.isinf(b):
        return False
    x, y = Fraction(a), Fraction(b)
    return abs(x - y) <= max(Fraction(1), abs(x), abs(y)) * Fraction(share)


def roots(coefficients: list[Fraction], within: Interval) -> list[Fraction]:
    """Return all real roots in an interval, each once, in order; rational ones of low degree exactly.

    Intervals are bisected to a relative width of 2⁻⁶⁰; Sturm's theorem gives the number of roots in each.
    """
    if len(coefficients) == 2:
        result = [-coefficients[0] / coefficients[1]]
    else:
        chain = _sturm(coefficients)
        bound = 1 + max(abs(c / coefficients[-1]) for c in coefficients[:-1])
        # Bisection always starts from the same ends, so a root has the same value for every interval.
        result = sorted(_isolate(chain, -bound, bound))
    return [root for root in result if root in within or _is_near_closed_end(root, within)]


def _is_near_closed_end(root: Fraction, within: Interval) -> bool:
    ends = ((within.lower, within.lower_closed), (within.upper, within.upper_closed))
    return any(closed and are_close(root, end, 1e-12) for end, closed in ends)


def _isolate(chain: list[list[Fraction]], low: Fraction, high: Fraction) -> Iterable[Fraction]:
    stack = [(low, high)]
    while stack:
        a, b = stack.pop()
        count = _sign_changes(chain, a) - _sign_changes(chain, b)  # the roots in (a, b]
        if not count:
            continue
        if not evaluate_polynomial(chain[0], b):
            yield b
            if count > 1:
                middle = (a + b) / 2
                stack.append((a, middle))
                # The end b is a root already; the other roots of (middle, b) lie below this number.
                stack.append((middle, b - (b - a) / 2**70))
        elif are_close(a, b, 2.0**-60):
            yield (a + b) / 2
        else:
            # A midpoint with few digits finds roots such as 0.5 exactly.
            middle = (a + b) / 2
            short = Fraction(float(middle))
            middle = short if a < short < b else middle
            stack += [(a, middle), (middle, b)]


def _sturm(coefficients: list[Fraction]) -> list[list[Fraction]]:
    """Return Sturm's chain of the square-free polynomial with the same roots."""
    chain = [coefficients, [k * c for k, c in enumerate(coefficients) if k]]
    while len(chain[-1]) > 1:
        _, rest = _divide(chain[-2], chain[-1])
        if not rest:
            break
        chain.append([-c for c in rest])
    return chain if len(chain[-1]) == 1 else _sturm(_divide(coefficients, chain[-1])[0])


def _divide(a: list[Fraction], b: list[Fraction]) -> tuple[list[Fraction], list[Fraction]]:
    """Return quotient and remainder of two polynomials, the remainder without leading zeros."""
    rest, quotient = list(a), list[Fraction]()
    while len(rest) >= len(b):
        factor = rest.pop() / b[-1]
        quotient.append(factor)
        for k in range(len(b) - 1):
            rest[len(rest) + 1 - len(b) + k] -= factor * b[k]
    while rest and not rest[-1]:
        rest.pop()
    return quotient[::-1], rest


def _sign_changes(chain: list[list[Fraction]], x: Fraction) -> int:
    signs = [s for s in (evaluate_polynomial(p, x) for p in chain) if s]
    return sum((a > 0) != (b > 0) for a, b in itertools.pairwise(signs))
