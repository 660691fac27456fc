"""Readers of the node types of a document: elementary functions, logic, rates, implicit functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import casadi as ca
from msgspec import Struct

from kineverse.errors import KineverseError
from kineverse.expressions import layout
from kineverse.expressions.expression import NO_NODES, Expression, from_casadi
from kineverse.expressions.graph import leaves, topological_order
from kineverse.expressions.implicit import Implicit, ImplicitFunction
from kineverse.expressions.node import Augment
from kineverse.expressions.nonsmooth import Extremum, Norm, Power, Select
from kineverse.expressions.piecewise import Piecewise, check_pieces
from kineverse.logic import And, Less, Not, Or
from kineverse.model.rates import Carried, Composed, Dependent, Rates, as_row, collect_symbols
from kineverse.model.traces import ReadNode
from kineverse.spatial import X, Y, Z, rotation_about, translation_along
from kineverse.symbols import Symbol

from .budget import COST_OF_STEP, MAX_NORM, MAX_PIECES, InvalidDocumentError
from .node_graph import NodeGraph
from .structs import NODES, AnyNode

_UNARY = """neg exp log expm1 log1p sqrt square=SQ twice inv sin cos tan arcsin=ASIN arccos=ACOS arctan=ATAN
    sinh cosh tanh arcsinh=ASINH arccosh=ACOSH arctanh=ATANH erf abs=FABS sign floor ceil not"""
# if_else_zero is b where a holds, else 0, even if b is NaN.
_BINARY = """add sub mul div pow constpow arctan2=ATAN2 hypot copysign fmod remainder min=FMIN max=FMAX
    lt le eq ne and or if_else_zero"""


def _codes(names: str) -> dict[str, int]:
    """Return CasADi's codes by our names, of which some are those of numpy."""
    pairs = (pair.partition("=") for pair in names.split())
    return {name: getattr(ca, f"OP_{other or name.upper()}") for name, _, other in pairs}


UNARY, BINARY = _codes(_UNARY), _codes(_BINARY)
ELEMENTARY_NAMES: dict[int, str] = {code: name for name, code in (*UNARY.items(), *BINARY.items())}


_AXES = (X, Y, Z)
_UNIT_TOLERANCE = 1e-9  # largest difference of the length of a direction from 1
_STEPS_OF_MOTION = 6  # CasADi's steps for the matrix of a rotation or translation, at most


def read_nodes(graph: NodeGraph, nodes: tuple[AnyNode, ...]) -> None:
    """Add the nodes of a table to the graph."""
    for node in nodes:
        try:
            _READERS[type(node)](graph, node)
        except (InvalidDocumentError, KineverseError) as error:
            raise InvalidDocumentError(f"nodes[{len(graph.sx)}]: {error}") from None


def decode_number(value: float | str) -> float:
    """Decode a number, of which infinities are texts."""
    return float(value)


@lru_cache(4096)
def _make_constant(value: float, sign: float) -> Expression:
    # 0.0 and -0.0 are equal keys.
    return from_casadi(ca.SX(value), (), NO_NODES)


def _constant(graph: NodeGraph, node: Any) -> None:
    value = decode_number(node.value)
    made = _make_constant(value, math.copysign(1.0, value))
    graph.add(made.sx, (), 0, made)


def check_name(name: str) -> str:
    """Return a name after checking that none of its parts is empty."""
    if not name or "//" in f"/{name}/":
        raise InvalidDocumentError(f"a name is expected, whose parts are not empty, not {name[:60]!r}")
    return name


def _symbol(graph: NodeGraph, node: Any) -> None:
    symbol = Symbol(graph.before + check_name(node.path), node.order, node.role)
    graph.add(symbol.sx, (), 0, symbol)


def _parameter(graph: NodeGraph, node: Any) -> None:
    symbol = Symbol(graph.before + check_name(node.path), 0, "parameter", decode_number(node.value))
    graph.add(symbol.sx, (), 0, symbol)


def _elementary(graph: NodeGraph, node: Any) -> None:
    sx, depths, function = graph.sx, graph.depths, node.function
    refs = [graph.check_scalar_ref(ref) for ref in node.arguments]
    if len(refs) != (2 if function in BINARY else 1):
        raise InvalidDocumentError(f"{function[:60]!r} has {len(refs)} arguments")
    if function in BINARY:
        a, b = refs
        if function == "constpow" and not sx[b].is_constant():
            raise InvalidDocumentError("the exponent of 'constpow' is a number; any other is one of 'pow'")
        if function == "pow" and Power.is_needed(sx[a], sx[b]):
            graph.add_alike(Power, node.arguments)
            return
        result, depth = ca.SX.binary(BINARY[function], sx[a], sx[b]), max(depths[a], depths[b])
    elif function in UNARY:
        result, depth = ca.SX.unary(UNARY[function], sx[refs[0]]), depths[refs[0]]
    else:
        raise InvalidDocumentError(f"there is no elementary function {function[:60]!r}")
    if result.op() == ca.OP_CONST and math.isnan(float(result)):
        raise InvalidDocumentError("the value is NaN")
    graph.add(result, (), depth)


