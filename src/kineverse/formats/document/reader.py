"""Reader of documents: checks every part, runs no code, and reports errors with their place."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from kineverse._runtime import no_collection
from kineverse.errors import FormatError, KineverseError
from kineverse.expressions.expression import Expression
from kineverse.formats.files import MAX_BYTES
from kineverse.formats.names import check_prefix
from kineverse.formats.resource_paths import restrict_meshes
from kineverse.formats.root_folder import NOWHERE, find_text_root
from kineverse.model.frame import WORLD
from kineverse.model.model import Model
from kineverse.model.operation import BODIES, FRAMES, KINDS, RATES, Cell, find_expressions
from kineverse.model.read_recorder import ABSENT, Read
from kineverse.model.registry import FileContent
from kineverse.model.traces import Trace
from kineverse.model.traces.trace import find_read_nodes
from kineverse.symbols import symbol_name

from .budget import COST_OF_NAME, MAX_NODES, check_counts, spend_rate_coupling
from .encoding import HASH, check_hash, unpack_document
from .json_values import InvalidDocumentError, check_entity_name, check_keys, check_list, check_text
from .node_graph import NodeGraph
from .node_types import read_node
from .opaque_operation import OpaqueOperation
from .parameters import decode_parameter
from .traces import TraceConsistency, check_read_nodes, decode_queries, merge_reads
from .values import Rename, decode_value
from .writer import FORMAT, VERSION

LONGEST_REASON = 1000


def read_operations(
    content: str | bytes, source: str = "document", prefix: str | None = None, root: str = NOWHERE
) -> list[tuple[str, OpaqueOperation]]:
    """Return the operations of a document, each with its tag.

    Parameters
    ----------
    content
        Text of the document, or its bytes in UTF-8.
    source
        Name of the document in errors.
    prefix
        Prefix of all names, tags included; the world stays the world.
    root
        Folder below which its meshes may be opened, see :mod:`kineverse.formats.root_folder`; by default
        there is none.

    Raises
    ------
    FormatError
        With the source, the place in the document and the reason.
    """
    _check_size(content, source)
    try:
        content = content.encode() if isinstance(content, str) else content
        content.decode()
    except UnicodeError as error:
        raise FormatError(f"{source}: a document is UTF-8 text, and this is not: {error}.") from None
    return _Document(source, prefix, root).read(_parse_json, content)


def read_packed_operations(
    data: bytes, source: str = "document", prefix: str | None = None, root: str = NOWHERE
) -> list[tuple[str, OpaqueOperation]]:
    """Return the operations of a packed document; as :func:`read_operations`.

    Raises
    ------
    FormatError
        With the source, the place in the document and the reason.
    MissingDependencyError
        If the package for msgpack is not installed.
    """
    _check_size(data, source)
    return _Document(source, prefix, root).read(unpack_document, data)


def document_operations(file: FileContent) -> list[tuple[str, OpaqueOperation]]:
    """Return the operations of a ``.kv.json`` file, each with its tag."""
    return read_operations(file.content, str(file.path), file.prefix, file.root)


def packed_document_operations(file: FileContent) -> list[tuple[str, OpaqueOperation]]:
    """Return the operations of a ``.kv.msgpack`` file, each with its tag."""
    return read_packed_operations(file.content, str(file.path), file.prefix, file.root)


class _Document:
    """Document that is being read."""

    def __init__(self, source: str, prefix: str | None, root: str) -> None:
        self._source, self._root = source, root
        self._place = ""
        self._prefix = prefix
        self._graph = NodeGraph(prefix)
        self._cells: dict[Cell, Any] = {}
        self._names: dict[str, set[str]] = {kind: set() for kind in KINDS}
        self._consistency = TraceConsistency(self._graph, self._cells, self._names)

    def read(self, parse: Callable[[bytes], Any], content: bytes) -> list[tuple[str, OpaqueOperation]]:
        try:
            with no_collection():
                return self._read(parse(content), content)
        except InvalidDocumentError as error:
            self._refuse(str(error))
        except RecursionError:
            self._refuse("it is nested too deeply")
        except MemoryError:
            self._refuse("there is not enough memory for it")

    def _read(self, given: Any, content: bytes) -> list[tuple[str, OpaqueOperation]]:
        self._place = "the document"
        if type(given) is not dict or given.get("format") != FORMAT:
            raise InvalidDocumentError(
                f'it does not begin with {{"format": "{FORMAT}", and so is not one of Kineverse'
            )
        self._check_version(given.get("version"))
        check_keys(given, ("format", "version", "nodes", "operations"), (HASH,))
        if HASH in given:
            check_hash(given[HASH], content, given)
        self._read_nodes(check_list(given["nodes"], "nodes"))
        return self._read_operations(check_list(given["operations"], "operations"))

    def _refuse(self, reason: str) -> NoReturn:
        place = f", {self._place}" if self._place else ""
        if len(reason) > LONGEST_REASON:  # it quotes names, which may be of any length
            reason = f"{reason[:LONGEST_REASON]} ..."
        raise FormatError(f"{self._source}{place}: {reason.removesuffix('.')}.") from None

    def _check_version(self, version: Any) -> None:
        if type(version) is not int or version < 1:
            raise InvalidDocumentError("its version is not a whole number from 1 on")
        if version > VERSION:
            shown = version if version < 1_000_000 else "a million or more"
            raise InvalidDocumentError(
                f"it is of version {shown}, and this Kineverse reads up to {VERSION}; update Kineverse"
            )

    def _read_nodes(self, table: list[Any]) -> None:
        if len(table) > MAX_NODES:
            raise InvalidDocumentError(f"{len(table):,} nodes; a document has up to {MAX_NODES:,}")
        graph = self._graph
        try:
            for node in table:
                read_node(graph, node)
        except (InvalidDocumentError, RecursionError):
            self._place = f"nodes[{len(graph.sx)}]"
            raise

    def _read_operations(self, operations: list[Any]) -> list[tuple[str, OpaqueOperation]]:
        result: dict[str, OpaqueOperation] = {}
        for i, given in enumerate(operations):
            self._place = f"operations[{i}]"
            check_keys(given, ("tag", "kind", "reads", "writes"), ("parameters", "trace", "frozen"))
            tag = check_text(given["tag"])
            if not tag:
                raise InvalidDocumentError("the tag is empty")
            if tag in result:
                raise InvalidDocumentError(f"the tag {tag[:60]!r} is taken by an earlier operation")
            result[tag] = self._operation(given, f"operations[{i}] ({tag[:60]!r})")
        self._place = "the rates"
        spend_rate_coupling(
            (value for (kind, _), value in self._cells.items() if kind == RATES), self._graph.budget
        )
        before = f"{self._prefix}/" if self._prefix else ""
        return [(before + tag, operation) for tag, operation in result.items()]

    def _operation(self, given: dict[str, Any], place: str) -> OpaqueOperation:
        self._place = f"{place}, reads"
        reads = check_keys(given["reads"], (), ("existence", "value", "listing"))
        cells: dict[Cell, Read] = {}
        for key, how in (("existence", Read.EXISTENCE), ("value", Read.VALUE)):
            for path in check_list(reads.get(key, []), key):
                cell = self._cell(*check_text(path).partition("/")[::2])
                cells[cell] = cells.get(cell, Read(0)) | how
        kinds = [_kind(kind) for kind in check_list(reads.get("listing", []), "listing")]
        writes = self._writes(given["writes"], place)
        for expression in self._expressions(writes):
            if find_read_nodes(expression):
                raise InvalidDocumentError("a read node stands outside of a trace")
        trace = self._trace(given["trace"], f"{place}, trace") if "trace" in given else None
        frozen = check_text(given.get("frozen", ""))
        if trace is not None:
            if frozen:
                raise InvalidDocumentError("an operation with a trace is not frozen")
            asked = self._consistency.reads_of(trace, writes)
            cells = merge_reads(cells, asked)
            kinds += sorted(asked.listings.difference(kinds))
        seen = {cell: self._cells.get(cell, ABSENT) for cell in cells}
        self._graph.budget.spend(COST_OF_NAME * sum(len(self._names[kind]) for kind in kinds))
        names = tuple((kind, tuple(sorted(self._names[kind]))) for kind in kinds)
        self._place = f"{place}, parameters"
        written_cells = {"/".join(cell) for cell, _ in writes}
        parameters = {
            check_text(key): decode_parameter(value, self._graph, self._rename, self._path, written_cells)
            for key, value in _members(given.get("parameters", {})).items()
        }
        overrides = any(cell in self._cells for cell, _ in writes)
        self._cells.update(writes)
        for kind, written in (cell for cell, _ in writes):
            self._names[kind].add(written)
        return OpaqueOperation(
            check_text(given["kind"]),
            parameters,
            tuple(sorted(cells.items())),
            names,
            writes,
            trace,
            frozen,
            seen,
            self._rename(""),
            overrides,
        )

    def _writes(self, given: Any, place: str) -> tuple[tuple[Cell, Any], ...]:
        writes = []
        given = check_keys(given, (), KINDS)
        for kind in (kind for kind in KINDS if kind in given):
            for key, value in _members(given[kind]).items():
                self._place = f"{place}, writes {kind}/{str(key)[:60]}"
                cell = self._cell(kind, check_entity_name(key))
                try:
                    read = decode_value(kind, value, self._graph, self._rename)
                except KineverseError as error:
                    raise InvalidDocumentError(str(error)) from None
                if kind == RATES and str(read[0]) != cell[1]:
                    raise InvalidDocumentError(f"this is the rate of '{read[0]}'")
                if kind == BODIES:
                    read = restrict_meshes(read, self._root, f"{self._source}, body {cell[1]}")
                writes.append((cell, read))
        return tuple(writes)

    def _trace(self, given: Any, place: str) -> Trace:
        self._place = place
        check_keys(given, ("questions", "writes"))
        steps = decode_queries(given["questions"], self._graph, self._cell)
        writes = self._writes(given["writes"], place)
        self._place = place
        for expression in self._expressions(writes):
            check_read_nodes(expression, len(steps))
        return Trace(steps, writes)

    def _expressions(self, writes: tuple[tuple[Cell, Any], ...]) -> Iterator[Expression]:
        """Yield the expressions of writes, if the document has read nodes at all."""
        if self._graph.has_read_nodes:
            for (kind, _), value in writes:
                yield from find_expressions(kind, value)

    def _path(self, given: str) -> str:
        return "/".join(self._cell(*given.partition("/")[::2]))

    def _cell(self, kind: Any, given: Any) -> Cell:
        kind, wanted = _kind(kind), check_text(given)  # any text: an operation may look up anything
        if kind == RATES:
            before = f"{symbol_name(self._prefix, 0)}/" if self._prefix else ""
            return kind, before + wanted
        return kind, wanted if kind == FRAMES and wanted == WORLD else self._rename(wanted)

    @property
    def _rename(self) -> Rename:
        before = f"{self._prefix}/" if self._prefix else ""
        return lambda given: before + given


def _check_size(content: str | bytes, source: str) -> None:
    if len(content) > MAX_BYTES:
        raise FormatError(f"{source}: larger than {MAX_BYTES} bytes, the most a document has.")


def _parse_json(content: bytes) -> Any:
    check_counts(content)
    text = content.decode()
    try:
        return json.loads(text, object_pairs_hook=_object, parse_constant=_no_constant)
    except json.JSONDecodeError as error:
        place = f"at line {error.lineno}, column {error.colno} (of {len(text)} characters)"
        raise InvalidDocumentError(f"it is not JSON: {error.msg} {place}") from None
    except ValueError as error:
        # An integer of thousands of digits, which Python refuses to read.
        raise InvalidDocumentError(str(error)) from None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                raise InvalidDocumentError(f"the key {key[:60]!r} occurs twice in one object")
            seen.add(key)
    return result


def _no_constant(literal: str) -> NoReturn:
    raise InvalidDocumentError(
        f'{literal} is no number of JSON; infinite bounds are written "inf" and "-inf"'
    )


def _members(value: Any) -> dict[str, Any]:
    if type(value) is not dict:
        raise InvalidDocumentError("an object is expected, from names to values")
    return value


def _kind(value: Any) -> str:
    if value not in KINDS:
        raise InvalidDocumentError(f"{str(value)[:40]!r} is not a kind of data; kinds are {', '.join(KINDS)}")
    return str(value)


def from_bytes(
    data: bytes, prefix: str | None = None, *, root: str | os.PathLike[str] | None = None
) -> Model:
    """Return the model in the result of :func:`.writer.to_bytes`. Runs no code and imports no name.

    Parameters
    ----------
    data
        The bytes, from any source.
    prefix
        Prefix of all names, tags included; the world stays the world.
    root
        Folder below which meshes given by path may be opened. By default only meshes of packages are.

    Raises
    ------
    FormatError
        If they are no valid document, with the place and the reason.
    MissingDependencyError
        If msgspec is not installed, which the extra ``exchange`` brings.
    """
    if not isinstance(data, (bytes, bytearray, memoryview)):
        raise FormatError(f"A packed document is bytes, not a {type(data).__name__}.")
    check_prefix(prefix)
    operations = read_packed_operations(
        bytes(data), "the document", prefix or None, find_text_root(NOWHERE, root)
    )
    model = Model()
    try:
        with model.edit() as edit, no_collection():
            for tag, operation in operations:
                edit.apply(operation, tag)
    except KineverseError as error:
        raise FormatError(f"The operations of the document cannot be applied: {error}") from error
    return model
