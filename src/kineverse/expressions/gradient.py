"""Augmented gradients: the chain rule over symbols and opaque nodes (2022 paper, Eqs. 5-8).

For an expression e with leaves l (symbols and elements of nodes), ``D(e)[w] = Σ_l ∂e/∂l · D(l)[w]``, where a
symbol a has ``D(a) = {ȧ: 1}``, a parameter ``{}`` and a node its own D. CasADi computes the partial
derivatives, all keys at once.
"""

from __future__ import annotations

import math
from collections.abc import ItemsView, Iterator, KeysView, Mapping, Sequence, ValuesView
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from kineverse.errors import ExpressionError, UnknownNameError, suggest

from . import layout
from .expression import Expression, access_listener, array, as_expression, from_casadi, union_nodes
from .graph import leaves, topological_order
from .substitution import apply_substitution, dummy_symbols, rename_symbols, replace_nodes

if TYPE_CHECKING:
    from kineverse.symbols import Symbol

    from .node import Node


class Gradient(Mapping["Symbol", Expression]):
    """D(e): an immutable mapping from derivative symbols to expressions, in the order of the symbols.

    Keys are symbols or their names, such as ``door:velocity``. Called with the values of symbols, it returns
    the numbers of its entries by name.
    """

    __slots__ = ("_about", "_entries", "_of")

    def __init__(
        self,
        entries: Mapping[Symbol, Expression],
        about: tuple[Symbol, ...] = (),
        of: Expression | None = None,
    ) -> None:
        self._entries, self._about = dict(entries), about
        self._of = of  # the expression, if some of the entries may be trends

    def __getitem__(self, key: Symbol | str) -> Expression:
        entry: Expression | None = self.get(key)
        if entry is not None:
            return entry
        name = str(key)
        raise UnknownNameError(
            f"The gradient has no entry for '{name}'; its keys are speeds. "
            f"{suggest(name, map(str, self._entries), 'speed')}"
        )

    def __contains__(self, key: object) -> bool:
        return self.get(key) is not None

    def __iter__(self) -> Iterator[Symbol]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    # The methods of dict are several times faster than those of Mapping.

    def get(self, key: object, default: Any = None) -> Any:
        """Return the entry of a speed, by symbol or name, else the default."""
        if isinstance(key, str):
            return next((entry for speed, entry in self._entries.items() if str(speed) == key), default)
        return self._entries.get(key, default)  # type: ignore[call-overload]

    def keys(self) -> KeysView[Symbol]:
        """Return the speeds, sorted."""
        return self._entries.keys()

    def values(self) -> ValuesView[Expression]:
        """Return the entries, in the order of their speeds."""
        return self._entries.values()

    def items(self) -> ItemsView[Symbol, Expression]:
        """Return speeds and entries."""
        return self._entries.items()

    def __call__(self, values: Mapping[Any, Any] | None = None, /, **by_name: float) -> dict[str, Any]:
        """Return the numbers of all entries by the names of their speeds: floats, or arrays of their shape.

        Parameters
        ----------
        values
            Numbers of symbols, as for the expression itself, see :meth:`Expression.__call__`.

        Raises
        ------
        UnknownNameError
            For missing values, listed, and for names that the expression does not contain.
        """
        from .evaluation import evaluate_mapping

        return evaluate_mapping(self._entries, self._about, {} if values is None else values, by_name)

    @property
    def trends(self) -> frozenset[Symbol]:
        """Speeds whose entries are trends: directions of search, which the exact gradient does not have."""
        if self._of is None:
            return frozenset()
        exact = gradient(self._of, heuristic=False)
        return frozenset(speed for speed, entry in self._entries.items() if entry != exact.get(speed))

    def __reduce__(self) -> Any:
        return Gradient, (self._entries, self._about, self._of)

    def __repr__(self) -> str:
        from .printing import mapping_text

        return mapping_text(self)

    def _repr_latex_(self) -> str:
        from .printing import gradient_latex

        return f"$\\displaystyle {gradient_latex(self, self.trends)}$"


