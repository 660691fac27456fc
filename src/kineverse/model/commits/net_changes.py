"""Net changes of an edit as a value, and their adoption by another model."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import Any

from kineverse.errors import EditError
from kineverse.model.articulation import Articulation
from kineverse.model.body import Body
from kineverse.model.changes import find_moved_tags
from kineverse.model.constraint import Constraint
from kineverse.model.frame import Frame
from kineverse.model.history import History, HistoryEntry, TouchedEntry
from kineverse.model.operation import KINDS, RATES, Operation
from kineverse.model.read_recorder import Read, Reads, SeenValues
from kineverse.symbols import Symbol

from .checks import check_parent, know_parents, know_reads

_PLACE = attrgetter("place")
_TYPES: dict[str, Any] = dict(
    zip(KINDS, (Frame, Body, Articulation, Constraint, tuple, Hashable), strict=True)
)


@dataclass(frozen=True, slots=True)
class PlacedEntry:
    """Entry of a model's history, with its place among the others.

    Attributes
    ----------
    entry
        Tag, operation, reads and writes.
    after
        Tag of the operation before it; None at the beginning.
    at_end
        True if nothing follows but what the edit has put there. It then goes to the end of any model, after
        what others have put there meanwhile.

    See Also
    --------
    kineverse.Model.adopt
    """

    entry: HistoryEntry
    after: str | None
    at_end: bool = False


@dataclass(frozen=True, slots=True)
class NetChanges:
    """Net effect of an edit, from :meth:`.Edit.net`; :meth:`.Model.adopt` makes it in an equal model.

    Attributes
    ----------
    put
        Entries that are new or have changed, in the order of the sequence.
    replaced
        Tags of operations in ``put`` that the edit has replaced or moved.
    rerun
        Tags of operations in ``put`` that were only run again, because values that they read have changed.
    moved
        Tags of those in ``replaced`` that are at another place among the others.
    removed
        Tags of operations that are gone.

    See Also
    --------
    kineverse.Model.adopt
    """

    put: tuple[PlacedEntry, ...] = ()
    replaced: tuple[str, ...] = ()
    rerun: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()

    @property
    def added(self) -> tuple[str, ...]:
        """Tags of new operations, in the order of the sequence."""
        known = {*self.replaced, *self.rerun}
        return tuple(placed.entry.tag for placed in self.put if placed.entry.tag not in known)

    @property
    def is_empty(self) -> bool:
        """True if the edit has done nothing so far."""
        return not (self.put or self.removed)


def group_tags(history: History, touched: Iterable[TouchedEntry]) -> dict[str, tuple[str, ...]]:
    """Return the tags of what the transaction has changed so far, by the names of these groups in a diff."""
    added, removed, replaced, rerun = [], [], [], []
    for before, now, is_given in touched:
        if now is None:
            assert before is not None
            removed.append(before.tag)
        elif before is None:
            added.append(now.tag)
        elif is_given:
            replaced.append((before, now))
        else:
            rerun.append(now)
    return {
        "added": tuple(added),
        "removed": tuple(removed),
        "replaced": tuple(now.tag for _, now in replaced),
        "rerun": tuple(entry.tag for entry in sorted(rerun, key=_PLACE)),
        "moved": _find_moved(history, added, replaced),
    }


def _find_moved(
    history: History, added: list[str], replaced: list[tuple[HistoryEntry, HistoryEntry]]
) -> tuple[str, ...]:
    """Return a smallest set of the tags put elsewhere whose removal makes both orders equal, in order."""
    again = [(old.place, new.place, new.tag) for old, new in replaced if old.place != new.place]
    if not again:
        return ()
    others = sorted([*(history.entries[tag].place for tag in added), *(place for _, place, _ in again)])

    def rank(place: int) -> int:
        """Return how many of the entries that stand still are before a place."""
        return bisect_left(history.sequence, place, key=_PLACE) - bisect_left(others, place)

    between = [one for one in again if rank(one[0]) == rank(one[1])]  # the same two that stand still
    old, new = ([tag for *_, tag in sorted(between, key=itemgetter(side))] for side in (0, 1))
    still = {*new}.difference(find_moved_tags(old, new))
    return tuple(tag for *_, tag in sorted(again, key=itemgetter(1)) if tag not in still)


def find_net_changes(history: History) -> NetChanges:
    """Return the net changes of the transaction so far."""
    groups = group_tags(history, history.touched())
    added, entries, sequence = groups.pop("added"), history.entries, history.sequence
    new = {*added, *groups["moved"]}
    end = len(sequence)
    while end and sequence[end - 1].tag in new:
        end -= 1
    put = []
    for entry in sorted((entries[t] for t in (*added, *groups["replaced"], *groups["rerun"])), key=_PLACE):
        index = bisect_left(sequence, entry.place, key=_PLACE)
        put.append(PlacedEntry(entry, sequence[index - 1].tag if index else None, index >= end))
    return NetChanges(tuple(put), **groups)


def adopt(history: History, changes: NetChanges, *, complete: bool) -> None:
    """Link the entries of net changes as they are, and run nothing.

    Other operations that read what has changed are marked to run. If the changes are to be complete, they are
    refused.
    """
    if not isinstance(changes, NetChanges):
        raise EditError(f"A model adopts kv.model.NetChanges, from edit.net(), not {changes!r:.80}.")
    fault = _find_fault(changes)
    if fault:
        raise EditError(f"The changes cannot be adopted: {fault}. Changes come from edit.net().")
    put = {placed.entry.tag: placed.entry for placed in changes.put}
    again, known = {*changes.replaced, *changes.rerun}, history.entries
    for tag in put:
        is_new = tag not in again
        if is_new == (tag in known):
            what = "taken" if is_new else "not there"
            raise EditError(f"The changes do not belong to this model: {tag!r} is {what}. {_ELSEWHERE}")
    history.settle()
    before = [known[tag] for tag in (*changes.removed, *put) if tag in known]
    cells = dict.fromkeys(cell for entry in (*before, *put.values()) for cell in entry.writes)
    parents: dict[str, list[tuple[str, str]]] = {}
    with history.step():
        seen = history.list_reads(cells, without=put)
        for tag in (*changes.removed, *changes.moved):
            history.remove(tag)
        for placed in changes.put:
            entry, parents[placed.entry.tag] = know_parents(placed.entry)
            if entry.tag not in changes.rerun:
                history.note_given(entry.tag)
            history.put(know_reads(history, entry.at(_find_place(history, placed))))
        for tag in put:
            # Parents are looked for when all are there, as frames may be replaced before them.
            for name, parent in parents[tag]:
                check_parent(history, name, parent, history.entries[tag].place)
        for tag, cell in history.find_outdated(seen):
            if complete:
                raise EditError(
                    f"The changes do not belong to this model: {tag!r} reads {'/'.join(cell)}, which they "
                    f"change, and is not among them. {_ELSEWHERE}"
                )


_ELSEWHERE = "Adopt them where the model is as it was before the edit."


def _find_place(history: History, placed: PlacedEntry) -> int:
    old = history.entries.get(placed.entry.tag)
    if old is not None:
        return old.place
    if placed.at_end:
        return history.place_at(None)
    return history.place_at(0 if placed.after is None else history.index(placed.after) + 1)


def _find_fault(changes: NetChanges) -> str:
    groups = (changes.replaced, changes.rerun, changes.moved, changes.removed)
    for group in (changes.put, *groups):
        if not isinstance(group, tuple | list):
            return f"{group!r:.80} is no tuple"
    for tag in (tag for group in groups for tag in group):
        if not isinstance(tag, str):
            return f"{tag!r:.80} is no tag"
    for placed in changes.put:
        entry = placed.entry if isinstance(placed, PlacedEntry) else None
        if not isinstance(entry, HistoryEntry) or not _are_reads(entry.reads):
            return f"{placed!r:.80} is no entry with its place and its reads"
        if not isinstance(entry.tag, str) or not entry.tag or not isinstance(entry.operation, Operation):
            return f"{entry.tag!r:.80} has no tag or no operation"
        if not isinstance(entry.writes, dict) or not all(
            _is_write(cell, value) for cell, value in entry.writes.items()
        ):
            return f"{entry.tag!r} has writes of wrong kinds or types, {entry.writes!r:.80}"
    put = [placed.entry.tag for placed in changes.put]
    known = {*changes.replaced, *changes.rerun}
    if len({*put, *changes.removed}) < len(put) + len(changes.removed):
        return "a tag is put or removed twice"
    if not ({*changes.moved} <= {*changes.replaced} and known <= {*put}):
        return "what is replaced, moved or run again is not put"
    return ""


def _are_reads(reads: object) -> bool:
    return (
        isinstance(reads, Reads)
        and isinstance(reads.cells, dict)
        and isinstance(reads.listings, set)
        and all(_is_cell(cell) and isinstance(how, Read) for cell, how in reads.cells.items())
        and reads.listings <= {*KINDS}
        and (reads.seen is None or isinstance(reads.seen, SeenValues))
    )


def _is_cell(cell: object) -> bool:
    return isinstance(cell, tuple) and len(cell) == 2 and cell[0] in KINDS and isinstance(cell[1], str)


def _is_write(cell: Any, value: Any) -> bool:
    return (
        _is_cell(cell)
        and isinstance(value, _TYPES[cell[0]])
        and (cell[0] != RATES or (len(value) == 2 and isinstance(value[0], Symbol)))
    )
