"""First guesses of unknowns as smooth functions of the inputs, fitted to one branch of solutions.

Over inputs within limits they are Chebyshev polynomials, over whole turns Fourier series; over several inputs
products of these, and over many inputs only those whose degrees add up to no more than the degree. They need
not be exact, Newton's method makes them so; but from every point of the domain it has to arrive at this
branch, and that is tried out before a seed is used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kineverse.expressions.expression import Expression, array
from kineverse.expressions.functions import cos, sin
from kineverse.symbols import Symbol

from .equations import Array

FEW = 3
"""Up to how many inputs all products are used, and samples lie on a grid."""

MARGIN = 0.2
"""How much further than its limits a loop is continued on each side: of their distance, and at least [m] or
[rad]. Estimates and controllers overstep limits."""


@dataclass(frozen=True)
class Interval:
    """The domain of one input: limits, or a whole turn.

    Attributes
    ----------
    lower, upper
        [m] or [rad].
    whole
        Whether it is an angle that goes round.
    """

    lower: float
    upper: float
    whole: bool = False

    def wider(self, below: float = 1.0, above: float = 1.0) -> Interval:
        """Return limits with parts of a margin around them; whole turns have none."""
        if self.whole:
            return self
        margin = MARGIN * max(self.upper - self.lower, 1.0)
        return Interval(self.lower - below * margin, self.upper + above * margin)

    def samples(self, count: int) -> Array:
        """Return points at which fits are well behaved, in order."""
        parts = np.arange(count) + (0.0 if self.whole else 0.5)
        return self.spread(parts / count)

    def spread(self, parts: Array) -> Array:
        """Return points for numbers in [0, 1): dense where fits need it."""
        width = self.upper - self.lower
        if self.whole:
            return self.lower + width * parts
        return (self.lower + self.upper) / 2 - width / 2 * np.cos(parts * np.pi)

    def orders(self, degree: int) -> list[int]:
        """Return the degree of each of the basis functions up to one."""
        if self.whole:
            return [(i + 1) // 2 for i in range(2 * degree + 1)]
        return [0] if self.upper == self.lower else list(range(degree + 1))

    def numbers(self, u: Array, degree: int) -> Array:
        """Return the basis functions at points, shape (N, size)."""
        if self.whole:
            parts = [np.ones_like(u)]
            for k in range(1, degree + 1):
                parts += [np.cos(k * u), np.sin(k * u)]
            return np.column_stack(parts)
        if self.upper == self.lower:
            return np.ones((len(u), 1))
        t = np.clip((2 * u - self.lower - self.upper) / (self.upper - self.lower), -1, 1)
        return np.polynomial.chebyshev.chebvander(t, degree).astype(np.float64)

    def functions(self, u: Symbol, degree: int) -> list[Expression]:
        """Return the same as expressions."""
        one = array(1.0)
        if self.upper == self.lower:
            return [one]
        if self.whole:
            c, s = cos(u), sin(u)
            result, (ck, sk) = [one], (c, s)
            for _ in range(degree):
                result += [ck, sk]
                ck, sk = ck * c - sk * s, sk * c + ck * s
            return result
        t = (2 * u - self.lower - self.upper) / (self.upper - self.lower)
        result = [one, t]
        while len(result) <= degree:
            result.append(2 * t * result[-1] - result[-2])
        return result[: degree + 1]


@dataclass(frozen=True)
class Seed:
    """A fitted guess: Σ coefficients · products of basis functions, and what grows with every turn.

    Attributes
    ----------
    intervals
        The domain of each input, shape (k,).
    degree
        Of the basis functions in each of them.
    coefficients
        One column for each unknown, shape (P, n).
    winding
        How unknowns grow with inputs that go round, shape (k, n).
    """

    intervals: tuple[Interval, ...]
    degree: int
    coefficients: Array
    winding: Array

    @staticmethod
    def fit(
        intervals: Sequence[Interval], degree: int, inputs: Array, solutions: Array, winding: Array
    ) -> Seed:
        """Fit a seed to solutions (N, n) at inputs (N, k)."""
        basis = _products(inputs, intervals, degree)
        coefficients = np.linalg.lstsq(basis, solutions - inputs @ winding, rcond=None)[0].astype(np.float64)
        # What is far below the error of the fit is noise, and costs as much as any other term.
        coefficients[np.abs(coefficients) < 1e-14 * np.abs(coefficients).max(initial=0.0)] = 0.0
        return Seed(tuple(intervals), degree, coefficients, winding)

    def at(self, inputs: Array) -> Array:
        """Return the guesses at inputs (N, k), shape (N, n)."""
        basis = _products(inputs, self.intervals, self.degree)
        return basis @ self.coefficients + inputs @ self.winding

    @property
    def terms(self) -> int:
        """The number of terms that are summed."""
        return int(np.count_nonzero(self.coefficients))

    def expression(self, inputs: Sequence[Symbol]) -> Expression:
        """Return the guesses as an expression of shape (n,)."""
        bases = [i.functions(u, self.degree) for i, u in zip(self.intervals, inputs, strict=True)]
        products = []
        for which in products_of(self.intervals, self.degree):
            product = array(1.0)
            for basis, i in zip(bases, which, strict=True):
                product = product * basis[i]
            products.append(product)
        guesses = []
        for column, grows in zip(self.coefficients.T, self.winding.T, strict=True):
            guess = array(0.0)
            for c, product in zip(column.tolist(), products, strict=True):
                guess = guess + c * product if c else guess
            for rate, u in zip(grows.tolist(), inputs, strict=True):
                guess = guess + rate * u if rate else guess
            guesses.append(guess)
        return array(guesses)


def _products(inputs: Array, intervals: Sequence[Interval], degree: int) -> Array:
    """Return the products of basis functions at points, shape (N, P)."""
    which = products_of(intervals, degree)
    result = np.ones((len(inputs), len(which)))
    for column, interval, i in zip(inputs.T, intervals, np.array(which, dtype=int).T, strict=True):
        result *= interval.numbers(column, degree)[:, i]
    return result


def products_of(intervals: Sequence[Interval], degree: int) -> list[tuple[int, ...]]:
    """Return which basis function of each input each product is made of."""
    most = degree if len(intervals) > FEW else degree * len(intervals)
    found: list[tuple[tuple[int, ...], int]] = [((), 0)]
    for interval in intervals:
        orders = interval.orders(degree)
        found = [
            ((*which, i), total + order)
            for which, total in found
            for i, order in enumerate(orders)
            if total + order <= most
        ]
    return [which for which, _ in found]
