"""What a document knows of an operation: what it read and what it wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from kineverse.errors import UnknownNameError
from kineverse.expressions.expression import Expression
from kineverse.model.operation import (
    ARTICULATIONS,
    BODIES,
    CONSTRAINTS,
    DATA,
    FRAMES,
    RATES,
    Effects,
    Operation,
)
from kineverse.model.reader import ABSENT, Cell, Read, Reader


@dataclass(frozen=True)
class Recorded(Operation):
    """An operation from a document, frozen: it writes what it wrote when the document was saved.

    It still depends on what the original read: it is run again when that changes, and refuses an edit that
    takes away something which was there. What it writes does not follow a changed value, though; for edits
    upstream that should carry through, replace it by an operation of the original class.

    Attributes
    ----------
    kind
        Name of the class that wrote this originally.
    reads
        The cells (kind, name) that were looked at, and how closely.
    listings
        Kinds of which all names were listed.
    required
        Those among the cells that existed.
    writes
        What it writes, by cell, in order.
    """

    kind: str
    reads: tuple[tuple[Cell, Read], ...] = ()
    listings: tuple[str, ...] = ()
    required: frozenset[Cell] = frozenset()
    writes: tuple[tuple[Cell, Any], ...] = field(default=(), repr=False)

    def apply(self, model: Reader) -> Effects:
        """Look at what the original looked at, and write what it wrote.

        Raises
        ------
        UnknownNameError
            If something it was made from does not exist any more.
        """
        model._reads.listings.update(self.listings)
        for cell, how in self.reads:
            model._reads.add(cell, how)
            if cell in self.required and model._value_at(cell) is ABSENT:
                kind, name = cell
                raise UnknownNameError(
                    f"{kind}/{name} does not exist, and this {self.kind} was made from it. It comes from a "
                    "document and cannot be made anew; keep what it needs, or remove or replace it too."
                )
        return self._effects

    @cached_property
    def _effects(self) -> Effects:
        kinds: dict[str, dict[Any, Any]] = {}
        for (kind, name), value in self.writes:
            if kind == RATES:
                coordinate, entry = value
                row = entry if isinstance(entry, Expression) else dict(entry)
                kinds.setdefault(kind, {})[coordinate] = row
            else:
                kinds.setdefault(kind, {})[name] = value

        def of(kind: str) -> Mapping[Any, Any]:
            return kinds.get(kind, {})

        return Effects(
            frames=of(FRAMES),
            constraints=of(CONSTRAINTS),
            rates=of(RATES),
            bodies=of(BODIES),
            articulations=of(ARTICULATIONS),
            data=of(DATA),
        )

    def default_tag(self) -> str:
        """Return the kind and the first name it writes."""
        return f"{self.kind} {self.writes[0][0][1]}" if self.writes else self.kind