def gradient(expression: Expression, heuristic: bool = True) -> Gradient:
    """Return D(e), see :meth:`Expression.gradient`."""
    known = expression._gradients.get(heuristic)
    if known is None:
        may_have_trends = heuristic and bool(expression._nodes)
        of = expression if may_have_trends else None
        known = Gradient(_gradient(expression, heuristic), expression.symbols, of)
        expression._gradients[heuristic] = known
    result: Gradient = known
    return result


def _gradient(expression: Expression, heuristic: bool) -> dict[Symbol, Expression]:
    symbols, inner = leaves(expression)
    if len(symbols) == 1 and symbols[0] is expression:
        return {symbols[0].derivative(): as_expression(1.0)} if symbols[0].has_derivative else {}
    # Only leaves with a gradient take part: the partial derivative by a parameter in an exponent is NaN for a
    # negative base.
    moving = [s for s in symbols if s.has_derivative]
    for node in topological_order(
        inner, lambda n: n.differentiated(heuristic), lambda n: heuristic in n._gradients
    ):
        node.gradient(heuristic)
    if len(inner) == 1 and expression._sx is inner[0].sx:
        return dict(sorted(inner[0].gradient(heuristic).items(), key=lambda item: item[0].sort_key))
    opaque = [(node, entries) for node in inner if (entries := node.gradient(heuristic))]
    if not moving and not opaque:
        return {}
    every = {s.derivative() for s in moving}.union(*(entries for _, entries in opaque))
    keys = sorted(every, key=lambda s: s.sort_key)
    # Shared parts determine the order of sums, and so the last bit: equal expressions share equal parts.
    elements = ca.cse(layout.column(expression._sx, expression._shape))
    if not opaque:
        by_key = ca.jacobian(elements, ca.vertcat(*(s._sx for s in moving)))
        column_of = {s.derivative(): i for i, s in enumerate(moving)}
        return _collect(expression, by_key, [column_of[k] for k in keys], keys, expression._nodes)
    position = {key: i for i, key in enumerate(keys)}
    blocks = [s._sx for s in moving] + [layout.column(n.sx, n.shape) for n, _ in opaque]
    seeds = []
    for symbol in moving:
        row = ca.SX(1, len(keys))
        row[0, position[symbol.derivative()]] = 1
        seeds.append(row)
    nodes = expression._nodes
    for node, entries in opaque:
        rows = ca.SX(node.size, len(keys))
        for key, value in entries.items():
            rows[:, position[key]] = layout.column(value._sx, value._shape)
        nodes = nodes | union_nodes(list(entries.values()))
        seeds.append(ca.sparsify(rows))
    # Cheaper than ca.jtimes, which differentiates once per key.
    by_key = ca.mtimes(ca.jacobian(elements, ca.vertcat(*blocks)), ca.vertcat(*seeds))
    return _collect(expression, by_key, list(range(len(keys))), keys, nodes)


def _collect(
    expression: Expression, by_key: layout.SX, columns: list[int], keys: list[Symbol], nodes: frozenset[Node]
) -> dict[Symbol, Expression]:
    shape = expression._shape
    result = {}
    for key, index in zip(keys, columns, strict=True):
        entry = by_key[:, index]
        if not entry.is_zero():
            result[key] = from_casadi(layout.from_column(ca.densify(entry), shape), shape, nodes)
    return result


