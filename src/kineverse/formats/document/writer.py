"""Writer of documents: blobs of operations, and documents as text, msgpack bytes and files."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from kineverse._runtime import no_collection
from kineverse.errors import FormatError, UnknownNameError, suggest
from kineverse.formats.files import replace_file
from kineverse.formats.resources import find_contents, find_mesh_folders
from kineverse.model.history import HistoryEntry
from kineverse.model.model import Model, Snapshot
from kineverse.model.model_view import ModelView
from kineverse.model.read_recorder import ABSENT, Read, ReadRecorder, Reads
from kineverse.model.traces import Trace, UntraceableError, record_trace

from . import encoding
from .budget import InvalidDocumentError
from .node_table import NodeTable
from .opaque_operation import OpaqueOperation
from .parameters import document_kind, encode_parameter, operation_parameters
from .structs import Resource
from .traces import encode_queries
from .values import encode_writes

# Flags are compared as wholes, because operations on them are slow.
_WITH_EXISTENCE = (Read.EXISTENCE, Read.EXISTENCE | Read.VALUE)
_WITH_VALUE = (Read.VALUE, Read.EXISTENCE | Read.VALUE)


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

    Examples
    --------
    >>> from pathlib import Path
    >>> kv.formats.document.write_document(kv.load("kitchen"), Path("home.kv.json"))
    >>> kv.load("home.kv.json")
    <Model: 54 frames, 23 DoF, 46 constraints (version 1)>
    """
    is_packed = target.name.endswith(".kv.msgpack")
    try:
        content = to_bytes(model) if is_packed else to_json(model).encode()
    except FormatError as error:
        raise FormatError(f"{target} is not written. {error}") from None
    replace_file(target, content)


def to_json(model: ModelView, *, resources: bool = False) -> str:
    """Return a model as the text of a document; equal for models made by the same operations.

    Parameters
    ----------
    model
        Model or snapshot.
    resources
        True to add SHA-256 and size of each mesh and texture that is found, see :func:`.add_resolver`.

    Raises
    ------
    FormatError
        For content that a document cannot carry.

    Examples
    --------
    >>> import json
    >>> document = json.loads(kv.formats.document.to_json(kv.load("kitchen")))
    >>> document["format"], len(document["operations"])
    ('kineverse', 108)
    """
    entries = _entries(model)
    return encoding.print_document(_blobs(entries), **_beside(entries, resources))


def to_bytes(model: ModelView, *, resources: bool = False) -> bytes:
    """Return a model as a document in msgpack, as in ``.kv.msgpack`` files; equal for equal models.

    Parameters
    ----------
    model
        Model or snapshot.
    resources
        True to add SHA-256 and size of each mesh and texture that is found, see :func:`.add_resolver`.

    Raises
    ------
    FormatError
        For content that a document cannot carry.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> data = kv.formats.to_bytes(model)
    >>> kv.formats.from_bytes(data)
    <Model: 54 frames, 23 DoF, 46 constraints (version 1)>
    """
    entries = _entries(model)
    return encoding.pack_document(_blobs(entries), **_beside(entries, resources))


def document_hash(model: ModelView) -> str:
    """Return the hash of a model's content, 64 hexadecimal digits.

    It is equal for models made by the same operations, in any process. Saving and loading a model as a
    document preserves it, in either form. Names are part of the content, so a prefix changes it.

    Parameters
    ----------
    model
        Model or snapshot.

    Raises
    ------
    FormatError
        For content that a document cannot carry.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> kv.formats.document_hash(model) == kv.formats.document_hash(model.copy())
    True
    """
    return encoding.hash_blobs(_blobs(_entries(model)))


def operation_to_bytes(model: ModelView, tag: str) -> bytes:
    """Return an operation of a model as bytes, its *blob*; equal operations have equal blobs.

    Parameters
    ----------
    model
        Model or snapshot.
    tag
        Tag of the operation.

    Raises
    ------
    UnknownNameError
        If there is no such operation.
    FormatError
        For content that a document cannot carry.

    See Also
    --------
    kineverse.formats.operation_from_bytes
    """
    if isinstance(model, Model) and model._edit is None:
        entries: Sequence[HistoryEntry] = model.history.sequence  # without a snapshot, which lists all values
        entry = model.history.entry(tag)
    else:
        entries = _entries(model)
        by_tag = {each.tag: each for each in entries}
        if tag not in by_tag:
            raise UnknownNameError(f"There is no operation {tag!r}. {suggest(str(tag), by_tag, 'tag')}")
        entry = by_tag[tag]
    return entry_to_bytes(entry, entries)


