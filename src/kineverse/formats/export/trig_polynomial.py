"""Trigonometric polynomials: a normal form in which transforms are compared exactly.

Products of rotations and translations by multiples of coordinates are sums of terms c · x^n · exp(i w·x). In
this form, two of them are equal if and only if their coefficients are, sin² + cos² is 1, and derivatives are
as easy as sums.
"""

from __future__ import annotations

import cmath
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca

from kineverse.intervals.graph import Term

Exponents: TypeAlias = tuple[tuple[int, float], ...]
"""Pairs of a variable and its exponent: a power n, or a frequency w; sorted."""

NOISE = 1e-14  # largest rounding error of a coefficient, in motions in [m] and [rad]
_MAX_TERMS = 300


class TooManyTermsError(Exception):
    """A product with too many terms; never raised to users."""


@dataclass(frozen=True)
class TrigPolynomial:
    """Sum of terms c · x^n · exp(i w·x); a variable is the index of its term in the graph."""

    terms: Mapping[tuple[Exponents, Exponents], complex]

    @staticmethod
    def constant(number: float) -> TrigPolynomial:
        """Return a constant polynomial."""
        return TrigPolynomial({((), ()): complex(number)} if number else {})

    @staticmethod
    def variable(index: int) -> TrigPolynomial:
        """Return the polynomial of a variable."""
        return TrigPolynomial({(((index, 1.0),), ()): 1.0 + 0.0j})

    def __add__(self, other: TrigPolynomial) -> TrigPolynomial:
        total = dict(self.terms)
        for key, c in other.terms.items():
            total[key] = total.get(key, 0.0) + c
        return _drop_noise(total)

    def __neg__(self) -> TrigPolynomial:
        return self.scale(-1.0)

    def __sub__(self, other: TrigPolynomial) -> TrigPolynomial:
        return self + (-other)

    def scale(self, factor: complex) -> TrigPolynomial:
        """Return the product with a number."""
        return TrigPolynomial({key: factor * c for key, c in self.terms.items()})

    def __mul__(self, other: TrigPolynomial) -> TrigPolynomial:
        if len(self.terms) * len(other.terms) > _MAX_TERMS**2:
            raise TooManyTermsError
        total: dict[tuple[Exponents, Exponents], complex] = {}
        for (p, w), c in self.terms.items():
            for (q, v), d in other.terms.items():
                key = _multiply_exponents(p, q), _multiply_exponents(w, v)
                total[key] = total.get(key, 0.0) + c * d
        return _drop_noise(total)

    @property
    def number(self) -> float | None:
        """Value of a constant polynomial; None if it is not constant."""
        if all(key == ((), ()) for key in self.terms):
            return self.terms.get(((), ()), 0j).real
        return None

    @property
    def polynomials(self) -> tuple[dict[int, tuple[float, ...]], float] | None:
        """Coefficients of a sum of polynomials of one variable each; None if it is no such sum.

        By variable, from the first power on, and the constant.
        """
        powers: dict[int, dict[int, float]] = {}
        offset = 0.0
        for (factors, waves), c in self.terms.items():
            if waves or len(factors) > 1:
                return None
            if factors:
                ((index, n),) = factors
                powers.setdefault(index, {})[int(n)] = c.real
            else:
                offset = c.real
        return {
            index: tuple(found.get(n, 0.0) for n in range(1, max(found) + 1))
            for index, found in powers.items()
        }, offset

    @property
    def affine(self) -> tuple[dict[int, float], float] | None:
        """Slopes by variable, and the constant, of an affine function; None for any other."""
        found = self.polynomials
        if found is None or any(len(coefficients) > 1 for coefficients in found[0].values()):
            return None
        return {index: slope for index, (slope,) in found[0].items()}, found[1]

    @property
    def variables(self) -> set[int]:
        """Variables of the polynomial."""
        return {index for key in self.terms for part in key for index, _ in part}

    def exponential(self) -> TrigPolynomial | None:
        """Return exp(i·x) of an affine function x; None for any other."""
        affine = self.affine
        if affine is None:
            return None
        slopes, offset = affine
        frequencies = tuple(sorted((index, w) for index, w in slopes.items() if w))
        return TrigPolynomial({((), frequencies): cmath.exp(1j * offset)})

    def derivative(self, index: int) -> TrigPolynomial:
        """Return the partial derivative with respect to a variable."""
        total: dict[tuple[Exponents, Exponents], complex] = {}
        for (powers, waves), c in self.terms.items():
            w, n = dict(waves).get(index, 0.0), dict(powers).get(index, 0.0)
            if w:
                total[powers, waves] = total.get((powers, waves), 0.0) + 1j * w * c
            if n:
                key = _multiply_exponents(powers, ((index, -1.0),)), waves
                total[key] = total.get(key, 0.0) + n * c
        return _drop_noise(total)

    def substitute_zero(self, index: int) -> TrigPolynomial:
        """Return the polynomial at the value 0 of a variable."""
        total: dict[tuple[Exponents, Exponents], complex] = {}
        for (powers, waves), c in self.terms.items():
            if index not in dict(powers):
                key = powers, tuple(pair for pair in waves if pair[0] != index)
                total[key] = total.get(key, 0.0) + c
        return _drop_noise(total)


