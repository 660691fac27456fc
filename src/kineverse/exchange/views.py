"""Parts of a model: what frames and coordinates need of it, and how commits change that.

A part is made of *cells*, the values of a model by kind and name: the frames of a wish with all frames above
them, and everything about the coordinates that these have. In the part, coordinates come with their rates and
with those that the rates are made of. A constraint about a coordinate of the part is in the part, and so are
all other coordinates of the constraint, in its bounds as well. So whatever a query about the wish finds in
the whole model, it finds in the part.

Part and whole agree, for wished frames and for all frames above them, in ``fk``, ``jacobian``, ``speeds_of``,
``symbols_of``, ``constraints_for`` and ``velocity_rows``. They agree, for every coordinate of the part, in
``rates``, ``limits`` at all states and at one, and ``default_state``. All names are those of the whole. A
listing, or a query without a subject, is about the part alone. Data are in no part, and a constraint that has
a coordinate in nothing but its bounds is not about it. A wished symbol brings no frames: without constraint
and rate there is nothing but its record.

A part has operations of the same tags in the same order, with those of their writes that are in the part, but
no parameters and traces, so they cannot be run again. It shows the present of a model: what was overwritten
is not in it. A frame that was attached elsewhere is in the world until then, so that all parents are there at
every place. So a value before the end of the sequence may be another one than that of the whole.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import Any, Final

from kineverse.errors import UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.expressions.graph import gradient_keys
from kineverse.formats.document import OpaqueOperation, entry_to_bytes
from kineverse.formats.document.parameters import document_kind
from kineverse.model.changes import Diff, find_moved_tags
from kineverse.model.frame import WORLD, Frame
from kineverse.model.history import History, HistoryEntry
from kineverse.model.model import Model
from kineverse.model.operation import (
    ARTICULATIONS,
    BODIES,
    CONSTRAINTS,
    FRAMES,
    RATES,
    Cell,
    find_expressions,
)
from kineverse.model.rates import collect_symbols
from kineverse.model.read_recorder import Read, Reads, unknown_name_error
from kineverse.symbols import parse_symbol_name, symbol_name

from .protocol import NO_CHAIN, Changes, CommitMessage, Placed, Published, encode
from .protocol import chain as link_commits

Key = tuple[str, str]  # cell, or ``about`` and a coordinate, ``tag`` and a tag, ``below`` and a prefix

MOST_MISSED: Final = 1000  # most commits that a replica catches up with; after more, it is made anew
EVERY_FRAME: Final = ("",)  # frames of a wish for all frames
LOAD_THE_WHOLE: Final = "To move it, or to run it again, load the whole model; or replace it by a new one."

_ABOUT, _TAG, _BELOW = "about", "tag", "below"
_COUPLING = (CONSTRAINTS, RATES, ARTICULATIONS)
_OVERWRITTEN = Frame(WORLD, ())
_PARTIAL = "only a part of it is here"
_PLACE = attrgetter("place")


@dataclass(frozen=True)
class Wish:
    """Frames and symbols by which a part of a model is asked for, all by name.

    ``kitchen/fridge_door`` is this frame. ``kitchen/``, with a slash at its end, stands for all frames with
    names that begin so, those that come later included. Symbols stand for their coordinates. With ``bodies``,
    wished frames have their bodies; the frames above them come without.
    """

    frames: tuple[str, ...] = ()
    symbols: tuple[str, ...] = ()
    bodies: bool = True

    @cached_property
    def id(self) -> str:
        """Digest of the wish, 32 hexadecimal digits; equal wishes have equal ones."""
        content = json.dumps([sorted({*self.frames}), sorted({*self.symbols}), self.bodies])
        return hashlib.sha256(content.encode(errors="surrogatepass")).hexdigest()[:32]

    @cached_property
    def paths(self) -> frozenset[str]:
        """Coordinates of the symbols, by path."""
        return frozenset(parse_symbol_name(name)[0] for name in self.symbols)

    def check(self, model: Model) -> None:
        """Check that all that is wished is there, else raise UnknownNameError with similar names.

        A text that is no name of a symbol at all is an ExpressionError.
        """
        frames = model.frames
        for name in self.frames:
            if _is_prefix(name):
                if name and not any(known.startswith(name) for known in frames):
                    prefixes = {known[: i + 1] for known in frames for i, c in enumerate(known) if c == "/"}
                    raise UnknownNameError(
                        f"There is no frame below {name!r}. {suggest(name, prefixes, 'prefix')}"
                    )
            elif name != WORLD and name not in frames:
                raise unknown_name_error(FRAMES, name, frames)
        for name in self.symbols:
            model.symbol(name)


class Coupling:
    """Index of a model: what is about each coordinate, kept up to date by the changes of commits."""

    def __init__(self, history: History) -> None:
        self._history = history
        self._paths: dict[Cell, tuple[Any, frozenset[str]]] = {}
        self._entered: dict[Cell, tuple[tuple[str, str], ...]] = {}
        self._groups: defaultdict[tuple[str, str], dict[str, None]] = defaultdict(dict)
        for kind in _COUPLING:
            for name in history.head[kind]:
                self.update((kind, name))

    def update(self, cell: Cell) -> Iterable[str]:
        """Enter the present value of a cell; return the coordinates that it adds something about."""
        kind, name = cell
        self._paths.pop(cell, None)
        if kind not in _COUPLING:
            return ()
        for group in self._entered.pop(cell, ()):
            self._groups[group].pop(name, None)
        value = self._history.head[kind].get(name)
        if value is None:
            return ()
        groups: list[tuple[str, str]]
        if kind == CONSTRAINTS:
            groups = [("constraints", path) for path in _paths_of((value.expression,))]
        elif kind == ARTICULATIONS:
            groups = [("records", symbol.path) for symbol in value.coordinates]
            groups.append(("child", value.child))
        elif isinstance(value[1], Expression):
            groups = [("dependent", path) for path in _paths_of((value[1],))]
        else:
            groups = [("driven", speed.path) for speed, _ in value[1]]
        self._entered[cell] = tuple(groups)
        for group in groups:
            self._groups[group][name] = None
        about = [path for what, path in groups if what != "child"]
        return [value[0].path, *about] if kind == RATES else about

    def paths(self, cell: Cell) -> frozenset[str]:
        """Return the coordinates in the value of a cell."""
        value = self._history.head[cell[0]][cell[1]]
        known = self._paths.get(cell)
        if known is None or known[0] is not value:
            known = self._paths[cell] = value, find_paths(cell[0], value)
        return known[1]

    def close(self, wish: Wish) -> tuple[dict[Cell, None], set[Key]]:
        """Return the cells that a wish needs, as far as they are there, and the keys of commits to them."""
        head = self._history.head
        frames, bodies = head[FRAMES], head[BODIES]
        cells: dict[Cell, None] = {}
        keys: set[Key] = set()
        wished: dict[str, None] = {}
        for name in wish.frames:
            if _is_prefix(name):
                keys.add((_BELOW, name))
                wished |= dict.fromkeys(known for known in frames if known.startswith(name))
            else:
                wished[name] = None
        waiting = list(wish.paths)
        for name in wished:
            keys.add((FRAMES, name))
            if wish.bodies:
                keys.add((BODIES, name))
                if name in bodies:
                    cells[BODIES, name] = None
            while name != WORLD and name in frames and (FRAMES, name) not in cells:
                cell = FRAMES, name
                cells[cell] = None
                waiting += self.paths(cell)
                name = frames[name].parent
        self._add_coordinates(waiting, cells, keys)
        for kind, name in list(cells):
            if kind == FRAMES:
                cells |= dict.fromkeys((ARTICULATIONS, record) for record in self._find("child", name))
        keys.update(cells)
        return cells, keys

    def _add_coordinates(self, waiting: list[str], cells: dict[Cell, None], keys: set[Key]) -> None:
        """Add everything about coordinates, and about those that it has in turn."""
        rates = self._history.head[RATES]
        found: set[str] = set()
        followed: set[str] = set()
        while waiting:
            path = waiting.pop()
            if path in found:
                continue
            found.add(path)
            rate = RATES, symbol_name(path, 0)
            if rate[1] in rates:
                cells[rate] = None
                waiting += self.paths(rate)
            cells |= dict.fromkeys((ARTICULATIONS, name) for name in self._find("records", path))
            # A constraint on the angles of a loop is about its crank, and one on a heading about the wheels.
            following = [path]
            while following:
                mover = following.pop()
                if mover in followed:
                    continue
                followed.add(mover)
                keys.add((_ABOUT, mover))
                for name in self._find("constraints", mover):
                    cell = CONSTRAINTS, name
                    if cell not in cells:
                        cells[cell] = None
                        waiting += self.paths(cell)
                following += (rates[name][0].path for name in self._find("dependent", mover))
                waiting += (rates[name][0].path for name in self._find("driven", mover))

    def _find(self, what: str, name: str) -> Iterable[str]:
        return self._groups.get((what, name), ())


def find_paths(kind: str, value: Any) -> frozenset[str]:
    """Return the coordinates in a written value, and the speeds of a rate."""
    found = _paths_of(find_expressions(kind, value))
    if kind == RATES and not isinstance(value[1], Expression):
        found |= {speed.path for speed, _ in value[1]}
    return found


def _paths_of(expressions: Iterable[Expression]) -> frozenset[str]:
    """Return the coordinates of expressions and of their gradients, heuristic ones included."""
    found: set[str] = set()
    for expression in expressions:
        found.update(symbol.path for symbol in collect_symbols(expression))
        if expression.nodes:  # else the gradient has the speeds of these
            found.update(symbol.path for symbol in gradient_keys(expression))
    return frozenset(found)


def _is_prefix(name: str) -> bool:
    """Return whether a name of a wish stands for all frames with names that begin so."""
    return not name or name.endswith("/")


def _part_entries(
    history: History, cells: Collection[Cell], known: Mapping[str, HistoryEntry]
) -> list[HistoryEntry]:
    """Return the operations of a part in order, each with its blob.

    Those that are as they are in an earlier part, ``known`` by tag, are the same objects.
    """
    writers: dict[str, HistoryEntry] = {}
    for cell in cells:
        # Frames hold others at every place; of all other values the last one counts.
        for entry in history.cells[cell] if cell[0] == FRAMES else history.cells[cell][-1:]:
            writers[entry.tag] = entry
    return [
        _part_entry(history, entry, cells, known.get(entry.tag))
        for entry in sorted(writers.values(), key=_PLACE)
    ]


def _part_entry(
    history: History, entry: HistoryEntry, cells: Collection[Cell], known: HistoryEntry | None
) -> HistoryEntry:
    writes: dict[Cell, Any] = {}
    reads = Reads()
    for cell, value in entry.writes.items():
        if cell not in cells:
            continue
        all_writers = history.cells[cell]
        if all_writers[-1] is entry:
            writes[cell] = value
        elif cell[0] == FRAMES:
            writes[cell] = _OVERWRITTEN
        if cell[0] == FRAMES and all_writers[0] is not entry:
            reads.add(cell, Read.EXISTENCE)  # without which it may not be overwritten
    for (written, _), value in writes.items():
        if written == FRAMES and value.parent != WORLD and (FRAMES, value.parent) not in writes:
            reads.add((FRAMES, value.parent), Read.EXISTENCE)
    operation = entry.operation
    kind = operation.kind if isinstance(operation, OpaqueOperation) else document_kind(type(operation))
    if known is not None and _is_same(known, kind, reads, writes):
        return known
    shown = OpaqueOperation(kind, reads=reads.cells, recorded=writes, frozen=_PARTIAL)
    made = HistoryEntry(entry.tag, shown, 0, reads, writes)
    blob = entry_to_bytes(made, ())
    return known if known is not None and known.blob == blob else made


def is_partial(entry: HistoryEntry) -> bool:
    """Return whether an operation comes from a part: it may lack writes, and is put nowhere else."""
    return isinstance(entry.operation, OpaqueOperation) and entry.operation.frozen == _PARTIAL


def _is_same(known: HistoryEntry, kind: str, reads: Reads, writes: Mapping[Cell, Any]) -> bool:
    operation = known.operation
    return (
        isinstance(operation, OpaqueOperation)
        and operation.kind == kind
        and known.reads.cells == reads.cells
        and list(known.writes) == list(writes)
        and all(known.writes[cell] is value for cell, value in writes.items())
    )


class View:
    """Part of a model that clients follow, kept up to date by :class:`Views`.

    ``id`` is that of the wish; ``users`` is the number of times that it was asked for and not released;
    ``log`` is for the commits that are made of its changes.
    """

    def __init__(self, model: Model, coupling: Coupling, wish: Wish) -> None:
        self._model = model
        self._coupling = coupling
        self.wish = wish
        self.id = wish.id
        self.users = 0
        self.log = ViewLog(model.version)
        self._entries: dict[str, HistoryEntry] = {}
        self._keys: set[Key] = set()
        self._renew()

    @property
    def entries(self) -> tuple[HistoryEntry, ...]:
        """Operations of the part in order."""
        return tuple(self._entries.values())

    def commit(self, keys: Set[Key], replaced: Set[str]) -> Changes | None:
        """Bring the part to the model after a commit; return the changes for a replica, None without any.

        The keys are of what has changed. Operations that changed count as replaced if their tags are among
        those given, which the commit itself has replaced or moved; all others as run again.
        """
        if self._keys.isdisjoint(keys):
            return None
        old = self._entries
        new = self._renew()
        moved = find_moved_tags([*old], [*new])
        put, after = [], ""
        again: dict[str, list[str]] = {"replaced": [], "rerun": []}
        for tag, entry in new.items():
            if old.get(tag) is not entry or tag in moved:
                put.append(Placed(entry_to_bytes(entry, ()), after))
                if tag in old:
                    again["replaced" if tag in replaced or tag in moved else "rerun"].append(tag)
            after = tag
        removed = tuple(tag for tag in old if tag not in new)
        if not (put or removed):
            return None
        return Changes(tuple(put), tuple(again["replaced"]), tuple(again["rerun"]), moved, removed)

    def _renew(self) -> dict[str, HistoryEntry]:
        cells, keys = self._coupling.close(self.wish)
        found = _part_entries(self._model.history, cells, self._entries)
        self._entries = {entry.tag: entry for entry in found}
        self._keys = keys.union((_TAG, tag) for tag in self._entries)
        return self._entries


class ViewLog:
    """Last commits of a part, as they were published."""

    def __init__(self, revision: int) -> None:
        self._begin = self.last = revision
        self.link = NO_CHAIN
        self._commits: deque[tuple[int, Published]] = deque()

    def add(self, epoch: str, chain: bytes, commit: CommitMessage) -> Published:
        """Add a commit, forget the oldest if there are many, and return what is published."""
        data = encode(commit)
        self.last, self.link = commit.revision, link_commits(self.link, data)
        published = Published(epoch, chain, data, self.link)
        self._commits.append((commit.revision, published))
        if len(self._commits) > MOST_MISSED:
            self._begin = self._commits.popleft()[0]
        return published

    def find_after(self, revision: int) -> list[Published] | None:
        """Return the commits after a revision; None if some of them are forgotten."""
        if revision < self._begin:
            return None
        return [published for number, published in self._commits if number > revision]


class Views:
    """Parts of a model that are followed. Not thread-safe."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._views: dict[str, View] = {}

    @cached_property
    def _coupling(self) -> Coupling:
        return Coupling(self._model.history)

    def __iter__(self) -> Iterator[View]:
        return iter(self._views.values())

    def get(self, view: str) -> View | None:
        """Return the view of an identifier, if it is followed."""
        return self._views.get(view)

    def add(self, wish: Wish, *, again: bool = False) -> View:
        """Return the view of a wish; equal wishes share one. Each user releases it at the end.

        Unknown names are refused as by :meth:`Wish.check`, unless others follow this view already, or one
        asks for it ``again``.
        """
        known = self._views.get(wish.id)
        if known is None:
            if not again:
                wish.check(self._model)
            known = self._views[wish.id] = View(self._model, self._coupling, wish)
        known.users += 1
        return known

    def release(self, view: View) -> None:
        """Follow a view no longer for one of its users."""
        view.users -= 1
        if view.users <= 0 and self._views.get(view.id) is view:
            del self._views[view.id]

    def commit(self, *diffs: Diff) -> list[tuple[View, Changes]]:
        """Return the views that commits have changed, each with the changes for its replicas.

        The diffs are those of one or several commits in order. The model is at the last of them, and so are
        the views afterwards.
        """
        if not self._views:
            vars(self).pop("_coupling", None)  # it would miss the changes
            return []
        keys: set[Key] = set()
        replaced: set[str] = set()
        for diff in diffs:
            keys |= self._find_keys(diff)
            replaced.update(diff.replaced)
        changed = [(view, view.commit(keys, replaced)) for view in self]
        return [(view, changes) for view, changes in changed if changes is not None]

    def _find_keys(self, diff: Diff) -> set[Key]:
        history = self._model.history
        keys: set[Key] = set()
        for tag in diff.tags:
            keys.add((_TAG, tag))
            if tag in history.entries:
                keys.update(history.entries[tag].writes)
        for change in diff.changes:
            cell = change.kind, change.name
            keys.add(cell)
            keys.update((_ABOUT, path) for path in self._coupling.update(cell))
            if change.kind == ARTICULATIONS and change.after is not None:
                keys.add((FRAMES, change.after.child))
            elif change.kind == FRAMES and change.before is None:
                keys.add((_BELOW, ""))
                keys.update((_BELOW, change.name[: i + 1]) for i, c in enumerate(change.name) if c == "/")
        return keys
