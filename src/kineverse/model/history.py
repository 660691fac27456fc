"""Sequence of operations and its fold, kept up to date incrementally by recorded reads.

Every operation has a place in the sequence. A read resolves to the last writer before the reader. When a
write changes, exactly the operations whose reads resolve to it are applied again, in order, until writes no
longer change. Every change can be undone until it is committed.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from typing import Any, TypeAlias

from kineverse._runtime import no_collection
from kineverse.errors import (
    DuplicateNameError,
    EditError,
    KineverseError,
    UnknownNameError,
    suggest,
)

from .commits.checks import (
    BEFORE_ALL,
    check_frames,
    check_names,
    check_overwrite,
    check_parent,
    check_writes,
    finds_what_it_read,
    know_parents,
    know_reads,
    refused_error,
)
from .operation import DATA, FRAMES, KINDS, Cell, Operation, Writes
from .read_recorder import ABSENT, Read, ReadRecorder, Reads, SeenValues, differs, unknown_path_error

_GAP = 1 << 32
_PLACE = attrgetter("place")


@dataclass(slots=True, eq=False, repr=False)
class HistoryEntry:
    """Operation at its place, with the reads and writes of its last run; immutable.

    ``blob`` is its form in documents, once it is known.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> entry = model.history.entry(model.history.tags[0])
    >>> entry.tag, entry.operation.default_tag()
    ('frame kitchen/kitchen', 'frame kitchen/kitchen')
    """

    tag: str
    operation: Operation
    place: int
    reads: Reads
    writes: dict[Cell, Any]
    blob: bytes | None = None

    def at(self, place: int) -> HistoryEntry:
        """Return the entry at another place."""
        return HistoryEntry(self.tag, self.operation, place, self.reads, self.writes, self.blob)

    def reading(self, reads: Reads) -> HistoryEntry:
        """Return the entry with other reads; its blob is not known then."""
        return HistoryEntry(self.tag, self.operation, self.place, reads, self.writes)


TouchedEntry: TypeAlias = tuple[HistoryEntry | None, HistoryEntry | None, bool]
"""Entry of a tag before and after an edit; False if its operation was only run again."""

CommitRecord: TypeAlias = dict[str, tuple[HistoryEntry | None, HistoryEntry | None]]
"""Entries before and after a commit, by tag, of the operations that the edit itself put, moved or removed."""


class History:
    """Operations of a model, with the writers and readers of each cell. Not thread-safe."""

    def __init__(self, entries: Iterable[HistoryEntry] = ()) -> None:
        self.entries: dict[str, HistoryEntry] = {}
        self.sequence: list[HistoryEntry] = []
        self.cells: dict[Cell, list[HistoryEntry]] = {}
        self.head: dict[str, dict[str, Any]] = {kind: {} for kind in KINDS}
        self.reading: dict[Cell, dict[str, Read]] = {}
        self.listing: dict[str, set[str]] = {kind: set() for kind in KINDS}
        self.runs = self.runs_before = 0
        self._undo: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self._before: dict[Cell, Any] = {}
        self._events: list[tuple[Cell, Any, Any]] = []
        self._dirty: list[tuple[int, str]] = []
        self._moved_frames: dict[tuple[str, int], None] = {}
        self._contested: dict[Cell, None] = {}
        self._given: dict[str, None] = {}
        self._touched: dict[str, HistoryEntry | None] = {}
        self.commits: dict[int, CommitRecord] = {}
        self._disordered: set[str] = set()
        with no_collection():
            self._fill(entries)

    def _fill(self, entries: Iterable[HistoryEntry]) -> None:
        cells, reading, head = self.cells, self.reading, self.head
        entries = list(entries)
        are_placed = all(one.place < other.place for one, other in pairwise(entries))
        for i, given in enumerate(entries):
            # New places, because the entries may come from several models.
            entry = know_reads(self, given if are_placed else given.at(i * _GAP))
            self.entries[entry.tag] = entry
            self.sequence.append(entry)
            for cell, value in entry.writes.items():
                cells.setdefault(cell, []).append(entry)
                head[cell[0]][cell[1]] = value
            for cell, how in entry.reads.cells.items():
                reading.setdefault(cell, {})[entry.tag] = how
            for kind in entry.reads.listings:
                self.listing[kind].add(entry.tag)

    def copy(self) -> History:
        """Return an independent history that shares the entries; no operation is applied."""
        other = History()
        other.entries = self.entries.copy()
        other.sequence = self.sequence.copy()
        other.cells = {cell: writers.copy() for cell, writers in self.cells.items()}
        other.reading = {cell: tags.copy() for cell, tags in self.reading.items()}
        other.listing = {kind: tags.copy() for kind, tags in self.listing.items()}
        other.head = {kind: self.ordered(kind).copy() for kind in self.head}
        other.commits = self.commits.copy()
        return other

    # -- queries -------------------------------------------------------------------------------------------

    @property
    def tags(self) -> list[str]:
        """The tags in order of application."""
        return [entry.tag for entry in self.sequence]

    def writers(self, path: str) -> list[str]:
        """Return the tags that write a path such as ``frames/kitchen/door``, in order."""
        return [e.tag for e in self.cells.get(as_cell(path), [])]

    def readers(self, path: str) -> list[str]:
        """Return the tags that read a path, in order."""
        cell = as_cell(path)
        tags = [*self.reading.get(cell, ()), *self.listing.get(cell[0], ())]
        return sorted(set(tags), key=lambda t: self.entries[t].place)

    def entry(self, tag: str) -> HistoryEntry:
        """Return the entry of a tag."""
        try:
            return self.entries[tag]
        except (KeyError, TypeError):
            raise UnknownNameError(
                f"There is no operation {tag!r}. {suggest(str(tag), self.entries, 'tag')}"
            ) from None

    def operation(self, tag: str) -> Operation:
        """Return the operation of a tag."""
        return self.entry(tag).operation

    # -- changes of the sequence ---------------------------------------------------------------------------

    def insert(
        self, tag: str, operation: Operation, index: int | None = None, seen: SeenValues | None = None
    ) -> None:
        """Run an operation and insert it before the one at ``index``, by default last.

        ``seen`` is what it has read in its document, if that is known.
        """
        self._check_new(tag, operation)
        with self.step():
            self.note_given(tag)
            entry = HistoryEntry(tag, operation, self.place_at(index), Reads(seen), {})
            if self._dirty:
                self._link(entry)
                self.mark_outdated(tag)
            else:
                entry = self._apply(entry)
                check_overwrite(self, entry)
                self.put(entry)

    def link(self, given: HistoryEntry) -> None:
        """Append an operation with its writes elsewhere; it is run only if it finds other values here."""
        entry = given.at(self.place_at())
        if self._dirty or given.tag in self.entries or not finds_what_it_read(self, entry):
            self.insert(given.tag, given.operation, seen=given.reads.seen)
            return
        entry, parents = know_parents(entry)
        for name, parent in parents:
            check_parent(self, name, parent, entry.place)
        check_overwrite(self, entry)
        self.note_given(entry.tag)
        if any(c in self.cells or c in self.reading or self.listing[c[0]] for c in entry.writes):
            self.put(entry)
            return
        # The usual case while a document is loaded, in one step.
        self._undo.append((self._take_back, (entry,)))
        self._index(entry)
        for cell, value in entry.writes.items():
            self.cells[cell] = [entry]
            self.head[cell[0]][cell[1]] = value
            self._before.setdefault(cell, ABSENT)
            self._events.append((cell, ABSENT, value))

    def _take_back(self, entry: HistoryEntry) -> None:
        for cell, value in entry.writes.items():
            self._put_head(cell, value, ABSENT)
        self._forget(entry)

    def index(self, tag: str) -> int:
        """Return the position of a tag in the sequence."""
        return bisect_left(self.sequence, self.entry(tag).place, key=_PLACE)

    def replace(self, tag: str, operation: Operation) -> None:
        """Replace an operation, at its place and under its tag."""
        old = self.entry(tag)
        check_operation(operation)
        with self.step():
            self.note_given(tag)
            reads = old.reads.copy()
            reads.seen = None
            self._exchange(HistoryEntry(tag, operation, old.place, reads, old.writes))
            if self._dirty:
                self.mark_outdated(tag)
            else:
                self._run(tag)
                check_overwrite(self, self.entries[tag])

    def remove(self, tag: str) -> None:
        """Remove an operation and its writes."""
        entry = self.entry(tag)
        self.note_given(tag)
        self._unlink(entry)
        for cell, value in entry.writes.items():
            self._mark_readers(cell, value, ABSENT, entry.place)

    def put(self, entry: HistoryEntry) -> None:
        """Link an entry at its place, or exchange the one there, and mark the readers of what it changes."""
        old = self.entries.get(entry.tag)
        if old is None:
            self._link(entry)
            for cell, value in entry.writes.items():
                self._mark_readers(cell, ABSENT, value, entry.place)
            return
        self._exchange(entry)
        for cell in {**old.writes, **entry.writes}:
            self._mark_readers(
                cell, old.writes.get(cell, ABSENT), entry.writes.get(cell, ABSENT), entry.place
            )

    def place_at(self, index: int | None = None) -> int:
        """Return a free place before the entry at an index, by default the last one of all."""
        if index is None or index >= len(self.sequence):
            return self.sequence[-1].place + _GAP if self.sequence else 0
        after = self.sequence[index].place
        before = self.sequence[index - 1].place if index else after - 2 * _GAP
        if after - before < 2:
            self._renumber()
            return self.place_at(index)
        return (before + after) // 2

    def free_place(self, place: int) -> int:
        """Return a place, or a free one directly before it if it is taken."""
        index = bisect_left(self.sequence, place, key=_PLACE)
        is_free = index == len(self.sequence) or self.sequence[index].place != place
        return place if is_free else self.place_at(index)

    def _check_new(self, tag: str, operation: object) -> None:
        if not isinstance(tag, str) or not tag:
            raise EditError(f"A tag is a non-empty text, not {tag!r}.")
        check_operation(operation)
        if tag in self.entries:
            raise DuplicateNameError(
                f"The tag {tag!r} is taken; give another one with tag=, or replace the operation."
            )

    def note_given(self, tag: str) -> None:
        """Note a tag as one that the edit itself puts, moves or removes."""
        if tag not in self._given:
            self._given[tag] = None
            self._undo.append((self._given.pop, (tag,)))

    @contextmanager
    def step(self) -> Iterator[None]:
        """Undo a single step if it raises, so that the edit can continue after the error."""
        mark, dirty = len(self._undo), list(self._dirty)
        try:
            yield
        except BaseException:
            self._undo_to(mark)
            self._dirty = dirty
            raise

    # -- running -------------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Apply all operations again whose reads have changed."""
        failures: dict[str, KineverseError] = {}
        failed: list[tuple[int, str]] = []
        done: set[tuple[int, str]] = set()
        while self._dirty:
            item = heapq.heappop(self._dirty)
            place, tag = item
            entry = self.entries.get(tag)
            if item in done or entry is None or entry.place != place:
                continue
            done.add(item)
            try:
                self._run(tag)
            except KineverseError as error:
                failures[tag] = error
                failed.append(item)
        if self._contested:
            check_names(self, self._contested, failures)
        if self._moved_frames:
            check_frames(self, self._moved_frames, failures)
        if failures:
            # The edit may still correct this; if not, it fails again at the end.
            self._dirty = failed
            raise refused_error(self, failures)
        self._contested.clear()
        self._moved_frames.clear()

    def _run(self, tag: str) -> None:
        self.put(self._apply(self.entries[tag]))

    def _apply(self, entry: HistoryEntry) -> HistoryEntry:
        self.runs += 1
        tag = entry.tag
        reads = Reads(entry.reads.seen)
        try:
            effects = entry.operation.apply(self.reader_at(entry.place, reads))
            if not isinstance(effects, Writes):
                raise EditError(f"apply() returns kv.model.Writes, not {type(effects).__name__}.")
            writes = effects.writes()
        except KineverseError:
            raise
        except Exception as error:
            raise EditError(f"Operation {tag!r} raised {type(error).__name__}: {error}") from error
        new = HistoryEntry(tag, entry.operation, entry.place, reads, writes)
        check_writes(self, new)
        return new

    def reader_at(self, place: int, reads: Reads) -> ReadRecorder:
        """Return the model before a place, which records what is read."""
        return ReadRecorder(
            lambda cell: self.value_at(cell, place), lambda kind: self.names_at(kind, place), reads
        )

    def _mark_readers(self, cell: Cell, old: Any, new: Any, place: int) -> None:
        kind, name = cell
        writers = self.cells.get(cell, ())
        if old is ABSENT and len(writers) == 1 and cell not in self.reading and not self.listing[kind]:
            # First write of a cell without readers, the usual case while a description is loaded.
            self._set_head(cell, new)
            return
        if old is ABSENT or new is ABSENT:
            # Readers then find the value of the previous writer.
            earlier = self.value_at(cell, place)
            old, new = (earlier if value is ABSENT else value for value in (old, new))
        if not differs(Read.VALUE, old, new):
            return
        index = bisect_right(writers, place, key=_PLACE)
        following = writers[index].place if index < len(writers) else None
        if following is None:
            self._set_head(cell, writers[-1].writes[cell] if writers else ABSENT)
        if kind == FRAMES and new is not ABSENT:
            if cell in self.reading if old is ABSENT else old.parent != new.parent:
                self._moved_frames[name, place] = None
        existence = (old is ABSENT) != (new is ABSENT)
        readers = [tag for tag, how in self.reading.get(cell, {}).items() if how & Read.VALUE or existence]
        for tag in (*readers, *(self.listing[kind] if existence else ())):
            reader = self.entries[tag].place
            if reader > place and (following is None or reader <= following):
                self.mark_outdated(tag)

    def list_reads(self, cells: Iterable[Cell], without: Container[str]) -> list[tuple[str, Cell, Any]]:
        """Return who else reads or lists some cells, and what each finds there, for :meth:`find_outdated`."""
        return [
            (tag, cell, self.value_at(cell, self.entries[tag].place))
            for cell in cells
            for tag in (*self.reading.get(cell, ()), *self.listing[cell[0]])
            if tag not in without
        ]

    def find_outdated(self, seen: Iterable[tuple[str, Cell, Any]]) -> list[tuple[str, Cell]]:
        """Return who finds something else than before, and where; only these remain marked."""
        self._dirty = []
        found = []
        for tag, cell, before in seen:
            entry = self.entries.get(tag)
            if entry is not None:
                how = entry.reads.cells.get(cell, Read.EXISTENCE)
                if differs(how, before, self.value_at(cell, entry.place)):
                    self.mark_outdated(tag)
                    found.append((tag, cell))
        return found

    def mark_outdated(self, tag: str) -> None:
        """Mark an operation to be run when the edit settles."""
        heapq.heappush(self._dirty, (self.entries[tag].place, tag))

    def value_at(self, cell: Cell, place: int) -> Any:
        """Return the value that the last writer before ``place`` wrote into a cell, or ABSENT."""
        writers = self.cells.get(cell)
        if not writers:
            return ABSENT
        index = len(writers) if writers[-1].place < place else bisect_left(writers, place, key=_PLACE)
        return writers[index - 1].writes[cell] if index else ABSENT

    def names_at(self, kind: str, place: int) -> list[str]:
        """Return the names of a kind that exist before ``place``, sorted."""
        if not self.sequence or self.sequence[-1].place <= place:
            own = self.sequence[-1].writes if self.sequence and self.sequence[-1].place == place else {}
            if not own:
                return sorted(self.head[kind])
        return sorted(n for (k, n), writers in self.cells.items() if k == kind and writers[0].place < place)

    def ordered(self, kind: str) -> dict[str, Any]:
        """Return the final values of a kind, in the order in which the sequence first writes them."""
        names = self.head[kind]
        if kind in self._disordered:
            cells = [cell for entry in self.sequence for cell in entry.writes if cell[0] == kind]
            values = {name: names[name] for _, name in cells if name in names}
            names.clear()
            names.update(values)
            self._disordered.discard(kind)
        return names

    # -- undo log ------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """Start a transaction, and clear the undo log."""
        self._undo.clear()
        self._before.clear()
        self._dirty.clear()
        self._moved_frames.clear()
        self._contested.clear()
        self._given.clear()
        self._touched = {}
        self.runs_before = self.runs

    def touched(self) -> Iterator[TouchedEntry]:
        """Yield what the transaction has changed, first what the edit itself did, in its order."""
        entries = self.entries
        for tag in self._given:
            before, now = self._touched.get(tag), entries.get(tag)
            if before is not None or now is not None:
                yield before, now, True
        for tag, before in self._touched.items():
            now = entries.get(tag)
            if before is not None and now is not None and now.reads is not before.reads:
                if tag not in self._given:
                    yield before, now, False

    def mark(self) -> tuple[Any, ...]:
        """Return the state of the transaction, for :meth:`return_to`."""
        return len(self._undo), self.runs, self._dirty.copy(), self._moved_frames.copy()

    def return_to(self, mark: tuple[Any, ...]) -> None:
        """Undo what the transaction did since a mark, which may be used again."""
        self._undo_to(mark[0])
        # Cycles are looked for again; names written twice are as entries are linked again.
        self.runs, self._dirty, self._moved_frames = mark[1], mark[2].copy(), mark[3].copy()

    def roll_back(self) -> None:
        """Undo everything since :meth:`begin`."""
        self._undo_to(0)
        self.begin()

    def _undo_to(self, mark: int) -> None:
        if len(self._undo) > mark:
            # The cached order may be that of the transaction that is now undone.
            self._disordered.update(KINDS)
        while len(self._undo) > mark:
            function, arguments = self._undo.pop()
            function(*arguments)

    def changes(self) -> Iterator[tuple[Cell, Any, Any]]:
        """Yield the cells whose final value differs from that at :meth:`begin`: (cell, before, after)."""
        for cell, before in self._before.items():
            after = self.head[cell[0]].get(cell[1], ABSENT)
            if before is not after and (before is ABSENT or after is ABSENT or before != after):
                yield cell, before, after

    def take_events(self) -> list[tuple[Cell, Any, Any]]:
        """Return the changes of final values since the last call, undone ones too: (cell, before, after)."""
        events, self._events = self._events, []
        return events

    def _set_head(self, cell: Cell, value: Any) -> None:
        old = self.head[cell[0]].get(cell[1], ABSENT)
        self._before.setdefault(cell, old)
        self._undo.append((self._put_head, (cell, value, old)))
        self._put_head(cell, old, value)

    def _put_head(self, cell: Cell, old: Any, value: Any) -> None:
        kind, name = cell
        if value is ABSENT:
            self.head[kind].pop(name, None)
        else:
            if name not in self.head[kind]:
                writers = self.cells.get(cell)
                if not writers or writers[0] is not self.sequence[-1]:
                    self._disordered.add(kind)
            self.head[kind][name] = value
        self._events.append((cell, old, value))

    def _link(self, entry: HistoryEntry) -> None:
        self._index(entry)
        for cell in entry.writes:
            writers = self.cells.get(cell)
            if writers is None:
                self.cells[cell] = [entry]
            else:
                insort(writers, entry, key=_PLACE)
                self._disordered.add(cell[0])
                if cell[0] != DATA:
                    self._contested[cell] = None
        self._undo.append((self._forget, (entry,)))

    def _index(self, entry: HistoryEntry) -> None:
        self._touched.setdefault(entry.tag, None)
        self.entries[entry.tag] = entry
        if not self.sequence or self.sequence[-1].place < entry.place:
            self.sequence.append(entry)
        else:
            insort(self.sequence, entry, key=_PLACE)
        for cell, how in entry.reads.cells.items():
            self.reading.setdefault(cell, {})[entry.tag] = how
        for kind in entry.reads.listings:
            self.listing[kind].add(entry.tag)

    def _unlink(self, entry: HistoryEntry) -> None:
        self._touched.setdefault(entry.tag, entry)
        self._forget(entry)
        self._undo.append((self._relink, (entry,)))

    def _relink(self, entry: HistoryEntry) -> None:
        self._link(entry)
        self._undo.pop()

    def _forget(self, entry: HistoryEntry) -> None:
        del self.entries[entry.tag]
        del self.sequence[bisect_left(self.sequence, entry.place, key=_PLACE)]
        for cell in entry.writes:
            writers = self.cells[cell]
            del writers[bisect_left(writers, entry.place, key=_PLACE)]
            if writers:
                self._disordered.add(cell[0])
            else:
                del self.cells[cell]
        for cell in entry.reads.cells:
            tags = self.reading[cell]
            del tags[entry.tag]
            if not tags:
                del self.reading[cell]
        for kind in entry.reads.listings:
            self.listing[kind].discard(entry.tag)

    def _exchange(self, new: HistoryEntry) -> None:
        old = self.entries[new.tag]
        self._unlink(old)
        self._link(new)
        if list(old.writes) != list(new.writes):
            self._disordered.update(kind for kind, _ in (*old.writes, *new.writes))

    def _renumber(self) -> None:
        # Copies and snapshots may share the entries, so they are replaced and not modified. Entries that are
        # not there any more keep their places among the others, to be put back there.
        pairs = [pair for commit in self.commits.values() for pair in commit.values() if pair[0] is not None]
        gone = [*self._touched.values(), *(entry for pair in pairs for entry in pair)]
        places = sorted({entry.place for entry in (*self.sequence, *gone) if entry is not None})
        new = {place: i * _GAP for i, place in enumerate(places)}

        def moved(entry: HistoryEntry | None) -> HistoryEntry | None:
            return None if entry is None else entry.at(new[entry.place])

        old = self.sequence, self._touched, self.commits
        self._undo.append((self._put_entries, old))
        self._put_entries(
            [entry.at(new[entry.place]) for entry in self.sequence],
            {tag: moved(entry) for tag, entry in self._touched.items()},
            {
                version: {
                    tag: pair if pair[0] is None else (moved(pair[0]), moved(pair[1]))
                    for tag, pair in commit.items()
                }
                for version, commit in self.commits.items()
            },
        )
        self._dirty = [(self.entries[tag].place, tag) for _, tag in self._dirty if tag in self.entries]
        heapq.heapify(self._dirty)

    def _put_entries(
        self,
        sequence: list[HistoryEntry],
        touched: dict[str, HistoryEntry | None],
        commits: dict[int, CommitRecord],
    ) -> None:
        # The order stays the same, so every sorted list of entries stays sorted.
        self.sequence, self._touched, self.commits = sequence, touched, commits
        self.entries = {entry.tag: entry for entry in sequence}
        for writers in self.cells.values():
            writers[:] = [self.entries[entry.tag] for entry in writers]
        # The places of moved frames are no longer known, so cycles are searched from the beginning.
        self._moved_frames = {(name, BEFORE_ALL): None for name, _ in self._moved_frames}


def as_cell(path: str) -> Cell:
    """Return kind and name of a path such as ``frames/kitchen/door``."""
    kind, _, name = str(path).partition("/")
    if kind not in KINDS or not name:
        raise unknown_path_error(path)
    return kind, name


def check_operation(operation: object) -> None:
    """Check that something is an operation."""
    if not isinstance(operation, Operation):
        raise EditError(f"{operation!r} is not an operation; subclass kv.Operation as a frozen dataclass.")
