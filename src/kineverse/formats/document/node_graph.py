"""Expressions of an operation by their place in its node table."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import casadi as ca

from kineverse.expressions import layout
from kineverse.expressions.expression import NO_NODES, Expression, from_casadi
from kineverse.expressions.node import Node
from kineverse.model.rates import Composed
from kineverse.symbols import Symbol

from .budget import (
    COST_OF_ELEMENT,
    COST_OF_NODE_BELOW,
    COST_OF_SCALAR,
    MAX_COMPOSITIONS,
    MAX_DIMENSIONS,
    MAX_ELEMENTS,
    MAX_LENGTH,
    MAX_NESTING,
    Budget,
    InvalidDocumentError,
)
from .structs import Pairs, Refs

_FEW = 256  # most steps of a table that are spent for each expression without counting its own


class NodeGraph:
    """Expressions of an operation, by their place in its node table."""

    def __init__(self, before: str, budget: Budget) -> None:
        self.before = before  # prefix of all names, with its slash
        self.has_read_nodes = False
        self.budget = budget
        self.steps = 0  # CasADi's steps for all nodes so far, at most
        self.sx: list[Any] = []
        self.shapes: list[layout.ArrayShape] = []
        self.depths: list[int] = []
        self._expressions: list[Expression | None] = []
        self._owners: dict[int, Node] = {}
        self._below: dict[Node, int] = {}
        self._compositions: dict[Node, int] = {}

    @property
    def has_opaque_nodes(self) -> bool:
        """True if a node has a gradient of its own."""
        return bool(self._owners)

    # -- access --------------------------------------------------------------------------------------------

    def expression(self, ref: int) -> Expression:
        """Return the expression at a place of the table."""
        place = self.check_ref(ref)
        known = self._expressions[place]
        if known is None:
            sx, nodes = self.sx[place], NO_NODES
            # Finding its symbols and comparing it traverse all of it.
            self.budget.spend(self.steps if self.steps <= _FEW else ca.n_nodes(sx))
            if self.depths[place]:
                owners = self._owners
                found = (owners.get(e.element_hash()) for e in ca.symvar(sx))
                nodes = frozenset(node for node in found if node is not None)
                self.budget.spend(COST_OF_NODE_BELOW * self._count(nodes))
            known = self._expressions[place] = from_casadi(sx, self.shapes[place], nodes)
        return known

    def graph_of(self, place: int) -> Any:
        """Return CasADi's graph at a place of the table."""
        sx = self.sx[place]
        if sx is None:
            expression = self._expressions[place]
            assert expression is not None
            sx = self.sx[place] = expression.sx
        return sx

    def scalar(self, ref: int) -> Expression:
        """Return the scalar at a place of the table."""
        return self.expression(self.check_scalar_ref(ref))

    def symbol(self, ref: int, least: int = 0) -> Symbol:
        """Return the symbol at a place of the table, of order ``least`` or more."""
        result = self._expressions[self.check_ref(ref)]
        if not isinstance(result, Symbol) or result.order < least:
            what = "the derivative of a symbol" if least else "a symbol"
            raise InvalidDocumentError(f"node {ref} should be {what}")
        return result

    def pairs(self, given: Pairs, least: int) -> list[tuple[Symbol, Expression]]:
        """Return pairs of symbol and expression, every symbol once."""
        result = {}
        for key, entry in given:
            symbol = self.symbol(key, least)
            if symbol in result:
                raise InvalidDocumentError(f"'{symbol}' is given twice")
            result[symbol] = self.expression(entry)
        return list(result.items())

    def owner(self, expression: Expression) -> Node | None:
        """Return the node of a scalar expression that is one node, None for any other expression."""
        return None if expression.shape else self._owners.get(expression.sx.element_hash())

    def check_ref(self, ref: int) -> int:
        """Return the place of an earlier node after checking that it is one."""
        if type(ref) is not int or not 0 <= ref < len(self.sx):
            raise InvalidDocumentError(f"{str(ref)[:60]} is not the place of an earlier node")
        return ref

    def check_scalar_ref(self, ref: int) -> int:
        """Return the place of an earlier node after checking that it is a scalar."""
        place = self.check_ref(ref)
        if self.shapes[place]:
            raise InvalidDocumentError(f"node {place} should be a scalar, and has shape {self.shapes[place]}")
        return place

    def shape(self, shape: layout.ArrayShape) -> layout.ArrayShape:
        """Return a shape after checking its size against limits and budget."""
        if len(shape) > MAX_DIMENSIONS:
            raise InvalidDocumentError(f"more than {MAX_DIMENSIONS} dimensions")
        # CasADi keeps a number for each column, even where there are no rows.
        lengths = math.prod(length for length in shape if length)
        if lengths > (MAX_LENGTH if math.prod(shape) else MAX_ELEMENTS):
            raise InvalidDocumentError(f"the shape {shape} is too large")
        self.budget.spend(math.prod(shape))
        return shape

    # -- construction --------------------------------------------------------------------------------------

    def add(
        self, sx: Any, shape: layout.ArrayShape, depth: int, expression: Expression | None = None
    ) -> None:
        """Add a node; its graph is None if it is made from the expression when it is needed."""
        self.steps += 1
        self.sx.append(sx)
        self.shapes.append(shape)
        self.depths.append(depth)
        self._expressions.append(expression)

    def add_alike(self, kind: type[Node], refs: Refs, options: tuple[Any, ...] = ()) -> None:
        """Add a node with a gradient of its own that has the shape of its arguments."""
        shapes = {self.shapes[self.check_ref(ref)] for ref in refs}
        if len(shapes) != 1:
            raise InvalidDocumentError("all parts should be of one shape")
        self.add_opaque(kind, refs, shapes.pop(), options)

    def add_opaque(
        self,
        kind: type[Node],
        refs: Refs,
        shape: layout.ArrayShape,
        options: tuple[Any, ...],
        inside: Iterable[int] = (),
    ) -> None:
        """Add a node with a gradient of its own; ``inside`` are the nodes in its options."""
        # Checked before construction, which already traverses the arguments.
        parts = [self.check_ref(ref) for ref in (*refs, *inside)]
        depth = 1 + max((self.depths[part] for part in parts), default=0)
        if depth > MAX_NESTING:
            raise InvalidDocumentError(
                f"more than {MAX_NESTING} nodes with a gradient of their own inside one another"
            )
        self.check_elements(shape, len(refs))
        below = NO_NODES.union(*(self.expression(part).nodes for part in parts if self.depths[part]))
        compositions = max(map(self._compositions.__getitem__, below), default=0) + (kind is Composed)
        if compositions > MAX_COMPOSITIONS:
            raise InvalidDocumentError(f"more than {MAX_COMPOSITIONS} compositions of compositions")
        made = kind.from_arguments(tuple(self.expression(ref) for ref in refs), shape, options)
        self.keep(made, depth, 1 + self._count(below), compositions)

    def keep(self, expression: Expression, depth: int, below: int = 1, compositions: int = 0) -> None:
        """Add the expression of a node with a gradient of its own."""
        (node,) = expression.nodes
        self._owners.update(dict.fromkeys(node.elements, node))
        self._below[node] = below
        self._compositions[node] = compositions
        self.add(expression.sx, node.shape, depth, expression)

    def check_elements(self, shape: layout.ArrayShape, arguments: int = 1) -> None:
        """Check the number of elements in all arguments of a node with a gradient of its own."""
        size = math.prod(shape) * max(arguments, 1)
        if size > MAX_ELEMENTS:
            raise InvalidDocumentError(
                f"{size} elements are more than {MAX_ELEMENTS}, the most that a node like this has"
            )
        self.budget.spend((COST_OF_ELEMENT if shape else COST_OF_SCALAR) * size)

    def _count(self, nodes: Iterable[Node]) -> int:
        """Return an upper bound of the number of nodes in and below these."""
        return min(sum(map(self._below.__getitem__, nodes)), len(self._below))
