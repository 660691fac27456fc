"""Writing a model as a document."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from kineverse.errors import FormatError
from kineverse.model.history import Entry
from kineverse.model.model import Model, Snapshot
from kineverse.model.operation import ARTICULATIONS, DATA, KINDS
from kineverse.model.reader import Read
from kineverse.model.view import ModelView

from .recorded import Recorded
from .table import Table, text
from .values import expressions_in, written

FORMAT = "kineverse"
VERSION = 1
SUFFIX = ".kv.json"

_dump = json.JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode


def write_document(model: ModelView, path: str | os.PathLike[str]) -> None:
    """Write a model to a ``.kv.json`` file, which is there whole or not at all.

    Raises
    ------
    FormatError
        If the name has another ending, the file cannot be written, or the model contains what a document
        cannot carry; the file is then what it was before.
    """
    try:
        target = Path(os.fsdecode(path)).expanduser()
    except (TypeError, RuntimeError):  # "~name", and nobody has that name
        raise FormatError(f"A model is saved to the path of a file, not to {path!r}.") from None
    if not target.name.endswith(SUFFIX):
        raise FormatError(f"{target}: a document has the ending {SUFFIX}, as in {target.stem + SUFFIX!r}.")
    try:
        content = document_of(model).encode()
    except FormatError as error:
        raise FormatError(f"{target} is not written. {error}") from None
    except UnicodeEncodeError as error:
        bad = ascii(error.object[max(error.start - 20, 0) : error.end])
        raise FormatError(f"{target} is not written. Half a surrogate pair is no text: {bad}.") from None
    try:
        _replace(Path(os.path.realpath(target)), content)
    except OSError as error:
        raise FormatError(f"{target} cannot be written: {error.strerror or error}.") from None


def document_of(model: ModelView) -> str:
    """Return the text of a document; equal for models made by the same operations.

    Raises
    ------
    FormatError
        Naming what a document cannot carry.
    """
    snapshot = model.snapshot() if isinstance(model, Model) else model
    if not isinstance(snapshot, Snapshot):
        raise FormatError(f"A model or a snapshot is saved, not a {type(model).__name__}.")
    entries = snapshot._entries
    try:
        table = Table(
            e
            for entry in entries
            for (kind, _), value in entry.writes.items()
            for e in expressions_in(kind, value)
        )
        operations = [_operation(entry, table) for entry in entries]
    except RecursionError:
        raise FormatError("The model contains data or gradients that are nested too deeply.") from None
    return "".join(
        (
            f'{{"format":"{FORMAT}","version":{VERSION},\n"nodes":[',
            *_lines(table.lines),
            '],\n"operations":[',
            *_lines(operations),
            "]}\n",
        )
    )


def _lines(items: list[str]) -> Iterator[str]:
    for i, item in enumerate(items):
        yield ",\n" if i else "\n"
        yield item
    if items:
        yield "\n"


def _operation(entry: Entry, table: Table) -> str:
    operation = entry.operation
    kinds: dict[str, dict[str, Any]] = {kind: {} for kind in KINDS}
    for (kind, name), value in entry.writes.items():
        try:
            kinds[kind][name] = written(kind, value, table.ref)
        except FormatError as error:
            noun = "The datum" if kind in (DATA, ARTICULATIONS) else "What is"
            raise FormatError(
                f"{noun} under '{kind}/{name}', written by {entry.tag!r}, has no place in a document: {error}"
            ) from None
    cells = sorted(entry.reads.cells.items())
    reads = {
        "existence": [f"{kind}/{name}" for (kind, name), how in cells if how & Read.EXISTENCE],
        "value": [f"{kind}/{name}" for (kind, name), how in cells if how & Read.VALUE],
        "listing": sorted(entry.reads.listings),
    }
    parts = {
        "tag": text(entry.tag),
        "kind": text(operation.kind if isinstance(operation, Recorded) else type(operation).__name__),
        "reads": _dump({how: names for how, names in reads.items() if names}),
        "writes": _dump({kind: values for kind, values in kinds.items() if values}),
    }
    joined = ",".join(f'"{key}":{value}' for key, value in parts.items())
    return f"{{{joined}}}"


def _replace(target: Path, content: bytes) -> None:
    """Put a file in the place of another in one step."""
    # Beside the target, since only within one file system does a file take another's place in one step.
    beside = target.with_name(f".{target.name[:100]}.{uuid.uuid4().hex}")
    try:
        with open(beside, "xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileNotFoundError):
            shutil.copymode(target, beside)
        os.replace(beside, target)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
