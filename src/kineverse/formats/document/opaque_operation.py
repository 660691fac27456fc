"""Operation of a document, without the class that wrote it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from kineverse.errors import KineverseError, ModelError, UnknownNameError
from kineverse.loops import CloseLoop
from kineverse.model.operation import Cell, Operation, Writes
from kineverse.model.read_recorder import ABSENT, Read, ReadRecorder
from kineverse.model.traces import Trace

from .parameters import rebuild_parameter


@dataclass(frozen=True)
class OpaqueOperation(Operation):
    """Operation from a document, without the class of the original.

    While its reads are unchanged, it writes what the original wrote, to the last bit. When a read changes, it
    is run again by its trace. Without a trace it is *frozen*: a loop (``kv.CloseLoop``) is closed again, any
    other change is refused. Then, or if the original branched on the changed value, replace it by one
    of its class in the same edit.

    Attributes
    ----------
    kind
        Frozen name of the original's class.
    given
        Encoded constructor arguments by name, see :attr:`parameters`.
    reads
        Cells (kind, name) that were read, with the kind of access.
    listings
        Kinds of which all names were listed, with these names.
    writes
        Values it writes, by cell, in order.
    trace
        Writes as expressions of the reads.
    frozen
        Reason for a missing trace of an operation that read values, else empty.
    seen
        Values of the cells that were read.
    scope
        Prefix of all names of the document.
    overrides
        True if it overwrites writes of operations before it in the document.
    """

    kind: str
    given: Mapping[str, Any] = field(default_factory=dict, hash=False)
    reads: tuple[tuple[Cell, Read], ...] = ()
    listings: tuple[tuple[str, tuple[str, ...]], ...] = ()
    writes: tuple[tuple[Cell, Any], ...] = field(default=(), repr=False)
    trace: Trace | None = field(default=None, repr=False)
    frozen: str = ""
    seen: Mapping[Cell, Any] = field(default_factory=dict, repr=False, compare=False)
    scope: str = ""
    overrides: bool = field(default=False, repr=False, compare=False)  # type: ignore[misc]

    @property
    def parameters(self) -> dict[str, Any]:
        """Constructor arguments of the original: ``kv.CloseLoop(**operation.parameters)`` rebuilds it.

        Names in them are as they were saved, without the prefix that the document was loaded under.
        """
        writes = {f"{kind}/{name}": value for (kind, name), value in self.writes}
        return {name: rebuild_parameter(value, writes) for name, value in self.given.items()}

    def apply(self, model: ReadRecorder) -> Writes:
        """Write what the original wrote, or what its trace computes from changed reads.

        Raises
        ------
        UnknownNameError
            If a value that the original read does not exist any more.
        ModelError
            If a read has changed in a way that the trace cannot follow.
        """
        model = self._in_scope(model)
        changed = self._changed(model)
        if not changed:
            return self._effects
        if self.kind == "CloseLoop" and self.trace is None:
            return CloseLoop(**self.parameters).below(self.scope).apply(model)
        error: KineverseError = ModelError(f"{self.frozen or 'it looked whether it is there'}.")
        if self.trace is not None:
            try:
                return self.trace.run(model, self._before(model))
            except KineverseError as problem:
                error = problem
        kind = UnknownNameError if isinstance(error, UnknownNameError) else ModelError
        raise kind(
            f"{changed[0]} has changed, and this {self.kind} was made from it: {error} It comes from a "
            "document, without its code; in the same edit, remove it, or replace it by "
            f"a new {self.kind}(...).{self._hint}"
        ) from None

    @property
    def _hint(self) -> str:
        if not self.given or not self.scope:
            return ""
        return f" Its parameters say from what, in names that lack '{self.scope}'."

    def _in_scope(self, model: ReadRecorder) -> ReadRecorder:
        """Return a reader that lists only names below the document's prefix, if it has one."""
        if not self.scope:
            return model
        return model.restricted(self.scope)

    def _changed(self, model: ReadRecorder) -> list[str]:
        """Read what the original read, and return the names of what has changed."""
        changed = []
        for kind, names in self.listings:
            if tuple(model.list_names(kind)) != names:
                changed.append(f"the list of all {kind}")
        for cell, how in self.reads:
            now, then = model.read(cell, how), self.seen.get(cell, ABSENT)
            if now is then:
                continue
            if then is ABSENT or now is ABSENT or (how & Read.VALUE and now != then):
                changed.append("/".join(cell))
        return changed

    def _before(self, model: ReadRecorder) -> ReadRecorder:
        """Return a reader with the values that the original read; the rest cannot have mattered to it."""
        return model.replaced(self.seen, dict(self.listings))

    @cached_property
    def _effects(self) -> Writes:
        return Writes.from_cells(dict(self.writes))

    def default_tag(self) -> str:
        """Return the kind and the name of the first write."""
        return f"{self.kind} {self.writes[0][0][1]}" if self.writes else self.kind
