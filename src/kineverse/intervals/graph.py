"""Expression graphs as elementary operations with logic, choices and kinks visible.

CasADi's graph of an expression contains Kineverse's nodes as symbols. A :class:`TermGraph` combines both:
arithmetic operations together with ``less``, ``select``, ``min``, ``max`` and piecewise polynomials, at which
a case split branches. Equal operations are one object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from kineverse.expressions import layout
from kineverse.expressions.expression import NODES, SYMBOLS, Expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.implicit import Implicit
from kineverse.expressions.node import Node
from kineverse.expressions.nonsmooth import Extremum, Norm, Select
from kineverse.expressions.piecewise import Piecewise
from kineverse.logic import Less
from kineverse.symbols import Symbol

SHARP_CONTRAST = 1e7  # contrast [per unit] from which on the ramp of less is neglected: it is a step
SATURATED = 20.0  # an argument from which on tanh is 1 to the last bit

_IMPLICIT = "implicit"
DOMAINS: dict[int, tuple[float, float]] = {
    ca.OP_SQRT: (0, math.inf),
    ca.OP_LOG: (0, math.inf),
    ca.OP_ASIN: (-1, 1),
    ca.OP_ACOS: (-1, 1),
    ca.OP_ATANH: (-1, 1),
    ca.OP_ACOSH: (1, math.inf),
    ca.OP_LOG1P: (-1, math.inf),
}
_COMPARISONS = (ca.OP_LT, ca.OP_LE, ca.OP_EQ, ca.OP_NE)


@dataclass(frozen=True, eq=False)
class Term:
    """Operation (by CasADi's number, or a name) on other terms."""

    index: int  # arguments have smaller ones
    op: int | str
    args: tuple[Term, ...]
    data: Any = None  # number of a constant, a symbol, a contrast, or a node
    deciders: tuple[Term, ...] = field(default=(), repr=False)


class TermGraph:
    """The terms of one or more expressions.

    See Also
    --------
    kineverse.intervals.enclose_bound
    """

    def __init__(self, constants: Mapping[Symbol, float]) -> None:
        self._given = constants
        self._known: dict[Any, Term] = {}
        self._node_terms: dict[Node, list[Term]] = {}

    def term(self, expression: Expression) -> Term:
        """Return the term of a scalar expression."""
        (term,) = self.elements(expression)
        return term

    def elements(self, expression: Expression) -> list[Term]:
        """Return the terms of the elements of an expression, column by column."""
        nodes = topological_order(leaves(expression)[1], _parts, self._node_terms.__contains__)
        for node in nodes:
            self._node_terms[node] = self._node(node)
        return self._graph(expression)

    def constant(self, number: float) -> Term:
        """Return the term of a number."""
        return self._step(ca.OP_CONST, data=float(number))

    def subtract(self, a: Term, b: Term) -> Term:
        """Return the difference; b - a is the negative of a - b, so both have the same deciders."""
        if b.op == ca.OP_CONST and b.data == 0:
            return a
        if a.index < b.index:
            return self._step(ca.OP_NEG, (self.subtract(b, a),))
        return self._step(ca.OP_SUB, (a, b))

    def divide(self, a: Term, b: Term) -> Term:
        """Return the quotient."""
        return a if b.op == ca.OP_CONST and b.data == 1 else self._step(ca.OP_DIV, (a, b))

    def _step(
        self, op: int | str, args: tuple[Term, ...] = (), data: Any = None, deciders: tuple[Term, ...] = ()
    ) -> Term:
        key = (op, tuple(a.index for a in args), repr(data) if isinstance(data, float) else data)
        known = self._known.get(key)
        if known is None:
            known = self._known[key] = Term(len(self._known), op, args, data, deciders)
        return known

    def _graph(self, expression: Expression) -> list[Term]:
        """Return the terms of the elements, column by column as in CasADi; those of nodes are known."""
        sx = ca.densify(expression.sx)
        elements = ca.symvar(sx)
        function = ca.Function("terms", [ca.vertcat(*elements)] if elements else [], [sx])
        inputs = [self._leaf(element) for element in elements]
        work: dict[int, Term] = {}
        result = [self.constant(0.0)] * sx.numel()
        for k in range(function.n_instructions()):
            op = function.instruction_id(k)
            sources, targets = function.instruction_input(k), function.instruction_output(k)
            if op == ca.OP_CONST:
                work[targets[0]] = self.constant(function.instruction_constant(k))
            elif op == ca.OP_INPUT:
                work[targets[0]] = inputs[sources[1]]
            elif op == ca.OP_OUTPUT:
                result[targets[1]] = work[sources[0]]
            else:
                work[targets[0]] = self._operation(op, tuple(work[i] for i in sources))
        return result

    def _leaf(self, element: layout.SX) -> Term:
        name = element.element_hash()
        symbol = SYMBOLS.get(name)
        if symbol is None:
            node = NODES[name]
            return self._node_terms[node][node.elements.index(name)]
        if symbol in self._given:
            return self.constant(self._given[symbol])
        return self._step(ca.OP_PARAMETER, data=symbol)

    def _operation(self, op: int, args: tuple[Term, ...]) -> Term:
        if op == ca.OP_SUB:
            return self.subtract(*args)
        if op == ca.OP_TWICE:
            return self._step(ca.OP_MUL, (args[0], self.constant(2.0)))
        if op == ca.OP_INV:
            return self._operation(ca.OP_DIV, (self.constant(1.0), args[0]))
        if op == ca.OP_SQ:
            return self._step(ca.OP_MUL, (args[0], args[0]))
        if op in _COMPARISONS or op in (ca.OP_FMIN, ca.OP_FMAX):
            return self._step(op, args, deciders=(self.subtract(*args),))
        if op in (ca.OP_FABS, ca.OP_SIGN):
            return self._step(op, args, deciders=args)
        if op in (ca.OP_IF_ELSE_ZERO, ca.OP_NOT):
            return self._step(op, args, deciders=args[:1])
        if op in (ca.OP_DIV, ca.OP_COPYSIGN):
            return self._step(op, args, deciders=args[1:])
        if op in (ca.OP_POW, ca.OP_CONSTPOW):
            return self._step(ca.OP_POW, args, deciders=args[:1])
        if op in DOMAINS:
            low, high = DOMAINS[op]
            ends = [self.subtract(args[0], self.constant(low))]
            ends += [self.subtract(self.constant(high), args[0])] if high < math.inf else []
            return self._step(op, args, deciders=tuple(ends))
        return self._step(op, args)

    def _node(self, node: Node) -> list[Term]:
        if isinstance(node, Implicit):
            inputs = tuple(self.term(a) for a in node.arguments)
            return [self._step(_IMPLICIT, inputs, (node, i)) for i in range(node.size)]
        if isinstance(node, Less | Select | Extremum | Piecewise):
            rows = list(zip(*(self._graph(a) for a in node.arguments), strict=True))
            return [self._choice(node, row) for row in rows]
        return self._graph(_formula(node))

    def _choice(self, node: Node, args: tuple[Term, ...]) -> Term:
        if isinstance(node, Less):
            contrast = float(node.options[0])
            excess = self.subtract(args[1], args[0])
            if contrast >= SHARP_CONTRAST:
                return self._step("less", (excess,), contrast, (excess,))
            width = self.constant(SATURATED / contrast)
            ramp = (self._step(ca.OP_ADD, (excess, width)), self.subtract(excess, width))
            return self._step("less", (excess,), contrast, ramp)
        if isinstance(node, Select):
            return self._step("select", args, deciders=(self.subtract(args[0], self.constant(0.5)),))
        if isinstance(node, Piecewise):
            knots = () if node.periodic else node.knots
            ends = tuple(self.subtract(args[0], self.constant(t)) for t in knots)
            return self._step("piecewise", args, (node.periodic, node.knots, node.pieces), ends)
        op = ca.OP_FMIN if node.options[0] == "min" else ca.OP_FMAX
        result = args[0]
        for other in args[1:]:
            result = self._operation(op, (result, other))
        return result


def _parts(node: Node) -> tuple[Expression, ...]:
    choices = Less | Select | Extremum | Piecewise | Implicit
    return node.arguments if isinstance(node, choices) else (_formula(node),)


def _formula(node: Node) -> Expression:
    return node.unscaled if isinstance(node, Norm) else node.value


def reachable_terms(roots: tuple[Term, ...]) -> list[Term]:
    """Return the arguments and deciders of terms, theirs, and so on, arguments first."""
    result: dict[int, Term] = {}
    stack = list(roots)
    while stack:
        term = stack.pop()
        if term.index not in result:
            result[term.index] = term
            stack += [*term.args, *term.deciders]
    return [result[index] for index in sorted(result)]
