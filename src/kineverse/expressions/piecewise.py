"""Piecewise polynomials and cubic splines of a scalar.

A :class:`Piecewise` node selects the coefficients of the piece that contains its argument, and evaluates one
polynomial. Its gradient is a piecewise polynomial again, so it is exact at the knots too, to every order. The
cost is linear in the number of pieces, without a branch.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.lie import Array

from . import layout
from .expression import Expression, ExpressionLike, as_expression, from_casadi
from .node import Node

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

PolynomialPieces = tuple[tuple[float, ...], ...]


def spline(
    x: ExpressionLike,
    knots: Iterable[float],
    values: Iterable[float],
    periodic: bool = False,
    slopes: tuple[float, float] | None = None,
) -> Expression:
    """Return the cubic spline through points, elementwise; all of its derivatives are exact.

    Note that outside of its knots a spline continues *straight*, with the slopes at its ends. These are
    0 unless given, so it stays at its first and last value. The first derivative is continuous everywhere,
    the second between the first and the last knot. A periodic spline is twice continuously differentiable
    everywhere. At ±infinity a spline has its limit, which is the last value, or ±infinity with a slope; a
    periodic spline has no limit and is NaN there.

    Between the knots t_k and t_k+1, at a distance h and with s = x - t_k, it is::

        y_k + m_k s + (3d - 2m_k - m_k+1) s²/h + (m_k + m_k+1 - 2d) s³/h²,      d = (y_k+1 - y_k)/h

    where the slopes m_k are those for which the second derivative is continuous (de Boor, A Practical Guide
    to Splines, IV).

    Parameters
    ----------
    x
        The argument.
    knots
        At least two increasing numbers, in the unit of x.
    values
        The values at the knots.
    periodic
        True to repeat: the last knot is the first one a period later, and has the same value.
    slopes
        The derivatives at the first and the last knot, (0, 0) by default; not for a periodic spline.

    Raises
    ------
    InvalidValueError
        For knots that do not increase, another number of values than of knots, NaN, or a periodic spline with
        different first and last values.

    Examples
    --------
    >>> x = kv.position("x")
    >>> profile = kv.spline(x, knots=[0, 1, 2], values=[0, 0.1, 0])
    >>> profile({"x": 1}), profile({"x": 5})
    (np.float64(0.1), np.float64(0.0))
    >>> profile.gradient()[x.derivative()]({"x": 0.5})
    np.float64(0.15000000000000002)
    """
    t, y = _numbers(knots, "knot"), _numbers(values, "value")
    _check_knots(t)
    if len(y) != len(t):
        raise InvalidValueError(f"A spline has as many values as knots, not {len(y)} for {len(t)}.")
    if periodic and y[0] != y[-1]:
        raise InvalidValueError(
            f"A periodic spline ends where it begins: its last value {y[-1]:g} is not its first, {y[0]:g}."
        )
    if periodic and slopes is not None:
        raise InvalidValueError("A periodic spline has no ends that slopes could be given for.")
    ends = _numbers((0.0, 0.0) if slopes is None else slopes, "slope")
    if len(ends) != 2:
        raise InvalidValueError(f"A spline has two slopes, at its ends, not {len(ends)}.")
    h, rise = np.diff(t), np.diff(y)
    d = rise / h
    m = _periodic_slopes(h, d) if periodic else _slopes(h, d, *ends)
    quadratic, cubic = (3 * d - 2 * m[:-1] - m[1:]) / h, (m[:-1] + m[1:] - 2 * d) / h**2
    pieces = np.column_stack([y[:-1], m[:-1], quadratic, cubic]).tolist()
    if not periodic:
        pieces = [[y[0], ends[0], 0.0, 0.0], *pieces, [y[-1], ends[1], 0.0, 0.0]]
    return piecewise(x, periodic, t, pieces)


def piecewise(
    x: ExpressionLike, periodic: bool, knots: Sequence[float], pieces: Sequence[Sequence[float]]
) -> Expression:
    """Return a piecewise polynomial of x, elementwise."""
    operand = as_expression(x)
    return Piecewise.from_arguments((operand,), operand.shape, check_pieces(periodic, knots, pieces))


def check_pieces(
    periodic: bool, knots: Sequence[float], pieces: Sequence[Sequence[float]]
) -> tuple[bool, tuple[float, ...], PolynomialPieces]:
    """Return the options of a node, from the arguments of :func:`piecewise`."""
    t = _numbers(knots, "knot")
    _check_knots(t)
    table = tuple(tuple(_numbers(piece, "coefficient")) for piece in pieces)
    wanted = len(t) - 1 if periodic else len(t) + 1
    if len(table) != wanted:
        raise InvalidValueError(f"{len(t)} knots make {wanted} pieces here, not {len(table)}.")
    if not table[0] or len({len(piece) for piece in table}) > 1:
        raise InvalidValueError("All pieces have equally many coefficients, and at least one.")
    return bool(periodic), tuple(t), table


class Piecewise(Node):
    """A piecewise polynomial of its argument; the options are periodicity, knots and coefficients."""

    __slots__ = ()
    kind = "piecewise"
    own_partials = True

    @property
    def periodic(self) -> bool:
        """True if it repeats."""
        return bool(self.options[0])

    @property
    def knots(self) -> tuple[float, ...]:
        """The boundaries of the pieces."""
        knots: tuple[float, ...] = self.options[1]
        return knots

    @property
    def pieces(self) -> PolynomialPieces:
        """The coefficients of each piece, constant first."""
        pieces: PolynomialPieces = self.options[2]
        return pieces

    def _value(self) -> Expression:
        (x,) = self.arguments
        if not x.size:
            return x
        elements = ca.densify(layout.column(x._sx, x.shape))
        values = [self._at(elements[i]) for i in range(x.size)]
        return from_casadi(layout.from_column(ca.vertcat(*values), x.shape), x.shape, x._nodes)

    def _at(self, x: layout.SX) -> layout.SX:
        t = self.knots
        if self.periodic:
            period = t[-1] - t[0]
            x = x - period * ca.floor((x - t[0]) / period)
            starts, switches = t[:-1], t[1:-1]
        else:
            starts, switches = (t[0], *t), t
        # Exactly one of these is 1 and the others are 0, so sums of products select without rounding.
        beyond = [ca.SX(1), *(ca.SX.binary(ca.OP_LE, knot, x) for knot in switches), ca.SX(0)]
        inside = [here - further for here, further in itertools.pairwise(beyond)]
        table = ca.sparsify(ca.DM(np.column_stack([starts, self.pieces]).T))
        start, *coefficients = ca.vertsplit(ca.densify(ca.mtimes(table, ca.vertcat(*inside))))
        s = x - start
        result = coefficients[-1]
        for coefficient in reversed(coefficients[:-1]):
            result = coefficient + s * result
        if self.periodic:
            return result
        # 0 times infinity is NaN, but a constant has a limit at infinity.
        below, above = _limit(self.pieces[0], -1.0), _limit(self.pieces[-1], 1.0)
        beyond_all = ca.SX.binary(ca.OP_EQ, ca.fabs(x), math.inf)
        return ca.if_else(beyond_all, ca.if_else(x < 0, below, above), result)

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        (x,) = self.arguments
        steps = tuple(tuple(k * c for k, c in enumerate(piece) if k) for piece in self.pieces)
        if not any(map(any, steps)):
            return {}
        slope = Piecewise.from_arguments(self.arguments, self.shape, (self.periodic, self.knots, steps))
        return {key: slope * entry for key, entry in x.gradient(heuristic).items()}


def _limit(piece: tuple[float, ...], side: float) -> float:
    """Return the limit of a polynomial at infinity, or at minus infinity."""
    power, leading = next(((k, c) for k, c in reversed(list(enumerate(piece))) if c), (0, piece[0]))
    return math.copysign(math.inf, leading * side**power) if power else leading


def _numbers(given: Iterable[float], what: str) -> list[float]:
    try:
        numbers = [float(number) for number in given]
    except (TypeError, ValueError):
        raise InvalidValueError(f"Every {what} is a number, which is not so in {given!r:.80}.") from None
    for i, number in enumerate(numbers):
        if not math.isfinite(number):
            raise InvalidValueError(f"Every {what} is a finite number, and number {i} is {number}.")
    return numbers


def _check_knots(t: list[float]) -> None:
    if len(t) < 2:
        raise InvalidValueError(f"There are at least two knots, not {len(t)}.")
    for i, (before, after) in enumerate(itertools.pairwise(t)):
        if not after > before:
            raise InvalidValueError(f"Knots increase: knot {i + 1} is {after:g}, and knot {i} is {before:g}.")


def _slopes(h: Array, d: Array, first: float, last: float) -> Array:
    """Return the slopes at all knots for which the second derivative is continuous at the inner ones."""
    n = len(h)
    system, right = np.eye(n + 1), np.array([first, *np.zeros(n - 1), last])
    for k in range(1, n):
        system[k, k - 1 : k + 2] = h[k], 2 * (h[k - 1] + h[k]), h[k - 1]
        right[k] = 3 * (h[k] * d[k - 1] + h[k - 1] * d[k])
    solution: Array = np.linalg.solve(system, right)
    return solution


def _periodic_slopes(h: Array, d: Array) -> Array:
    """Return the slopes at all knots of a periodic spline, with a continuous second derivative everywhere."""
    n = len(h)
    system, right = np.zeros((n, n)), np.zeros(n)
    for k in range(n):
        for column, entry in ((k - 1, h[k]), (k, 2 * (h[k - 1] + h[k])), ((k + 1) % n, h[k - 1])):
            system[k, column] += entry
        right[k] = 3 * (h[k] * d[k - 1] + h[k - 1] * d[k])
    solution = np.linalg.solve(system, right)
    return np.append(solution, solution[0])
