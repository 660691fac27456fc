"""The sequence of operations and its fold, kept up to date by recorded reads.

Every operation has a place in the sequence. A read is resolved at the reader's place: by the last writer
before it. When what a writer wrote changes, exactly the operations whose reads resolve to it are run again,
in order, and it stops where writes come out equal. Every change can be undone until it is committed.
"""

from __future__ import annotations

import heapq
from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from operator import attrgetter
from typing import Any

from kineverse.errors import EditError, KineverseError, ModelError, NameTakenError, UnknownNameError, suggest

from .frame import WORLD, Frame
from .kinematics import ancestors
from .operation import CONSTRAINTS, FRAMES, KINDS, Effects, Operation
from .reader import ABSENT, Cell, Read, Reader, Reads, missing

_GAP = 1 << 32
_PLACE = attrgetter("place")


class Entry:
    """An operation at its place, with what its last run read and wrote; never changed, only exchanged."""

    __slots__ = ("operation", "place", "reads", "tag", "writes")

    def __init__(
        self, tag: str, operation: Operation, place: int, reads: Reads, writes: dict[Cell, Any]
    ) -> None:
        self.tag = tag
        self.operation = operation
        self.place = place
        self.reads = reads
        self.writes = writes


class History:
    """Operations, cells and readers; the heart of a model. Not thread-safe by itself."""

    def __init__(self, entries: Iterable[Entry] = ()) -> None:
        self.entries: dict[str, Entry] = {}
        self.sequence: list[Entry] = []
        self.cells: dict[Cell, list[Entry]] = {}
        self.head: dict[str, dict[str, Any]] = {kind: {} for kind in KINDS}
        self.reading: dict[Cell, dict[str, Read]] = {}
        self.listing: dict[str, set[str]] = {kind: set() for kind in KINDS}
        self.runs = 0
        self._undo: list[tuple[Callable[..., Any], tuple[Any, ...]]] = []
        self._before: dict[Cell, Any] = {}
        self._events: list[tuple[Cell, Any, Any]] = []
        self._dirty: list[tuple[int, str]] = []
        self._moved_frames: dict[str, None] = {}
        self._contested: dict[str, None] = {}
        self._disordered: set[str] = set()
        for i, e in enumerate(entries):
            # Placed anew: entries are shared with snapshots, and only some have been renumbered since.
            self._link(Entry(e.tag, e.operation, i * _GAP, e.reads, e.writes))
        for (kind, name), writers in self.cells.items():
            self.head[kind][name] = writers[-1].writes[kind, name]
        self.begin()

    # -- questions -----------------------------------------------------------------------------------------

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

    def entry(self, tag: str) -> Entry:
        """Return the entry of a tag.

        Raises
        ------
        UnknownNameError
            Listing similar tags.
        """
        try:
            return self.entries[tag]
        except (KeyError, TypeError):
            raise UnknownNameError(
                f"There is no operation {tag!r}. {suggest(str(tag), self.entries, 'tag')}"
            ) from None

    def operation(self, tag: str) -> Operation:
        """Return the operation of a tag.

        Raises
        ------
        UnknownNameError
            Listing similar tags.
        """
        return self.entry(tag).operation

    # -- changes of the sequence ---------------------------------------------------------------------------

    def append(self, tag: str, operation: Operation) -> None:
        """Add an operation at the end."""
        place = self.sequence[-1].place + _GAP if self.sequence else 0
        self._add(tag, operation, place)

    def insert(self, tag: str, operation: Operation, index: int) -> None:
        """Add an operation in front of the one at ``index``."""
        if index >= len(self.sequence):
            self.append(tag, operation)
            return
        after = self.sequence[index].place
        before = self.sequence[index - 1].place if index else after - 2 * _GAP
        if after - before < 2:
            self._renumber()
            self.insert(tag, operation, index)
            return
        self._add(tag, operation, (before + after) // 2)

    def index(self, tag: str) -> int:
        """Return the position of a tag in the sequence."""
        return bisect_left(self.sequence, self.entry(tag).place, key=_PLACE)

    def replace(self, tag: str, operation: Operation) -> None:
        """Exchange an operation, at its place and under its tag."""
        old = self.entry(tag)
        _check_operation(operation)
        with self._step():
            self._exchange(Entry(tag, operation, old.place, old.reads, old.writes))
            if self._dirty:
                self._soil(tag)
            else:
                self._run(tag)
                self._check_free(self.entries[tag])

    def remove(self, tag: str) -> None:
        """Take an operation out, with everything it wrote."""
        entry = self.entry(tag)
        self._unlink(entry)
        for cell, value in entry.writes.items():
            self._touched(cell, value, ABSENT, entry.place)

    def _add(self, tag: str, operation: Operation, place: int) -> None:
        if not isinstance(tag, str) or not tag:
            raise EditError(f"A tag is a non-empty text, not {tag!r}.")
        _check_operation(operation)
        if tag in self.entries:
            raise NameTakenError(
                f"The tag {tag!r} is taken; give another one with tag=, or replace the operation."
            )
        with self._step():
            entry = Entry(tag, operation, place, Reads(), {})
            if self._dirty:
                self._link(entry)
                self._soil(tag)
            else:
                entry = self._applied(entry)
                self._check_free(entry)
                self._link(entry)
                for cell, value in entry.writes.items():
                    self._touched(cell, ABSENT, value, place)

    @contextmanager
    def _step(self) -> Iterator[None]:
        """Undo a single step if it raises, so that whoever catches the error can go on."""
        mark, dirty = len(self._undo), list(self._dirty)
        try:
            yield
        except BaseException:
            self._undo_to(mark)
            self._dirty = dirty
            raise

    # -- running -------------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Run again whatever has to be.

        Raises
        ------
        EditError
            Listing every operation that could not be run, with what it misses.
        """
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
            self._check_names(failures)
        if self._moved_frames:
            self._check_frames(failures)
        if failures:
            # Whoever catches this inside an edit may mend it; what is not mended fails again at the end.
            self._dirty = failed
            lines = "".join(f"\n  {tag!r}: {error}" for tag, error in failures.items())
            raise EditError(f"The edit is refused, because these operations cannot be applied:{lines}")
        self._contested.clear()
        self._moved_frames.clear()

    def _run(self, tag: str) -> None:
        old = self.entries[tag]
        new = self._applied(old)
        self._exchange(new)
        for cell in {**old.writes, **new.writes}:
            self._touched(cell, old.writes.get(cell, ABSENT), new.writes.get(cell, ABSENT), new.place)

    def _applied(self, entry: Entry) -> Entry:
        """Run an operation at its place; return its entry with what it read and wrote."""
        self.runs += 1
        tag = entry.tag
        reads = Reads()
        reader = Reader(
            lambda cell: self.value_at(cell, entry.place), lambda k: self.names_at(k, entry.place), reads
        )
        try:
            effects = entry.operation.apply(reader)
            if not isinstance(effects, Effects):
                raise EditError(f"apply() returns kv.Effects, not {type(effects).__name__}.")
            writes = effects.writes()
        except KineverseError:
            raise
        except Exception as error:
            raise EditError(f"Operation {tag!r} raised {type(error).__name__}: {error}") from error
        for (kind, name), value in writes.items():
            if not isinstance(name, str) or not name or "//" in f"/{name}/":
                raise EditError(f"Operation {tag!r} writes {kind} under {name!r}, which is not a name.")
            if kind == FRAMES:
                self._check_parent(name, value, writes, reads, entry.place)
        return Entry(tag, entry.operation, entry.place, reads, writes)

    def _check_parent(
        self, name: str, frame: Frame, writes: Mapping[Cell, Any], reads: Reads, place: int
    ) -> None:
        if name == WORLD:
            raise EditError(f"The frame '{WORLD}' is the root of everything and cannot be written.")
        parent = frame.parent
        if parent == WORLD:
            return
        # An operation may write several frames, one below the other.
        above, chain = parent, {name}
        while (FRAMES, above) in writes and above not in chain:
            chain.add(above)
            above = writes[FRAMES, above].parent
        if above == name:
            raise ModelError(f"Cyclic frames: '{name}' would be its own parent.")
        if parent in chain:
            return
        reads.add((FRAMES, parent), Read.EXISTENCE)
        if self.value_at((FRAMES, parent), place) is ABSENT:
            error = missing(FRAMES, parent, self.names_at(FRAMES, place))
            raise UnknownNameError(f"The parent of frame '{name}' is missing. {error}")

    def _check_free(self, entry: Entry) -> None:
        for kind, name in entry.writes:
            if kind == CONSTRAINTS:
                # One that comes later may yet be called something else when it is run again.
                for other in self.cells.get((kind, name), ()):
                    if other.place < entry.place:
                        raise _taken(name, other.tag)

    def _check_names(self, failures: dict[str, KineverseError]) -> None:
        """Look for constraints that have two makers."""
        for name in self._contested:
            first, *others = self.cells.get((CONSTRAINTS, name), (None,))
            for entry in others:
                if first is not None and entry is not None:
                    failures.setdefault(entry.tag, _taken(name, first.tag))

    def _check_frames(self, failures: dict[str, KineverseError]) -> None:
        """Look for circles, which only frames that were written anew can close."""
        frames = self.head[FRAMES]
        sound = {WORLD}
        for name in self._moved_frames:
            if name not in frames:
                continue
            chain: dict[str, None] = {}
            link = name
            while link not in sound and link not in chain and link in frames:
                chain[link] = None
                link = frames[link].parent
            if link in sound:
                sound.update(chain)
                continue
            try:
                ancestors(name, frames.__getitem__)
            except ModelError as error:
                failures[self.cells[FRAMES, name][-1].tag] = error
            except KeyError as error:
                failures.setdefault(self.cells[FRAMES, name][-1].tag, missing(FRAMES, error.args[0], frames))

    def _touched(self, cell: Cell, old: Any, new: Any, place: int) -> None:
        """Note that a write at ``place`` changed, for those who read it."""
        kind, name = cell
        writers = self.cells.get(cell, ())
        if old is ABSENT and len(writers) == 1 and cell not in self.reading and not self.listing[kind]:
            # The first to write what nobody asked for: most of what loading a description does.
            self._set_head(cell, new)
            return
        if old is ABSENT or new is ABSENT:
            # What readers find instead is what was written before.
            earlier = self.value_at(cell, place)
            old, new = (earlier if value is ABSENT else value for value in (old, new))
        if old is new or (old is not ABSENT and new is not ABSENT and old == new):
            return
        index = bisect_right(writers, place, key=_PLACE)
        following = writers[index].place if index < len(writers) else None
        if following is None:
            self._set_head(cell, writers[-1].writes[cell] if writers else ABSENT)
            if kind == FRAMES and (old is not ABSENT or len(writers) > 1 or cell in self.reading):
                self._moved_frames[name] = None
        existence = (old is ABSENT) != (new is ABSENT)
        for tag, how in self.reading.get(cell, {}).items():
            reader = self.entries[tag].place
            if (
                reader > place
                and (following is None or reader <= following)
                and (how & Read.VALUE or existence)
            ):
                self._soil(tag)
        if existence:
            for tag in self.listing[kind]:
                reader = self.entries[tag].place
                if reader > place and (following is None or reader <= following):
                    self._soil(tag)

    def _soil(self, tag: str) -> None:
        heapq.heappush(self._dirty, (self.entries[tag].place, tag))

    def value_at(self, cell: Cell, place: int) -> Any:
        """Return what the last writer before ``place`` wrote into a cell, or ABSENT."""
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

    # -- bookkeeping that can be undone --------------------------------------------------------------------

    def begin(self) -> None:
        """Start a transaction: forget how to undo what was before."""
        self._undo.clear()
        self._before.clear()
        self._dirty.clear()
        self._moved_frames.clear()
        self._contested.clear()

    def roll_back(self) -> None:
        """Undo everything since :meth:`begin`."""
        self._undo_to(0)
        self.begin()

    def _undo_to(self, mark: int) -> None:
        if len(self._undo) > mark:
            # Who looked in between has the values in the order that is now undone.
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

    def _link(self, entry: Entry) -> None:
        self.entries[entry.tag] = entry
        if not self.sequence or self.sequence[-1].place < entry.place:
            self.sequence.append(entry)
        else:
            insort(self.sequence, entry, key=_PLACE)
        for cell in entry.writes:
            writers = self.cells.get(cell)
            if writers is None:
                self.cells[cell] = [entry]
            else:
                insort(writers, entry, key=_PLACE)
                self._disordered.add(cell[0])
                if cell[0] == CONSTRAINTS:
                    self._contested[cell[1]] = None
        for cell, how in entry.reads.cells.items():
            self.reading.setdefault(cell, {})[entry.tag] = how
        for kind in entry.reads.listings:
            self.listing[kind].add(entry.tag)
        self._undo.append((self._forget, (entry,)))

    def _unlink(self, entry: Entry) -> None:
        self._forget(entry)
        self._undo.append((self._relink, (entry,)))

    def _relink(self, entry: Entry) -> None:
        self._link(entry)
        self._undo.pop()

    def _forget(self, entry: Entry) -> None:
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

    def _exchange(self, new: Entry) -> None:
        old = self.entries[new.tag]
        self._unlink(old)
        self._link(new)
        if list(old.writes) != list(new.writes):
            self._disordered.update(kind for kind, _ in (*old.writes, *new.writes))

    def _renumber(self) -> None:
        entries = self.sequence
        self._undo.append((self._restore_places, ([(e, e.place) for e in entries],)))
        self._restore_places([(e, i * _GAP) for i, e in enumerate(entries)])
        self._dirty = [(self.entries[tag].place, tag) for _, tag in self._dirty if tag in self.entries]
        heapq.heapify(self._dirty)

    @staticmethod
    def _restore_places(places: list[tuple[Entry, int]]) -> None:
        # The order stays the same, so every sorted list of entries stays sorted.
        for entry, place in places:
            entry.place = place


def as_cell(path: str) -> Cell:
    """Return kind and name of a path such as ``frames/kitchen/door``.

    Raises
    ------
    UnknownNameError
        If it does not begin with a kind.
    """
    kind, _, name = path.partition("/")
    if kind not in KINDS or not name:
        raise UnknownNameError(
            f"{path!r} is not a path into a model; it begins with one of {', '.join(KINDS)}, then '/'."
        )
    return kind, name


def _check_operation(operation: object) -> None:
    if not isinstance(operation, Operation):
        raise EditError(f"{operation!r} is not an operation; subclass kv.Operation as a frozen dataclass.")


def _taken(name: str, maker: str) -> NameTakenError:
    return NameTakenError(
        f"There is a constraint '{name}' already, made by {maker!r}; "
        "choose another name or replace that operation."
    )
