"""Conflicts of edits with commits that their clients did not know yet.

For each cell, kind of names and operation, the last revision that has changed it is kept, and the last one
that has put an operation which reads it. An edit made at an earlier revision is in conflict if it meets them.
Operations that are run again are no part of an edit: they are run on what is there.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Final, Literal, TypeAlias

from kineverse.model.history import History, HistoryEntry, TouchedEntry
from kineverse.model.operation import Cell
from kineverse.model.read_recorder import ABSENT, Read, differs

from .protocol import Reason, Refused

KEPT: Final = 10_000  # number of revisions that edits may be behind; fewer if they are of millions of values
_MOST_NOTES: Final = 4_000_000
_LONGEST_MESSAGE: Final = 1000

# Flags are compared as wholes, because operations on them are slow.
_WITH_VALUE = (Read.VALUE, Read.EXISTENCE | Read.VALUE)

_What: TypeAlias = Literal["changed", "moved", "value", "comes", "read", "looked", "names", "listed"]


class RefusedError(Exception):
    """Edit that is not made, with its answer, whose message is one line."""

    def __init__(
        self, reason: Reason, message: str, tag: str = "", path: str = "", revision: int = 0, who: str = ""
    ) -> None:
        super().__init__(reason, message, tag, path, revision, who)
        text = " ".join(message.split())
        if len(text) > _LONGEST_MESSAGE:
            text = f"{text[:_LONGEST_MESSAGE]} ..."
        self.answer = Refused(reason, text, tag, path, revision, who)


class Revisions:
    """Last revisions of all that commits have changed and read, since a revision."""

    def __init__(self, revision: int, chain: bytes) -> None:
        self._commits = {revision: (chain, "")}  # with the author
        self._last: OrderedDict[tuple[_What, Hashable], int] = OrderedDict()

    def chain_at(self, revision: int) -> bytes | None:
        """Return the digest of all commits up to a revision; None if it is not known."""
        return self._commits[revision][0] if revision in self._commits else None

    def who_made(self, revision: int) -> str:
        """Return who made a commit, empty if that is not known."""
        return self._commits[revision][1] if revision in self._commits else ""

    def last(self, what: _What, key: Hashable) -> int:
        """Return the last revision that has done something with a tag, cell or kind; 0 if none is known.

        Tags are *changed*, which is put, moved or removed, or *moved*. Of cells, the *value* is written, the
        name *comes* or goes, the value is *read*, or it is *looked* if the name is there. Of kinds, *names*
        come or go, or are *listed*.
        """
        return self._last.get((what, key), 0)

    def note(
        self, revision: int, chain: bytes, who: str, touched: Iterable[TouchedEntry], history: History
    ) -> None:
        """Note a commit that has just been made, and forget those that are too long ago."""
        self._commits[revision] = chain, who
        for before, now, is_given in touched:
            is_moved = before is not None and now is not None and before.place != now.place
            for cell, is_existence in _find_changes(before, now, is_moved, history):
                self._note("value", cell, revision)
                if is_existence:
                    self._note("comes", cell, revision)
                    self._note("names", cell[0], revision)
            entry = now or before
            if entry is None or not is_given:
                continue
            self._note("changed", entry.tag, revision)
            if is_moved:
                self._note("moved", entry.tag, revision)
            if now is not None:
                for cell, how in now.reads.cells.items():
                    self._note("read" if how in _WITH_VALUE else "looked", cell, revision)
                for kind in now.reads.listings:
                    self._note("listed", kind, revision)
        while len(self._commits) > KEPT or (len(self._last) > _MOST_NOTES and len(self._commits) > 1):
            del self._commits[next(iter(self._commits))]
            oldest = next(iter(self._commits))
            while self._last and next(iter(self._last.values())) <= oldest:
                self._last.popitem(last=False)

    def _note(self, what: _What, key: Hashable, revision: int) -> None:
        self._last[what, key] = revision
        self._last.move_to_end((what, key))

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
            if self.last("changed", tag) > base:
                raise self.conflict_about(
                    tag, tag, "has changed" if tag in history.entries else "has removed"
                )
        for entry in put:
            for cell, how in entry.reads.cells.items():
                last = self.last("value" if how in _WITH_VALUE else "comes", cell)
                if last > base:
                    raise self._conflict(last, entry.tag, "has changed", cell, "reads")
            for kind in entry.reads.listings:
                last = self.last("names", kind)
                if last > base:
                    raise self._conflict(last, entry.tag, "has changed the names of", (kind, ""), "reads")
        pairs: list[tuple[str, HistoryEntry | None]] = [(entry.tag, entry) for entry in put]
        for tag, now in (*pairs, *((tag, None) for tag in removed)):
            for cell, is_existence in _find_changes(history.entries.get(tag), now, tag in moved, history):
                last = self.last("value", cell)
                if last > base:
                    raise self._conflict(last, tag, "has changed", cell, "writes")
                last = self.last("read", cell)
                if is_existence:
                    last = max(last, self.last("looked", cell), self.last("listed", cell[0]))
                if last > base:
                    raise self._conflict(last, tag, "reads", cell, "changes")

    def conflict_about(self, tag: str, other: str, what: str) -> RefusedError:
        """Return the conflict of an operation with the last commit of another one, or of itself."""
        revision = self.last("changed", other)
        who = self.who_made(revision)
        message = f"Revision {revision}, by {who}, {what} the operation {other!r}. Try again."
        return RefusedError("conflict", message, tag, "", revision, who)

    def _conflict(self, revision: int, tag: str, what: str, cell: Cell, how: str) -> RefusedError:
        path, who = "/".join(cell).rstrip("/"), self.who_made(revision)
        message = f"Revision {revision}, by {who}, {what} {path}, which {tag!r} {how}. Try again."
        return RefusedError("conflict", message, tag, path, revision, who)


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
