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
    """Who wants to know how closely an answer is looked at."""

    serial: int

    def look(self, question: int, how: Access) -> None:
        """Note it."""


class ReadNode(Node):
    """An expression that the model gave, kept apart from what is made of it.

    While an operation is traced it behaves as what it stands for, and what an operation may decide by is
    noted: which symbols there are, and the value itself, which is also what comparing and printing show.
    In a trace that comes from elsewhere it stands for nothing yet (it has no arguments).

    The options are who watches (None for nobody), the place of the question, the place of the expression in
    its answer, and the *path*: the gradient entries that lead from there to this one, each with whether
    trends count.
    """

    __slots__ = ()
    kind = "read"

    @classmethod
    def standing_for(cls, expression: Expression, listener: Tracer, question: int, part: int) -> Expression:
        """Return the place of an expression, of its shape."""
        return cls.from_arguments((expression,), expression.shape, (listener, question, part, ()))

    @classmethod
    def empty(cls, shape: ArrayShape, question: int, part: int, path: GradientPath) -> Expression:
        """Return a place that stands for nothing yet."""
        return cls.from_arguments((), shape, (None, question, part, path))

    @property
    def question(self) -> int:
        """The place of the question."""
        return int(self.options[1])

    @property
    def part(self) -> int:
        """The place of the expression in the answer."""
        return int(self.options[2])

    @property
    def path(self) -> GradientPath:
        """The gradient entries that were followed, each with whether trends count."""
        path: GradientPath = self.options[3]
        return path

    @property
    def parts(self) -> tuple[Expression, ...]:
        """Nothing: what it stands for is not part of what is made of it."""
        return ()

    @property
    def is_constant(self) -> bool:
        """Never, so that what works for expressions is done also where a number would do."""
        return False

    def _initialise(
        self, key: bytes, arguments: tuple[Expression, ...], shape: ArrayShape, options: tuple[Any, ...]
    ) -> None:
        super()._initialise(key, arguments, shape, options)
        self.listener = options[0]

    @classmethod
    def _options_key(cls, options: tuple[Any, ...]) -> str:
        listener, question, part, path = options
        steps = [(symbol.sort_key, heuristic) for symbol, heuristic in path]
        return repr((listener and listener.serial, question, part, steps))

    def _look(self, how: Access) -> Expression:
        """Return what it stands for, and let it be known."""
        if not self.arguments:
            raise ModelError("A trace has no value before it is run.")
        # How the entries of a gradient depend on symbols does not show in what it stands for.
        self.options[0].look(self.question, Access.VALUE if self.path else how)
        return self.arguments[0]

    @property
    def symbols(self) -> frozenset[Symbol]:
        """The symbols of what it stands for."""
        return frozenset(self._look(Access.SYMBOLS).symbols)

    @property
    def value(self) -> Expression:
        """What it stands for."""
        return self._look(Access.VALUE)

    def gradient(self, heuristic: bool) -> Mapping[Symbol, Expression]:
        """Return D, whose entries are places, too."""
        listener, question, part, path = self.options
        return {
            key: ReadNode.from_arguments(
                (entry,), self.shape, (listener, question, part, (*path, (key, heuristic)))
            )
            for key, entry in self._look(Access.SYMBOLS).gradient(heuristic).items()
        }

    def gradient_keys(self, heuristic: bool) -> frozenset[Symbol]:
        """Return the keys of D."""
        return frozenset(self._look(Access.SYMBOLS).gradient(heuristic))

    def differentiated(self, heuristic: bool) -> tuple[Expression, ...]:
        """Return nothing: the entries are asked for one by one."""
        return ()

    def depends_on(self, substitution: Substitution) -> bool:
        """Return whether a substitution changes it."""
        return substitution.changes(self._look(Access.VALUE))

    def substitute(self, substitution: Substitution) -> Expression:
        """Return what it stands for after a substitution, and so no place any more."""
        return apply_substitution(self._look(Access.VALUE), substitution)

    def _value(self) -> NoReturn:
        raise AssertionError("what calls this is overridden")

    def _gradient(self, heuristic: bool) -> NoReturn:
        raise AssertionError("what calls this is overridden")


def follow_gradient_path(expression: Expression, path: GradientPath) -> Expression:
    """Return the gradient entry that a path leads to; zero where there is none."""
    for key, heuristic in path:
        entry = expression.gradient(heuristic).get(key)
        expression = as_expression(np.zeros(expression.shape)) if entry is None else entry
    return expression


def fill_read_nodes(expression: Expression, put: Callable[[ReadNode], Expression]) -> Expression:
    """Return an expression in which places are exchanged for what belongs there.

    What was made of a place is made again of what is there now, which is not a substitution: an entry of a
    gradient that was overridden stays overridden.
    """
    if not expression._nodes:
        return expression
    images: dict[Node, Expression] = {}
    for node in topological_order(leaves(expression)[1], _below, images.__contains__):
        if isinstance(node, ReadNode):
            images[node] = put(node)
            continue
        arguments = tuple(replace_nodes(part, images) for part in node.arguments)
        if any(new is not old for new, old in zip(arguments, node.arguments, strict=True)):
            images[node] = type(node).from_arguments(arguments, node.shape, node.options)
    return replace_nodes(expression, images)


def find_read_nodes(expression: Expression) -> list[ReadNode]:
    """Return the places in an expression, at every depth."""
    nodes = topological_order(leaves(expression)[1], lambda n: n.parts, lambda _: False)
    return [node for node in nodes if isinstance(node, ReadNode)]


def _below(node: Node) -> tuple[Expression, ...]:
    return () if isinstance(node, ReadNode) else node.arguments
