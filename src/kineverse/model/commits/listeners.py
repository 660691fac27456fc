"""Listeners to the commits of a model, with filters for what they read of it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from kineverse._checks import as_entries
from kineverse._names import is_pattern, matches_pattern
from kineverse._runtime import Closing
from kineverse.errors import ExpressionError
from kineverse.expressions.expression import Expression
from kineverse.model.body import Pose
from kineverse.model.changes import Change, Diff
from kineverse.model.frame import WORLD, Frame
from kineverse.model.operation import CONSTRAINTS, FRAMES, KINDS, RATES
from kineverse.model.rates import collect_symbols
from kineverse.model.read_recorder import unknown_path_error
from kineverse.symbols import Symbol, check_symbols

Callback = Callable[[Diff], None]


class Commit:
    """Commit as its listeners see it: the diff, and frames and rates before and after it."""

    def __init__(self, diff: Diff, head: Mapping[str, Mapping[str, Any]]) -> None:
        self.diff = diff
        self._head = head

    @cached_property
    def _changed(self) -> dict[str, dict[str, Change]]:
        kinds = (FRAMES, RATES)
        return {kind: {c.name: c for c in self.diff.changes if c.kind == kind} for kind in kinds}

    def match_frames(self, names: Iterable[str]) -> Iterator[str]:
        """Yield frames by name, and for patterns all that match, before or after the commit."""
        for name in names:
            if is_pattern(name):
                every = dict.fromkeys((*self._head[FRAMES], *self._changed[FRAMES]))
                yield from (frame for frame in every if matches_pattern(frame, (name,)))
            else:
                yield name

    def find_pose_changes(self, frame: str) -> list[Change]:
        """Return the changes that give a frame other forward kinematics."""
        frames, rates = self._changed[FRAMES], self._changed[RATES]
        if not frames and not rates:
            return []
        after, found = self._chain(frame, {}), []
        if frame in frames or not frames.keys().isdisjoint(after):
            before = self._chain(frame, frames)
            if not _have_equal_motion(list(before.values()), list(after.values())):
                found = [frames[name] for name in {**before, **after} if name in frames]
        if rates:
            moving = [x for f in after.values() for x in f.factors if isinstance(x, Expression)]
            reached = self._reach(s.path for factor in moving for s in collect_symbols(factor))
            found += [rates[name] for name in reached if name in rates]
        return found

    def find_changes_about(self, paths: Iterable[str]) -> list[Change]:
        """Return the changes of constraints and rates that concern coordinates or what they depend on."""
        about, driving = self._reach(paths, dependent=True).keys(), self._reach(paths)
        return [
            change
            for change in self.diff.changes
            if change.kind in (CONSTRAINTS, RATES)
            and (
                not about.isdisjoint(self._reach(change.coordinates, dependent=True))
                or (change.kind == RATES and change.name in driving)
            )
        ]

    def _chain(self, name: str, changed: Mapping[str, Change]) -> dict[str, Frame]:
        """Return a frame and those above it, by name; before the commit if its changes are given."""
        chain: dict[str, Frame] = {}
        while name != WORLD:
            frame = changed[name].before if name in changed else self._head[FRAMES].get(name)
            if frame is None:
                break
            chain[name] = frame
            name = frame.parent
        return chain

    def _reach(self, paths: Iterable[str], *, dependent: bool = False) -> dict[str, None]:
        """Return coordinates with those that determine them: by all rates, or if they are dependent."""
        rates = self._head[RATES]
        waiting = list(paths)
        found: dict[str, None] = {}
        while waiting:
            path = waiting.pop()
            if path in found:
                continue
            found[path] = None
            if path in rates:
                entry = rates[path][1]
                if isinstance(entry, Expression):
                    waiting += [s.path for s in collect_symbols(entry)]
                elif not dependent:
                    for speed, value in entry:
                        waiting += [speed.path, *(s.path for s in collect_symbols(value))]
        return found


def _have_equal_motion(before: list[Frame], after: list[Frame]) -> bool:
    """Return whether two chains, from the tip upwards, multiply to the same motion, factor by factor."""
    if not (before and after):
        return False
    for end in (-1, 0):
        while before and after and before[end] is after[end]:
            del before[end], after[end]
    one, other = list(_multiply_constants(before)), list(_multiply_constants(after))
    return len(one) == len(other) and all(
        np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b for a, b in zip(one, other, strict=True)
    )


def _multiply_constants(chain: list[Frame]) -> Iterator[Any]:
    """Yield the moving factors of a chain from the root to its tip, and the products of constants between."""
    constant = np.eye(4)
    for frame in chain[::-1]:
        for factor in frame.factors:
            if isinstance(factor, Pose):
                constant = constant @ factor.matrix
            else:
                yield constant
                yield factor
                constant = np.eye(4)
    yield constant


@dataclass(frozen=True)
class CommitFilter:
    """Paths, coordinates, tags and frames that a listener follows; None where it does not filter."""

    paths: tuple[str, ...] | None = None
    coordinates: frozenset[str] | None = None
    tags: tuple[str, ...] | None = None
    frames: tuple[str, ...] | None = None

    @staticmethod
    def of(
        paths: Iterable[str] | None,
        symbols: Iterable[Symbol] | None,
        tags: Iterable[str] | None,
        frames: Iterable[str] | None,
    ) -> CommitFilter:
        """Build a filter from what a listener asks for."""
        paths = _texts("paths", paths)
        for path in paths or ():
            if path and path.partition("/")[0] not in KINDS:  # everything is below the empty path
                raise unknown_path_error(path)
        return CommitFilter(
            paths,
            None if symbols is None else frozenset(s.path for s in check_symbols(symbols)),
            _texts("tags", tags),
            _texts("frames", frames),
        )

    def select(self, commit: Commit) -> Diff | None:
        """Return the part of a commit's diff that passes; None if it is empty."""
        diff = commit.diff
        if self == _EVERYTHING:
            return diff
        found = [c for c in diff.changes if any(_below(c.path, path) for path in self.paths or ())]
        if self.coordinates:
            found += commit.find_changes_about(self.coordinates)
        poses = []
        for frame in commit.match_frames(self.frames or ()):
            moving = commit.find_pose_changes(frame)
            if moving:
                poses.append(frame)
                found += moving
        tags = frozenset(self.tags or ())
        groups = ("added", "removed", "replaced", "moved", "rerun")
        heard = {name: tuple(t for t in getattr(diff, name) if t in tags) for name in groups}
        if not (found or any(heard.values())):
            return None
        changes = tuple({id(change): change for change in found}.values())
        return replace(diff, changes=changes, poses=tuple(poses), **heard)  # type: ignore[arg-type]


