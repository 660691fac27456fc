"""Writer of documents, as JSON text, msgpack bytes and files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from kineverse._runtime import no_collection
from kineverse.errors import FormatError
from kineverse.expressions.expression import Expression
from kineverse.formats.files import replace_file
from kineverse.model.history import HistoryEntry
from kineverse.model.model import Model, Snapshot
from kineverse.model.model_view import ModelView
from kineverse.model.operation import ARTICULATIONS, DATA, KINDS, Cell, find_expressions
from kineverse.model.read_recorder import ABSENT, Read, ReadRecorder, Reads
from kineverse.model.traces import Trace, UntraceableError, record_trace

from .encoding import append_hash, dump_json, pack_document, read_hash
from .node_table import NodeTable, encode_string
from .opaque_operation import OpaqueOperation
from .parameters import document_kind, encode_parameter, expressions_in_parameter, operation_parameters
from .traces import encode_queries, trace_expressions
from .values import encode_value

FORMAT = "kineverse"
VERSION = 1


def write_document(model: ModelView, target: Path) -> None:
    """Write a model to a file atomically.

    Parameters
    ----------
    model
        Model or snapshot.
    target
        Path that ends in ``.kv.json`` or ``.kv.msgpack``.

    Raises
    ------
    FormatError
        If the file cannot be written, or for content that a document cannot carry; it is unchanged then.
    MissingDependencyError
        If the package for msgpack is needed and not installed.
    """
    try:
        text = to_json(model)
    except FormatError as error:
        raise FormatError(f"{target} is not written. {error}") from None
    replace_file(target, pack_document(text) if target.name.endswith(".kv.msgpack") else text.encode())


def to_json(model: ModelView) -> str:
    """Return a model as the text of a document; equal for models made by the same operations.

    Raises
    ------
    FormatError
        For content that a document cannot carry.
    """
    snapshot = model.snapshot() if isinstance(model, Model) else model
    if not isinstance(snapshot, Snapshot):
        raise FormatError(f"A model or a snapshot is saved, not a {type(model).__name__}.")
    try:
        with no_collection():
            return _write_text(snapshot)
    except RecursionError:
        raise FormatError("The model contains data or gradients that are nested too deeply.") from None


def to_bytes(model: ModelView) -> bytes:
    """Return a model as a document in msgpack, as in ``.kv.msgpack`` files; equal for equal models.

    Parameters
    ----------
    model
        Model or snapshot.

    Raises
    ------
    FormatError
        For content that a document cannot carry.
    MissingDependencyError
        If msgspec is not installed, which the extra ``exchange`` brings.
    """
    return pack_document(to_json(model))


def _write_text(snapshot: Snapshot) -> str:
    parts = [_Parts(entry, cells) for entry, cells in _with_cells_before(snapshot.entries)]
    table = NodeTable(e for part in parts for e in part.expressions)
    operations = [_encode_operation(part, table) for part in parts]
    body = "".join(
        (
            f'{{"format":"{FORMAT}","version":{VERSION},\n"nodes":[',
            *_lines(table.lines),
            '],\n"operations":[',
            *_lines(operations),
            "]",
        )
    )
    try:
        return append_hash(body)
    except UnicodeEncodeError as error:
        bad = ascii(body[max(error.start - 20, 0) : error.end])
        raise FormatError(f"Half a surrogate pair is no text: {bad}.") from None


def document_hash(model: ModelView) -> str:
    """Return the hash of a model's content, 64 hexadecimal digits.

    It is equal for models made by the same operations, in any process. Saving and loading a model as a
    document preserves it, in either encoding. Names are part of the content, so a prefix changes it.

    Parameters
    ----------
    model
        Model or snapshot.

    Raises
    ------
    FormatError
        For content that a document cannot carry.
    """
    return read_hash(to_json(model))


def _with_cells_before(entries: Sequence[HistoryEntry]) -> Iterator[tuple[HistoryEntry, dict[Cell, Any]]]:
    """Yield the operations, each with the cells before it, in one dictionary that is updated in place."""
    cells: dict[Cell, Any] = {}
    for entry in entries:
        yield entry, cells
        cells.update(entry.writes)


class _Parts:
    """Content of a document for one operation."""

    trace: Trace | None = None
    frozen = ""

    def __init__(self, entry: HistoryEntry, cells: dict[Cell, Any]) -> None:
        self.entry = entry
        operation = entry.operation
        if isinstance(operation, OpaqueOperation):
            self.kind, self.parameters = operation.kind, operation.given
            self.trace, self.frozen = operation.trace, operation.frozen
            return
        self.kind, self.parameters = document_kind(type(operation)), operation_parameters(operation)
        if entry.reads.listings or any(how & Read.VALUE for how in entry.reads.cells.values()):
            if entry.reads.trace is None:
                entry.reads.trace = _find_trace(entry, cells)
            found = entry.reads.trace
            self.trace, self.frozen = (found, "") if isinstance(found, Trace) else (None, str(found))

    @property
    def expressions(self) -> Iterator[Expression]:
        for (kind, _), value in self.entry.writes.items():
            yield from find_expressions(kind, value)
        for parameter in self.parameters.values():
            yield from expressions_in_parameter(parameter, self.entry.writes)
        if self.trace is not None:
            yield from trace_expressions(self.trace)


def _find_trace(entry: HistoryEntry, cells: dict[Cell, Any]) -> Trace | str:
    """Return the trace of an operation, or the reason for none."""
    before = ReadRecorder(
        lambda cell: cells.get(cell, ABSENT),
        lambda kind: sorted(name for k, name in cells if k == kind),
        Reads(),
    )
    try:
        return record_trace(entry.operation, before, entry.writes)
    except UntraceableError as error:
        return str(error)


def _lines(items: list[str]) -> Iterator[str]:
    for i, item in enumerate(items):
        yield ",\n" if i else "\n"
        yield item
    if items:
        yield "\n"


def _encode_operation(what: _Parts, table: NodeTable) -> str:
    entry = what.entry
    cells = sorted(entry.reads.cells.items())
    reads = {
        "existence": [f"{kind}/{name}" for (kind, name), how in cells if how & Read.EXISTENCE],
        "value": [f"{kind}/{name}" for (kind, name), how in cells if how & Read.VALUE],
        "listing": sorted(entry.reads.listings),
    }
    parameters = {
        name: encode_parameter(value, entry.writes, table.ref) for name, value in what.parameters.items()
    }
    parts = {"tag": entry.tag, "kind": what.kind}
    members = {key: encode_string(value) for key, value in parts.items()}
    if parameters:
        members["parameters"] = dump_json(parameters)
    members["reads"] = dump_json({how: names for how, names in reads.items() if names})
    members["writes"] = dump_json(_encode_writes(entry.tag, entry.writes, table))
    if what.trace is not None:
        questions = encode_queries(what.trace, table.ref)
        writes = _encode_writes(entry.tag, dict(what.trace.writes), table)
        members["trace"] = dump_json({"questions": questions, "writes": writes})
    if what.frozen:
        members["frozen"] = encode_string(what.frozen)
    joined = ",".join(f'"{key}":{value}' for key, value in members.items())
    return f"{{{joined}}}"


def _encode_writes(tag: str, writes: Mapping[Cell, Any], table: NodeTable) -> dict[str, dict[str, Any]]:
    kinds: dict[str, dict[str, Any]] = {kind: {} for kind in KINDS}
    for (kind, name), value in writes.items():
        try:
            kinds[kind][name] = encode_value(kind, value, table.ref)
        except FormatError as error:
            noun = "The datum" if kind in (DATA, ARTICULATIONS) else "What is"
            raise FormatError(
                f"{noun} under '{kind}/{name}', written by {tag!r}, has no place in a document: {error}"
            ) from None
    return {kind: values for kind, values in kinds.items() if values}
