"""Node table of an operation, written from expressions.

Every node is a tuple that begins with its type, in the layout of :mod:`.structs`; a reference is the place of
an earlier node in the table.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter
from typing import Any

import casadi as ca

from kineverse.errors import FormatError
from kineverse.expressions import layout
from kineverse.expressions.expression import NODES, SYMBOLS, Expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.implicit import Implicit, ImplicitFunction
from kineverse.expressions.layout import SX
from kineverse.expressions.node import Augment, Node
from kineverse.expressions.nonsmooth import Extremum, Norm, Power, Select
from kineverse.expressions.piecewise import Piecewise
from kineverse.logic import And, Less, Not, Or
from kineverse.model.rates import Carried, Composed, Dependent
from kineverse.model.traces import ReadNode
from kineverse.spatial import OneAxisTransform, as_one_axis_transform
from kineverse.symbols import Symbol

from .budget import MAX_ELEMENTS, MAX_NODES
from .node_types import ELEMENTARY_NAMES
from .structs import VERSION

_PLAIN = (Not, Select, Norm)


class NodeTable:
    """Topologically sorted table of the nodes of expressions; :meth:`ref` returns the place of one.

    Equal parts are one node, in the order in which the expressions need them, operands first, from left to
    right: equal operations have equal tables.
    """

    def __init__(self) -> None:
        self.nodes: list[tuple[Any, ...]] = []
        self._made: dict[Any, int] = {}
        self._symbols: dict[Symbol, int] = {}
        self._opaque: dict[Node, int] = {}
        self._elements: dict[int, int] = {}  # places of CasADi's elements, by hash
        self._indices: dict[Node, dict[int, int]] = {}
        self._known: dict[int, int] = {}
        # Expressions are kept, so that neither their ids nor hashes of their elements are used again.
        self._keep: list[Expression] = []

    def ref(self, expression: Expression) -> int:
        """Return the place of an expression."""
        if type(expression) is Symbol:
            return self._symbol(expression)
        known = self._known.get(id(expression))
        if known is None:
            self._keep.append(expression)
            known = self._known[id(expression)] = self._place(expression)
        return known

    def _place(self, expression: Expression) -> int:
        if expression.shape == (4, 4):
            expression = as_one_axis_transform(expression)
            self._keep.append(expression)
            if isinstance(expression, OneAxisTransform):
                kind = "rotation" if expression.is_rotation else "translation"
                direction = tuple(map(float, expression.direction))
                amount = self.ref(expression.amount)
                return self._shared((kind, direction, amount), (kind, str(direction), amount))
        if expression.nodes:
            opaque = leaves(expression)[1]
            for node in topological_order(opaque, lambda n: n.parts, self._opaque.__contains__):
                self._opaque[node] = self._node(node)
        sx = expression.sx
        if not expression.shape and sx.nnz():
            return self._scalar(sx)
        return self._array(sx, expression.shape)

    def _array(self, sx: SX, shape: layout.ArrayShape) -> int:
        elements = sx.nonzeros()
        size, columns = math.prod(shape), layout.rows_and_columns(shape)[1]
        if len(elements) == size and size and elements[0].op() == ca.OP_PARAMETER:
            owner = NODES.get(elements[0].element_hash())
            if owner is not None and owner.shape == shape and ca.is_equal(owner.sx, sx):
                return self._opaque[owner]
        stored = zip(sx.sparsity().row(), sx.sparsity().get_col(), elements, strict=True)
        refs: list[int | None] = [None] * size
        for row, column, element in sorted(stored, key=itemgetter(0, 1)):
            refs[row * columns + column] = self._scalar(element)
        return self._shared(("matrix", shape, tuple(refs)))

    def _scalar(self, root: SX) -> int:
        """Return the place of an element, after those of its operands."""
        if root.op() == ca.OP_CONST:
            return self._constant(float(root))
        places = self._elements
        goal = root.element_hash()
        stack: list[tuple[SX, int, list[tuple[SX, int]] | None]] = [(root, goal, None)]
        while stack:
            sx, key, operands = stack.pop()
            if key in places:
                continue
            code = sx.op()
            if code == ca.OP_CONST:
                places[key] = self._constant(float(sx))
                continue
            if code == ca.OP_PARAMETER:
                places[key] = self._leaf(key)
                continue
            if operands is None:
                found = [sx.dep(k) for k in range(sx.n_dep())]
                operands = [(operand, operand.element_hash()) for operand in found]
                missing = [(operand, its, None) for operand, its in operands if its not in places]
                if missing:
                    stack += [(sx, key, operands), *reversed(missing)]
                    continue
            places[key] = self._elementary(code, [places[its] for _, its in operands])
        return places[goal]

    def _elementary(self, code: int, refs: list[int]) -> int:
        if code not in ELEMENTARY_NAMES:
            raise FormatError(f"A document of version {VERSION} has no function with CasADi's code {code}.")
        return self._shared(("elementary", ELEMENTARY_NAMES[code], tuple(refs)))

    def _constant(self, value: float) -> int:
        # 0.0 and -0.0 are equal keys.
        return self._shared(("constant", encode_number(value)), value or str(value))

    def _leaf(self, key: int) -> int:
        symbol = SYMBOLS.get(key)
        if symbol is not None:
            return self._symbol(symbol)
        owner = NODES[key]
        place = self._opaque[owner]
        if not owner.shape:
            return place
        if owner not in self._indices:
            elements = layout.column(owner.sx, owner.shape).nonzeros()
            self._indices[owner] = {element.element_hash(): i for i, element in enumerate(elements)}
        return self._shared(("element", place, self._indices[owner][key]))

    def _symbol(self, symbol: Symbol) -> int:
        place = self._symbols.get(symbol)
        if place is None:
            if symbol.role == "parameter":
                node: tuple[Any, ...] = ("parameter", symbol.path, encode_number(symbol.value))
            else:
                node = ("symbol", symbol.path, symbol.order, symbol.role)
            place = self._symbols[symbol] = self._add(node)
        return place

    def _node(self, node: Node) -> int:
        if type(node) is Carried:
            return self._shared(("carried", self.ref(node.coordinate), self._rates(node)))
        if type(node) is ReadNode:
            path = tuple((self.ref(key), trends) for key, trends in node.path)
            return self._shared(("read", node.query, node.part, node.shape, path))
        if node.size * max(len(node.arguments), 1) > MAX_ELEMENTS:
            raise FormatError(
                f"The model has a node '{node.label}' of shape {node.shape} with {len(node.arguments)} "
                f"arguments; a document has up to {MAX_ELEMENTS} elements in all arguments of one."
            )
        refs = tuple(self.ref(argument) for argument in node.arguments)
        if type(node) is Augment:
            entries = self._pairs(node.options[2:], refs[1:])
            return self._shared(("augment", refs[0], node.replace, node.heuristic, entries))
        if type(node) is Less:
            return self._shared(("less", *refs, float(node.options[0])))
        if type(node) is Extremum:
            return self._shared(("extremum", node.options[0], refs))
        if type(node) is Piecewise:
            pieces = tuple(map(_floats, node.pieces))
            made = ("piecewise", *refs, node.periodic, _floats(node.knots), pieces)
            return self._shared(made, repr(made))
        if type(node) is Composed:
            return self._shared(("composed", refs[0], self._pairs(node.options, refs[1:])))
        if type(node) is Dependent:
            return self._shared(("dependent", *refs, self.ref(node.coordinate)))
        if type(node) is Implicit:
            return self._implicit(node.function, refs)
        if type(node) is Power:
            return self._shared(("elementary", "pow", refs))
        if type(node) in (And, Or):
            return self._shared((node.kind, refs))
        if type(node) in _PLAIN:
            return self._shared((node.kind, *refs))
        raise FormatError(
            f"A document of version {VERSION} has no node '{node.kind}' ({type(node).__name__}); the model "
            "cannot be saved with it."
        )

    def _rates(self, node: Carried) -> tuple[Any, ...]:
        rows = []
        for coordinate, row in sorted(node.rates.items(), key=lambda item: item[0].sort_key):
            pairs = self._pairs(list(row), [self.ref(entry) for entry in row.values()])
            rows.append((self.ref(coordinate), pairs))
        return tuple(rows)

    def _implicit(self, f: ImplicitFunction, refs: tuple[int, ...]) -> int:
        unknowns, inputs = (tuple(map(self.ref, symbols)) for symbols in (f.unknowns, f.inputs))
        residual, seed = self.ref(f.residual), self.ref(f.seed)
        domain = tuple(tuple(map(encode_number, ends)) for ends in f.domain)
        made = ("implicit", f.name, unknowns, inputs, residual, tuple(f.rows), seed, f.steps, refs, domain)
        return self._shared(made, repr(made))

    def _pairs(self, symbols: Sequence[Symbol], refs: Sequence[int]) -> tuple[tuple[int, int], ...]:
        return tuple((self._symbol(s), ref) for s, ref in zip(symbols, refs, strict=True))

    def _shared(self, node: tuple[Any, ...], key: Any = None) -> int:
        """Return the place of a node; its key tells apart what compares as equal."""
        key = node if key is None else key
        place = self._made.get(key)
        if place is None:
            place = self._made[key] = self._add(node)
        return place

    def _add(self, node: tuple[Any, ...]) -> int:
        if len(self.nodes) >= MAX_NODES:
            raise FormatError(f"The model has more than {MAX_NODES:,} nodes, the most a document has.")
        self.nodes.append(node)
        return len(self.nodes) - 1


def _floats(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(map(float, values))


def encode_number(value: Any) -> float | str:
    """Encode a number; infinities are texts."""
    try:
        result = float(value) if isinstance(value, float | int) else float(value.item())
    except OverflowError:
        raise FormatError("an integer is too large for a 64-bit float") from None
    except (AttributeError, TypeError, ValueError):
        raise FormatError(f"a number is wanted, not {value!r}") from None
    if math.isnan(result):
        raise FormatError("NaN has no place in a document")
    return result if math.isfinite(result) else ("inf" if result > 0 else "-inf")