_EVERYTHING = CommitFilter()


@dataclass(frozen=True, eq=False)
class Listener(Closing):
    """Callback with its filter; :meth:`close` unregisters it.

    See Also
    --------
    kineverse.Model.listen
    """

    callback: Callback
    filter: CommitFilter
    registry: Listeners

    def close(self) -> None:
        """Unregister the callback; a second call has no effect."""
        self.registry.remove(self)


Witness = Callable[[Commit], None]
"""Function that is called in a commit, before anybody else sees its version; it must be short."""


class Listeners:
    """Listeners of one model, called in the order of registration and of versions."""

    def __init__(self) -> None:
        self._listeners: list[Listener] = []
        self.witnesses: list[Witness] = []
        self._waiting: deque[tuple[int, list[tuple[Listener, Diff]]]] = deque()
        self._delivering = False
        self._lock = threading.Lock()

    def add(self, callback: Callback, wanted: CommitFilter) -> Listener:
        """Register a callback, which gets what passes the filter."""
        if not callable(callback):
            raise ExpressionError(f"A listener is called with a diff, and {callback!r} cannot be called.")
        listener = Listener(callback, wanted, self)
        with self._lock:
            self._listeners.append(listener)
        return listener

    def remove(self, listener: Listener) -> None:
        """Unregister a listener."""
        with self._lock:
            self._listeners = [known for known in self._listeners if known is not listener]

    def post(self, commit: Commit) -> None:
        """Queue what each listener gets of the present commit; called in the order of versions."""
        for witness in tuple(self.witnesses):
            witness(commit)
        if commit.diff.is_empty:  # only its version is new
            return
        parts = [(listener, listener.filter.select(commit)) for listener in self._listeners]
        heard = [(listener, part) for listener, part in parts if part is not None]
        if heard:
            with self._lock:
                self._waiting.append((commit.diff.version, heard))

    def deliver(self, caught: type[BaseException] = Exception) -> None:
        """Call the listeners with the queued diffs. What they raise of a kind is logged; the others go on.

        One thread delivers at a time, so diffs arrive in order. If another thread, or a callback that edits
        the model, posts a diff meanwhile, the delivering thread takes it over.
        """
        while True:
            with self._lock:
                if self._delivering or not self._waiting:
                    return
                self._delivering = True
                version, heard = self._waiting.popleft()
            try:
                for listener, part in heard:
                    if listener in self._listeners:
                        _tell(listener, part, version, caught)
            finally:
                with self._lock:
                    self._delivering = False


def _tell(listener: Listener, part: Diff, version: int, caught: type[BaseException]) -> None:
    try:
        listener.callback(part)
    except caught:
        import logging  # for start-up time

        logging.getLogger(__name__).exception("A listener of the model raised at version %d.", version)


def _texts(name: str, given: Iterable[str] | None) -> tuple[str, ...] | None:
    return None if given is None else as_entries(f"{name}=", given, str, f"{name} of the model, as texts")


def _below(path: str, root: str) -> bool:
    return not root or path == root or path.startswith(root if root.endswith("/") else f"{root}/")
