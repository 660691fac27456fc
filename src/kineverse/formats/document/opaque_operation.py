"""Operation of a document, without the class that wrote it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from kineverse.errors import KineverseError, ModelError, UnknownNameError
from kineverse.model.operation import Cell, FinishedWrites, Operation, Writes
from kineverse.model.read_recorder import ABSENT, Read, ReadRecorder, SeenValues, differs
from kineverse.model.traces import Trace
from kineverse.model.traces.replay import writes_agree
from kineverse.model.traces.trace import run_query, substitute_results
from kineverse.model.traces.trace_queries import QueryResult

from .parameters import OpaqueRecord, UnsupportedParameter, find_class, rebuild_parameter


@dataclass(frozen=True)
class OpaqueOperation(Operation):
    """Operation from a document, without the class of the original.

    While its reads are unchanged, it writes what the original wrote, to the last bit. When a read changes, it
    is run again by its trace. Without a trace it is *frozen*: an operation of the library is made again from
    its parameters, any other change is refused. Then, or if the original branched on the changed value,
    replace it by one of its class in the same edit.

    Attributes
    ----------
    kind
        Frozen name of the original's class.
    given
        Encoded constructor arguments by name, see :attr:`parameters`.
    reads
        Cells (kind, name) that were read, with the kind of access.
    listings
        Kinds of which all names were listed.
    recorded
        Values it writes, by cell, in order.
    trace
        Writes as expressions of the reads.
    frozen
        Reason for a missing trace of an operation that read values, else empty.
    scope
        Prefix that the names in its parameters lack, with its slash.

    Examples
    --------
    >>> data = kv.formats.to_bytes(kv.load("articulations/screw"))
    >>> entry = kv.formats.entries_from_bytes(data)[0]
    >>> entry.tag, entry.operation.kind, entry.operation.trace
    ('screw/frame block', 'AddFrame', None)
    """

    kind: str
    given: Mapping[str, Any] = field(default_factory=dict, hash=False)
    reads: Mapping[Cell, Read] = field(default_factory=dict, hash=False)
    listings: frozenset[str] = frozenset()
    recorded: Mapping[Cell, Any] = field(  # type: ignore[misc]
        default_factory=dict, hash=False, repr=False
    )
    trace: Trace | None = field(default=None, repr=False)
    frozen: str = ""
    scope: str = ""

    @property
    def parameters(self) -> dict[str, Any]:
        """Constructor arguments of the original: ``kv.CloseLoop(**operation.parameters)`` rebuilds it.

        Names in them are as they were saved, without the prefix that the document was loaded under.
        """
        writes = {f"{kind}/{name}": value for (kind, name), value in self.recorded.items()}
        return {name: rebuild_parameter(value, writes) for name, value in self.given.items()}

    def apply(self, model: ReadRecorder) -> Writes:
        """Write what the original wrote, or what its trace or its class makes of changed reads.

        Raises
        ------
        UnknownNameError
            If a value that the original read does not exist any more.
        ModelError
            If a read has changed in a way that the trace cannot follow.
        """
        scope, seen = self._in_scope(model), model.seen
        if seen is None:
            model.remember(self.see(model))
            return self._run_first(scope)
        changed = self._changed(scope, seen)
        if not changed:
            return FinishedWrites(self.recorded)
        error: KineverseError = ModelError(f"{self.frozen or 'it looked whether it is there'}.")
        if self.trace is not None:
            try:
                return self.trace.run(scope, scope.replaced(seen.values, seen.names))
            except KineverseError as problem:
                error = problem
        else:
            again = self.run_anew(model)
            if again is not None:
                return again
        kind = UnknownNameError if isinstance(error, UnknownNameError) else ModelError
        is_below = self.given and self.scope
        hint = f" Its parameters say from what, in names that lack '{self.scope}'." if is_below else ""
        raise kind(
            f"{changed[0]} has changed, and this {self.kind} was made from it: {error} It comes from a "
            "document, without its code; in the same edit, remove it, or replace it by "
            f"a new {self.kind}(...).{hint}"
        ) from None

    def run_anew(self, model: ReadRecorder) -> Writes | None:
        """Return the writes of the operation of the library that it was; None if it was none."""
        again = self.rebuild()
        return None if again is None else again.apply(self._in_scope(model))

    def see(self, model: ReadRecorder) -> SeenValues:
        """Return what a model has of what the original read."""
        model = self._in_scope(model)
        values = {cell: model.read(cell, how) for cell, how in self.reads.items()}
        names = {kind: tuple(model.list_names(kind)) for kind in self.listings}
        silent = model.replaced({}, {})
        overrides = any(silent.read(cell, Read.EXISTENCE) is not ABSENT for cell in self.recorded)
        return SeenValues(values, names, overrides)

    def _run_first(self, model: ReadRecorder) -> Writes:
        """Write what the original wrote, unless the trace shows that it has read other values."""
        if self.trace is None:
            return FinishedWrites(self.recorded)
        results: list[QueryResult] = []
        for step in self.trace.steps:
            results.append(run_query(substitute_results(step.query, results), model))
        effects = self.trace.compute_writes(results)
        return FinishedWrites(self.recorded) if writes_agree(effects.writes(), self.recorded) else effects

    def rebuild(self) -> Operation | None:
        """Return the operation of the library that it was, below the prefix; None for any other."""
        kind, parameters = find_class(self.kind), self.parameters
        unknown = (OpaqueRecord, UnsupportedParameter)
        if not (kind and issubclass(kind, Operation)) or any(
            isinstance(parameter, unknown) for parameter in parameters.values()
        ):
            return None
        try:
            made = kind(**parameters)
        except (TypeError, KineverseError):  # a class of somebody else has the same name
            return None
        return made.below(self.scope) if self.scope else made

    def _in_scope(self, model: ReadRecorder) -> ReadRecorder:
        """Return a reader that lists only names below the document's prefix, if it has one."""
        return model.restricted(self.scope) if self.scope else model

    def _changed(self, model: ReadRecorder, seen: SeenValues) -> list[str]:
        """Read what the original read, and return the names of what has changed."""
        changed = [
            f"the list of all {kind}"
            for kind in sorted(self.listings)
            if tuple(model.list_names(kind)) != seen.names[kind]
        ]
        for cell, how in sorted(self.reads.items()):
            if differs(how, seen.values.get(cell, ABSENT), model.read(cell, how)):
                changed.append("/".join(cell))
        return changed

    def default_tag(self) -> str:
        """Return the kind and the name of the first write."""
        return f"{self.kind} {next(iter(self.recorded))[1]}" if self.recorded else self.kind
