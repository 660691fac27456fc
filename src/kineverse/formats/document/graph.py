"""From the table of nodes in a document back to expressions; see :mod:`.table`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import casadi as ca

from kineverse.errors import KineverseError
from kineverse.expressions import layout
from kineverse.expressions.expression import NO_NODES, Expression, make
from kineverse.expressions.functions import Extremum, Norm, Select
from kineverse.expressions.implicit import Implicit, ImplicitFunction
from kineverse.expressions.node import Augment, Node
from kineverse.expressions.piecewise import Piecewise, checked_pieces
from kineverse.logic import And, Less, Not, Or
from kineverse.model.rates import Carried, Composed, Dependent, Rates, as_row
from kineverse.model.traces import Answer
from kineverse.symbols import ROLES, Symbol

from .checks import RefusedError, exactly, listed, name, number, numbers, the, whole
from .elementary import BINARY, UNARY

MAX_ORDER = 1000
MAX_DIMENSIONS = 16
MAX_LENGTH = 1 << 24
MAX_STEPS = 100
MAX_QUESTIONS = 10_000
MAX_ANSWER = 10_000
MAX_NESTING = 400
"""Nodes with a gradient of their own inside one another; what works on them follows them down."""


class Graph:
    """The expressions of a document, by their place in its table.

    Parameters
    ----------
    prefix
        Put in front of the paths of all symbols, with a slash.
    """

    def __init__(self, prefix: str | None) -> None:
        self.place = 0
        self.has_answers = False
        """Whether there are ``read`` nodes, which belong into traces."""
        self._before = f"{prefix}/" if prefix else ""
        self._sx: list[Any] = []
        self._shapes: list[layout.Shape] = []
        self._depths: list[int] = []
        self._expressions: list[Expression | None] = []
        self._owners: dict[int, Node] = {}

    def read(self, table: list[Any]) -> None:
        """Read all nodes.

        Raises
        ------
        RefusedError
            At the first node that is not what it should be; :attr:`place` is where.
        """
        readers: dict[str, Callable[[list[Any]], None]] = {
            "constant": self._constant,
            "symbol": self._symbol,
            "elementary": self._elementary,
            "element": self._element,
            "matrix": self._matrix,
            "augment": self._augment,
            "less": self._less,
            "not": self._not,
            "and": self._joined,
            "or": self._joined,
            "select": self._select,
            "extremum": self._extremum,
            "norm": self._norm,
            "piecewise": self._piecewise,
            "carried": self._carried,
            "composed": self._composed,
            "dependent": self._dependent,
            "implicit": self._implicit,
            "read": self._read,
        }
        for self.place, node in enumerate(table):
            if type(node) is not list or not node or type(node[0]) is not str:
                raise RefusedError("a node is a list that begins with its type")
            reader = readers.get(node[0])
            if reader is None:
                raise RefusedError(f"there is no node type {node[0][:40]!r}; types are {', '.join(readers)}")
            try:
                reader(node)
            except KineverseError as error:
                raise RefusedError(str(error)) from None

    def expression(self, ref: Any) -> Expression:
        """Return the expression at a place of the table."""
        place = self._at(ref)
        known = self._expressions[place]
        if known is None:
            sx, nodes = self._sx[place], NO_NODES
            if self._depths[place]:
                owners = self._owners
                found = (owners.get(e.element_hash()) for e in ca.symvar(sx))
                nodes = frozenset(node for node in found if node is not None)
            known = self._expressions[place] = make(sx, self._shapes[place], nodes)
        return known

    def scalar(self, ref: Any) -> Expression:
        """Return the scalar at a place of the table."""
        return self.expression(self._scalar_at(ref))

    def symbol(self, ref: Any, least: int = 0) -> Symbol:
        """Return the symbol at a place of the table, of order ``least`` or more."""
        found = self._expressions[self._at(ref)]
        if not isinstance(found, Symbol) or found.order < least:
            what = "the derivative of a symbol" if least else "a symbol"
            raise RefusedError(f"node {ref} should be {what}")
        return found

    def pairs(self, value: Any, least: int) -> list[tuple[Symbol, Expression]]:
        """Return pairs of symbol and expression, every symbol once."""
        result = {}
        for item in listed(value, "pairs"):
            key, entry = exactly(listed(item, "a pair"), 2)
            symbol = self.symbol(key, least)
            if symbol in result:
                raise RefusedError(f"'{symbol}' is given twice")
            result[symbol] = self.expression(entry)
        return list(result.items())

    def _at(self, ref: Any) -> int:
        if type(ref) is not int or not 0 <= ref < len(self._sx):
            raise RefusedError(f"{_short(ref)} is not the place of an earlier node")
        return ref

    def _scalar_at(self, ref: Any) -> int:
        place = self._at(ref)
        if self._shapes[place]:
            raise RefusedError(f"node {place} should be a scalar, and has shape {self._shapes[place]}")
        return place

    def _add(self, sx: Any, shape: layout.Shape, depth: int, expression: Expression | None = None) -> None:
        self._sx.append(sx)
        self._shapes.append(shape)
        self._depths.append(depth)
        self._expressions.append(expression)

    # -- node by node --------------------------------------------------------------------------------------

    def _constant(self, node: list[Any]) -> None:
        _, value = exactly(node, 2)
        self._add(ca.SX(number(value)), (), 0)

    def _symbol(self, node: list[Any]) -> None:
        path, order, role = exactly(node, 5 if node[3:4] == ["parameter"] else 4)[1:4]
        value = float(number(node[4])) if role == "parameter" else None
        if type(role) is not str or role not in ROLES:
            raise RefusedError(f"{_short(role)} is not a role; roles are {', '.join(ROLES)}")
        symbol = Symbol(self._before + name(path), whole(order, MAX_ORDER), role, value)
        self._add(symbol._sx, (), 0, symbol)

    def _elementary(self, node: list[Any]) -> None:
        sx, depths = self._sx, self._depths
        function = node[1] if len(node) > 2 and type(node[1]) is str else ""
        if function in BINARY:
            a, b = map(self._scalar_at, exactly(node, 4)[2:])
            result, depth = ca.SX.binary(BINARY[function], sx[a], sx[b]), max(depths[a], depths[b])
        elif function in UNARY:
            a = self._scalar_at(exactly(node, 3)[2])
            result, depth = ca.SX.unary(UNARY[function], sx[a]), depths[a]
        else:
            raise RefusedError(f"there is no elementary function {_short(node[1] if node[1:] else None)}")
        if result.op() == ca.OP_CONST and math.isnan(float(result)):
            raise RefusedError("the value is NaN")
        self._add(result, (), depth)

    def _element(self, node: list[Any]) -> None:
        _, ref, index = exactly(node, 3)
        place = self._at(ref)
        shape = self._shapes[place]
        size = math.prod(shape)
        if not shape or not size:
            raise RefusedError(f"node {place} has no elements to choose from")
        element = layout.column(self._sx[place], shape)[whole(index, size - 1)]
        self._add(element, (), self._depths[place])

    def _matrix(self, node: list[Any]) -> None:
        _, given, refs = exactly(node, 3)
        shape = self._shape(given)
        if math.prod(shape) != len(listed(refs, "the elements")):
            raise RefusedError(f"{len(refs)} elements do not fill the shape {shape}")
        stored = [i for i, ref in enumerate(refs) if ref is not None]
        places = [self._scalar_at(refs[i]) for i in stored]
        elements = ca.vertcat(*(self._sx[p] for p in places)) if places else ca.SX(0, 1)
        column = ca.SX(ca.Sparsity(len(refs), 1, [0, len(stored)], stored), elements)
        rows, columns = layout.rows_and_columns(shape)
        sx = layout.from_column(column, shape) if refs else ca.SX(rows, columns)
        self._add(sx, shape, max((self._depths[p] for p in places), default=0))

    def _shape(self, given: Any) -> layout.Shape:
        if len(listed(given, "a shape")) > MAX_DIMENSIONS:
            raise RefusedError(f"more than {MAX_DIMENSIONS} dimensions")
        shape = tuple(whole(length, MAX_LENGTH) for length in given)
        if math.prod(length for length in shape if length) > MAX_LENGTH:
            raise RefusedError(f"the shape {shape} is too large")
        return shape

    def _opaque(self, kind: type[Node], refs: list[Any], options: tuple[Any, ...] = ()) -> None:
        """Add a node whose arguments and itself are of one shape."""
        shapes = {self._shapes[self._at(ref)] for ref in refs}
        if len(shapes) != 1:
            raise RefusedError("all parts should be of one shape")
        self._node(kind, refs, shapes.pop(), options)

    def _node(
        self,
        kind: type[Node],
        refs: list[Any],
        shape: layout.Shape,
        options: tuple[Any, ...],
        inside: Iterable[Any] = (),
    ) -> None:
        """Add a node of these arguments, in whose options there may be other nodes still."""
        # Asked before it is made: what makes the node follows it down already.
        depth = 1 + max((self._depths[self._at(ref)] for ref in (*refs, *inside)), default=0)
        if depth > MAX_NESTING:
            raise RefusedError(
                f"more than {MAX_NESTING} nodes with a gradient of their own inside one another"
            )
        self._keep(kind.of(tuple(self.expression(ref) for ref in refs), shape, options), depth)

    def _keep(self, expression: Expression, depth: int) -> None:
        (node,) = expression._nodes
        self._owners.update(dict.fromkeys(node.elements, node))
        self._add(expression._sx, node.shape, depth, expression)

    def _augment(self, node: list[Any]) -> None:
        _, value, replace, heuristic, entries = exactly(node, 5)
        pairs = self.pairs(entries, 1)
        if [k for k, _ in pairs] != sorted((k for k, _ in pairs), key=lambda s: s.sort_key):
            raise RefusedError("the entries are not sorted by path and order")
        flags = the(bool, replace, "true or false"), the(bool, heuristic, "true or false")
        self._opaque(Augment, [value, *(ref for _, ref in entries)], (*flags, *(key for key, _ in pairs)))

    def _less(self, node: list[Any]) -> None:
        _, a, b, contrast = exactly(node, 4)
        if not 0 < number(contrast) < math.inf:
            raise RefusedError("the contrast is a positive number")
        self._opaque(Less, [a, b], (float(contrast),))

    def _not(self, node: list[Any]) -> None:
        self._opaque(Not, exactly(node, 2)[1:])

    def _joined(self, node: list[Any]) -> None:
        self._opaque(And if node[0] == "and" else Or, node[1:])

    def _select(self, node: list[Any]) -> None:
        self._opaque(Select, exactly(node, 4)[1:])

    def _extremum(self, node: list[Any]) -> None:
        if len(node) < 4:
            raise RefusedError("an extremum is one of at least two expressions")
        _, which, *refs = node
        if which not in ("min", "max"):
            raise RefusedError(f"an extremum is 'min' or 'max', not {_short(which)}")
        self._opaque(Extremum, refs, (which,))

    def _norm(self, node: list[Any]) -> None:
        (ref,) = exactly(node, 2)[1:]
        shape = self._shapes[self._at(ref)]
        if len(shape) != 1 or not shape[0]:
            raise RefusedError(f"the norm is that of a vector, not of shape {shape}")
        self._node(Norm, [ref], (), ())

    def _piecewise(self, node: list[Any]) -> None:
        _, ref, periodic, knots, pieces = exactly(node, 5)
        table = [numbers(piece) for piece in listed(pieces, "pieces")]
        options = checked_pieces(the(bool, periodic, "true or false"), numbers(knots), table)
        self._opaque(Piecewise, [ref], options)

    def _carried(self, node: list[Any]) -> None:
        _, ref, table = exactly(node, 3)
        coordinate = self.symbol(ref)
        rows = {}
        for item in listed(table, "a rate table"):
            key, row = exactly(listed(item, "a row"), 2)
            symbol = self.symbol(key)
            if symbol in rows:
                raise RefusedError(f"'{symbol}' has two rows")
            rows[symbol] = as_row(symbol, dict(self.pairs(row, 1)))
        if coordinate not in rows:
            raise RefusedError(f"the table has no row for '{coordinate}'")
        inside = [entry for _, row in table for _, entry in row]
        self._node(Carried, [ref], (), (Rates(rows),), inside)

    def _composed(self, node: list[Any]) -> None:
        _, ref, replacements = exactly(node, 3)
        inner = self.expression(ref)
        owner = self._owners.get(inner._sx.element_hash()) if not inner.shape else None
        if not isinstance(owner, (Carried, Composed)):
            raise RefusedError(f"node {ref} should be a carried coordinate")
        pairs = self.pairs(replacements, 0)
        if any(entry.shape for _, entry in pairs):
            raise RefusedError("a symbol is replaced by a scalar")
        refs = [ref, *(entry for _, entry in replacements)]
        self._node(Composed, refs, (), tuple(key for key, _ in pairs))

    def _read(self, node: list[Any]) -> None:
        _, question, part, shape, steps = exactly(node, 5)
        path = []
        for step in listed(steps, "a path"):
            ref, trends = exactly(listed(step, "a symbol, and whether trends count"), 2)
            path.append((self.symbol(ref, 1), the(bool, trends, "true or false")))
        if math.prod(self._shape(shape)) > MAX_ANSWER:
            raise RefusedError(f"an answer of more than {MAX_ANSWER} elements")
        question, part = whole(question, MAX_QUESTIONS), whole(part, MAX_QUESTIONS)
        self._keep(Answer.empty(self._shape(shape), question, part, tuple(path)), 1)
        self.has_answers = True

    def _dependent(self, node: list[Any]) -> None:
        _, ref, coordinate = exactly(node, 3)
        self._node(Dependent, [self._scalar_at(ref)], (), (self.symbol(coordinate),))

    def _implicit(self, node: list[Any]) -> None:
        _, label, unknowns, inputs, residual, rows, seed, steps, arguments = exactly(node, 9)
        function = ImplicitFunction(
            name=name(label),
            unknowns=tuple(self.symbol(ref) for ref in listed(unknowns, "the unknowns")),
            inputs=tuple(self.symbol(ref) for ref in listed(inputs, "the inputs")),
            residual=self.expression(residual),
            rows=tuple(whole(row, MAX_LENGTH) for row in listed(rows, "the rows that are solved")),
            seed=self.expression(seed),
            steps=whole(steps, MAX_STEPS),
        )
        if len(listed(arguments, "the arguments")) != len(function.inputs):
            raise RefusedError(f"{len(arguments)} arguments for {len(function.inputs)} inputs")
        refs = [self._scalar_at(ref) for ref in arguments]
        self._node(Implicit, refs, (len(function.unknowns),), (function,), (residual, seed))


def _short(value: Any) -> str:
    shown = repr(value) if isinstance(value, (str, int, float, bool, type(None))) else type(value).__name__
    return shown if len(shown) <= 60 else f"{shown[:57]}..."