def _element(graph: NodeGraph, node: Any) -> None:
    place = graph.check_ref(node.array)
    shape = graph.shapes[place]
    size = math.prod(shape)
    if not shape or not size:
        raise InvalidDocumentError(f"node {place} has no elements to choose from")
    if node.index >= size:
        raise InvalidDocumentError(f"node {place} has {size} elements, and none at {node.index}")
    row, column = divmod(node.index, layout.rows_and_columns(shape)[1])
    graph.add(graph.graph_of(place)[row, column], (), graph.depths[place])


def _matrix(graph: NodeGraph, node: Any) -> None:
    shape, refs = graph.shape(node.shape), node.elements
    if math.prod(shape) != len(refs):
        raise InvalidDocumentError(f"{len(refs)} elements do not fill the shape {shape}")
    stored = [i for i, ref in enumerate(refs) if ref is not None]
    places = [graph.check_scalar_ref(ref) for ref in refs if ref is not None]
    elements = ca.vertcat(*(graph.sx[p] for p in places)) if places else ca.SX(0, 1)
    column = ca.SX(ca.Sparsity(len(refs), 1, [0, len(stored)], stored), elements)
    rows, columns = layout.rows_and_columns(shape)
    sx = layout.from_column(column, shape) if refs else ca.SX(rows, columns)
    graph.add(sx, shape, max((graph.depths[p] for p in places), default=0))


def _rotation(graph: NodeGraph, node: Any) -> None:
    if node.axis not in _AXES:
        raise InvalidDocumentError("a rotation is about one of the axes x, y and z")
    place = graph.check_scalar_ref(node.angle)
    graph.add(None, (4, 4), graph.depths[place], rotation_about(node.axis, graph.expression(place)))
    graph.steps += _STEPS_OF_MOTION


def _translation(graph: NodeGraph, node: Any) -> None:
    if not abs(math.hypot(*node.direction) - 1) <= _UNIT_TOLERANCE:
        raise InvalidDocumentError("the direction of a translation is of length 1")
    place = graph.check_scalar_ref(node.distance)
    graph.add(None, (4, 4), graph.depths[place], translation_along(node.direction, graph.expression(place)))
    graph.steps += _STEPS_OF_MOTION


def _augment(graph: NodeGraph, node: Any) -> None:
    keys = [key for key, _ in graph.pairs(node.entries, 1)]
    if keys != sorted(keys, key=lambda symbol: symbol.sort_key):
        raise InvalidDocumentError("the entries are not sorted by path and order")
    refs = (node.value, *(ref for _, ref in node.entries))
    graph.add_alike(Augment, refs, (node.replace, node.heuristic, *keys))


def _less(graph: NodeGraph, node: Any) -> None:
    if not node.contrast > 0:
        raise InvalidDocumentError("the contrast is a positive number")
    graph.add_alike(Less, (node.left, node.right), (node.contrast,))


def _norm(graph: NodeGraph, node: Any) -> None:
    shape = graph.shapes[graph.check_ref(node.argument)]
    if len(shape) != 1 or not shape[0]:
        raise InvalidDocumentError(f"the norm is that of a vector, not of shape {shape}")
    if shape[0] > MAX_NORM:
        raise InvalidDocumentError(f"the norm of {shape[0]} elements, more than {MAX_NORM}")
    graph.add_opaque(Norm, (node.argument,), (), ())


def _piecewise(graph: NodeGraph, node: Any) -> None:
    options = check_pieces(node.periodic, node.knots, list(node.pieces))
    # Each element evaluates the whole table.
    work = sum(map(len, node.pieces)) * math.prod(graph.shapes[graph.check_ref(node.argument)])
    if work > MAX_PIECES:
        raise InvalidDocumentError(f"{work} coefficients, for all elements together, more than {MAX_PIECES}")
    graph.budget.spend(work)
    graph.add_alike(Piecewise, (node.argument,), options)


def _carried(graph: NodeGraph, node: Any) -> None:
    coordinate = graph.symbol(node.coordinate)
    rows = {}
    for key, row in node.rates:
        symbol = graph.symbol(key)
        if symbol in rows:
            raise InvalidDocumentError(f"'{symbol}' has two rows")
        rows[symbol] = as_row(symbol, dict(graph.pairs(row, 1)))
    if coordinate not in rows:
        raise InvalidDocumentError(f"the table has no row for '{coordinate}'")
    inside = [entry for _, row in node.rates for _, entry in row]
    # The form that models have and write: rows of other coordinates are substituted into this one.
    graph.add_opaque(Carried, (node.coordinate,), (), (Rates(rows).closure(coordinate),), inside)


