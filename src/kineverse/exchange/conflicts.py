"""Conflicts of edits with commits that their clients did not know yet.

For each cell, kind of names and operation, the last revision that has changed it is kept, and the last one
that has put an operation which reads it. An edit made at an earlier revision is in conflict if it meets them.
Operations that are run again are no part of an edit: they are run on what is there.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Final, TypeVar

from kineverse.model.history import History, HistoryEntry, TouchedEntry
from kineverse.model.operation import Cell
from kineverse.model.read_recorder import ABSENT, Read, differs

from .protocol import Reason, Refused

KEPT: Final = 10_000
"""Number of revisions that edits may be behind; fewer if they are of more than a million values."""
_MOST_CELLS: Final = 1_000_000
_LONGEST_MESSAGE: Final = 1000

# Flags are compared as wholes, because operations on them are slow.
_WITH_VALUE = (Read.VALUE, Read.EXISTENCE | Read.VALUE)

Key = TypeVar("Key", bound=Hashable)


class RefusedError(Exception):
    """Edit that is not made, with its answer, whose message is one line."""

    def __init__(
        self, reason: Reason, message: str, tag: str = "", path: str = "", revision: int = 0, who: str = ""
    ) -> None:
        super().__init__(message)
        text = " ".join(message.split())
        if len(text) > _LONGEST_MESSAGE:
            text = f"{text[:_LONGEST_MESSAGE]} ..."
        self.answer = Refused(reason, text, tag, path, revision, who)


class Revisions:
    """Last revisions of all that commits have changed and read, since a revision."""

    def __init__(self, revision: int, chain: bytes) -> None:
        self._commits = {revision: (chain, "")}  # with the author
        self._tags: OrderedDict[str, int] = OrderedDict()
        self._moves: OrderedDict[str, int] = OrderedDict()
        self._values: OrderedDict[Cell, int] = OrderedDict()
        self._existence: OrderedDict[Cell, int] = OrderedDict()
        self._names: dict[str, int] = {}
        self._read_values: OrderedDict[Cell, int] = OrderedDict()
        self._read_existence: OrderedDict[Cell, int] = OrderedDict()
        self._listings: dict[str, int] = {}

    @property
    def oldest(self) -> int:
        """The first revision that an edit may have as its base."""
        return next(iter(self._commits))

    def chain_at(self, revision: int) -> bytes | None:
        """Return the digest of all commits up to a revision; None if it is not known."""
        return self._commits[revision][0] if revision in self._commits else None

    def who_made(self, revision: int) -> str:
        """Return who made a commit, empty if that is not known."""
        return self._commits[revision][1] if revision in self._commits else ""

    def last_change(self, tag: str) -> int:
        """Return the last revision that has put, moved or removed an operation; 0 if none is known."""
        return self._tags.get(tag, 0)

    def last_move(self, tag: str) -> int:
        """Return the last revision that has moved an operation; 0 if none is known."""
        return self._moves.get(tag, 0)

    def note(
        self, revision: int, chain: bytes, who: str, touched: Iterable[TouchedEntry], history: History
    ) -> None:
        """Note a commit that has just been made, and forget those that are too long ago."""
        self._commits[revision] = chain, who
        for before, now, is_given in touched:
            is_moved = before is not None and now is not None and before.place != now.place
            for cell, is_existence in _find_changes(before, now, is_moved, history):
                _put(self._values, cell, revision)
                if is_existence:
                    _put(self._existence, cell, revision)
                    self._names[cell[0]] = revision
            entry = now or before
            if entry is None or not is_given:
                continue
            _put(self._tags, entry.tag, revision)
            if is_moved:
                _put(self._moves, entry.tag, revision)
            if now is not None:
                for cell, how in now.reads.cells.items():
                    _put(self._read_values if how in _WITH_VALUE else self._read_existence, cell, revision)
                for kind in now.reads.listings:
                    self._listings[kind] = revision
        while len(self._commits) > KEPT or (len(self._values) > _MOST_CELLS and len(self._commits) > 1):
            self._forget()

    def _forget(self) -> None:
        del self._commits[self.oldest]
        for revisions in (
            self._tags,
            self._moves,
            self._values,
            self._existence,
            self._read_values,
            self._read_existence,
        ):
            while revisions and next(iter(revisions.values())) <= self.oldest:
                revisions.popitem(last=False)

    def check(
        self,
        base: int,
        put: Sequence[HistoryEntry],
        moved: Collection[str],
        removed: Sequence[str],
        history: History,
    ) -> None:
        """Raise a RefusedError if an edit is in conflict with a commit after its base, a revision.

        ``put`` are the entries that it puts, with what they read; ``moved`` and ``removed`` the tags of those
        that it moves and of others that it removes. ``history`` is that before the edit.
        """
        for tag in (*(entry.tag for entry in put), *removed):
            if self._tags.get(tag, 0) > base:
                raise self.conflict_about(
                    tag, tag, "has changed" if tag in history.entries else "has removed"
                )
        for entry in put:
            for cell, how in entry.reads.cells.items():
                last = (self._values if how in _WITH_VALUE else self._existence).get(cell, 0)
                if last > base:
                    raise self._conflict(last, entry.tag, "has changed", cell, "reads")
            for kind in entry.reads.listings:
                last = self._names.get(kind, 0)
                if last > base:
                    raise self._conflict(last, entry.tag, "has changed the names of", (kind, ""), "reads")
        pairs: list[tuple[str, HistoryEntry | None]] = [(entry.tag, entry) for entry in put]
        for tag, now in (*pairs, *((tag, None) for tag in removed)):
            for cell, is_existence in _find_changes(history.entries.get(tag), now, tag in moved, history):
                last = self._values.get(cell, 0)
                if last > base:
                    raise self._conflict(last, tag, "has changed", cell, "writes")
                last = max(
                    self._read_values.get(cell, 0),
                    self._read_existence.get(cell, 0) if is_existence else 0,
                    self._listings.get(cell[0], 0) if is_existence else 0,
                )
                if last > base:
                    raise self._conflict(last, tag, "reads", cell, "changes")

    def conflict_about(self, tag: str, other: str, what: str) -> RefusedError:
        """Return the conflict of an operation with the last commit of another one, or of itself."""
        revision = self._tags[other]
        who = self.who_made(revision)
        message = f"Revision {revision}, by {who}, {what} the operation {other!r}. Try again."
        return RefusedError("conflict", message, tag, "", revision, who)

    def _conflict(self, revision: int, tag: str, what: str, cell: Cell, how: str) -> RefusedError:
        path, who = "/".join(cell).rstrip("/"), self.who_made(revision)
        message = f"Revision {revision}, by {who}, {what} {path}, which {tag!r} {how}. Try again."
        return RefusedError("conflict", message, tag, path, revision, who)


def _put(revisions: OrderedDict[Key, int], key: Key, revision: int) -> None:
    revisions[key] = revision
    revisions.move_to_end(key)


def _find_changes(
    before: HistoryEntry | None, now: HistoryEntry | None, is_moved: bool, history: History
) -> Iterator[tuple[Cell, bool]]:
    """Yield the cells in which an entry that is put or removed writes something else, and if they come or go.

    A cell that other operations write as well neither comes nor goes. All writes of an operation that is
    moved count, as operations between the two places find other ones.
    """
    old: Mapping[Cell, object] = {} if before is None else before.writes
    new: Mapping[Cell, object] = {} if now is None else now.writes
    entry = now or before
    if entry is None or (old is new and not is_moved):
        return
    tag = entry.tag
    for cell in {**old, **new}:
        one, other = old.get(cell, ABSENT), new.get(cell, ABSENT)
        if is_moved or differs(Read.VALUE, one, other):
            existence = is_moved or (one is ABSENT) != (other is ABSENT)
            alone = existence and all(writer.tag == tag for writer in history.cells.get(cell, ()))
            yield cell, alone
