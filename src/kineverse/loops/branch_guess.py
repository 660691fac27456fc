"""Initial guess of the dependent coordinates, fitted to samples of one branch.

The basis functions are Chebyshev polynomials for inputs with limits and Fourier series for full revolutions,
and their products for several inputs; for many inputs, products up to a total degree. The guess need not be
exact, because Newton's method refines it. But Newton's method must converge to this branch from every point
of the domain, which is checked on samples before a guess is used.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from kineverse.errors import NoSolutionError
from kineverse.expressions.expression import Expression, array
from kineverse.expressions.functions import cos, sin
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .branches import FIRST_STEP, continue_solution
from .equations import Equations

FEW = 3  # largest number of inputs with all products as basis, and samples on a grid

MARGIN = 0.2
"""Margin of the domain beyond each limit: relative to the range, and at least this value [m], [rad].
Estimates and controllers overstep limits."""


class InputDomain(Struct, frozen=True):
    """Domain of one input: limits, or a full revolution."""

    lower: float  # [m] or [rad]
    upper: float
    whole: bool = False  # True for an angle without limits

    def widen(self, below: float = 1.0, above: float = 1.0) -> InputDomain:
        """Return the domain widened by fractions of the margin; a full revolution stays."""
        if self.whole:
            return self
        margin = MARGIN * max(self.upper - self.lower, 1.0)
        return InputDomain(self.lower - below * margin, self.upper + above * margin)

    def samples(self, count: int) -> Array:
        """Return sample points for well-conditioned fits, in order."""
        parts = np.arange(count) + (0.0 if self.whole else 0.5)
        return self.place_points(parts / count)

    def place_points(self, parts: Array) -> Array:
        """Map numbers in [0, 1) to the domain, with the density of the sample points."""
        width = self.upper - self.lower
        if self.whole:
            return self.lower + width * parts
        return (self.lower + self.upper) / 2 - width / 2 * np.cos(parts * np.pi)

    def orders(self, degree: int) -> list[int]:
        """Return the degree of each basis function up to a degree."""
        if self.whole:
            return [(i + 1) // 2 for i in range(2 * degree + 1)]
        return [0] if self.upper == self.lower else list(range(degree + 1))

    def evaluate_basis(self, u: Array, degree: int) -> Array:
        """Evaluate the basis functions at points, shape (N, size)."""
        if self.whole:
            parts = [np.ones_like(u)]
            for k in range(1, degree + 1):
                parts += [np.cos(k * u), np.sin(k * u)]
            return np.column_stack(parts)
        if self.upper == self.lower:
            return np.ones((len(u), 1))
        t = np.clip((2 * u - self.lower - self.upper) / (self.upper - self.lower), -1, 1)
        return np.polynomial.chebyshev.chebvander(t, degree).astype(np.float64)

    def basis_expressions(self, u: Symbol, degree: int) -> list[Expression]:
        """Return the basis functions as expressions of an input."""
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


class BranchGuess(Struct, frozen=True):
    """Fitted guess: Σ coefficient · product of basis functions, plus a linear term in periodic inputs."""

    intervals: tuple[InputDomain, ...]  # (k,), of the inputs
    degree: int  # of the basis functions in each input
    coefficients: Array  # (P, n), a column for each unknown
    winding: Array  # (k, n) slopes of the unknowns over periodic inputs

    @staticmethod
    def fit(
        intervals: Sequence[InputDomain], degree: int, inputs: Array, solutions: Array, winding: Array
    ) -> BranchGuess:
        """Fit a guess to solutions (N, n) at inputs (N, k)."""
        basis = _evaluate_products(inputs, intervals, degree)
        coefficients = np.linalg.lstsq(basis, solutions - inputs @ winding, rcond=None)[0].astype(np.float64)
        # Coefficients far below the error of the fit are noise, and cost as much as others.
        coefficients[np.abs(coefficients) < 1e-14 * np.abs(coefficients).max(initial=0.0)] = 0.0
        return BranchGuess(tuple(intervals), degree, coefficients, winding)

    def evaluate(self, inputs: Array) -> Array:
        """Return the guesses at inputs (N, k), shape (N, n)."""
        basis = _evaluate_products(inputs, self.intervals, self.degree)
        return basis @ self.coefficients + inputs @ self.winding

    @property
    def terms(self) -> int:
        """Number of terms."""
        return int(np.count_nonzero(self.coefficients))

    def expression(self, inputs: Sequence[Symbol]) -> Expression:
        """Return the guesses as an expression of shape (n,)."""
        bases = [i.basis_expressions(u, self.degree) for i, u in zip(self.intervals, inputs, strict=True)]
        products = []
        for which in list_products(self.intervals, self.degree):
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


def _evaluate_products(inputs: Array, intervals: Sequence[InputDomain], degree: int) -> Array:
    """Evaluate the products of basis functions at points, shape (N, P)."""
    which = list_products(intervals, degree)
    result = np.ones((len(inputs), len(which)))
    for column, interval, i in zip(inputs.T, intervals, np.array(which, dtype=int).T, strict=True):
        result *= interval.evaluate_basis(column, degree)[:, i]
    return result


def list_products(intervals: Sequence[InputDomain], degree: int) -> list[tuple[int, ...]]:
    """Return the index of the basis function of each input for each product."""
    most = degree if len(intervals) > FEW else degree * len(intervals)
    result: list[tuple[tuple[int, ...], int]] = [((), 0)]
    for interval in intervals:
        orders = interval.orders(degree)
        result = [
            ((*which, i), total + order)
            for which, total in result
            for i, order in enumerate(orders)
            if total + order <= most
        ]
    return [which for which, _ in result]


_SAMPLES = {1: 65, 2: 17, 3: 9}
_SCATTERED = 400
_TRIED = 200
_MOST_CORNERED = 8
_SHOWN = 6


class BranchSamples:
    """Samples of one solution branch over the domain, which contains the limits."""

    def __init__(
        self,
        name: str,
        equations: Equations,
        limits: Sequence[InputDomain],
        intervals: Sequence[InputDomain],
        x: Array,
        u: Array,
        angles: npt.NDArray[np.bool_],
    ) -> None:
        self.name, self.equations, self.intervals = name, equations, intervals
        self._given = u[len(intervals) :]
        self._angles = angles
        k = len(intervals)
        generator = np.random.default_rng(1)
        lower = np.array([i.lower for i in intervals])
        upper = np.array([i.upper for i in intervals])
        home = np.clip(u[:k], lower, upper)
        x = self._continue(x, u[:k], home)
        if k <= FEW:
            grid = _grid([i.samples(_SAMPLES.get(k, 1)) for i in intervals])
        else:  # a grid would have too many points
            parts = generator.uniform(size=(_SCATTERED, k))
            grid = np.column_stack([i.place_points(p) for i, p in zip(intervals, parts.T, strict=True)])
        corners = np.vstack([_corners(limits, generator), _corners(intervals, generator)])
        tried = np.vstack([corners, generator.uniform(lower, upper, (_TRIED, k))])
        everywhere = np.vstack([home, grid, tried])
        solutions = self._continue_to(x, everywhere)
        self.inputs, self.solutions = everywhere[: len(grid) + 1], solutions[: len(grid) + 1]
        self.tried, self.wanted = everywhere[len(grid) + 1 :], solutions[len(grid) + 1 :]
        self.winding = self._winding(x, home)
        inside = np.ones(len(everywhere), dtype=bool)
        for column, limit in zip(everywhere.T, limits, strict=True):
            inside &= (column >= limit.lower) & (column <= limit.upper)
        points = zip(everywhere[inside], solutions[inside], strict=True)
        ratios = np.array([regularity(equations, s, self.all_inputs(q)) for q, s in points])
        self.condition = float(ratios.min())
        self.worst = everywhere[inside][int(ratios.argmin())]

    def all_inputs(self, q: Array) -> Array:
        """Return free coordinates (..., k) followed by the parameters."""
        return np.concatenate([q, np.broadcast_to(self._given, (*q.shape[:-1], len(self._given)))], axis=-1)

    def changes_sign(self, rows: Sequence[int]) -> bool:
        """Return whether det ∂r/∂x of these rows changes its sign, so that it is zero in between."""
        points = zip((*self.inputs, *self.tried), (*self.solutions, *self.wanted), strict=True)
        matrices = (self.equations(x, self.all_inputs(q))[1][list(rows)] for q, x in points)
        return len({float(np.linalg.slogdet(matrix)[0]) for matrix in matrices}) > 1

    def _continue(self, x: Array, start: Array, end: Array, first_step: float = FIRST_STEP) -> Array:
        inputs = self.all_inputs(start), self.all_inputs(end)
        reached = continue_solution(self.equations, x, *inputs, first_step)
        if reached.part < 1.0:
            there = start + reached.part * (end - start)
            at = format_point(self.equations.inputs, there)
            to = format_point(self.equations.inputs, end, named=False)
            raise NoSolutionError(
                f"Loop '{self.name}' does not close between home and {to}: it ends, or is singular, at {at}. "
                "Narrow the limits, or the loop's within={...}, so that it closes everywhere."
            )
        return reached.solution

    def _continue_to(self, x: Array, points: Array) -> Array:
        """Return the solutions at points, each continued from the nearest known one."""
        scale = np.array([max(i.upper - i.lower, 1e-12) for i in self.intervals])
        solutions = np.zeros((len(points), len(x)))
        solutions[0] = self._continue(x, points[0], points[0])
        left = np.arange(1, len(points))
        nearest = np.zeros(len(points), dtype=int)
        distance = np.abs((points - points[0]) / scale).max(axis=1, initial=0.0)
        while len(left):
            position = int(distance[left].argmin())
            i, left = left[position], np.delete(left, position)
            begin = nearest[i]
            solutions[i] = self._continue(solutions[begin], points[begin], points[i], first_step=1.0)
            closer = np.abs((points - points[i]) / scale).max(axis=1, initial=0.0)
            better = closer < distance
            nearest[better], distance[better] = i, closer[better]
        return solutions

    def _winding(self, x: Array, home: Array) -> Array:
        """Return the slopes of the unknowns over a full revolution of each periodic input, per radian."""
        winding = np.zeros((len(home), len(x)))
        for k, interval in enumerate(self.intervals):
            if not interval.whole:
                continue
            end = home.copy()
            end[k] += 2 * np.pi
            grown = (self._continue(x, home, end) - x) / (2 * np.pi)
            whole = np.abs(grown - np.round(grown)) < 1e-6
            if not np.all(whole | ~self._angles):
                raise NoSolutionError(
                    f"Loop '{self.name}' is on another branch after a turn of '{self.equations.inputs[k]}': "
                    "it goes through a singular configuration. Limit that coordinate."
                )
            # A length may grow with revolutions, as for a nut on a screw; rounding errors of 0 are removed.
            lengths = np.where(np.abs(grown) < 1e-9, 0.0, grown)
            winding[k] = np.where(self._angles, np.round(grown), lengths)
        return winding


def regularity(equations: Equations, x: Array, u: Array) -> float:
    """Return the ratio of the smallest to the largest singular value of ∂r/∂x."""
    values = np.linalg.svd(equations(x, u)[1], compute_uv=False)
    return float(values[-1] / max(values[0], 1e-30))


def format_point(symbols: Sequence[Symbol], values: Array, named: bool = True) -> str:
    """Format the values of the first few inputs for a message."""
    pairs = list(zip(symbols, values.tolist(), strict=False))
    shown = ", ".join(f"{s} = {v:.6g}" if named else f"{v:.6g}" for s, v in pairs[:_SHOWN])
    return shown + (", ..." if len(pairs) > _SHOWN else "")


def _corners(intervals: Sequence[InputDomain], generator: np.random.Generator) -> Array:
    ends = np.array([(i.lower, i.upper) for i in intervals]).reshape(-1, 2)
    if len(ends) <= _MOST_CORNERED:
        return _grid(list(ends))
    which = generator.integers(0, 2, (1 << _MOST_CORNERED, len(ends)))
    return np.take_along_axis(ends, which.T, axis=1).T


def _grid(axes: Sequence[Array]) -> Array:
    points = list(itertools.product(*axes))
    return np.array(points).reshape(len(points), len(axes))
