"""Continuous boolean logic (2020 paper, III-C and Eq. 4).

Values lie in [0, 1]. Every node has two kinds of derivative: as a *fact* it is locally constant, and its
*trend* is a direction in which it becomes true. ``gradient()`` contains trends; ``gradient(heuristic=False)``
leaves them out.

For operands ``v_i`` with trends ``D_i``, ``P = Π v_i`` and ``Q = Π (1 - v_i)``:

=========  ==================  ==========================
node       value               trend
=========  ==================  ==========================
less(φ,ψ)  (1+tanh((ψ-φ)R))/2  D(ψ) - D(φ)
not        1 - v               -D
and        P                   Σ (1 - v_i + P)·D_i
or         1 - Q               Σ (v_i + Q)·D_i
=========  ==================  ==========================

The trend of ``and`` is the product rule if at most one operand is false, and the plain sum if all are, where
the product rule is zero. Operands that are true do not contribute. It is dual to the trend of ``or`` under De
Morgan. ``a * b`` and ``1 - a`` keep the product rule, as in the papers; locks use ``&`` and ``~``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import reduce
from numbers import Real
from typing import ClassVar

import casadi as ca

from kineverse.errors import ExpressionError, InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression, binary, broadcast
from kineverse.expressions.functions import absolute, tanh
from kineverse.expressions.node import Node
from kineverse.symbols import Symbol

__all__ = ["CONTRAST", "less", "logic_and", "logic_not", "logic_or"]

CONTRAST = 1e10
"""Contrast of comparisons by default: they change from 0 to 1 within about 1e-10 around equality."""


def less(a: ExpressionLike, b: ExpressionLike, contrast: float = CONTRAST) -> Expression:
    """Return the truth of a < b: 1 or 0, and 0.5 at equality, also of two equal infinities.

    Parameters
    ----------
    a, b
        The operands, compared elementwise.
    contrast
        R, per unit: the value changes within about 1/R around equality.

    Examples
    --------
    >>> q = kv.position("q")
    >>> kv.logic.less(q, 1)({"q": 0.2}), kv.logic.less(q, 1)({"q": 1}), (q < 1)({"q": 3})
    (np.float64(1.0), np.float64(0.5), np.float64(0.0))
    """
    if not isinstance(contrast, Real) or not 0 < contrast < math.inf:
        raise InvalidValueError(f"The contrast is a positive number, not {contrast!r}.")
    x, y = broadcast(as_expression(a), as_expression(b))
    return Less.from_arguments((x, y), x.shape, (float(contrast),))


def logic_not(a: ExpressionLike) -> Expression:
    """Return the truth of "not a"; also ``~a``.

    Examples
    --------
    >>> kv.logic.logic_not(kv.position("q") < 1)({"q": 3})
    np.float64(1.0)
    """
    operand = as_expression(a)
    return Not.from_arguments((operand,), operand.shape)


def logic_and(*operands: ExpressionLike) -> Expression:
    """Return the truth of "all of them"; also ``a & b``.

    Examples
    --------
    >>> q = kv.position("q")
    >>> inside = kv.logic.logic_and(0 < q, q < 1)
    >>> inside({"q": 0.5}), inside({"q": 2})
    (np.float64(1.0), np.float64(0.0))
    """
    return _join(And, operands)


def logic_or(*operands: ExpressionLike) -> Expression:
    """Return the truth of "at least one of them"; also ``a | b``.

    Examples
    --------
    >>> bolt, q = kv.position("bolt"), kv.position("door")
    >>> free = kv.logic.logic_or(bolt > 0.01, q > 0.2)
    >>> free({"bolt": 0, "door": 0.5})
    np.float64(1.0)
    >>> free.gradient()[bolt.derivative()]({"bolt": 0, "door": 0.1})  # drawing the bolt frees the door
    np.float64(1.0)
    """
    return _join(Or, operands)


def _join(kind: type[_Joined], operands: tuple[ExpressionLike, ...]) -> Expression:
    if not operands:
        raise ExpressionError(f"'{kind.kind}' needs at least one operand.")
    flat: list[Expression] = []
    for operand in operands:
        expression = as_expression(operand)
        # (a & b) & c is flattened to a & b & c, because the trend is defined over all operands together.
        inner = _is_only(expression, kind)
        flat.extend(inner.arguments if inner is not None else (expression,))
    if len(flat) == 1 and _is_only(flat[0], _Logic) is not None:
        return flat[0]
    shaped = broadcast(*flat)
    return kind.from_arguments(shaped, shaped[0].shape)


def _is_only(expression: Expression, kind: type[object]) -> Node | None:
    """Return the node if the expression consists of one node of this kind."""
    if len(expression._nodes) != 1:
        return None
    (node,) = expression._nodes
    if isinstance(node, kind) and node.shape == expression.shape and ca.is_equal(expression._sx, node.sx):
        return node
    return None


class _Logic(Node):
    """Base of nodes with a trend as their only gradient."""

    __slots__ = ()
    symbol: ClassVar[str]

    def _gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        return self._trend() if heuristic else {}

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return the operands, for a trend; none for facts, as the node is locally constant."""
        return self.arguments if heuristic else ()

    def _trend(self) -> Mapping[Symbol, Expression]:
        raise NotImplementedError


