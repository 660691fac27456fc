"""Trigonometric polynomials: a normal form in which transforms are compared exactly.

Rotations by multiples of coordinates, and all products of them with translations along multiples of
coordinates, are made of terms c · x^n · exp(i w·x). Written so, two of them are equal if and only if their
coefficients are, sin² + cos² is 1, and derivatives are as easy as sums.
"""

from __future__ import annotations

import cmath
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca

from kineverse.intervals.graph import Term

Exponents: TypeAlias = tuple[tuple[int, float], ...]
"""Pairs of a variable and how often it occurs: its power, or the frequency of its wave; sorted."""

NOISE = 1e-14
"""What is left of a coefficient by rounding, of a motion in [m] and [rad], is this at most."""
_MOST_TERMS = 300


class TooManyTermsError(Exception):
    """A product has more terms than are looked at; no user ever sees it."""


@dataclass(frozen=True)
class TrigPolynomial:
    """A sum of coefficients · powers · waves; variables are numbered by the terms that they are."""

    terms: Mapping[tuple[Exponents, Exponents], complex]

    @staticmethod
    def constant(number: float) -> TrigPolynomial:
        """Return a number."""
        return TrigPolynomial({((), ()): complex(number)} if number else {})

    @staticmethod
    def variable(index: int) -> TrigPolynomial:
        """Return a variable."""
        return TrigPolynomial({(((index, 1.0),), ()): 1.0 + 0.0j})

    def __add__(self, other: TrigPolynomial) -> TrigPolynomial:
        total = dict(self.terms)
        for key, c in other.terms.items():
            total[key] = total.get(key, 0.0) + c
        return _drop_noise(total)

    def __neg__(self) -> TrigPolynomial:
        return self.scaled(-1.0)

    def __sub__(self, other: TrigPolynomial) -> TrigPolynomial:
        return self + (-other)

    def scaled(self, factor: complex) -> TrigPolynomial:
        """Return a multiple."""
        return TrigPolynomial({key: factor * c for key, c in self.terms.items()})

    def __mul__(self, other: TrigPolynomial) -> TrigPolynomial:
        if len(self.terms) * len(other.terms) > _MOST_TERMS**2:
            raise TooManyTermsError
        total: dict[tuple[Exponents, Exponents], complex] = {}
        for (p, w), c in self.terms.items():
            for (q, v), d in other.terms.items():
                key = _multiply_exponents(p, q), _multiply_exponents(w, v)
                total[key] = total.get(key, 0.0) + c * d
        return _drop_noise(total)

    @property
    def number(self) -> float | None:
        """The constant that it is; None if it is none."""
        if all(key == ((), ()) for key in self.terms):
            return self.terms.get(((), ()), 0j).real
        return None

    @property
    def polynomials(self) -> tuple[dict[int, tuple[float, ...]], float] | None:
        """Coefficients by variable, of its first power on, and the constant; None if it is no such sum."""
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
    def line(self) -> tuple[dict[int, float], float] | None:
        """Slopes by variable, and the constant, of a sum of multiples; None for anything else."""
        found = self.polynomials
        if found is None or any(len(coefficients) > 1 for coefficients in found[0].values()):
            return None
        return {index: slope for index, (slope,) in found[0].items()}, found[1]

    @property
    def variables(self) -> set[int]:
        """The variables that occur."""
        return {index for key in self.terms for part in key for index, _ in part}

    def wave(self) -> TrigPolynomial | None:
        """Return exp(i·x) of a sum of multiples x; None for anything else."""
        line = self.line
        if line is None:
            return None
        slopes, offset = line
        frequencies = tuple(sorted((index, w) for index, w in slopes.items() if w))
        return TrigPolynomial({((), frequencies): cmath.exp(1j * offset)})

    def derivative(self, index: int) -> TrigPolynomial:
        """Return the partial derivative by a variable."""
        total: dict[tuple[Exponents, Exponents], complex] = {}
        for (powers, waves), c in self.terms.items():
            w, n = dict(waves).get(index, 0.0), dict(powers).get(index, 0.0)
            if w:
                total[powers, waves] = total.get((powers, waves), 0.0) + 1j * w * c
            if n:
                key = _multiply_exponents(powers, ((index, -1.0),)), waves
                total[key] = total.get(key, 0.0) + n * c
        return _drop_noise(total)

    def at_zero(self, index: int) -> TrigPolynomial:
        """Return what is left where a variable is 0."""
        total: dict[tuple[Exponents, Exponents], complex] = {}
        for (powers, waves), c in self.terms.items():
            if index not in dict(powers):
                key = powers, tuple(pair for pair in waves if pair[0] != index)
                total[key] = total.get(key, 0.0) + c
        return _drop_noise(total)


class TrigPolynomialConverter:
    """Turns steps of a graph into sums of powers and waves; what is neither becomes a variable.

    With ``angles``, so does what is inside of a sine or cosine and is no sum of multiples.
    """

    def __init__(self, angles: bool = False) -> None:
        self._angles = angles
        self._known: dict[int, TrigPolynomial] = {}
        self.variables: dict[int, Term] = {}

    def of(self, term: Term) -> TrigPolynomial:
        """Return a step; its arguments are looked at first, however deep they are."""
        waiting = [term]
        while waiting:
            last = waiting[-1]
            missing = [a for a in last.args if a.index not in self._known]
            if missing:
                waiting += missing
                continue
            waiting.pop()
            if last.index not in self._known:
                found = self._step(last, [self._known[a.index] for a in last.args])
                self._known[last.index] = self._variable(last) if found is None else found
        return self._known[term.index]

    def _variable(self, term: Term) -> TrigPolynomial:
        self.variables[term.index] = term
        return TrigPolynomial.variable(term.index)

    def _step(self, term: Term, args: list[TrigPolynomial]) -> TrigPolynomial | None:
        """Return the sum that a step is, None if it is none."""
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
            return args[0].scaled(1.0 / divisor) if divisor else None
        if op in (ca.OP_SIN, ca.OP_COS):
            wave = args[0].wave()
            if wave is None and self._angles:
                wave = self._variable(term.args[0]).wave()
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
    """Return the real part of exp(i x), or its imaginary part."""
    ((powers, frequencies), c) = next(iter(wave.terms.items()))
    back = tuple((index, -w) for index, w in frequencies)
    half = -0.5j if sine else 0.5
    first = TrigPolynomial({(powers, frequencies): half * c})
    return first + TrigPolynomial({(powers, back): half.conjugate() * c.conjugate()})


def _multiply_exponents(a: Exponents, b: Exponents) -> Exponents:
    if not a or not b:
        return a or b
    total = dict(a)
    for index, n in b:
        total[index] = total.get(index, 0.0) + n
    return tuple(sorted((index, n) for index, n in total.items() if n))


def _drop_noise(terms: Mapping[tuple[Exponents, Exponents], complex]) -> TrigPolynomial:
    if len(terms) > _MOST_TERMS:
        raise TooManyTermsError
    return TrigPolynomial({key: c for key, c in terms.items() if abs(c) > NOISE})
