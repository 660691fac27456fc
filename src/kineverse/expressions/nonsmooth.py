"""Nonsmooth nodes: selection, extrema, Euclidean norm and power.

Their gradients are finite wherever a derivative exists: branches that are not selected are never multiplied.
The gradient of the norm at the origin is 0.
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
    """``where``, with condition and branches as arguments, all of the node's shape."""

    __slots__ = ()
    kind = "select"
    own_partials = True

    @property
    def _is_true(self) -> Expression:
        return binary(ca.OP_LE, 0.5, self.arguments[0])

    def _value(self) -> Expression:
        return self._select(self.arguments[1], self.arguments[2])

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        a, b = (argument.gradient(heuristic) for argument in self.arguments[1:])
        zero = as_expression(np.zeros(self.shape))
        return {key: self._select(a.get(key, zero), b.get(key, zero)) for key in {**a, **b}}

    def _select(self, if_true: Expression, if_false: Expression) -> Expression:
        from .implicit import implicit_nodes

        if implicit_nodes(self.arguments[:1]):
            # A loop that does not close is NaN. Then the result is NaN too, and evaluation raises the reason.
            fails = binary(ca.OP_LT, self.arguments[0], 0.5)
            neither = from_casadi(ca.SX.nan(*if_false._sx.shape), if_false.shape, frozenset())
            if_false = _select(fails, if_false, neither)
        return _select(self._is_true, if_true, if_false)

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return the branches; the condition has no part in the gradient."""
        return self.arguments[1:]


def _select(holds: Expression, if_true: Expression, if_false: Expression) -> Expression:
    """Return a selection by a comparison; CasADi keeps selections free of NaN in every derivative."""
    chosen = ca.if_else(holds._sx, if_true._sx, if_false._sx)
    return from_casadi(chosen, holds._shape, union_nodes((holds, if_true, if_false)))


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
        # NaN if an argument is NaN, else a number or infinity. CasADi simplifies x == x, and also
        # 0 <= sqrt(x), to true.
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
                # Zero times NaN would be NaN, so terms without a share are selected out.
                term = binary(ca.OP_IF_ELSE_ZERO, share, share * entry)
                result[key] = result[key] + term if key in result else term
        return result


def _reduce_pairwise(op: int, operands: Sequence[Expression]) -> Expression:
    """Return operands joined pairwise by an operation, in a tree of logarithmic depth."""
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
        """√Σ x², which equals the norm unless a square overflows or underflows."""
        return _root_of_squares(self.arguments[0])

    def _value(self) -> Expression:
        # Scaling by a power of two is exact. It brings huge and tiny vectors to a range in which squares
        # neither overflow nor underflow.
        (vector,) = self.arguments
        squares = from_casadi(ca.sumsqr(vector._sx), (), vector._nodes)
        huge, tiny = binary(ca.OP_LT, _LARGE, squares), binary(ca.OP_LT, squares, _SMALL)
        scale = _select(huge, 1 / _SCALE, _select(tiny, _SCALE, as_expression(1.0)))
        return _root_of_squares(vector * scale) / scale

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        (vector,) = self.arguments
        # Divided first, because a product of two large numbers may overflow.
        zero = as_expression(np.zeros(vector.shape))
        away = binary(ca.OP_LT, zero, self.value)
        direction = Select.from_arguments((away, vector / self.value, zero), vector.shape)
        return {key: direction @ entry for key, entry in vector.gradient(heuristic).items()}


_LARGE, _SMALL = as_expression(1e300), as_expression(1e-280)
_SCALE = as_expression(2.0**600)


def _root_of_squares(vector: Expression) -> Expression:
    return unary(ca.OP_SQRT, from_casadi(ca.sumsqr(vector._sx), (), vector._nodes))


class Power(Node):
    """A scalar to the power of a scalar that is not constant.

    CasADi's derivatives are NaN at base 0, where the logarithm is infinite; those of this node are not.
    """

    __slots__ = ()
    kind = "power"
    own_partials = True

    @staticmethod
    def is_needed(base: SX, exponent: SX) -> bool:
        """Return True if a power may have derivatives that CasADi lacks: those at base 0."""
        never_zero = base.is_constant() and all(float(element) for element in base.elements())
        return not exponent.is_constant() and not never_zero

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
            slope = Select.from_arguments((one, zero, exponent * power(base, exponent - 1)), ())
            result = {key: slope * entry for key, entry in of_base.items()}
        if of_exponent:
            slope = Select.from_arguments((nothing, zero, self.value * unary(ca.OP_LOG, base)), ())
            for key, entry in of_exponent.items():
                result[key] = result[key] + slope * entry if key in result else slope * entry
        return result


def power(base: ExpressionLike, exponent: ExpressionLike) -> Expression:
    """Return the power, elementwise, with derivatives wherever they exist, also at base 0."""
    x, y = as_expression(base), as_expression(exponent)
    if not Power.is_needed(x._sx, y._sx):
        return binary(ca.OP_POW, x, y)
    x, y = broadcast(x, y)
    if not x.shape:
        return Power.from_arguments((x, y), ())
    pairs = zip(x.ravel(), y.ravel(), strict=True)
    return array([power(a, b) for a, b in pairs]).reshape(x.shape)