class TrigPolynomialConverter:
    """Converter of term graphs to trigonometric polynomials; any other term becomes a variable.

    With ``angles``, so does the argument of a sine or cosine that is not affine.
    """

    def __init__(self, angles: bool = False) -> None:
        self._angles = angles
        self._converted: dict[int, TrigPolynomial] = {}
        self.variables: dict[int, Term] = {}

    def convert(self, term: Term) -> TrigPolynomial:
        """Convert a term after its arguments, iteratively, whatever the depth."""
        stack = [term]
        while stack:
            last = stack[-1]
            missing = [a for a in last.args if a.index not in self._converted]
            if missing:
                stack += missing
                continue
            stack.pop()
            if last.index not in self._converted:
                found = self._convert_term(last, [self._converted[a.index] for a in last.args])
                self._converted[last.index] = self._variable(last) if found is None else found
        return self._converted[term.index]

    def _variable(self, term: Term) -> TrigPolynomial:
        self.variables[term.index] = term
        return TrigPolynomial.variable(term.index)

    def _convert_term(self, term: Term, args: list[TrigPolynomial]) -> TrigPolynomial | None:
        op = term.op
        if op == ca.OP_CONST:
            return TrigPolynomial.constant(term.data)
        if op == ca.OP_ADD:
            return args[0] + args[1]
        if op == ca.OP_SUB:
            return args[0] - args[1]
        if op == ca.OP_NEG:
            return -args[0]
        if op == ca.OP_MUL:
            return args[0] * args[1]
        if op == ca.OP_DIV:
            divisor = args[1].number
            return args[0].scale(1.0 / divisor) if divisor else None
        if op in (ca.OP_SIN, ca.OP_COS):
            wave = args[0].exponential()
            if wave is None and self._angles:
                wave = self._variable(term.args[0]).exponential()
            return None if wave is None else _real_part(wave, op == ca.OP_SIN)
        if op == ca.OP_POW:
            power = args[1].number
            if power is None or power != int(power) or not 0 <= power <= 4:
                return None
            result = TrigPolynomial.constant(1.0)
            for _ in range(int(power)):
                result = result * args[0]
            return result
        return None


def _real_part(wave: TrigPolynomial, sine: bool) -> TrigPolynomial:
    """Return cos(x), the real part of the wave exp(i x), or sin(x), its imaginary part."""
    ((powers, frequencies), c) = next(iter(wave.terms.items()))
    opposite = tuple((index, -w) for index, w in frequencies)
    half = -0.5j if sine else 0.5
    first = TrigPolynomial({(powers, frequencies): half * c})
    return first + TrigPolynomial({(powers, opposite): half.conjugate() * c.conjugate()})


def _multiply_exponents(a: Exponents, b: Exponents) -> Exponents:
    if not a or not b:
        return a or b
    total = dict(a)
    for index, n in b:
        total[index] = total.get(index, 0.0) + n
    return tuple(sorted((index, n) for index, n in total.items() if n))


def _drop_noise(terms: Mapping[tuple[Exponents, Exponents], complex]) -> TrigPolynomial:
    if len(terms) > _MAX_TERMS:
        raise TooManyTermsError
    return TrigPolynomial({key: c for key, c in terms.items() if abs(c) > NOISE})
