"""What operations write, as JSON values and back.

A frame is ``{"parent": name, "factors": [...]}``, each factor a pose (its 12 numbers) or the place of an
expression; a constraint the places of ``[lower, expression, upper]``; a rate
``[coordinate, [[speed, ref], ...]]``. Data are texts, numbers, true, false, null and lists of these; an
expression is ``{"expression": ref}``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, TypeAlias

from kineverse.errors import FormatError
from kineverse.expressions.expression import Expression
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose
from kineverse.model.constraint import Constraint
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES
from kineverse.model.rates import Entry, as_entry
from kineverse.symbols import Symbol

from .checks import RefusedError, exactly, fields, listed, name, number, numbers, string
from .graph import Graph
from .limits import MAX_DEPTH, check_depth
from .shapes import (
    read_body,
    read_pose,
    written_body,
    written_number,
    written_numbers,
    written_pose,
    written_text,
)

Ref: TypeAlias = Callable[[Expression], int]
Rename: TypeAlias = Callable[[str], str]

MAX_BITS = 10_000
"""The longest integer: Python reads no more than 4300 digits."""
PLAIN_BITS = 63
"""The longest integer that is written as a number, as other languages and msgpack have no longer ones."""
DATUM_TAGS = ("expression", "float", "integer")
_INTEGER = re.compile("-?[0-9]{1,3011}")


# -- writing -------------------------------------------------------------------------------------------------


def written(kind: str, value: Any, ref: Ref) -> Any:
    """Return a value as JSON has it.

    Raises
    ------
    FormatError
        For what a document has no place for.
    """
    if kind == FRAMES:
        factors = [written_pose(f) if isinstance(f, Pose) else ref(f) for f in value.factors]
        return {"parent": value.parent, "factors": factors}
    if kind == CONSTRAINTS:
        return [ref(value.lower), ref(value.expression), ref(value.upper)]
    if kind == RATES:
        coordinate, row = value
        if isinstance(row, Expression):
            return [ref(coordinate), ref(row)]
        return [ref(coordinate), [[ref(speed), ref(entry)] for speed, entry in row]]
    if kind == BODIES:
        return written_body(value)
    if kind == ARTICULATIONS:
        record = {
            "kind": written_text(value.kind),
            "parent": written_text(value.parent),
            "child": written_text(value.child),
            "coordinates": [ref(s) for s in value.coordinates],
            "home": written_numbers(value.home),
            "speeds": [ref(s) for s in value.speeds],
            "dynamics": [[written_text(item), written_datum(datum, ref)] for item, datum in value.dynamics],
        }
        return record if value.follows is None else {**record, "follows": ref(value.follows)}
    return written_datum(value, ref)


def written_datum(value: Any, ref: Ref, depth: int = 0) -> Any:
    """Return a datum as JSON has it, which lies in so many tuples.

    Raises
    ------
    FormatError
        For what is none.
    """
    if type(value) is int and value.bit_length() > MAX_BITS:
        raise FormatError(f"an integer of {value.bit_length()} bits is too long, of more than {MAX_BITS}")
    if type(value) is int and value.bit_length() > PLAIN_BITS:
        return {"integer": str(value)}
    if value is None or type(value) in (bool, int, str):
        return value
    if isinstance(value, float):  # numpy's is one, too
        number = float(value)
        return number if math.isfinite(number) else {"float": written_number(number)}
    if type(value) is tuple:
        if depth > MAX_DEPTH:
            raise FormatError(f"it is nested too deeply, in more than {MAX_DEPTH} others")
        return [written_datum(item, ref, depth + 1) for item in value]
    if isinstance(value, Expression):
        return {"expression": ref(value)}
    raise FormatError(
        f"a {type(value).__name__} cannot be saved; write texts, numbers, true or false, None, expressions "
        "and tuples of these"
    )


# -- reading -------------------------------------------------------------------------------------------------


def as_read(kind: str, value: Any, graph: Graph, rename: Rename) -> Any:
    """Return what JSON has as the value of an operation.

    Raises
    ------
    RefusedError
        Where it is not what it should be.
    """
    return _READERS[kind](value, graph, rename)


def frame_name(value: Any, rename: Rename) -> str:
    """Return the name of a frame that may be the world."""
    given = name(value)
    return given if given == WORLD else rename(given)


def _read_frame(value: Any, graph: Graph, rename: Rename) -> Frame:
    given = fields(value, ("parent", "factors"))
    factors: list[Pose | Expression] = []
    for factor in listed(given["factors"], "factors"):
        if type(factor) is list:
            factors.append(read_pose(factor))
            continue
        transform = graph.expression(factor)
        if transform.shape != (4, 4):
            raise RefusedError(f"a factor should be 4×4, not of shape {transform.shape}")
        factors.append(transform)
    return Frame(frame_name(given["parent"], rename), tuple(factors))


def _read_constraint(value: Any, graph: Graph, rename: Rename) -> Constraint:
    return Constraint(*map(graph.scalar, exactly(listed(value, "lower, expression, upper"), 3)))


def _read_rate(value: Any, graph: Graph, rename: Rename) -> tuple[Symbol, Entry]:
    coordinate, entry = exactly(listed(value, "a coordinate, and its row or what it depends on"), 2)
    symbol = graph.symbol(coordinate)
    if type(entry) is int:
        return symbol, as_entry(symbol, graph.scalar(entry))
    return symbol, as_entry(symbol, dict(graph.pairs(entry, 1)))


def _read_articulation(value: Any, graph: Graph, rename: Rename) -> Articulation:
    required = ("kind", "parent", "child", "coordinates", "home", "speeds", "dynamics")
    given = fields(value, required, ("follows",))
    dynamics = [exactly(listed(d, "name and value"), 2) for d in listed(given["dynamics"], "dynamics")]
    coordinates = tuple(map(graph.symbol, listed(given["coordinates"], "coordinates")))
    home = numbers(given["home"])
    names = [symbol.path.rpartition("/")[2] for symbol in coordinates]
    for k in range(len(names) - 3):
        if names[k : k + 4] == ["qx", "qy", "qz", "qw"] and not any(home[k : k + 4]):
            raise RefusedError("its home has a quaternion of length zero, at which nothing has a pose")
    return Articulation(
        string(given["kind"]),
        frame_name(given["parent"], rename),
        frame_name(given["child"], rename),
        coordinates,
        home,
        tuple(graph.symbol(ref, 1) for ref in listed(given["speeds"], "speeds")),
        tuple((string(item), read_datum(datum, graph, rename)) for item, datum in dynamics),
        graph.scalar(given["follows"]) if "follows" in given else None,
    )


def read_datum(value: Any, graph: Graph, rename: Rename, depth: int = 0) -> Any:
    """Return a datum that was written, and lies in so many lists."""
    if type(value) is list:
        check_depth(depth)
        return tuple([read_datum(item, graph, rename, depth + 1) for item in value])
    if type(value) is dict:
        return _read_tagged(value, graph)
    if type(value) is int and value.bit_length() > PLAIN_BITS:
        raise RefusedError('an integer of more than 64 bits is written {"integer": "its digits"}')
    if type(value) is str:
        return string(value)
    if value is not None and type(value) not in (bool, int, float):
        raise RefusedError(f"a {type(value).__name__} is no datum")
    return number(value) if type(value) is float else value


def _read_tagged(value: dict[str, Any], graph: Graph) -> Any:
    given = fields(value, (), DATUM_TAGS)
    if len(given) != 1:
        raise RefusedError(f"an object among data has one of the keys {', '.join(DATUM_TAGS)}")
    ((tag, inner),) = given.items()
    if tag == "expression":
        return graph.expression(inner)
    if tag == "float" and inner in ("inf", "-inf"):
        return number(inner)
    if tag == "integer" and type(inner) is str and _INTEGER.fullmatch(inner):
        return int(inner)
    raise RefusedError(f"{tag!r} is the place of an expression, 'inf' or '-inf', or the digits of an integer")


_READERS: dict[str, Callable[[Any, Graph, Rename], Any]] = {
    FRAMES: _read_frame,
    BODIES: lambda value, graph, rename: read_body(value),
    ARTICULATIONS: _read_articulation,
    CONSTRAINTS: _read_constraint,
    RATES: _read_rate,
    DATA: read_datum,
}
