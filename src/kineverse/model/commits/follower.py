"""Values that are built from a model, and anew in the background when what they read of it has changed."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Generic, NamedTuple, TypeVar

from kineverse._checks import as_count, as_tolerance
from kineverse._runtime import Closing
from kineverse.errors import EditError, ExpressionError
from kineverse.model.model import Model, Snapshot
from kineverse.symbols import Symbol

from .listeners import Commit, CommitFilter

_LOG = logging.getLogger(__name__)

Built = TypeVar("Built")


def follow(
    model: Model,
    build: Callable[[Snapshot], Built],
    *,
    frames: Iterable[str] | None = None,
    symbols: Iterable[Symbol] | None = None,
    paths: Iterable[str] | None = None,
) -> Follower[Built]:
    """Build a value from a model now, and anew in the background when what it reads has changed.

    For what is made once and used in a loop: a compiled function, a controller, a tracker, a scene. The value
    is exchanged whole, when the new one is complete. Commits during a build lead to one more, of the newest
    version.

    Parameters
    ----------
    model
        Model to follow.
    build
        Function of a snapshot that returns the value. It is called in this thread first, then in one of its
        own. It must not change what earlier calls returned, which may be in use.
    frames, symbols, paths
        What the value reads, as for :meth:`.Model.listen`: frames by their forward kinematics, symbols by
        their constraints and rates, paths by their values. Without any, each commit counts.

    Returns
    -------
    Follower
        The value with its version. It follows the model until it is closed.

    Raises
    ------
    Exception
        Whatever the first build raises. Errors of later ones are in :attr:`Follower.error`.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> build = lambda snapshot: kv.compile(snapshot.fk("kitchen/fridge_door_handle"), tier="interpreter")
    >>> follower = kv.follow(model, build, frames=["kitchen/fridge_door_handle"])
    >>> follower.value([0.5])[:3, 3].round(3)
    array([ 0.842, -1.403,  1.184])
    >>> follower.version
    1
    >>> follower.close()
    """
    if not isinstance(model, Model):
        raise ExpressionError(f"A kv.Model can be followed, and a {type(model).__name__} does not change.")
    if not callable(build):
        raise ExpressionError(
            f"A value is built by a function of a snapshot, and {build!r} cannot be called."
        )
    return Follower(model, build, CommitFilter.of(paths, symbols, None, frames))


class BuiltValue(NamedTuple, Generic[Built]):
    """Value with the version of the model that it was built from.

    See Also
    --------
    kineverse.follow
    """

    value: Built
    version: int


class Follower(Closing, Generic[Built]):
    """Value that follows a model, from :func:`kineverse.follow`; :meth:`close` ends that.

    Attributes
    ----------
    current
        The value and the version of the model that it was built from, together.
    error
        Exception of the last build, if it failed; the value is then that of the last one that did not.

    See Also
    --------
    kineverse.follow
    """

    current: BuiltValue[Built]
    error: BaseException | None

    def __init__(self, model: Model, build: Callable[[Snapshot], Built], wanted: CommitFilter) -> None:
        self._model = model
        self._build = build
        self._filter = wanted
        self._changed = threading.Condition()
        self._is_closed = False
        self._is_building = True
        self.error = None
        with model._lock:
            if model._edit is not None:
                raise EditError("A model is followed from a commit on: call follow() after the edit.")
            snapshot = model.snapshot()
            self._heard = self._relevant = self._tried = snapshot.version
            model._listeners.witnesses.append(self._hear)
        try:
            self.current = BuiltValue(build(snapshot), snapshot.version)
        except BaseException:
            self.close()
            raise
        with self._changed:
            self._is_building = False
            self._start()

    @property
    def value(self) -> Built:
        """The value of the last build that succeeded."""
        return self.current.value

    @property
    def version(self) -> int:
        """Version of the model that the value was built from; it holds until what it reads changes."""
        return self.current.version

    def wait(self, version: int | None = None, timeout: float | None = None) -> bool:
        """Wait until the value holds for a version, by default the present one; not inside an edit.

        Parameters
        ----------
        version
            Version of the model, which may be one to come.
        timeout
            Longest time to wait [s].

        Returns
        -------
        bool
            False if the time is over, the follower is closed, or the build for that version has failed.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> follower = kv.follow(model, lambda snapshot: len(snapshot.frames))
        >>> with model.edit() as edit:
        ...     edit.add_frame("lamp", parent="world")
        'frame lamp'
        >>> follower.wait(timeout=60)
        True
        >>> follower.value
        55
        >>> follower.close()
        """
        wanted = self._model.version if version is None else as_count("version", version, 0)
        limit = None if timeout is None else as_tolerance(timeout, "A timeout")

        def is_done() -> bool:
            return self._is_closed or (self._heard >= wanted and self._tried >= min(self._relevant, wanted))

        with self._changed:
            return self._changed.wait_for(is_done, limit) and not self._is_closed and self.error is None

    def close(self) -> None:
        """End the following; the value stays. A second call has no effect."""
        with suppress(ValueError):
            self._model._listeners.witnesses.remove(self._hear)
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _hear(self, commit: Commit) -> None:
        is_relevant = self._filter.select(commit) is not None
        with self._changed:
            self._heard = commit.diff.version
            if is_relevant:
                self._relevant = self._heard
                self._start()
            self._changed.notify_all()

    def _start(self) -> None:
        if self._tried < self._relevant and not (self._is_building or self._is_closed):
            self._is_building = True
            # A daemon, which ends with the process, and with the last build: none waits for commits.
            try:
                threading.Thread(target=self._work, name="kineverse-follow", daemon=True).start()
            except RuntimeError as error:  # too many threads, or the program ends; the commit stands
                _LOG.exception("A value that follows a model could not be built: no thread starts.")
                self._is_building, self._tried, self.error = False, self._relevant, error

    def _work(self) -> None:
        while True:
            built, error = self.current, None
            snapshot = self._model.snapshot()
            try:
                built = BuiltValue(self._build(snapshot), snapshot.version)
            except BaseException as problem:  # SystemExit too, as somebody may wait for the value
                _LOG.exception(
                    "A value that follows a model could not be built at version %d.", snapshot.version
                )
                error = problem
            with self._changed:
                if not self._is_closed:
                    self.current, self.error = built, error
                self._tried = snapshot.version
                self._changed.notify_all()
                if self._is_closed or self._tried >= self._relevant:
                    self._is_building = False
                    return
