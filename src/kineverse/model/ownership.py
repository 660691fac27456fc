"""Who may write over what another operation wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kineverse.errors import NameTakenError

from .operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, RATES
from .reader import Cell

if TYPE_CHECKING:
    from .history import Entry

_NOUNS = {
    FRAMES: "a frame",
    BODIES: "a body of",
    ARTICULATIONS: "an articulation",
    CONSTRAINTS: "a constraint",
    RATES: "a rate of",
    DATA: "a datum",
}


def may_override(entry: Entry, cell: Cell) -> bool:
    """Return whether an operation may write over what is there: data, and what it knows to be there."""
    kind = cell[0]
    if kind == CONSTRAINTS:
        return False
    return kind == DATA or cell in entry.reads.cells or entry.operation.overrides


def taken(cell: Cell, entry: Entry, maker: str) -> NameTakenError:
    """Return the error for a name that an operation before has written."""
    kind, name = cell
    what = f"{_NOUNS[kind]} '{name}'"
    if kind == CONSTRAINTS:
        return NameTakenError(
            f"There is {what} already, made by {maker!r}; choose another name or replace that operation."
        )
    attach = "To put it into another parent, attach it; to" if kind == FRAMES else "To"
    return NameTakenError(
        f"There is {what} already, written by {maker!r}, and {entry.tag!r} would write over it. Choose "
        f"another name, or replace that operation. {attach} write over it on purpose, pass override=True to "
        "the method of the edit."
    )
