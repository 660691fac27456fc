"""Reader of documents: checks every part, runs no code, and reports errors with their place."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from kineverse._runtime import no_collection
from kineverse.errors import FormatError, KineverseError
from kineverse.formats.files import MAX_BYTES
from kineverse.formats.names import check_prefix
from kineverse.formats.resources import folders_by_tag, map_meshes, meshes_of, restrict_meshes
from kineverse.formats.root_folder import NOWHERE, find_text_root
from kineverse.model.body import Body, Mesh
from kineverse.model.frame import WORLD
from kineverse.model.history import HistoryEntry
from kineverse.model.model import Model
from kineverse.model.operation import BODIES, FRAMES, KINDS, RATES, Cell, Writes, find_expressions
from kineverse.model.read_recorder import ABSENT, Read, Reads, SeenValues
from kineverse.model.registry import FileContent
from kineverse.model.traces.trace import find_read_nodes

from .budget import (
    COST_OF_NAME,
    MAX_NODES,
    Budget,
    InvalidDocumentError,
    check_counts,
    spend_rate_coupling,
)
from .encoding import check_text, hash_blobs, read_envelope, read_operation
from .node_graph import NodeGraph
from .node_types import read_nodes
from .opaque_operation import OpaqueOperation
from .parameters import decode_parameter
from .structs import OperationValue, ReadsValue
from .traces import TraceConsistency, decode_trace, named_reads
from .values import Names, decode_writes

LONGEST_REASON = 1000


def read_operations(
    content: str | bytes,
    source: str = "document",
    prefix: str | None = None,
    root: str = NOWHERE,
    *,
    is_packed: bool = False,
) -> list[tuple[str, OpaqueOperation]]:
    """Return the operations of a document, each with its tag.

    The content is text, its UTF-8, or msgpack if ``is_packed``. Errors (FormatError) name the source. All
    names are put below the prefix; meshes below the root may be opened, see :mod:`..root_folder`.

    An operation alone does not know what it has read. A whole model is made of :func:`entries_from_bytes`.

    Examples
    --------
    >>> text = kv.formats.document.to_json(kv.load("kitchen"))
    >>> tag, operation = kv.formats.document.read_operations(text)[0]
    >>> tag, operation.kind
    ('frame kitchen/kitchen', 'AddFrame')
    """
    if isinstance(content, str):
        content = content.encode(errors="surrogatepass")  # refused by its place
    entries = _Document(source, prefix, root).read(content, not is_packed)
    return [(e.tag, e.operation) for e in entries if isinstance(e.operation, OpaqueOperation)]


def document_entries(file: FileContent) -> list[HistoryEntry]:
    """Return the operations of a ``.kv.json`` or ``.kv.msgpack`` file, with what they read and wrote."""
    is_text = not file.path.name.endswith(".kv.msgpack")
    return _Document(str(file.path), file.prefix, file.root).read(file.content, is_text)


def operation_from_bytes(
    data: bytes, prefix: str | None = None, *, root: str | os.PathLike[str] | None = None
) -> HistoryEntry:
    """Return the operation in the result of :func:`.writer.operation_to_bytes`. Runs no code.

    Its ``operation`` can be applied to a model, ``edit.apply(entry.operation, entry.tag)``: what the model
    contains then is what it has read, and its trace is run if it leads to other values.

    Parameters
    ----------
    data
        The bytes, from any source.
    prefix
        Prefix of all names, the tag included; the world stays the world.
    root
        Folder below which meshes given by path may be opened. By default only meshes of packages are.

    Raises
    ------
    FormatError
        If they are no valid operation, with the place and the reason.

    Examples
    --------
    >>> blob = kv.formats.operation_to_bytes(kv.load("kitchen"), "frame kitchen/kitchen")
    >>> entry = kv.formats.operation_from_bytes(blob, prefix="left")
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(entry.operation, entry.tag)
    'left/frame kitchen/kitchen'
    """
    return _Document("the operation", prefix, find_text_root(NOWHERE, root)).read_alone(data)


def entries_from_bytes(
    data: bytes,
    prefix: str | None = None,
    *,
    root: str | os.PathLike[str] | None = None,
    source: str = "the document",
) -> list[HistoryEntry]:
    """Return the operations in the result of :func:`.writer.to_bytes`, with what they read and wrote.

    ``edit.link(entry)`` of each in turn makes the model. Runs no code and imports no name.

    Parameters
    ----------
    data
        The bytes, from any source; also those of a document as text.
    prefix
        Prefix of all names, tags included; the world stays the world.
    root
        Folder below which meshes given by path may be opened. By default only meshes of packages are.
    source
        Name of the document in errors.

    Raises
    ------
    FormatError
        If they are no valid document, with the place and the reason.

    Examples
    --------
    >>> data = kv.formats.to_bytes(kv.load("kitchen"))
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     for entry in kv.formats.entries_from_bytes(data, prefix="left"):
    ...         tag = edit.link(entry)
    >>> model
    <Model: 54 frames, 23 DoF, 46 constraints (version 1)>
    """
    return _Document(source, prefix, find_text_root(NOWHERE, root)).read(data)


def from_bytes(
    data: bytes, prefix: str | None = None, *, root: str | os.PathLike[str] | None = None
) -> Model:
    """Return the model in the result of :func:`.writer.to_bytes`. Runs no code and imports no name.

    Parameters and errors are those of :func:`entries_from_bytes`.

    Examples
    --------
    >>> data = kv.formats.to_bytes(kv.load("kitchen"))
    >>> sorted(kv.formats.from_bytes(data, prefix="left").frames)[0]
    'left/kitchen/dishwasher'
    """
    entries = entries_from_bytes(data, prefix, root=root)
    model = Model()
    try:
        with no_collection(), model.edit() as edit:
            for entry in entries:
                edit.link(entry)
    except KineverseError as error:
        raise FormatError(f"The operations of the document cannot be applied: {error}") from error
    return model


class _Document:
    """Document that is being read."""

    def __init__(self, source: str, prefix: str | None, root: str) -> None:
        check_prefix(prefix)
        self._source, self._root = source, root
        self._place, self._part = "", ""
        self._names = Names(f"{prefix}/" if prefix else "")
        self._budget = Budget()
        self._contents: dict[tuple[str, str], tuple[str, int]] = {}
        self._cells: dict[Cell, Any] = {}
        self._listed: dict[str, set[str]] = {kind: set() for kind in KINDS}
        self._consistency = TraceConsistency(self._budget, self._cells, self._listed)

    def read(self, content: bytes, is_text: bool | None = None) -> list[HistoryEntry]:
        """Return the operations of a document; by default, one that begins with a brace is a text."""
        with self._refusing(), no_collection():
            content = self._check_content(content)
            return self._read(content, content.lstrip()[:1] == b"{" if is_text is None else is_text)

    def read_alone(self, blob: bytes) -> HistoryEntry:
        """Return the operation of a blob, which does not know what it has read."""
        with self._refusing(), no_collection():
            blob = self._check_content(blob)
            check_counts(blob, False)
            operation, _ = read_operation(blob, False)
            entry = self._entry(operation, blob, {}, False)
            self._spend_rates(entry.writes)
            return entry

    def _check_content(self, content: Any) -> bytes:
        if not isinstance(content, (bytes, bytearray, memoryview)):
            raise InvalidDocumentError(f"it is bytes, not a {type(content).__name__}")
        if len(content) > MAX_BYTES:
            raise InvalidDocumentError(f"larger than {MAX_BYTES} bytes, the most a document has")
        return bytes(content)

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        """Turn all errors of the content into one with source and place."""
        try:
            yield
        except (InvalidDocumentError, KineverseError) as error:
            reason = str(error)
        except RecursionError:
            reason = "it is nested too deeply"
        except MemoryError:
            reason = "there is not enough memory for it"
        else:
            return
        place = f", {self._place}{self._part}" if self._place else ""
        if len(reason) > LONGEST_REASON:  # it quotes names, which may be of any length
            reason = f"{reason[:LONGEST_REASON]} ..."
        reason = " ".join(reason.splitlines())
        raise FormatError(f"{self._source}{place}: {reason.removesuffix('.')}.") from None

    def _read(self, content: bytes, is_text: bool) -> list[HistoryEntry]:
        envelope = read_envelope(content, is_text)
        values: list[OperationValue] = []
        blobs: list[bytes] = []
        for i, raw in enumerate(envelope.operations):
            self._place = f"operations[{i}]"
            value, blob = read_operation(bytes(raw), is_text)
            values.append(value)
            blobs.append(blob)
        self._place = "the document"
        if is_text:
            check_text(content, envelope, values)
        if envelope.sha256 and hash_blobs(blobs) != envelope.sha256:
            raise InvalidDocumentError(
                "its content is not what 'sha256' says; it was changed or damaged since it was written. Get "
                "another copy, or, if the change is intended, delete the member 'sha256': it is written "
                "again when the model is saved, for instance by 'kineverse convert'"
            )
        if sum(len(value.nodes) for value in values) > MAX_NODES:
            raise InvalidDocumentError(f"a document has up to {MAX_NODES:,} nodes")
        folders = folders_by_tag(envelope.folders)
        self._contents = {(r.folder, r.uri): (r.sha256, r.size) for r in envelope.resources}
        entries: dict[str, HistoryEntry] = {}
        for i, (value, blob) in enumerate(zip(values, blobs, strict=True)):
            self._place = f"operations[{i}]"
            if value.tag in entries:
                raise InvalidDocumentError(f"the tag {value.tag[:60]!r} is taken by an earlier operation")
            self._place = f"operations[{i}] ({value.tag[:60]!r})"
            entries[value.tag] = self._entry(value, blob, folders.get(value.tag, {}), True)
        self._spend_rates(self._cells)
        return list(entries.values())

    def _spend_rates(self, cells: dict[Cell, Any]) -> None:
        self._place = "the rates"
        spend_rate_coupling((value for (kind, _), value in cells.items() if kind == RATES), self._budget)

    def _entry(
        self, value: OperationValue, blob: bytes, folders: dict[int, str], is_in_document: bool
    ) -> HistoryEntry:
        """Return an operation with its reads and writes, and what it has read if the document has that."""
        names, graph = self._names, NodeGraph(self._names.before, self._budget)
        read_nodes(graph, value.nodes)
        given = writes = self._writes(value, graph, folders)
        if graph.has_opaque_nodes:  # coordinates may be carried, which no model contains
            writes = Writes.from_cells(given).writes()
        is_as_given = not names.before and (writes is given or writes == given)
        self._part = ", reads"
        reads = self._reads(value.reads)
        claimed, listed = reads.cells.copy(), reads.listings.copy()
        self._part = ", trace"
        trace = None if value.trace is None else decode_trace(value.trace, graph, names)
        if trace is not None:
            if value.frozen:
                raise InvalidDocumentError("an operation with a trace is not frozen")
            asked = self._consistency.reads_of(trace, writes) if is_in_document else named_reads(trace)
            for cell, how in asked.cells.items():
                reads.add(cell, how)
            reads.listings |= asked.listings
        _add_parents(reads, writes)
        is_as_given &= claimed == reads.cells and listed == reads.listings
        self._part = ", parameters"
        parameters = value.parameters
        for name, parameter in parameters.items():
            parameters[name] = decode_parameter(parameter, graph, names, writes)
        self._part = ""
        if is_in_document:
            reads.seen = self._seen(reads, writes)
            for cell, written in writes.items():
                self._cells[cell] = written
                self._listed[cell[0]].add(cell[1])
        operation = OpaqueOperation(
            value.kind,
            parameters,
            reads.cells,
            frozenset(reads.listings),
            writes,
            trace,
            value.frozen,
            names.before + value.below,
        )
        tag = names.before + value.tag
        return HistoryEntry(tag, operation, 0, reads, writes, blob if is_as_given else None)

    def _writes(self, value: OperationValue, graph: NodeGraph, folders: dict[int, str]) -> dict[Cell, Any]:
        writes = dict(decode_writes(value.writes, graph, self._names))
        if graph.has_read_nodes:
            for (kind, _), written in writes.items():
                if any(map(find_read_nodes, find_expressions(kind, written))):
                    raise InvalidDocumentError("a read node stands outside of a trace")
        if value.writes.bodies:
            self._place_meshes(writes, folders)
        return writes

    def _place_meshes(self, writes: dict[Cell, Any], folders: dict[int, str]) -> None:
        count = 0

        def place(mesh: Mesh) -> Mesh:
            nonlocal count
            count += 1
            folder = folders.get(count - 1) or folders.get(-1, "")
            return Mesh(mesh.uri, mesh.scale, folder, content=self._contents.get((folder, mesh.uri)))

        for cell, body in writes.items():
            if cell[0] == BODIES and isinstance(body, Body) and meshes_of(body):
                placed = map_meshes(body, place) if folders or self._contents else body
                writes[cell] = restrict_meshes(placed, self._root, f"{self._source}, body {cell[1]}")

    def _reads(self, given: ReadsValue | None) -> Reads:
        reads = Reads()
        if given is not None:
            self._budget.spend(COST_OF_NAME * (len(given.existence) + len(given.value)))
            for path in given.existence:
                reads.add(self._names.path_cell(path), Read.EXISTENCE)
            for path in given.value:
                reads.add(self._names.path_cell(path), Read.VALUE)
            for kind in given.listing:
                reads.listings.add(self._names.cell(kind, "x")[0])
        return reads

    def _seen(self, reads: Reads, writes: dict[Cell, Any]) -> SeenValues:
        names = {}
        for kind in reads.listings:
            self._budget.spend(COST_OF_NAME * len(self._listed[kind]))
            names[kind] = tuple(sorted(self._listed[kind]))
        values = {cell: self._cells.get(cell, ABSENT) for cell in reads.cells}
        return SeenValues(values, names, not self._cells.keys().isdisjoint(writes))


def _add_parents(reads: Reads, writes: dict[Cell, Any]) -> None:
    for (kind, _), value in writes.items():
        if kind == FRAMES and value.parent != WORLD and (FRAMES, value.parent) not in writes:
            reads.cells.setdefault((FRAMES, value.parent), Read.EXISTENCE)
