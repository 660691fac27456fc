"""Undo of commits that a server has made before it was started, by what its store has kept of them."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from operator import attrgetter

from kineverse.formats import operation_from_bytes
from kineverse.formats.document import OpaqueOperation
from kineverse.model import NetChanges, PlacedEntry
from kineverse.model.history import History, HistoryEntry
from kineverse.model.read_recorder import Read

from . import protocol
from .conflicts import Conflict, ConflictFoundError
from .protocol import Commit
from .store import Replaced, Store

_PLACE = attrgetter("place")


def find_inverse(store: Store, history: History, revision: int) -> NetChanges:
    """Return the changes that take back a commit of a store.

    Parameters
    ----------
    store
        Store of the commits, up to the present one.
    history
        History of the present model.
    revision
        Revision of the commit.

    Raises
    ------
    ConflictFoundError
        If a later commit has changed one of its operations, or what a frozen one had read.
    """
    data, replaced = store.commit_of(revision)
    commit: Commit = protocol.decode_commit(data)
    changes = commit.changes
    messages = store.last_commits(store.revision - revision, store.revision + 1)
    later: list[Commit] = [protocol.decode_commit(one) for one in messages]  # the newest first
    put: list[PlacedEntry] = []
    removed = {old.tag for old in replaced if old.blob is None}
    gone = {*removed, *changes.moved}
    for old in sorted(replaced, key=_PLACE):
        _check_unchanged(history, revision, old.tag, old.tag in changes.removed, later)
        if old.blob is not None:
            entry = operation_from_bytes(old.blob)
            if computes(entry) and is_frozen(entry):
                _check_unread(store, revision, entry, later)
            put.append(PlacedEntry(entry, _find_anchor(history, old, put, gone)))
    again = tuple(placed.entry.tag for placed in put if placed.entry.tag in history.entries)
    moved = tuple(tag for tag in changes.moved if tag in again)
    return NetChanges(tuple(put), again, (), moved, tuple(sorted(removed)))


def computes(entry: HistoryEntry) -> bool:
    """Return whether an operation depends on values that it reads, and not only on their being there."""
    reads = entry.reads
    return bool(reads.listings) or any(how is not Read.EXISTENCE for how in reads.cells.values())


def is_frozen(entry: HistoryEntry) -> bool:
    """Return whether an operation of a document has no trace."""
    return isinstance(entry.operation, OpaqueOperation) and entry.operation.trace is None


def _check_unchanged(
    history: History, revision: int, tag: str, was_removed: bool, later: Sequence[Commit]
) -> None:
    for one in later:
        of = one.changes
        if tag in of.removed or tag in of.replaced or tag in of.moved:
            raise _conflict(one, tag, "", f"has changed {tag!r} after revision {revision}, which did so too")
    if was_removed == (tag in history.entries):
        raise _conflict(later[0], tag, "", f"is after another {tag!r} than that of revision {revision}")


def _check_unread(store: Store, revision: int, entry: HistoryEntry, later: Sequence[Commit]) -> None:
    """Check that a frozen operation finds what it has read; it does not know that itself."""
    for one in later:
        blobs = [placed.blob for placed in one.changes.put]
        blobs += [old.blob for old in store.commit_of(one.revision)[1] if old.blob is not None]
        for cell in (cell for blob in blobs for cell in operation_from_bytes(blob).writes):
            if cell in entry.reads.cells or cell[0] in entry.reads.listings:
                path = "/".join(cell)
                what = f"has changed {path} after revision {revision}, and {entry.tag!r} was made from it"
                raise _conflict(one, entry.tag, path, what)


def _conflict(later: Commit, tag: str, path: str, what: str) -> ConflictFoundError:
    message = f"Revision {later.revision}, by {later.who}, {what}. Undo it first."
    return ConflictFoundError(Conflict(message, tag, path, later.revision, later.who))


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
