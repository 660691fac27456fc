"""The types of nodes in a document, and how each is read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import casadi as ca

from kineverse.errors import KineverseError
from kineverse.expressions import layout
from kineverse.expressions.functions import Extremum, Norm, Power, Select
from kineverse.expressions.node import Augment
from kineverse.expressions.piecewise import Piecewise, checked_pieces
from kineverse.logic import And, Less, Not, Or
from kineverse.model.rates import Carried, Composed, Dependent, Rates, as_row
from kineverse.model.traces import Answer
from kineverse.symbols import ROLES, Symbol

from .checks import RefusedError, exactly, listed, name, number, numbers, shown, the, whole
from .elementary import BINARY, UNARY
from .graph import Graph
from .limits import MAX_NORM, MAX_ORDER, MAX_PATH, MAX_PIECES, MAX_QUESTIONS
from .unknowns import read_implicit


def read_node(graph: Graph, node: Any) -> None:
    """Add the next node of a table.

    Raises
    ------
    RefusedError
        If it is not what it should be.
    """
    if type(node) is not list or not node or type(node[0]) is not str:
        raise RefusedError("a node is a list that begins with its type")
    reader = NODE_TYPES.get(node[0])
    if reader is None:
        raise RefusedError(f"there is no node type {node[0][:40]!r}; types are {', '.join(NODE_TYPES)}")
    try:
        reader(graph, node)
    except KineverseError as error:
        raise RefusedError(str(error)) from None


def _constant(graph: Graph, node: list[Any]) -> None:
    _, value = exactly(node, 2)
    graph.add(ca.SX(number(value)), (), 0)


def _symbol(graph: Graph, node: list[Any]) -> None:
    path, order, role = exactly(node, 5 if node[3:4] == ["parameter"] else 4)[1:4]
    value = float(number(node[4])) if role == "parameter" else None
    if type(role) is not str or role not in ROLES:
        raise RefusedError(f"{shown(role)} is not a role; roles are {', '.join(ROLES)}")
    symbol = Symbol(graph.before + name(path), whole(order, MAX_ORDER), role, value)
    graph.add(symbol._sx, (), 0, symbol)


def _elementary(graph: Graph, node: list[Any]) -> None:
    sx, depths = graph.sx, graph.depths
    function = node[1] if len(node) > 2 and type(node[1]) is str else ""
    if function in BINARY:
        a, b = map(graph.scalar_at, exactly(node, 4)[2:])
        if function == "pow" and Power.is_needed(sx[a], sx[b]):
            graph.add_alike(Power, node[2:])
            return
        result, depth = ca.SX.binary(BINARY[function], sx[a], sx[b]), max(depths[a], depths[b])
    elif function in UNARY:
        a = graph.scalar_at(exactly(node, 3)[2])
        result, depth = ca.SX.unary(UNARY[function], sx[a]), depths[a]
    else:
        raise RefusedError(f"there is no elementary function {shown(node[1] if node[1:] else None)}")
    if result.op() == ca.OP_CONST and math.isnan(float(result)):
        raise RefusedError("the value is NaN")
    graph.add(result, (), depth)


def _element(graph: Graph, node: list[Any]) -> None:
    _, ref, index = exactly(node, 3)
    place = graph.at(ref)
    shape = graph.shapes[place]
    size = math.prod(shape)
    if not shape or not size:
        raise RefusedError(f"node {place} has no elements to choose from")
    row, column = divmod(whole(index, size - 1), layout.rows_and_columns(shape)[1])
    graph.add(graph.sx[place][row, column], (), graph.depths[place])


def _matrix(graph: Graph, node: list[Any]) -> None:
    _, given, refs = exactly(node, 3)
    shape = graph.shape(given)
    if math.prod(shape) != len(listed(refs, "the elements")):
        raise RefusedError(f"{len(refs)} elements do not fill the shape {shape}")
    stored = [i for i, ref in enumerate(refs) if ref is not None]
    places = [graph.scalar_at(refs[i]) for i in stored]
    elements = ca.vertcat(*(graph.sx[p] for p in places)) if places else ca.SX(0, 1)
    column = ca.SX(ca.Sparsity(len(refs), 1, [0, len(stored)], stored), elements)
    rows, columns = layout.rows_and_columns(shape)
    sx = layout.from_column(column, shape) if refs else ca.SX(rows, columns)
    graph.add(sx, shape, max((graph.depths[p] for p in places), default=0))


def _augment(graph: Graph, node: list[Any]) -> None:
    _, value, replace, heuristic, entries = exactly(node, 5)
    keys = [key for key, _ in graph.pairs(entries, 1)]
    if keys != sorted(keys, key=lambda symbol: symbol.sort_key):
        raise RefusedError("the entries are not sorted by path and order")
    flags = the(bool, replace, "true or false"), the(bool, heuristic, "true or false")
    graph.add_alike(Augment, [value, *(ref for _, ref in entries)], (*flags, *keys))


def _less(graph: Graph, node: list[Any]) -> None:
    _, a, b, contrast = exactly(node, 4)
    if not 0 < number(contrast) < math.inf:
        raise RefusedError("the contrast is a positive number")
    graph.add_alike(Less, [a, b], (float(contrast),))


def _not(graph: Graph, node: list[Any]) -> None:
    graph.add_alike(Not, exactly(node, 2)[1:])


def _and(graph: Graph, node: list[Any]) -> None:
    graph.add_alike(And, node[1:])


def _or(graph: Graph, node: list[Any]) -> None:
    graph.add_alike(Or, node[1:])


def _select(graph: Graph, node: list[Any]) -> None:
    graph.add_alike(Select, exactly(node, 4)[1:])


def _extremum(graph: Graph, node: list[Any]) -> None:
    if len(node) < 4:
        raise RefusedError("an extremum is one of at least two expressions")
    _, which, *refs = node
    if which not in ("min", "max"):
        raise RefusedError(f"an extremum is 'min' or 'max', not {shown(which)}")
    graph.add_alike(Extremum, refs, (which,))


def _norm(graph: Graph, node: list[Any]) -> None:
    (ref,) = exactly(node, 2)[1:]
    shape = graph.shapes[graph.at(ref)]
    if len(shape) != 1 or not shape[0]:
        raise RefusedError(f"the norm is that of a vector, not of shape {shape}")
    if shape[0] > MAX_NORM:
        raise RefusedError(f"the norm of {shape[0]} elements, more than {MAX_NORM}")
    graph.add_opaque(Norm, [ref], (), ())


def _piecewise(graph: Graph, node: list[Any]) -> None:
    _, ref, periodic, knots, pieces = exactly(node, 5)
    table = [numbers(piece) for piece in listed(pieces, "pieces")]
    options = checked_pieces(the(bool, periodic, "true or false"), numbers(knots), table)
    # All of the table is looked at for each element.
    work = sum(map(len, table)) * math.prod(graph.shapes[graph.at(ref)])
    if work > MAX_PIECES:
        raise RefusedError(f"{work} coefficients, for all elements together, more than {MAX_PIECES}")
    graph.budget.spend(work)
    graph.add_alike(Piecewise, [ref], options)


def _carried(graph: Graph, node: list[Any]) -> None:
    _, ref, table = exactly(node, 3)
    coordinate = graph.symbol(ref)
    rows = {}
    for item in listed(table, "a rate table"):
        key, row = exactly(listed(item, "a row"), 2)
        symbol = graph.symbol(key)
        if symbol in rows:
            raise RefusedError(f"'{symbol}' has two rows")
        rows[symbol] = as_row(symbol, dict(graph.pairs(row, 1)))
    if coordinate not in rows:
        raise RefusedError(f"the table has no row for '{coordinate}'")
    inside = [entry for _, row in table for _, entry in row]
    # As a model has it, and it is written: what other rows say is put into this one, and left out then.
    graph.add_opaque(Carried, [ref], (), (Rates(rows).closure(coordinate),), inside)


def _composed(graph: Graph, node: list[Any]) -> None:
    _, ref, replacements = exactly(node, 3)
    if not isinstance(graph.owner(graph.expression(ref)), (Carried, Composed)):
        raise RefusedError(f"node {ref} should be a carried coordinate")
    pairs = graph.pairs(replacements, 0)
    if any(entry.shape for _, entry in pairs):
        raise RefusedError("a symbol is replaced by a scalar")
    refs = [ref, *(entry for _, entry in replacements)]
    graph.add_opaque(Composed, refs, (), tuple(key for key, _ in pairs))


def _dependent(graph: Graph, node: list[Any]) -> None:
    _, ref, coordinate = exactly(node, 3)
    graph.add_opaque(Dependent, [graph.scalar_at(ref)], (), (graph.symbol(coordinate),))


def _read(graph: Graph, node: list[Any]) -> None:
    _, question, part, given, steps = exactly(node, 5)
    if len(listed(steps, "a path")) > MAX_PATH:
        raise RefusedError(f"a path has up to {MAX_PATH} steps")
    path = []
    for step in steps:
        ref, trends = exactly(listed(step, "a symbol, and whether trends count"), 2)
        path.append((graph.symbol(ref, 1), the(bool, trends, "true or false")))
    shape = graph.shape(given)
    graph.check_elements(shape)
    question, part = whole(question, MAX_QUESTIONS), whole(part, MAX_QUESTIONS)
    graph.keep(Answer.empty(shape, question, part, tuple(path)), 1)
    graph.has_answers = True


NODE_TYPES: Mapping[str, Callable[[Graph, list[Any]], None]] = MappingProxyType(
    {
        "constant": _constant,
        "symbol": _symbol,
        "elementary": _elementary,
        "element": _element,
        "matrix": _matrix,
        "augment": _augment,
        "less": _less,
        "not": _not,
        "and": _and,
        "or": _or,
        "select": _select,
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
"""All types of nodes, and how they are read."""
