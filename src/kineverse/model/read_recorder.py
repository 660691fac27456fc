"""View of the model before an operation, with recorded reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import IntFlag
from typing import TYPE_CHECKING, Any, NamedTuple

from kineverse.errors import KineverseError, UnknownNameError, suggest
from kineverse.expressions.expression import Expression
from kineverse.symbols import Symbol

from .articulation import Articulation
from .body import Body
from .constraint import Constraint
from .frame import WORLD, Frame
from .kinematics import branches, relative_pose
from .operation import ARTICULATIONS, BODIES, CONSTRAINTS, DATA, FRAMES, KINDS, RATES
from .rates import RateEntry, Rates, collect_symbols, to_plain

if TYPE_CHECKING:
    from .operation import Cell

_MANY = 100


class _Absent:
    """Type of :data:`ABSENT`, of which copies and pickles are the same object."""

    def __reduce__(self) -> str:
        return "ABSENT"


ABSENT: Any = _Absent()


class Read(IntFlag):
    """Strength of a read: existence of a name only, or its value."""

    EXISTENCE = 1
    VALUE = 2


class SeenValues(NamedTuple):
    """Values that an operation of a document has read there; its writes in the document follow from them."""

    values: Mapping[Cell, Any]  # of the cells that it read
    names: Mapping[str, tuple[str, ...]]  # of the kinds that it listed
    overrides: bool  # True if it overwrote writes of operations before it


class Reads:
    """Recorded reads of one run: cells with the strength of the read, and listed kinds.

    ``seen`` is what an operation of a document has read there, once it is known; all later runs refer to it.
    The trace of the run, once it is made, is stored here as well.
    """

    __slots__ = ("cells", "listings", "seen", "trace")

    def __init__(self, seen: SeenValues | None = None) -> None:
        self.cells: dict[Cell, Read] = {}
        self.listings: set[str] = set()
        self.seen = seen
        self.trace: object = None

    def copy(self) -> Reads:
        """Return an independent copy."""
        other = Reads(self.seen)
        other.cells, other.listings, other.trace = self.cells.copy(), self.listings.copy(), self.trace
        return other

    def add(self, cell: Cell, how: Read) -> None:
        """Record a read of a cell."""
        known = self.cells.get(cell)
        self.cells[cell] = how if known is None else known | how


class ReadRecorder:
    """Model before an operation, with the names of :class:`~kineverse.Model` and recorded reads.

    Expressions are in plain coordinates, except those of :meth:`fk` and :meth:`carry`.

    See Also
    --------
    kineverse.Operation
    """

    def __init__(
        self, value_at: Callable[[Cell], Any], names_at: Callable[[str], list[str]], reads: Reads
    ) -> None:
        self._value_at = value_at
        self._names_at = names_at
        self._reads = reads

    @property
    def seen(self) -> SeenValues | None:
        """Values that the operation has read in its document; None until they are known."""
        return self._reads.seen

    def remember(self, seen: SeenValues) -> None:
        """Keep values as those that the operation has read."""
        self._reads.seen = seen

    def read(self, cell: Cell, how: Read) -> Any:
        """Record a read of a cell, and return its value; :data:`ABSENT` if it has none."""
        self._reads.add(cell, how)
        return self._value_at(cell)

    def list_names(self, kind: str) -> list[str]:
        """Record that the names of a kind were listed, and return them."""
        self._reads.listings.add(kind)
        return self._names_at(kind)

    def restricted(self, prefix: str) -> ReadRecorder:
        """Return a reader that lists only names with a prefix, and records in the same place."""
        return ReadRecorder(
            self._value_at,
            lambda kind: [name for name in self._names_at(kind) if name.startswith(prefix)],
            self._reads,
        )

    def replaced(self, values: Mapping[Cell, Any], listings: Mapping[str, Sequence[str]]) -> ReadRecorder:
        """Return a reader with other values in some cells and other listings; this one records nothing."""
        return ReadRecorder(
            lambda cell: values[cell] if cell in values else self._value_at(cell),
            lambda kind: list(listings[kind]) if kind in listings else self._names_at(kind),
            Reads(),
        )

    # Mappings are made on demand: most operations read little, and some read nothing.

    @property
    def frames(self) -> Mapping[str, Frame]:
        """Frames by name."""
        return self.by_kind(FRAMES)

    @property
    def bodies(self) -> Mapping[str, Body]:
        """Bodies by the frame they belong to."""
        return self.by_kind(BODIES)

    @property
    def articulations(self) -> Mapping[str, Articulation]:
        """Articulations by name."""
        return self.by_kind(ARTICULATIONS)

    @property
    def constraints(self) -> Mapping[str, Constraint]:
        """Constraints by name."""
        return self.by_kind(CONSTRAINTS)

    @property
    def data(self) -> Mapping[str, Any]:
        """All other data by name."""
        return self.by_kind(DATA)

    def by_kind(self, kind: str) -> Mapping[str, Any]:
        """Return one kind of data by name."""
        return _RecordedMapping(self, kind)

    def fk(self, frame: str, relative_to: str = WORLD) -> Expression:
        """Return relative_to_T_frame, 4×4, with coordinates carried by the rates before the operation."""
        recorded = self.frames.__getitem__
        try:
            # Frames above the last common ancestor do not affect the result, so their reads are not recorded.
            base, down = branches(frame, relative_to, self._peek)
        except (KineverseError, KeyError):
            base, down = branches(frame, relative_to, recorded)
        for name in (*base, *down):
            recorded(name)
        for end in {frame, relative_to} - {WORLD}:
            self._reads.add((FRAMES, end), Read.EXISTENCE)
        return self.carry(relative_pose(frame, relative_to, self._peek))

    def _peek(self, name: str) -> Frame:
        value: Frame = self._value_at((FRAMES, name))
        if value is ABSENT:
            raise KeyError(name)
        return value

    def coordinates_between(self, frame: str, relative_to: str = WORLD) -> tuple[Symbol, ...]:
        """Return the coordinates between two frames, from the last common ancestor downwards.

        Coordinates of the branch of ``frame`` come first. Dependent coordinates are replaced by independent
        ones.
        """
        base, down = branches(frame, relative_to, self.frames.__getitem__)
        found: dict[Symbol, None] = {}
        for name in (*down, *base):
            for factor in self._peek(name).factors:
                if isinstance(factor, Expression):
                    for symbol in factor.symbols:
                        behind = self.resolve(symbol).symbols if symbol.has_derivative else ()
                        found.update(dict.fromkeys(s for s in behind if s.has_derivative))
        return tuple(found)

    def resolve(self, expression: Expression) -> Expression:
        """Return an expression in independent plain coordinates."""
        expression = to_plain(expression)
        return self._rates_for(expression).resolve(expression)

    def carry(self, expression: Expression) -> Expression:
        """Return an expression with coordinates carried by the rates before the operation."""
        return self._rates_for(expression).carry(expression)

    def _rates_for(self, expression: Expression) -> Rates:
        entries: dict[Symbol, RateEntry] = {}
        wanted = list(collect_symbols(expression))
        while wanted:
            x = wanted.pop()
            if x.order or x in entries or not x.has_derivative:
                continue
            found = self.read((RATES, str(x)), Read.VALUE)
            if found is not ABSENT:
                entry = entries[x] = found[1]
                if isinstance(entry, Expression):
                    wanted += collect_symbols(entry)
                    continue
                for speed, value in entry:
                    wanted += [speed.position, *collect_symbols(value)]
        return Rates(entries)


class _RecordedMapping(Mapping[str, Any]):
    """Mapping of one kind of data by name, with recorded reads."""

    def __init__(self, reader: ReadRecorder, kind: str) -> None:
        self._reader, self._kind = reader, kind

    def __getitem__(self, name: str) -> Any:
        value = self._reader.read((self._kind, name), Read.VALUE)
        if value is ABSENT:
            raise unknown_name_error(self._kind, name, self._reader._names_at(self._kind))
        return value

    def get(self, name: str, default: Any = None) -> Any:
        value = self._reader.read((self._kind, name), Read.VALUE)
        return default if value is ABSENT else value

    def __contains__(self, name: object) -> bool:
        if not isinstance(name, str):
            return False
        return self._reader.read((self._kind, name), Read.EXISTENCE) is not ABSENT

    def __iter__(self) -> Iterator[str]:
        return iter(self._reader.list_names(self._kind))

    def __len__(self) -> int:
        return len(self._reader.list_names(self._kind))


def differs(how: Read, before: Any, now: Any) -> bool:
    """Return whether a read finds something else than before; 1, 1.0 and True differ, and 0.0 and -0.0."""
    if before is now:
        return False
    return before is ABSENT or now is ABSENT or bool(how & Read.VALUE and not _is_same(before, now))


def _is_same(one: Any, other: Any) -> bool:
    if type(one) is tuple and type(other) is tuple:
        return len(one) == len(other) and all(map(_is_same, one, other))
    if isinstance(one, (int, float)) or isinstance(other, (int, float)):
        return type(one) is type(other) and repr(one) == repr(other)
    return bool(one == other)


def unknown_path_error(path: object) -> UnknownNameError:
    """Return the error for an invalid path into a model."""
    return UnknownNameError(
        f"{path!r} is not a path into a model; it begins with one of {', '.join(KINDS)}, then '/'."
    )


def unknown_name_error(kind: str, name: str, available: Any) -> UnknownNameError:
    """Return the error for an unknown name, with similar names."""
    noun = {BODIES: "body", RATES: "rate", DATA: "datum"}.get(kind, kind[:-1])
    if not isinstance(name, str):
        return UnknownNameError(f"A {noun} is asked for by its name, a text, not by {name!r}.")
    names = list(available)
    if kind == FRAMES:
        if name == WORLD:
            return UnknownNameError(
                f"The frame '{WORLD}' is the root of all others, and is not listed among them."
            )
        names.append(WORLD)
    if len(names) > _MANY:
        # An edit may miss thousands of names at once, and the search for similar ones is slow.
        start, end = name[: len(name) // 2 + 1], name[-len(name) // 2 :]
        names = [n for n in names if n.startswith(start) or n.endswith(end)][:_MANY]
        if not names:
            return UnknownNameError(f"There is no {noun} {name!r:.80}, and none of a similar name.")
    return UnknownNameError(f"There is no {noun} {name!r:.80}. {suggest(name, names, noun)}")
