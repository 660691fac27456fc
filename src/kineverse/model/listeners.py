"""Notification of listeners about committed changes, once for each commit."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from kineverse.errors import ExpressionError
from kineverse.symbols import Symbol, check_symbols

from .diff import Change, Diff
from .operation import CONSTRAINTS, KINDS
from .read_recorder import unknown_path_error

_LOG = logging.getLogger(__name__)

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
            _LOG.exception("A listener of the model raised at version %d.", diff.version)


def _names(names: Iterable[str]) -> tuple[str, ...]:
    return (names,) if isinstance(names, str) else tuple(names)


def _below(path: str, root: str) -> bool:
    return not root or path == root or path.startswith(root if root.endswith("/") else f"{root}/")
