"""Checks of a sequence of operations: names, parents of frames, cycles, values written twice.

Entries that come from elsewhere are also completed here by what they have read.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping
from operator import attrgetter
from typing import TYPE_CHECKING

from kineverse.errors import EditError, KineverseError, ModelError, UnknownNameError, list_some
from kineverse.model.frame import WORLD
from kineverse.model.operation import FRAMES, Cell, may_override, overwrite_error
from kineverse.model.read_recorder import ABSENT, Read, Reads, unknown_name_error

if TYPE_CHECKING:
    from kineverse.model.history import History, HistoryEntry

BEFORE_ALL = -1 << 200  # place before those of all entries

_PLACE = attrgetter("place")
_LISTED = 10
_FEW = 4


def check_writes(history: History, entry: HistoryEntry) -> None:
    """Check the names that a run has written, and the parents of its frames, which are added to its reads."""
    for name, parent in find_parents(entry):
        entry.reads.add((FRAMES, parent), Read.EXISTENCE)
        check_parent(history, name, parent, entry.place)


def check_parent(history: History, name: str, parent: str, place: int) -> None:
    """Check that the parent of a frame exists before a place."""
    if history.value_at((FRAMES, parent), place) is ABSENT:
        error = unknown_name_error(FRAMES, parent, history.names_at(FRAMES, place))
        raise UnknownNameError(f"The parent of frame '{name}' is missing. {error}")


def find_parents(entry: HistoryEntry) -> Iterator[tuple[str, str]]:
    """Yield the frames that an entry puts below frames of others, each with its parent; check all names."""
    for (kind, name), value in entry.writes.items():
        if not isinstance(name, str) or not name or "//" in f"/{name}/":
            raise EditError(f"Operation {entry.tag!r} writes {kind} under {name!r}, which is not a name.")
        if kind != FRAMES:
            continue
        if name == WORLD:
            raise EditError(f"The frame '{WORLD}' is the root of everything and cannot be written.")
        if value.parent == WORLD:
            continue
        # An operation may write several frames, one below the other.
        above, chain = value.parent, {name}
        while (FRAMES, above) in entry.writes and above not in chain:
            chain.add(above)
            above = entry.writes[FRAMES, above].parent
        if above == name:
            raise ModelError(f"Cyclic frames: '{name}' would be its own parent.")
        if value.parent not in chain:
            yield name, value.parent


def know_parents(entry: HistoryEntry) -> tuple[HistoryEntry, list[tuple[str, str]]]:
    """Return an entry that has read the parents of its frames, and these as :func:`find_parents` does.

    It is the given one, or has a copy of its reads, which belong to others as well.
    """
    parents = list(find_parents(entry))
    missing = [parent for _, parent in parents if (FRAMES, parent) not in entry.reads.cells]
    if missing:
        entry = entry.reading(entry.reads.copy())
        for parent in missing:
            entry.reads.add((FRAMES, parent), Read.EXISTENCE)
    return entry, parents


def know_reads(history: History, entry: HistoryEntry) -> HistoryEntry:
    """Return an entry that takes what there is before its place as what it has read, if that is not known.

    Only that of an operation from a document that was never run does not know it.
    """
    if entry.reads.seen is not None or entry.operation.recorded is not entry.writes:
        return entry
    known = entry.reading(entry.reads.copy())
    known.reads.seen = entry.operation.see(history.reader_at(entry.place, Reads()))
    known.blob = entry.blob
    return known


def finds_what_it_read(history: History, entry: HistoryEntry) -> bool:
    """Return whether all values that an operation has read elsewhere are the same objects here."""
    seen, place = entry.reads.seen, entry.place
    return (
        seen is not None
        and all(history.value_at(cell, place) is value for cell, value in seen.values.items())
        and all(tuple(history.names_at(kind, place)) == names for kind, names in seen.names.items())
    )


def check_overwrite(history: History, entry: HistoryEntry) -> None:
    """Refuse an operation that overwrites a value of an earlier one without having read it."""
    for cell in entry.writes:
        writers = history.cells.get(cell)
        # A later operation may write another name when it is applied again.
        if writers and writers[0].place < entry.place and not may_override(entry, cell):
            raise overwrite_error(cell, entry, writers[0].tag)


def check_names(history: History, contested: Iterable[Cell], failures: dict[str, KineverseError]) -> None:
    """Report cells with a second writer that has not read the value of the first."""
    for cell in contested:
        first, *others = history.cells.get(cell, (None,))
        for entry in others:
            if first is not None and entry is not None and not may_override(entry, cell):
                failures.setdefault(entry.tag, overwrite_error(cell, entry, first.tag))


def check_frames(
    history: History, moved: Iterable[tuple[str, int]], failures: dict[str, KineverseError]
) -> None:
    """Report cycles of frames at any place of the sequence; only frames with new writes can close one."""
    for name, place in moved:
        circle = _find_cycle(history, name, place)
        if circle is not None:
            tag, names = circle
            failures.setdefault(tag, ModelError(f"Cyclic frames: {' -> '.join([*names, names[0]])}."))


def _find_cycle(history: History, name: str, place: int) -> tuple[str, list[str]] | None:
    """Return the first cycle through a frame, between a place and the frame's next write.

    The result is the tag of the operation that closes the cycle, and the names of its frames.
    """
    end = None if place == BEFORE_ALL else _next_writer(history, name, place)
    while True:
        chain: dict[str, HistoryEntry] = {}
        until = end
        link = name
        while link != WORLD and link not in chain:
            writers = history.cells.get((FRAMES, link), [])
            index = bisect_right(writers, place, key=_PLACE)
            if index < len(writers) and (until is None or writers[index].place < until):
                until = writers[index].place
            if not index:
                break  # the frame does not exist yet
            chain[link] = writers[index - 1]
            link = writers[index - 1].writes[FRAMES, link].parent
        if link == name and chain:
            return max(chain.values(), key=_PLACE).tag, list(chain)
        if until is None or until == end:
            return None
        place = until


def _next_writer(history: History, name: str, place: int) -> int | None:
    writers = history.cells.get((FRAMES, name), [])
    index = bisect_right(writers, place, key=_PLACE)
    return writers[index].place if index < len(writers) else None


def refused_error(history: History, failures: Mapping[str, KineverseError]) -> EditError:
    """Return the error for an edit after which operations cannot be applied."""
    lines = [f"  {tag!r}: {error}" for tag, error in list(failures.items())[:_LISTED]]
    if len(failures) > _LISTED:
        lines.append(f"  and {len(failures) - _LISTED} more operations.")
    needing = _dependents(history, failures)
    if needing:
        lines.append(f"What these write is needed by {list_some(map(repr, needing), _FEW)}.")
    listed = "\n".join(lines)
    return EditError(
        f"The edit is refused, because these operations cannot be applied:\n{listed}", dict(failures)
    )


def _dependents(history: History, tags: Iterable[str]) -> list[str]:
    """Return the tags of all operations that depend on others, directly or indirectly, in order."""
    entries = history.entries
    waiting = list(tags)
    found = set(waiting)
    first = len(found)
    while waiting:
        entry = entries[waiting.pop()]
        for cell in entry.writes:
            for tag in history.reading.get(cell, ()):
                if tag not in found and entries[tag].place > entry.place:
                    found.add(tag)
                    waiting.append(tag)
    if len(found) == first:
        return []
    return sorted(found.difference(tags), key=lambda tag: entries[tag].place)