def _composed(graph: NodeGraph, node: Any) -> None:
    if not isinstance(graph.owner(graph.expression(node.coordinate)), (Carried, Composed)):
        raise InvalidDocumentError(f"node {node.coordinate} should be a carried coordinate")
    pairs = graph.pairs(node.replacements, 0)
    if any(entry.shape for _, entry in pairs):
        raise InvalidDocumentError("a symbol is replaced by a scalar")
    refs = (node.coordinate, *(entry for _, entry in node.replacements))
    graph.add_opaque(Composed, refs, (), tuple(key for key, _ in pairs))


def _dependent(graph: NodeGraph, node: Any) -> None:
    value = graph.check_scalar_ref(node.value)
    graph.add_opaque(Dependent, (value,), (), (graph.symbol(node.coordinate),))


def _implicit(graph: NodeGraph, node: Any) -> None:
    unknowns = tuple(map(graph.symbol, node.unknowns))
    inputs = tuple(map(graph.symbol, node.inputs))
    residual, seed = graph.expression(node.residual), graph.expression(node.seed)
    # Spent before construction, which evaluates the function and so takes the steps.
    work = _newton_work(graph, residual, unknowns, node.steps)
    graph.budget.spend(work)
    graph.check_elements(residual.shape)
    function = ImplicitFunction(
        name=graph.before + check_name(node.name),
        unknowns=unknowns,
        inputs=inputs,
        residual=residual,
        rows=node.rows,
        seed=seed,
        steps=node.steps,
        domain=tuple((decode_number(lower), decode_number(upper)) for lower, upper in node.domain),
    )
    if node.domain and not function.domain:
        raise InvalidDocumentError("a domain has a bound, or is left out")
    graph.budget.functions[function.key] = work
    if len(node.arguments) != len(inputs):
        raise InvalidDocumentError(f"{len(node.arguments)} arguments for {len(inputs)} inputs")
    refs = tuple(map(graph.check_scalar_ref, node.arguments))
    graph.add_opaque(Implicit, refs, (len(unknowns),), (function,), (node.residual, node.seed))


def _newton_work(graph: NodeGraph, residual: Expression, unknowns: tuple[Symbol, ...], steps: int) -> int:
    """Estimate the number of nodes of an implicit function with all Newton steps written out.

    Each step has the residual, its derivatives by the unknowns and the solution of a linear system. An
    implicit function inside, whose arguments contain the unknowns, is written out in each step again.
    """
    n = len(unknowns)
    size = ca.n_nodes(residual.sx)
    for inner in topological_order(leaves(residual)[1], lambda n: n.arguments, lambda _: False):
        size += sum(ca.n_nodes(part.sx) for part in inner.arguments)
        if isinstance(inner, Implicit):
            again = any(collect_symbols(a).intersection(unknowns) for a in inner.arguments)
            size += graph.budget.functions[inner.function.key] if again else 0
    return int((steps + 1) * (COST_OF_STEP + (n + 2) * size + n**3))


def _read(graph: NodeGraph, node: Any) -> None:
    path = tuple((graph.symbol(ref, 1), trends) for ref, trends in node.path)
    shape = graph.shape(node.shape)
    graph.check_elements(shape)
    graph.keep(ReadNode.empty(shape, node.question, node.part, path), 1)
    graph.has_read_nodes = True


_READERS: Mapping[type[Struct], Callable[[NodeGraph, Any], None]] = MappingProxyType(
    {
        NODES[tag]: reader
        for tag, reader in {
            "constant": _constant,
            "symbol": _symbol,
            "parameter": _parameter,
            "elementary": _elementary,
            "element": _element,
            "matrix": _matrix,
            "rotation": _rotation,
            "translation": _translation,
            "augment": _augment,
            "less": _less,
            "not": lambda graph, node: graph.add_alike(Not, (node.argument,)),
            "and": lambda graph, node: graph.add_alike(And, node.arguments),
            "or": lambda graph, node: graph.add_alike(Or, node.arguments),
            "select": lambda graph, node: graph.add_alike(
                Select, (node.condition, node.chosen, node.otherwise)
            ),
            "extremum": lambda graph, node: graph.add_alike(Extremum, node.arguments, (node.which,)),
            "norm": _norm,
            "piecewise": _piecewise,
            "carried": _carried,
            "composed": _composed,
            "dependent": _dependent,
            "implicit": _implicit,
            "read": _read,
        }.items()
    }
)