class Less(_Logic):
    """The truth of one expression being less than another."""

    __slots__ = ()
    kind = "less"

    def _value(self) -> Expression:
        return (1 + tanh(self._excess() * self.options[0])) / 2

    def _excess(self) -> Expression:
        """Return b - a, and 0 if both are the same infinity."""
        a, b = self.arguments
        difference = b - a
        if _is_finite(a) or _is_finite(b):
            return difference
        # The difference of equal infinities is NaN and becomes 0; NaN operands stay NaN.
        number = binary(ca.OP_LE, absolute(difference), math.inf)
        return binary(ca.OP_IF_ELSE_ZERO, binary(ca.OP_OR, number, binary(ca.OP_NE, a, b)), difference)

    def _trend(self) -> Mapping[Symbol, Expression]:
        a, b = self.arguments
        return weighted_sum([(-1, a.gradient()), (1, b.gradient())])


def _is_finite(x: Expression) -> bool:
    return bool(x._sx.is_constant()) and all(math.isfinite(float(e)) for e in x._sx.elements())


class Not(_Logic):
    """Negation."""

    __slots__ = ()
    kind = "not"

    def _value(self) -> Expression:
        return 1 - self.arguments[0]

    def _trend(self) -> Mapping[Symbol, Expression]:
        return weighted_sum([(-1, self.arguments[0].gradient())])


class _Joined(_Logic):
    """Conjunction and disjunction."""

    __slots__ = ()


class And(_Joined):
    """Conjunction of any number of operands."""

    __slots__ = ()
    kind = "and"

    def _value(self) -> Expression:
        return reduce(lambda a, b: a * b, self.arguments)

    def _trend(self) -> Mapping[Symbol, Expression]:
        return weighted_sum([(1 - v + self.value, v.gradient()) for v in self.arguments])


class Or(_Joined):
    """Disjunction of any number of operands."""

    __slots__ = ()
    kind = "or"

    def _value(self) -> Expression:
        return 1 - self._all_false()

    def _all_false(self) -> Expression:
        return reduce(lambda a, b: a * b, [1 - v for v in self.arguments])

    def _trend(self) -> Mapping[Symbol, Expression]:
        return weighted_sum([(v + self._all_false(), v.gradient()) for v in self.arguments])


def weighted_sum(terms: list[tuple[ExpressionLike, Mapping[Symbol, Expression]]]) -> dict[Symbol, Expression]:
    """Return ``Σ weight·gradient`` over the union of keys of all gradients."""
    result: dict[Symbol, Expression] = {}
    for weight, gradient in terms:
        for key, entry in gradient.items():
            term = weight * entry
            result[key] = result[key] + term if key in result else term
    return result
