"""Changes of a model by a commit, and listeners that get them."""

from __future__ import annotations

import math
import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from kineverse.errors import ExpressionError
from kineverse.symbols import Symbol, check_symbols

from .constraint import Constraint, coordinates
from .operation import CONSTRAINTS, KINDS
from .read_recorder import unknown_path_error


@dataclass(frozen=True, slots=True)
class Change:
    """Structural change of one value; ``before`` is None for an added value, ``after`` for a removed one."""

    kind: str
    name: str
    before: Any
    after: Any

    @property
    def path(self) -> str:
        """Kind and name, such as ``frames/kitchen/door``."""
        return f"{self.kind}/{self.name}"

    @property
    def coordinates(self) -> frozenset[str]:
        """Coordinates of a constraint before and after the change; empty for other kinds of data."""
        sides = [v for v in (self.before, self.after) if isinstance(v, Constraint)]
        return frozenset().union(*(coordinates(c.lower, c.expression, c.upper) for c in sides))


@dataclass(frozen=True, slots=True)
class Diff:
    """Difference between two versions of a model.

    Attributes
    ----------
    version
        Version after the change. A commit starts from ``version - 1``.
    changes
        Values that changed, in no particular order.
    added, removed, replaced
        Tags of operations, in the order of the edit.
    reruns
        Number of times that an operation was applied.
    moved
        Tags of operations with a new position relative to the others. In a commit, these were removed and
        added again elsewhere, and are in ``replaced`` as well.
    rerun
        Tags of operations that were applied again because a value that they read had changed, in order.
        ``changes`` shows if their writes changed. Empty in comparisons of models.
    """

    version: int
    changes: tuple[Change, ...]
    added: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    reruns: int = 0
    moved: tuple[str, ...] = ()
    rerun: tuple[str, ...] = ()

    @property
    def is_empty(self) -> bool:
        """True if there are no differences."""
        return not (self.changes or self.tags)

    @property
    def paths(self) -> tuple[str, ...]:
        """The paths of all changes, sorted."""
        return tuple(sorted(c.path for c in self.changes))

    @property
    def tags(self) -> frozenset[str]:
        """Tags that were added, removed, replaced, moved or run again."""
        return frozenset((*self.added, *self.removed, *self.replaced, *self.moved, *self.rerun))


def find_moved_tags(before: Sequence[str], after: Sequence[str], among: Container[str]) -> tuple[str, ...]:
    """Return a smallest set of tags whose removal makes both orders equal, in the new order."""
    present = set(after)
    place = {tag: i for i, tag in enumerate(tag for tag in before if tag in present)}
    common = [tag for tag in after if tag in place]
    kept = _longest_in_order([place[tag] for tag in common], [tag not in among for tag in common])
    return tuple(tag for i, tag in enumerate(common) if i not in kept)


def _longest_in_order(places: Sequence[int], wanted: Sequence[bool]) -> set[int]:
    """Return the indices of a longest increasing part that has all that are wanted, which increase."""
    kept: set[int] = set()  # what stands still leaves room for the others only in between
    low, start = -1, 0
    for end in (*(i for i, is_wanted in enumerate(wanted) if is_wanted), len(places)):
        high = places[end] if end < len(places) else max(places, default=0) + 1
        inside = [i for i in range(start, end) if low < places[i] < high]
        kept.update(inside[k] for k in _longest([places[i] for i in inside]))
        if end < len(places):
            kept.add(end)
            low, start = high, end + 1
    return kept


def _longest(places: Sequence[int]) -> set[int]:
    ends: list[int] = []  # ends[k]: the least end of an increasing part of k + 1 places
    lengths: list[int] = []
    for place in places:
        length = bisect_left(ends, place)
        lengths.append(length)
        ends[length : length + 1] = [place]
    kept: set[int] = set()
    length, last = len(ends) - 1, math.inf
    for i in range(len(places) - 1, -1, -1):
        if lengths[i] == length and places[i] < last:
            kept.add(i)
            length, last = length - 1, places[i]
    return kept


