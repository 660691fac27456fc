"""Budget of work and sizes that a document may cost, checked before it is spent.

A text of some kilobytes can ask for a lot of work: arrays of many elements that are repeated by each node
above them, Newton steps that are made within Newton steps. So reading has a budget of steps, each about what
one node of an expression costs, and what would go over it is refused. A robot takes some ten thousand.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from kineverse.expressions.expression import Expression
from kineverse.model.rate_nodes import collect_symbols
from kineverse.symbols import Symbol

from .schema import InvalidDocumentError

MAX_NODES = 1 << 22
MAX_LISTS = 10_000_000
"""Lists and objects in a document."""
MAX_VALUES = 1 << 26
"""All values in a document."""
MAX_WORK = 30_000_000
MAX_DEPTH = 100
"""Lists and objects inside one another, among data and parameters."""
MAX_NESTING = 400
"""Nodes with a gradient of their own inside one another; what works on them follows them down."""
MAX_COMPOSITIONS = 12
"""Compositions inside one another; each doubles what the gradient is made of."""
MAX_ORDER = 1000
MAX_DIMENSIONS = 16
MAX_LENGTH = 1 << 24
MAX_STEPS = 100
"""Newton steps."""
MAX_PATH = 16
"""Gradient entries of gradient entries that a ``read`` node follows."""
MAX_QUESTIONS = 10_000
MAX_ELEMENTS = 10_000
"""Elements of a node with a gradient of its own, those of all its arguments together."""
MAX_NORM = 1000
"""Elements under a norm, each of which may have a gradient by as many symbols."""
MAX_PIECES = 100_000
"""Coefficients of a piecewise polynomial, counted once for each element of its argument."""
COST_OF_SCALAR, COST_OF_ELEMENT = 5, 200
"""What nodes with a gradient of their own cost, scalars and each element of an array."""
COST_OF_NODE_BELOW = 20
"""What a node costs each time that something made of it is looked at."""
COST_OF_RATE = 20
"""What a rate costs for each coordinate whose rate leads to it."""
COST_OF_NAME = 10
"""What a name costs for each operation that listed it."""
COST_OF_FRAME = 5
"""What a frame costs each time that a trace asks for a pose, and it is on the way."""
COST_OF_STEP = 1000
"""What a Newton step costs, beside what is in it."""


class Budget:
    """How much work the reading of one document may still be."""

    def __init__(self) -> None:
        self._left = MAX_WORK

    def spend(self, steps: int) -> None:
        """Note work that is going to be done.

        Raises
        ------
        RefusedError
            If it is too much.
        """
        self._left -= steps
        if self._left < 0:
            raise InvalidDocumentError(
                f"to evaluate it takes more than {MAX_WORK:,} steps, the most a document may need"
            )


def check_counts(content: bytes) -> None:
    """Refuse a text of JSON that has too many parts, before it is parsed.

    Raises
    ------
    RefusedError
        If it has.
    """
    lists = content.count(b"[") + content.count(b"{")
    if lists > MAX_LISTS:
        raise InvalidDocumentError(
            f"more than {MAX_LISTS:,} lists and objects; a document has up to {MAX_NODES:,} nodes"
        )
    if lists + content.count(b",") > MAX_VALUES:
        raise InvalidDocumentError(f"more than {MAX_VALUES:,} values, the most a document has")


def check_depth(depth: int) -> None:
    """Refuse data that lie in too many others.

    Raises
    ------
    RefusedError
        If they do.
    """
    if depth > MAX_DEPTH:
        raise InvalidDocumentError(f"data are nested too deeply, in more than {MAX_DEPTH} others")


def spend_rate_coupling(rates: Iterable[tuple[Symbol, Any]], budget: Budget) -> None:
    """Spend what it costs to carry every coordinate, each with all that its rate is made of.

    Raises
    ------
    RefusedError
        If it is too much.
    """
    given = dict(rates)
    leads = {
        coordinate: _symbols_of_rate(entry).intersection(given.keys()) for coordinate, entry in given.items()
    }
    for coordinate in leads:
        found, waiting = {coordinate}, [coordinate]
        while waiting:
            budget.spend(COST_OF_RATE)
            further = leads[waiting.pop()].difference(found)
            found |= further
            waiting += further


def _symbols_of_rate(entry: Any) -> set[Symbol]:
    if isinstance(entry, Expression):
        return collect_symbols(entry)
    found = {speed.position for speed, _ in entry}
    return found.union(*(collect_symbols(factor) for _, factor in entry))
