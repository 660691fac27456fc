"""Nonsmooth nodes: selection, extrema, Euclidean norm and power.

They are written so that a gradient is finite wherever a derivative can be given: what was not chosen is never
multiplied, and the norm has gradient 0 at the origin.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from .expression import (
    Expression,
    ExpressionLike,
    array,
    as_expression,
    binary,
    broadcast,
    from_casadi,
    unary,
    union_nodes,
)
from .layout import SX
from .node import Node

if TYPE_CHECKING:
    from kineverse.symbols import Symbol


class Select(Node):
    """``where``: its arguments are condition and branches, all of the node's shape."""

    __slots__ = ()
    kind = "select"
    own_partials = True

    @property
    def _holds(self) -> Expression:
        return binary(ca.OP_LE, 0.5, self.arguments[0])

    def _value(self) -> Expression:
        return self._chosen(self.arguments[1], self.arguments[2])

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        a, b = (argument.gradient(heuristic) for argument in self.arguments[1:])
        zero = as_expression(np.zeros(self.shape))
        return {key: self._chosen(a.get(key, zero), b.get(key, zero)) for key in {**a, **b}}

    def _chosen(self, if_true: Expression, if_false: Expression) -> Expression:
        from .implicit import implicit_nodes

        if implicit_nodes(self.arguments[:1]):
            # A loop that does not close here is NaN. Nothing is chosen then, and evaluation says why.
            fails = binary(ca.OP_LT, self.arguments[0], 0.5)
            neither = from_casadi(ca.SX.nan(*if_false._sx.shape), if_false.shape, frozenset())
            if_false = _select(fails, if_false, neither)
        return _select(self._holds, if_true, if_false)

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return the branches; the condition selects and has no part in the gradient."""
        return self.arguments[1:]


def _select(holds: Expression, if_true: Expression, if_false: Expression) -> Expression:
    """Return a choice by a comparison; CasADi keeps such choices free of NaN in every derivative."""
    return from_casadi(
        ca.if_else(holds._sx, if_true._sx, if_false._sx),
        holds._shape,
        union_nodes((holds, if_true, if_false)),
    )


class Extremum(Node):
    """``minimum`` and ``maximum`` of two or more arguments of the node's shape."""

    __slots__ = ()
    kind = "extremum"
    own_partials = True

    @property
    def label(self) -> str:
        """``minimum`` or ``maximum``."""
        return f"{self.options[0]}imum"

    def _value(self) -> Expression:
        number = _reduce_pairwise(ca.OP_FMIN if self.options[0] == "min" else ca.OP_FMAX, self.arguments)
        # Where an argument is NaN this is NaN, and else a number or infinite. CasADi takes x == x for true,
        # and 0 <= sqrt(x) too.
        size = _reduce_pairwise(ca.OP_ADD, [unary(ca.OP_FABS, a) for a in self.arguments])
        unordered = unary(ca.OP_NOT, binary(ca.OP_LE, size, math.inf))
        # Subtracted, because -0 + 0 would be another zero.
        return number - binary(ca.OP_IF_ELSE_ZERO, unordered, size)

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        won = [binary(ca.OP_EQ, argument, self.value) for argument in self.arguments]
        each = 1 / _reduce_pairwise(ca.OP_ADD, won)
        result: dict[Symbol, Expression] = {}
        for argument, wins in zip(self.arguments, won, strict=True):
            share = wins * each  # 1, 0, at a tie 1/n; of NaN 0/0, NaN as well
            for key, entry in argument.gradient(heuristic).items():
                # Zero times NaN would be NaN; what has no share is not looked at.
                term = binary(ca.OP_IF_ELSE_ZERO, share, share * entry)
                result[key] = result[key] + term if key in result else term
        return result