Callback = Callable[[Diff], None]


@dataclass(frozen=True, eq=False)
class Listener:
    """Callback with its filter; :meth:`close` unregisters it."""

    callback: Callback
    paths: tuple[str, ...] | None
    coordinates: frozenset[str] | None
    tags: frozenset[str] | None
    registry: Listeners

    def close(self) -> None:
        """Unregister the callback; a second call has no effect."""
        self.registry.remove(self)

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def relevant(self, diff: Diff) -> Diff | None:
        """Return the part of a diff that passes the filter; None if it is empty."""
        if self.paths is None and self.coordinates is None and self.tags is None:
            return diff
        changes = tuple(c for c in diff.changes if self._wants(c))
        tags = self.tags or frozenset()
        groups = ("added", "removed", "replaced", "moved", "rerun")
        heard = {name: tuple(t for t in getattr(diff, name) if t in tags) for name in groups}
        if not (changes or any(heard.values())):
            return None
        return replace(diff, changes=changes, **heard)  # type: ignore[arg-type]

    def _wants(self, change: Change) -> bool:
        if self.paths is not None and any(_below(change.path, p) for p in self.paths):
            return True
        wanted = self.coordinates
        return wanted is not None and change.kind == CONSTRAINTS and not wanted.isdisjoint(change.coordinates)


class Listeners:
    """Listeners of one model, called in the order of registration and of versions."""

    def __init__(self) -> None:
        self._listeners: list[Listener] = []
        self._waiting: deque[tuple[Diff, tuple[Listener, ...]]] = deque()
        self._delivering = False
        self._lock = threading.Lock()

    def add(
        self,
        callback: Callback,
        paths: Iterable[str] | None,
        symbols: Iterable[Symbol] | None,
        tags: Iterable[str] | None,
    ) -> Listener:
        """Register a callback; without a filter it gets every diff."""
        if not callable(callback):
            raise ExpressionError(f"A listener is called with a diff, and {callback!r} cannot be called.")
        for path in () if paths is None else _names(paths):
            if path and str(path).partition("/")[0] not in KINDS:  # everything is below the empty path
                raise unknown_path_error(path)
        listener = Listener(
            callback,
            None if paths is None else _names(paths),
            None if symbols is None else frozenset(s.path for s in check_symbols(symbols)),
            None if tags is None else frozenset(_names(tags)),
            self,
        )
        self._listeners.append(listener)
        return listener

    def remove(self, listener: Listener) -> None:
        """Unregister a listener."""
        self._listeners = [known for known in self._listeners if known is not listener]

    def post(self, diff: Diff) -> None:
        """Queue a diff for the present listeners; called in the order of versions."""
        if self._listeners:
            with self._lock:
                self._waiting.append((diff, tuple(self._listeners)))

    def deliver(self) -> None:
        """Call the listeners with the queued diffs. An exception of a listener is logged; the others go on.

        One thread delivers at a time, so diffs arrive in order. If another thread, or a callback that edits
        the model, posts a diff meanwhile, the delivering thread takes it over.
        """
        while True:
            with self._lock:
                if self._delivering or not self._waiting:
                    return
                self._delivering = True
                diff, listeners = self._waiting.popleft()
            try:
                for listener in listeners:
                    self._tell(listener, diff)
            finally:
                with self._lock:
                    self._delivering = False

    def _tell(self, listener: Listener, diff: Diff) -> None:
        part = listener.relevant(diff) if listener in self._listeners else None
        if part is None:
            return
        try:
            listener.callback(part)
        except Exception:
            import logging  # for start-up time

            logging.getLogger(__name__).exception(
                "A listener of the model raised at version %d.", diff.version
            )


def _names(names: Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _below(path: str, root: str) -> bool:
    return not root or path == root or path.startswith(root if root.endswith("/") else f"{root}/")