def jacobian(expression: Expression, symbols: Sequence[Symbol], heuristic: bool = True) -> Expression:
    """Return the derivatives by ``symbols`` along the last axis, see :meth:`Expression.jacobian`."""
    from kineverse.symbols import check_symbols

    wanted = check_symbols(symbols)
    for symbol in wanted:
        if not symbol.has_derivative:
            raise ExpressionError(
                f"Parameter '{symbol}' has no derivative to read a column from; "
                "use partial([...]) for ∂/∂parameter."
            )
    listener = access_listener(expression)
    if listener is not None:
        kind = "jacobian" if heuristic else "facts"
        result: Expression = listener.ask(kind, expression, array(list(wanted)))
        return result
    entries = gradient(expression, heuristic)
    columns = [entries.get(symbol.derivative()) for symbol in wanted]
    speeds = [symbol for symbol in wanted if symbol in entries]
    if speeds and not any(column is not None for column in columns):
        raise ExpressionError(
            f"'{speeds[0]}' is a speed, and the columns of a jacobian are named by positions: that of "
            f"'{speeds[0].integral()}' is D(e)['{speeds[0]}']. Pass positions, as model.degrees_of_freedom, "
            "or read e.gradient(), whose keys are speeds; model.rates.over_free_speeds(e.gradient()) has "
            "columns for all free speeds, those of wheels as well. For the derivative by a speed "
            "itself, which is 0 here, there is partial([...])."
        )
    return stack_columns(columns, expression._shape)


def partial(expression: Expression, symbols: Sequence[Symbol]) -> Expression:
    """Return the plain partial derivatives, see :meth:`Expression.partial`."""
    from kineverse.symbols import check_symbols

    wanted = check_symbols(symbols)
    listener = access_listener(expression)
    if listener is not None:
        result: Expression = listener.ask("partial", expression, array(list(wanted)))
        return result
    # D has no entries for parameters; dummy symbols with a derivative take their places.
    moving = dummy_symbols(wanted)
    entries = gradient(rename_symbols(_without_augmentation(expression), moving), False)
    back = {stand_in: s for s, stand_in in moving.items()}
    columns = [entries.get(moving.get(s, s).derivative()) for s in wanted]
    renamed = [c if c is None else apply_substitution(c, back) for c in columns]
    return stack_columns(renamed, expression._shape)


def _without_augmentation(expression: Expression) -> Expression:
    """Return an expression of the same value whose gradient is that of the value."""
    plain: dict[Node, Expression] = {}

    def parts(node: Node) -> tuple[Expression, ...]:
        return node.arguments if node.own_partials else (node.value,)

    for node in topological_order(leaves(expression)[1], parts, plain.__contains__):
        replaced = tuple(replace_nodes(part, plain) for part in parts(node))
        own = node.own_partials
        plain[node] = type(node).from_arguments(replaced, node.shape, node.options) if own else replaced[0]
    return replace_nodes(expression, plain)


def stack_columns(columns: list[Expression | None], shape: layout.ArrayShape) -> Expression:
    """Return expressions of one shape, None for zero, along a new last axis."""
    size = math.prod(shape)
    stored = [ca.SX.zeros(size, 1) if c is None else layout.column(c._sx, c._shape) for c in columns]
    matrix = ca.horzcat(*stored) if stored else ca.SX.zeros(size, 0)
    full = (*shape, len(columns))
    # The rows are the elements of the expression in C order, which is the layout of the longer shape, except
    # for a vector, which is stored as a column.
    stored_matrix = matrix if shape else matrix.T
    return from_casadi(stored_matrix, full, union_nodes([c for c in columns if c is not None]))


def total_derivative(expression: Expression, heuristic: bool = False) -> Expression:
    """Return ``ė = Σ D(e)[v]·v``, of the expression's shape: its rate as a function of the speeds.

    Examples
    --------
    >>> x, y = kv.position("x"), kv.position("y")
    >>> kv.expressions.total_derivative(x * y)
    y*x:velocity + x*y:velocity
    """
    if not expression._shape and not expression._nodes and expression._sx.is_symbolic():
        (symbol,) = expression.symbols  # the most frequent case: a limit on a joint's speed
        return symbol.derivative() if symbol.has_derivative else as_expression(0.0)
    rate = as_expression(np.zeros(expression.shape))
    for key, entry in gradient(expression, heuristic).items():
        rate = rate + entry * key
    return rate