def _reduce_pairwise(op: int, operands: Sequence[Expression]) -> Expression:
    """Return operands joined in pairs, these again in pairs, and so on: a thousand are ten deep."""
    joined = list(operands)
    while len(joined) > 1:
        odd = joined[-1:] if len(joined) % 2 else []
        joined = [binary(op, x, y) for x, y in zip(joined[:-1:2], joined[1::2], strict=False)] + odd
    return joined[0]


class Norm(Node):
    """The Euclidean norm of one vector; its first and second derivatives at the origin are 0."""

    __slots__ = ()
    kind = "norm"
    own_partials = True

    @property
    def unscaled(self) -> Expression:
        """√Σ x²: what the norm is in real numbers, and in doubles unless a square leaves their range."""
        return _root_of_squares(self.arguments[0])

    def _value(self) -> Expression:
        # A power of two changes no digit, and 1 none at all. It brings huge and tiny vectors to where squares
        # neither overflow nor vanish.
        (vector,) = self.arguments
        squares = from_casadi(ca.sumsqr(vector._sx), (), vector._nodes)
        huge, tiny = binary(ca.OP_LT, _LARGE, squares), binary(ca.OP_LT, squares, _SMALL)
        scale = _select(huge, 1 / _SCALE, _select(tiny, _SCALE, as_expression(1.0)))
        return _root_of_squares(vector * scale) / scale

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        (vector,) = self.arguments
        # Divided first: a product of two large numbers may be too large.
        zero = as_expression(np.zeros(vector.shape))
        away = binary(ca.OP_LT, zero, self.value)
        direction = Select.of((away, vector / self.value, zero), vector.shape)
        return {key: direction @ entry for key, entry in vector.gradient(heuristic).items()}


_LARGE, _SMALL = as_expression(1e300), as_expression(1e-280)
_SCALE = as_expression(2.0**600)


def _root_of_squares(vector: Expression) -> Expression:
    return unary(ca.OP_SQRT, from_casadi(ca.sumsqr(vector._sx), (), vector._nodes))


class Power(Node):
    """One scalar to the power of another that is not constant.

    CasADi's derivatives are NaN at 0, where log is infinite; these are right wherever there is one.
    """

    __slots__ = ()
    kind = "power"
    own_partials = True

    @staticmethod
    def is_needed(base: SX, exponent: SX) -> bool:
        """Return whether a power may have derivatives that CasADi does not know: those of 0 to something."""
        return not exponent.is_constant() and not (
            base.is_constant() and all(float(element) for element in base.elements())
        )

    def _value(self) -> Expression:
        return binary(ca.OP_POW, *self.arguments)

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        base, exponent = self.arguments
        at_zero, zero = binary(ca.OP_EQ, base, 0.0), as_expression(0.0)
        # 0⁰ is 1, as x⁰ is for every x; and 0ʸ is 0 for every positive y.
        one = at_zero * binary(ca.OP_EQ, exponent, 0.0)
        nothing = at_zero * binary(ca.OP_LT, 0.0, exponent)
        of_base, of_exponent = base.gradient(heuristic), exponent.gradient(heuristic)
        result: dict[Symbol, Expression] = {}
        if of_base:
            slope = Select.of((one, zero, exponent * power(base, exponent - 1)), ())
            result = {key: slope * entry for key, entry in of_base.items()}
        if of_exponent:
            slope = Select.of((nothing, zero, self.value * unary(ca.OP_LOG, base)), ())
            for key, entry in of_exponent.items():
                result[key] = result[key] + slope * entry if key in result else slope * entry
        return result


def power(base: ExpressionLike, exponent: ExpressionLike) -> Expression:
    """Return the power, elementwise, with derivatives wherever they exist: at 0 too."""
    x, y = as_expression(base), as_expression(exponent)
    if not Power.is_needed(x._sx, y._sx):
        return binary(ca.OP_POW, x, y)
    x, y = broadcast(x, y)
    if not x.shape:
        return Power.of((x, y), ())
    pairs = zip(x.ravel(), y.ravel(), strict=True)
    return array([power(a, b) for a, b in pairs]).reshape(x.shape)
