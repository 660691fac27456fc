"""Node types of a document and their readers: elementary, logic, rates, implicit functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import casadi as ca

from kineverse.errors import KineverseError
from kineverse.expressions import layout
from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.implicit import Implicit, ImplicitFunction
from kineverse.expressions.node import Augment, Node
from kineverse.expressions.nonsmooth import Extremum, Norm, Power, Select
from kineverse.expressions.piecewise import Piecewise, check_pieces
from kineverse.logic import And, Less, Not, Or
from kineverse.model.rates import Carried, Composed, Dependent, Rates, as_row, collect_symbols
from kineverse.model.traces import ReadNode
from kineverse.symbols import ROLES, Symbol

from .budget import (
    COST_OF_STEP,
    MAX_LENGTH,
    MAX_NORM,
    MAX_ORDER,
    MAX_PATH,
    MAX_PIECES,
    MAX_QUESTIONS,
    MAX_STEPS,
)
from .json_values import (
    InvalidDocumentError,
    check_entity_name,
    check_integer,
    check_length,
    check_list,
    check_number,
    check_numbers,
    check_type,
    describe_value,
)
from .node_graph import NodeGraph

UNARY: dict[str, int] = {
    "neg": ca.OP_NEG,
    "exp": ca.OP_EXP,
    "log": ca.OP_LOG,
    "expm1": ca.OP_EXPM1,
    "log1p": ca.OP_LOG1P,
    "sqrt": ca.OP_SQRT,
    "square": ca.OP_SQ,
    "twice": ca.OP_TWICE,
    "inv": ca.OP_INV,
    "sin": ca.OP_SIN,
    "cos": ca.OP_COS,
    "tan": ca.OP_TAN,
    "arcsin": ca.OP_ASIN,
    "arccos": ca.OP_ACOS,
    "arctan": ca.OP_ATAN,
    "sinh": ca.OP_SINH,
    "cosh": ca.OP_COSH,
    "tanh": ca.OP_TANH,
    "arcsinh": ca.OP_ASINH,
    "arccosh": ca.OP_ACOSH,
    "arctanh": ca.OP_ATANH,
    "erf": ca.OP_ERF,
    "abs": ca.OP_FABS,
    "sign": ca.OP_SIGN,
    "floor": ca.OP_FLOOR,
    "ceil": ca.OP_CEIL,
    "not": ca.OP_NOT,
}

BINARY: dict[str, int] = {
    "add": ca.OP_ADD,
    "sub": ca.OP_SUB,
    "mul": ca.OP_MUL,
    "div": ca.OP_DIV,
    "pow": ca.OP_POW,
    "constpow": ca.OP_CONSTPOW,
    "arctan2": ca.OP_ATAN2,
    "hypot": ca.OP_HYPOT,
    "copysign": ca.OP_COPYSIGN,
    "fmod": ca.OP_FMOD,
    "remainder": ca.OP_REMAINDER,
    "min": ca.OP_FMIN,
    "max": ca.OP_FMAX,
    "lt": ca.OP_LT,
    "le": ca.OP_LE,
    "eq": ca.OP_EQ,
    "ne": ca.OP_NE,
    "and": ca.OP_AND,
    "or": ca.OP_OR,
    # b where a holds, else 0, even if b is NaN.
    "if_else_zero": ca.OP_IF_ELSE_ZERO,
}

ELEMENTARY_NAMES: dict[int, str] = {code: name for name, code in (*UNARY.items(), *BINARY.items())}


def read_implicit(graph: NodeGraph, node: list[Any]) -> None:
    """Add an implicit function applied to arguments."""
    # Documents of earlier versions have no domain, and neither has a function that holds everywhere.
    _, label, unknowns, inputs, residual, rows, seed, steps, arguments, *domain = check_length(
        node, 10 if len(node) > 9 else 9
    )
    x = tuple(graph.symbol(ref) for ref in check_list(unknowns, "the unknowns"))
    u = tuple(graph.symbol(ref) for ref in check_list(inputs, "the inputs"))
    r, first = graph.expression(residual), graph.expression(seed)
    # Spent before construction, which evaluates the function and so takes the steps.
    work = _newton_work(graph, r, x, check_integer(steps, MAX_STEPS))
    graph.budget.spend(work)
    graph.check_elements(r.shape)
    function = ImplicitFunction(
        name=graph.before + check_entity_name(label),
        unknowns=x,
        inputs=u,
        residual=r,
        rows=tuple(check_integer(row, MAX_LENGTH) for row in check_list(rows, "the rows that are solved")),
        seed=first,
        steps=steps,
        domain=tuple(_domain_interval(ends) for given in domain for ends in check_list(given, "a domain")),
    )
    if domain and not function.domain:
        raise InvalidDocumentError("a domain has a bound, or is left out")
    graph.work[function.key] = work
    if len(check_list(arguments, "the arguments")) != len(u):
        raise InvalidDocumentError(f"{len(arguments)} arguments for {len(u)} inputs")
    refs = [graph.check_scalar_ref(ref) for ref in arguments]
    graph.add_opaque(Implicit, refs, (len(x),), (function,), (residual, seed))


def _domain_interval(ends: Any) -> tuple[float, float]:
    lower, upper = check_numbers(ends, 2)
    return lower, upper


def _newton_work(graph: NodeGraph, residual: Expression, unknowns: tuple[Symbol, ...], steps: int) -> int:
    """Estimate the number of nodes of an implicit function with all Newton steps written out.

    Each step has the residual, its derivatives by the unknowns and the solution of a linear system. An
    implicit function inside, whose arguments contain the unknowns, is written out in each step again.
    """
    n = len(unknowns)
    size = ca.n_nodes(residual.sx)
    for inner in topological_order(leaves(residual)[1], _arguments_of, lambda _: False):
        size += sum(ca.n_nodes(part.sx) for part in inner.arguments)
        if isinstance(inner, Implicit):
            again = any(collect_symbols(a).intersection(unknowns) for a in inner.arguments)
            size += graph.work[inner.function.key] if again else 0
    return int((steps + 1) * (COST_OF_STEP + (n + 2) * size + n**3))


def _arguments_of(node: Node) -> tuple[Expression, ...]:
    return node.arguments


def read_node(graph: NodeGraph, node: Any) -> None:
    """Add the next node of a table to the graph."""
    if type(node) is not list or not node or type(node[0]) is not str:
        raise InvalidDocumentError("a node is a list that begins with its type")
    reader = NODE_TYPES.get(node[0])
    if reader is None:
        raise InvalidDocumentError(
            f"there is no node type {node[0][:40]!r}; types are {', '.join(NODE_TYPES)}"
        )
    try:
        reader(graph, node)
    except KineverseError as error:
        raise InvalidDocumentError(str(error)) from None


def _constant(graph: NodeGraph, node: list[Any]) -> None:
    _, value = check_length(node, 2)
    graph.add(ca.SX(check_number(value)), (), 0)


def _symbol(graph: NodeGraph, node: list[Any]) -> None:
    path, order, role = check_length(node, 5 if node[3:4] == ["parameter"] else 4)[1:4]
    value = float(check_number(node[4])) if role == "parameter" else None
    if type(role) is not str or role not in ROLES:
        raise InvalidDocumentError(f"{describe_value(role)} is not a role; roles are {', '.join(ROLES)}")
    symbol = Symbol(graph.before + check_entity_name(path), check_integer(order, MAX_ORDER), role, value)
    graph.add(symbol.sx, (), 0, symbol)


def _elementary(graph: NodeGraph, node: list[Any]) -> None:
    sx, depths = graph.sx, graph.depths
    function = node[1] if len(node) > 2 and type(node[1]) is str else ""
    if function in BINARY:
        a, b = map(graph.check_scalar_ref, check_length(node, 4)[2:])
        if function == "pow" and Power.is_needed(sx[a], sx[b]):
            graph.add_alike(Power, node[2:])
            return
        result, depth = ca.SX.binary(BINARY[function], sx[a], sx[b]), max(depths[a], depths[b])
    elif function in UNARY:
        a = graph.check_scalar_ref(check_length(node, 3)[2])
        result, depth = ca.SX.unary(UNARY[function], sx[a]), depths[a]
    else:
        raise InvalidDocumentError(
            f"there is no elementary function {describe_value(node[1] if node[1:] else None)}"
        )
    if result.op() == ca.OP_CONST and math.isnan(float(result)):
        raise InvalidDocumentError("the value is NaN")
    graph.add(result, (), depth)


def _element(graph: NodeGraph, node: list[Any]) -> None:
    _, ref, index = check_length(node, 3)
    place = graph.check_ref(ref)
    shape = graph.shapes[place]
    size = math.prod(shape)
    if not shape or not size:
        raise InvalidDocumentError(f"node {place} has no elements to choose from")
    row, column = divmod(check_integer(index, size - 1), layout.rows_and_columns(shape)[1])
    graph.add(graph.sx[place][row, column], (), graph.depths[place])


def _matrix(graph: NodeGraph, node: list[Any]) -> None:
    _, given, refs = check_length(node, 3)
    shape = graph.shape(given)
    if math.prod(shape) != len(check_list(refs, "the elements")):
        raise InvalidDocumentError(f"{len(refs)} elements do not fill the shape {shape}")
    stored = [i for i, ref in enumerate(refs) if ref is not None]
    places = [graph.check_scalar_ref(refs[i]) for i in stored]
    elements = ca.vertcat(*(graph.sx[p] for p in places)) if places else ca.SX(0, 1)
    column = ca.SX(ca.Sparsity(len(refs), 1, [0, len(stored)], stored), elements)
    rows, columns = layout.rows_and_columns(shape)
    sx = layout.from_column(column, shape) if refs else ca.SX(rows, columns)
    graph.add(sx, shape, max((graph.depths[p] for p in places), default=0))


def _augment(graph: NodeGraph, node: list[Any]) -> None:
    _, value, replace, heuristic, entries = check_length(node, 5)
    keys = [key for key, _ in graph.pairs(entries, 1)]
    if keys != sorted(keys, key=lambda symbol: symbol.sort_key):
        raise InvalidDocumentError("the entries are not sorted by path and order")
    flags = check_type(bool, replace, "true or false"), check_type(bool, heuristic, "true or false")
    graph.add_alike(Augment, [value, *(ref for _, ref in entries)], (*flags, *keys))


def _less(graph: NodeGraph, node: list[Any]) -> None:
    _, a, b, contrast = check_length(node, 4)
    if not 0 < check_number(contrast) < math.inf:
        raise InvalidDocumentError("the contrast is a positive number")
    graph.add_alike(Less, [a, b], (float(contrast),))


def _extremum(graph: NodeGraph, node: list[Any]) -> None:
    if len(node) < 4:
        raise InvalidDocumentError("an extremum is one of at least two expressions")
    _, which, *refs = node
    if which not in ("min", "max"):
        raise InvalidDocumentError(f"an extremum is 'min' or 'max', not {describe_value(which)}")
    graph.add_alike(Extremum, refs, (which,))


def _norm(graph: NodeGraph, node: list[Any]) -> None:
    (ref,) = check_length(node, 2)[1:]
    shape = graph.shapes[graph.check_ref(ref)]
    if len(shape) != 1 or not shape[0]:
        raise InvalidDocumentError(f"the norm is that of a vector, not of shape {shape}")
    if shape[0] > MAX_NORM:
        raise InvalidDocumentError(f"the norm of {shape[0]} elements, more than {MAX_NORM}")
    graph.add_opaque(Norm, [ref], (), ())


def _piecewise(graph: NodeGraph, node: list[Any]) -> None:
    _, ref, periodic, knots, pieces = check_length(node, 5)
    table = [check_numbers(piece) for piece in check_list(pieces, "pieces")]
    options = check_pieces(check_type(bool, periodic, "true or false"), check_numbers(knots), table)
    # Each element evaluates the whole table.
    work = sum(map(len, table)) * math.prod(graph.shapes[graph.check_ref(ref)])
    if work > MAX_PIECES:
        raise InvalidDocumentError(f"{work} coefficients, for all elements together, more than {MAX_PIECES}")
    graph.budget.spend(work)
    graph.add_alike(Piecewise, [ref], options)


def _carried(graph: NodeGraph, node: list[Any]) -> None:
    _, ref, table = check_length(node, 3)
    coordinate = graph.symbol(ref)
    rows = {}
    for item in check_list(table, "a rate table"):
        key, row = check_length(check_list(item, "a row"), 2)
        symbol = graph.symbol(key)
        if symbol in rows:
            raise InvalidDocumentError(f"'{symbol}' has two rows")
        rows[symbol] = as_row(symbol, dict(graph.pairs(row, 1)))
    if coordinate not in rows:
        raise InvalidDocumentError(f"the table has no row for '{coordinate}'")
    inside = [entry for _, row in table for _, entry in row]
    # The form that models have and write: rows of other coordinates are substituted into this one.
    graph.add_opaque(Carried, [ref], (), (Rates(rows).closure(coordinate),), inside)


def _composed(graph: NodeGraph, node: list[Any]) -> None:
    _, ref, replacements = check_length(node, 3)
    if not isinstance(graph.owner(graph.expression(ref)), (Carried, Composed)):
        raise InvalidDocumentError(f"node {ref} should be a carried coordinate")
    pairs = graph.pairs(replacements, 0)
    if any(entry.shape for _, entry in pairs):
        raise InvalidDocumentError("a symbol is replaced by a scalar")
    refs = [ref, *(entry for _, entry in replacements)]
    graph.add_opaque(Composed, refs, (), tuple(key for key, _ in pairs))


def _dependent(graph: NodeGraph, node: list[Any]) -> None:
    _, ref, coordinate = check_length(node, 3)
    graph.add_opaque(Dependent, [graph.check_scalar_ref(ref)], (), (graph.symbol(coordinate),))


def _read(graph: NodeGraph, node: list[Any]) -> None:
    _, question, part, given, steps = check_length(node, 5)
    if len(check_list(steps, "a path")) > MAX_PATH:
        raise InvalidDocumentError(f"a path has up to {MAX_PATH} steps")
    path = []
    for step in steps:
        ref, trends = check_length(check_list(step, "a symbol, and whether trends count"), 2)
        path.append((graph.symbol(ref, 1), check_type(bool, trends, "true or false")))
    shape = graph.shape(given)
    graph.check_elements(shape)
    question, part = check_integer(question, MAX_QUESTIONS), check_integer(part, MAX_QUESTIONS)
    graph.keep(ReadNode.empty(shape, question, part, tuple(path)), 1)
    graph.has_read_nodes = True


NODE_TYPES: Mapping[str, Callable[[NodeGraph, list[Any]], None]] = MappingProxyType(
    {
        "constant": _constant,
        "symbol": _symbol,
        "elementary": _elementary,
        "element": _element,
        "matrix": _matrix,
        "augment": _augment,
        "less": _less,
        "not": lambda graph, node: graph.add_alike(Not, check_length(node, 2)[1:]),
        "and": lambda graph, node: graph.add_alike(And, node[1:]),
        "or": lambda graph, node: graph.add_alike(Or, node[1:]),
        "select": lambda graph, node: graph.add_alike(Select, check_length(node, 4)[1:]),
        "extremum": _extremum,
        "norm": _norm,
        "piecewise": _piecewise,
        "carried": _carried,
        "composed": _composed,
        "dependent": _dependent,
        "implicit": read_implicit,
        "read": _read,
    }
)
"""Readers of all node types, by the name of the type."""
