"""Undo of commits that a server has made before it was started, by what its store has kept of them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from operator import attrgetter
from typing import Any, Final

from kineverse.formats import operation_from_bytes
from kineverse.formats.document import OpaqueOperation
from kineverse.model import NetChanges, PlacedEntry
from kineverse.model.history import History, HistoryEntry
from kineverse.model.operation import Cell
from kineverse.model.read_recorder import ABSENT, Read, differs

from . import protocol
from .conflicts import RefusedError
from .protocol import CommitMessage
from .store import Replaced, Store

_PLACE = attrgetter("place")
_UNKNOWN: Final = object()


def find_inverse(store: Store, history: History, revision: int) -> NetChanges:
    """Return the changes that take back a commit of a store, which has all commits of a model.

    If a later commit has changed one of its operations, or what a frozen one had read, it is in conflict with
    that (RefusedError).
    """
    data, replaced = store.commit_of(revision)
    commit: CommitMessage = protocol.decode_commit(data)
    changes = commit.changes
    messages = store.last_commits(store.revision - revision, store.revision + 1)
    later: list[CommitMessage] = [protocol.decode_commit(one) for one in messages]  # the newest first
    put: list[PlacedEntry] = []
    removed = {old.tag for old in replaced if old.blob is None}
    gone = {*removed, *changes.moved}
    for old in sorted(replaced, key=_PLACE):
        _check_unchanged(history, revision, old.tag, old.tag in changes.removed, later)
        if old.blob is not None:
            entry = operation_from_bytes(old.blob)
            if computes(entry) and not _has_trace(entry):
                _check_unread(store, history, entry, later)
            put.append(PlacedEntry(entry, _find_anchor(history, old, put, gone)))
    again = tuple(placed.entry.tag for placed in put if placed.entry.tag in history.entries)
    moved = tuple(tag for tag in changes.moved if tag in again)
    return NetChanges(tuple(put), again, (), moved, tuple(sorted(removed)))


def computes(entry: HistoryEntry) -> bool:
    """Return whether an operation depends on more of what it reads than on its being there."""
    kinds = {*entry.reads.cells.values()}
    return _has_trace(entry) or bool(entry.reads.listings or kinds - {Read.EXISTENCE})


def _has_trace(entry: HistoryEntry) -> bool:
    return isinstance(entry.operation, OpaqueOperation) and entry.operation.trace is not None


def _check_unchanged(
    history: History, revision: int, tag: str, was_removed: bool, later: Sequence[CommitMessage]
) -> None:
    for one in later:
        of = one.changes
        if tag in of.removed or tag in of.replaced or tag in of.moved:
            raise _conflict(one, tag, "", f"has changed {tag!r} after revision {revision}, which did so too")
    if was_removed == (tag in history.entries):
        raise _conflict(later[0], tag, "", f"is after another {tag!r} than that of revision {revision}")


def _check_unread(
    store: Store, history: History, entry: HistoryEntry, later: Sequence[CommitMessage]
) -> None:
    """Check that a frozen operation finds what it has read; it does not know that itself."""
    # The value before the first commit that touched it, and that commit.
    then: dict[Cell, tuple[Any, CommitMessage]] = {}
    for one in later[::-1]:
        _, replaced = store.commit_of(one.revision)
        old: dict[Cell, Any] = {}
        for blob in (was.blob for was in replaced if was.blob is not None):
            old.update(operation_from_bytes(blob).writes)
        for now in (operation_from_bytes(placed.blob) for placed in one.changes.put):
            # What an operation wrote before it was run again is not kept.
            unknown = _UNKNOWN if now.tag in one.changes.rerun else ABSENT
            old.update({cell: unknown for cell in now.writes if cell not in old})
        then.update({cell: (value, one) for cell, value in old.items() if cell not in then})
    for cell, (value, one) in then.items():
        how = entry.reads.cells.get(cell)
        now = history.head[cell[0]].get(cell[1], ABSENT)
        is_changed = how is not None and (value is _UNKNOWN or differs(how, value, now))
        if is_changed or cell[0] in entry.reads.listings:
            path = "/".join(cell)
            raise _conflict(one, entry.tag, path, f"has changed {path}, from which {entry.tag!r} was made")


def _conflict(later: CommitMessage, tag: str, path: str, what: str) -> RefusedError:
    message = f"Revision {later.revision}, by {later.who}, {what}. Undo it first."
    return RefusedError("conflict", message, tag, path, later.revision, later.who)


def _find_anchor(history: History, old: Replaced, put: Sequence[PlacedEntry], gone: set[str]) -> str | None:
    """Return the tag after which an operation goes back: that of before, else the one at its place."""
    put_tags = {placed.entry.tag for placed in put}
    if old.after in put_tags or (old.after in history.entries and old.after not in gone):
        return old.after
    if not old.after:
        return None
    index = bisect_left(history.sequence, old.place, key=_PLACE)
    earlier = (entry.tag for entry in history.sequence[:index][::-1] if entry.tag not in gone)
    return next(earlier, None)
