"""Budget of work and limits of size for reading a document.

A document of some kilobytes can demand a lot of work: arrays of many elements that each node above repeats,
Newton steps within Newton steps. So reading has a budget of steps, one for about the work of one expression
node. The reader spends from it before it does the work, and refuses a document that exceeds it. A robot takes
some ten thousand steps.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from kineverse.expressions.expression import Expression
from kineverse.model.rates import collect_symbols
from kineverse.symbols import Symbol

MAX_NODES = 1 << 22
MAX_LISTS = 10_000_000  # most lists and objects in a document
MAX_VALUES = 1 << 26  # most values in a document
MAX_WORK = 30_000_000
MAX_DEPTH = 100  # deepest nesting of lists and objects in data and parameters
MAX_NESTING = 400  # deepest nesting of nodes with a gradient of their own; algorithms on them are recursive
MAX_COMPOSITIONS = 12  # deepest nesting of compositions; each doubles the size of the gradient
MAX_ORDER = 1000
MAX_DIMENSIONS = 16
MAX_LENGTH = 1 << 24
MAX_STEPS = 100  # most Newton steps of an implicit function
MAX_PATH = 16  # longest path of nested gradient entries in a read node
MAX_QUESTIONS = 10_000
MAX_ELEMENTS = 10_000  # most elements in all arguments of a node with a gradient of its own
MAX_NORM = 1000
"""Most elements of the argument of a norm, each of which may have a gradient by as many symbols."""
MAX_PIECES = 100_000  # most coefficients of a piecewise polynomial, times the elements of its argument
COST_OF_SCALAR, COST_OF_ELEMENT = 5, 200
"""Cost of a node with a gradient of its own: of a scalar, and of each element of an array."""
COST_OF_NODE_BELOW = 20  # cost of a node for each traversal of an expression that contains it
COST_OF_RATE = 20  # cost of a rate for each coordinate whose rate depends on it
COST_OF_NAME = 10  # cost of a name for each operation that listed it
COST_OF_FRAME = 5  # cost of a frame for each pose in a trace whose kinematic chain contains it
COST_OF_STEP = 1000  # cost of a Newton step in addition to that of its residual


class InvalidDocumentError(Exception):
    """Reason why a document is refused, without its place; the reader raises a FormatError with both."""


class Budget:
    """Work that remains for the reading of one document, in steps."""

    def __init__(self) -> None:
        self._left = MAX_WORK
        self.functions: dict[bytes, int] = {}  # work of implicit functions, by their keys

    def spend(self, steps: int) -> None:
        """Spend steps on work before it is done."""
        self._left -= steps
        if self._left < 0:
            raise InvalidDocumentError(
                f"to evaluate it takes more than {MAX_WORK:,} steps, the most a document may need"
            )


# First bytes of lists and maps of msgpack; they also occur inside of numbers and texts, so their count is an
# upper bound.
_LISTS = bytes((*range(0x80, 0xA0), 0xDC, 0xDD, 0xDE, 0xDF))


def check_counts(content: bytes, is_text: bool) -> None:
    """Check the number of parts of a document before it is decoded."""
    if is_text:
        lists = content.count(b"[") + content.count(b"{")
        values = lists + content.count(b",")
    else:
        lists = values = len(content) - len(content.translate(None, _LISTS))
    if lists > MAX_LISTS:
        raise InvalidDocumentError(
            f"more than {MAX_LISTS:,} lists and objects; a document has up to {MAX_NODES:,} nodes"
        )
    if values > MAX_VALUES:
        raise InvalidDocumentError(f"more than {MAX_VALUES:,} values, the most a document has")


def check_depth(depth: int) -> None:
    """Check the nesting depth of data."""
    if depth > MAX_DEPTH:
        raise InvalidDocumentError(f"data are nested too deeply, in more than {MAX_DEPTH} others")


def spend_rate_coupling(rates: Iterable[tuple[Symbol, Any]], budget: Budget) -> None:
    """Spend the cost of carrying every coordinate, each with all rates that its own depends on."""
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
    """Return the symbols of a rate, with the positions of its speeds."""
    if isinstance(entry, Expression):
        return collect_symbols(entry)
    found = {speed.position for speed, _ in entry}
    return found.union(*(collect_symbols(factor) for _, factor in entry))
