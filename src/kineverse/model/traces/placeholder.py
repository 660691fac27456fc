"""Expression node for a value that a traced operation has read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

import numpy as np

from kineverse.errors import ModelError
from kineverse.expressions.expression import Expression, as_expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.node import AccessListener, Node
from kineverse.expressions.substitution import apply_substitution, replace_nodes

from .trace_queries import Access

if TYPE_CHECKING:
    from kineverse.expressions.layout import ArrayShape
    from kineverse.expressions.substitution import Substitution
    from kineverse.symbols import Symbol

GradientPath = tuple[tuple["Symbol", bool], ...]


class Tracer(AccessListener, Protocol):
    """Receiver of the accesses to query results."""

    serial: int

    def record_access(self, query: int, how: Access) -> None:
        """Record an access to the result of a query."""


class ReadNode(Node):
    """Placeholder for an expression in a query result.

    While an operation is traced, the node behaves as the expression it stands for, and records accesses that
    an operation can base decisions on: to the symbols, and to the value, which comparing and printing also
    show. In a trace from a document it is empty: it has no arguments.

    The options are the tracer (None for none), the index of the query, the index of the expression in its
    result, and the *path*: the gradient entries that lead from that expression to this one, each with a flag
    for heuristic entries.
    """

    __slots__ = ()
    kind = "read"

    @classmethod
    def from_expression(cls, expression: Expression, listener: Tracer, query: int, part: int) -> Expression:
        """Return a placeholder that stands for an expression."""
        return cls.from_arguments((expression,), expression.shape, (listener, query, part, ()))

    @classmethod
    def empty(cls, shape: ArrayShape, query: int, part: int, path: GradientPath) -> Expression:
        """Return an empty placeholder."""
        return cls.from_arguments((), shape, (None, query, part, path))

    @property
    def query(self) -> int:
        """Index of the query."""
        return int(self.options[1])

    @property
    def part(self) -> int:
        """Index of the expression in the query result."""
        return int(self.options[2])

    @property
    def path(self) -> GradientPath:
        """Gradient entries from the result to this expression, each with a flag for heuristic entries."""
        path: GradientPath = self.options[3]
        return path

    @property
    def parts(self) -> tuple[Expression, ...]:
        """Empty: the expression it stands for is not part of expressions with the placeholder."""
        return ()

    @property
    def is_constant(self) -> bool:
        """False, so that code takes its path for expressions and not for numbers."""
        return False

    def _initialise(
        self, key: bytes, arguments: tuple[Expression, ...], shape: ArrayShape, options: tuple[Any, ...]
    ) -> None:
        super()._initialise(key, arguments, shape, options)
        self.listener = options[0]

    @classmethod
    def _options_key(cls, options: tuple[Any, ...]) -> str:
        listener, query, part, path = options
        steps = [(symbol.sort_key, heuristic) for symbol, heuristic in path]
        return repr((listener and listener.serial, query, part, steps))

    def _look(self, how: Access) -> Expression:
        """Record an access, and return the expression it stands for."""
        if not self.arguments:
            raise ModelError("A trace has no value before it is run.")
        # The symbols of gradient entries do not follow from those of the expression.
        self.options[0].record_access(self.query, Access.VALUE if self.path else how)
        return self.arguments[0]

    @property
    def symbols(self) -> frozenset[Symbol]:
        """Symbols of the expression it stands for."""
        return frozenset(self._look(Access.SYMBOLS).symbols)

    @property
    def value(self) -> Expression:
        """Expression it stands for."""
        return self._look(Access.VALUE)

    def gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        """Return the gradient, with placeholders as entries."""
        listener, query, part, path = self.options
        return {
            key: ReadNode.from_arguments(
                (entry,), self.shape, (listener, query, part, (*path, (key, heuristic)))
            )
            for key, entry in self._look(Access.SYMBOLS).gradient(heuristic).items()
        }

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the keys of the gradient."""
        return frozenset(self._look(Access.SYMBOLS).gradient(heuristic))

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return nothing, because gradient entries are queried one by one."""
        return ()

    def depends_on(self, substitution: Substitution) -> bool:
        """Return whether a substitution changes it."""
        return substitution.changes(self._look(Access.VALUE))

    def substitute(self, substitution: Substitution) -> Expression:
        """Return the expression it stands for after a substitution."""
        return apply_substitution(self._look(Access.VALUE), substitution)

    def _value(self) -> NoReturn:
        raise AssertionError("what calls this is overridden")

    def _gradient(self, heuristic: bool) -> NoReturn:
        raise AssertionError("what calls this is overridden")


def follow_gradient_path(expression: Expression, path: GradientPath) -> Expression:
    """Return the gradient entry at the end of a path; zero if there is none."""
    for key, heuristic in path:
        entry = expression.gradient(heuristic).get(key)
        expression = as_expression(np.zeros(expression.shape)) if entry is None else entry
    return expression


def fill_read_nodes(expression: Expression, replacement: Callable[[ReadNode], Expression]) -> Expression:
    """Replace the placeholders of an expression.

    Nodes are built again from their new arguments. Unlike in a substitution, overridden gradient entries stay
    overridden.
    """
    if not expression.nodes:
        return expression
    images: dict[Node, Expression] = {}
    for node in topological_order(leaves(expression)[1], _below, images.__contains__):
        if isinstance(node, ReadNode):
            images[node] = replacement(node)
            continue
        arguments = tuple(replace_nodes(part, images) for part in node.arguments)
        if any(new is not old for new, old in zip(arguments, node.arguments, strict=True)):
            images[node] = type(node).from_arguments(arguments, node.shape, node.options)
    return replace_nodes(expression, images)


def find_read_nodes(expression: Expression) -> list[ReadNode]:
    """Return the placeholders in an expression, at every depth."""
    nodes = topological_order(leaves(expression)[1], lambda n: n.parts, lambda _: False)
    return [node for node in nodes if isinstance(node, ReadNode)]


def _below(node: Node) -> tuple[Expression, ...]:
    return () if isinstance(node, ReadNode) else node.arguments