def entry_to_bytes(entry: HistoryEntry, entries: Sequence[HistoryEntry]) -> bytes:
    """Return an entry of a history as bytes, its *blob*, and keep it with the entry.

    The entry may be one of an edit that is still open. Others are only looked at if it computes with values
    that it read, and its trace is not known yet.

    Parameters
    ----------
    entry, entries
        Entry, and those of all operations in order, ``model.history.sequence``.

    Raises
    ------
    FormatError
        For content that a document cannot carry.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> entries = model.history.sequence
    >>> blob = kv.formats.entry_to_bytes(entries[0], entries)
    >>> blob == kv.formats.operation_to_bytes(model, entries[0].tag)
    True
    """
    return entry.blob or _blob(entry, entries)


def operation_digest(model: ModelView, tag: str) -> str:
    """Return SHA-256 of :func:`operation_to_bytes`, 64 hexadecimal digits.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> kv.formats.operation_digest(model, "joint kitchen/fridge_door")[:8]
    '8af535b1'
    """
    return encoding.digest(operation_to_bytes(model, tag)).hex()


def _entries(model: ModelView) -> Sequence[HistoryEntry]:
    snapshot = model.snapshot() if isinstance(model, Model) else model
    if not isinstance(snapshot, Snapshot):
        raise FormatError(f"A model or a snapshot is saved, not a {type(model).__name__}.")
    return snapshot.entries


def _blobs(entries: Sequence[HistoryEntry]) -> list[bytes]:
    """Return the blobs of operations; those that are known are not encoded again."""
    with no_collection():
        return [entry_to_bytes(entry, entries) for entry in entries]


def _blob(entry: HistoryEntry, entries: Sequence[HistoryEntry]) -> bytes:
    """Return the blob of one of the entries, and keep it."""
    try:
        entry.blob = encoding.make_blob(_encode_operation(entry, entries))
    except RecursionError:
        raise FormatError("The model contains data or gradients that are nested too deeply.") from None
    except InvalidDocumentError as error:
        raise FormatError(
            f"The operation {entry.tag!r} has a value that has no place in a document: {error}."
        ) from None
    return entry.blob


def _encode_operation(entry: HistoryEntry, entries: Sequence[HistoryEntry]) -> dict[str, Any]:
    operation, writes = entry.operation, entry.writes
    trace: Trace | None = None
    table = NodeTable()
    result: dict[str, Any] = {"tag": entry.tag}
    if isinstance(operation, OpaqueOperation):
        kind, parameters, trace = operation.kind, operation.given, operation.trace
        result["frozen"], result["below"] = operation.frozen, operation.scope
    else:
        kind, parameters = document_kind(type(operation)), operation_parameters(operation)
        if entry.reads.listings or any(how in _WITH_VALUE for how in entry.reads.cells.values()):
            if entry.reads.trace is None:
                entry.reads.trace = _find_trace(entry, entries)
            found = entry.reads.trace
            if isinstance(found, Trace):
                trace = found
            else:
                result["frozen"] = str(found)
    result["kind"] = kind
    result["writes"] = encode_writes(entry.tag, writes, table.ref)
    if parameters:
        written = {id(value): f"{kind}/{name}" for (kind, name), value in writes.items()}
        result["parameters"] = {
            name: encode_parameter(value, written, table.ref) for name, value in parameters.items()
        }
    if entry.reads.cells or entry.reads.listings:
        result["reads"] = _encode_reads(entry.reads)
    if trace is not None:
        queries = encode_queries(trace, table.ref)
        result["trace"] = {
            "questions": queries,
            "writes": encode_writes(entry.tag, dict(trace.writes), table.ref),
        }
    result["nodes"] = table.nodes
    return result


def _encode_reads(reads: Reads) -> dict[str, list[str]]:
    cells = sorted(reads.cells.items())
    return {
        "existence": [f"{kind}/{name}" for (kind, name), how in cells if how in _WITH_EXISTENCE],
        "value": [f"{kind}/{name}" for (kind, name), how in cells if how in _WITH_VALUE],
        "listing": sorted(reads.listings),
    }


def _find_trace(entry: HistoryEntry, entries: Sequence[HistoryEntry]) -> Trace | str:
    """Return the trace of an operation after those before it, or the reason for none."""
    earlier = takewhile(lambda other: other is not entry, entries)
    cells = {cell: value for other in earlier for cell, value in other.writes.items()}
    before = ReadRecorder(
        lambda cell: cells.get(cell, ABSENT),
        lambda kind: sorted(name for k, name in cells if k == kind),
        Reads(entry.reads.seen),
    )
    try:
        return record_trace(entry.operation, before, entry.writes)
    except UntraceableError as error:
        return str(error)


def _beside(entries: Sequence[HistoryEntry], resources: bool) -> dict[str, Any]:
    """Return the members of a document that are no part of its content."""
    contents = find_contents(entries, resources).items()
    files = tuple(Resource(uri, sha256, size, folder) for (folder, uri), (sha256, size) in contents)
    return {"folders": find_mesh_folders(entries), "resources": files}
