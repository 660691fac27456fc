"""Articulation models A = (D, C) that can be edited while they are used (2022 paper, III-A)."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any

from kineverse._checks import check_flag
from kineverse._runtime import no_collection
from kineverse.errors import EditError, ExpressionError, KineverseError, UnknownAttributeError
from kineverse.symbols import Symbol

from .changes import Change, Diff
from .commits.listeners import Commit, CommitFilter, Listener, Listeners
from .commits.net_changes import NetChanges, adopt, group_tags
from .commits.undo import keep_commit
from .edit import Edit
from .history import History, HistoryEntry
from .model_view import ModelView
from .read_recorder import ABSENT
from .registry import LoopTreatment, SourceFile


class EditContext(AbstractContextManager["Edit"]):
    """Context manager of :meth:`Model.edit`; each ``with`` block opens a new edit."""

    def __init__(self, begin: Callable[[], AbstractContextManager[Edit]]) -> None:
        self._begin = begin

    def __enter__(self) -> Edit:
        transaction = self._begin()
        edit = transaction.__enter__()
        self._transaction = transaction  # after it is open, because a nested edit is refused
        return edit

    def __exit__(self, *raised: Any) -> bool | None:
        return self._transaction.__exit__(*raised)

    if not TYPE_CHECKING:  # type checkers report unknown names themselves

        def __getattr__(self, name: str) -> Any:
            raise UnknownAttributeError(
                f"model.edit() has to be opened before .{name}: write `with model.edit() as edit:`, and in "
                f"the block edit.{name if hasattr(Edit, name) else 'add_frame'}(...)."
            )


class Model(ModelView):
    """Articulation model: named data and constraints, the fold of a sequence of operations.

    A model contains no state; values are passed to its queries. It is changed in transactions::

        with model.edit() as edit:
            edit.add_frame("door", parent="world", transform=kv.rotation_z(kv.position("door")))
            edit.constrain("door/range", 0, kv.position("door"), 1.5)

    One thread edits at a time, and readers in other threads wait for it; a :meth:`snapshot` never changes.

    Examples
    --------
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.add_frame("door", parent="world", transform=kv.rotation_z(kv.position("door")))
    ...     edit.add_frame("handle", parent="door", transform=kv.translation(0.4, 0, 0))
    ...     edit.constrain("door/range", 0, kv.position("door"), 1.5)
    'frame door'
    'frame handle'
    'constraint door/range'
    >>> model
    <Model: 2 frames, 1 DoF, 1 constraint (version 1)>
    >>> model.fk("handle")({"door": 0.5})[:3, 3].round(3)
    array([0.351, 0.192, 0.   ])
    >>> model.violations({"door": 2})
    1 violated
      door/range: 0 <= 2 <= 1.5 is off by 0.5
    """

    def __init__(
        self,
        _entries: Iterable[HistoryEntry] | History = (),
        _version: int = 0,
        _sources: tuple[SourceFile, ...] = (),
    ) -> None:
        if isinstance(_entries, str | os.PathLike):
            raise ExpressionError(
                f"A model begins empty, with kv.Model(). To load one: kv.load({os.fspath(_entries)!r})."
            )
        if not isinstance(_entries, History):
            if not isinstance(_entries, list | tuple) or not all(
                isinstance(one, HistoryEntry) for one in _entries
            ):
                raise ExpressionError(
                    "A model begins empty, with kv.Model(), and is not made from a "
                    f"{type(_entries).__name__}. To load one: kv.load(path)."
                )
            _entries = History(_entries)
            if _version == 1:  # all of it comes from one commit
                _entries.commits[1] = {entry.tag: (None, entry) for entry in _entries.sequence}
        self._history = _entries
        self._sources = _sources
        self._edit: Edit | None = None
        self._listeners = Listeners()
        super().__init__(self._history.head, _version)

    @property
    def history(self) -> History:
        """Operations: ``tags``, ``entry(tag)``, ``writers(path)``, ``readers(path)``, ``runs``."""
        return self._history

    # -- editing -------------------------------------------------------------------------------------------

    def edit(self, *, strict: bool = False) -> AbstractContextManager[Edit]:
        """Open a transaction, committed as a whole at the end of its ``with`` block.

        Parameters
        ----------
        strict
            True to refuse the edit of a live model if anything in it has changed since the edit began. It has
            no effect here, where nobody else edits meanwhile.

        Raises
        ------
        EditError
            At the end of the block, if operations fail after the edit. The message lists the first ones, and
            the attribute ``failures`` has all.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     edit.add_frame("lamp", parent="world", transform=kv.translation(0, 0, 2))
        ...     edit.add_frame("bulb", parent="lmap")
        Traceback (most recent call last):
            ...
        kineverse.errors.UnknownNameError: The parent of frame 'bulb' is missing. There is no frame ...
        >>> "lamp" in model.frames
        False
        """
        check_flag("strict", strict)
        return EditContext(lambda: self._transaction(lambda _: self._commit()))

    @contextmanager
    def _transaction(self, finish: Callable[[Edit], None]) -> Iterator[Edit]:
        """Open an edit, and call ``finish`` with it at its end; what that does not commit is rolled back.

        Other threads wait until it is over. What was posted to listeners is delivered after that.
        """
        with self._lock:
            if self._edit is not None:
                raise EditError("The model is being edited already; use that edit.")
            self._history.begin()
            self._edit = edit = Edit(self._history, self)
            try:
                yield edit
                finish(edit)
            finally:
                self._history.roll_back()  # nothing is left of a commit to be undone
                edit._open = False
                self._edit = None
                self._settle()
        self._deliver()

    def _deliver(self) -> None:
        """Call the listeners with what was posted to them; called by the thread that committed."""
        self._listeners.deliver()

    def _settle(self) -> None:
        if self._edit is not None:
            self._history.settle()
        events = self._history.take_events()
        if events:
            self._invalidate(events)

    def _writers(self, path: str) -> list[str]:
        return self._history.writers(path)

    def _ordered(self, kind: str) -> dict[str, Any]:
        return self._history.ordered(kind)

    def _commit(self, version: int | None = None) -> None:
        """Commit the open edit as the next version, unless it has changed nothing; or as a given version."""
        history = self._history
        history.settle()
        self.rates  # noqa: B018 - cyclic rates are an error of the edit, not of a later query
        touched = list(history.touched())
        if version is None:
            if not touched:
                return
            version = self._version + 1
        changes = [
            Change(kind, name, None if before is ABSENT else before, None if after is ABSENT else after)
            for (kind, name), before, after in history.changes()
        ]
        reruns = history.runs - history.runs_before
        diff = Diff(version, tuple(changes), reruns=reruns, **group_tags(history, touched))
        keep_commit(history, version, touched)
        history.begin()
        self._version = version
        self._derived = {}
        self._listeners.post(Commit(diff, history.head))

    def adopt(self, changes: NetChanges) -> None:
        """Make the net changes of an edit of an equal model, in one commit, without running an operation.

        A copy that adopts the changes of each edit in order keeps equal values, order and history. Listeners
        get one diff, as after the edit itself.

        Parameters
        ----------
        changes
            Result of :meth:`.Edit.net`.

        Raises
        ------
        EditError
            If the changes do not belong to this model: a tag is taken, an anchor or a parent is missing,
            frames or rates are cyclic, or another operation reads what they change. The model is unchanged.

        Examples
        --------
        >>> original = kv.load("kitchen")
        >>> twin = original.copy()
        >>> with original.edit() as edit:
        ...     edit.write("owner", "Ada")
        ...     changes = edit.net()
        'data owner'
        >>> twin.adopt(changes)
        >>> twin.data["owner"], twin.snapshot() == original.snapshot()
        ('Ada', True)
        """
        self._adopt(changes)

    def _adopt(self, changes: NetChanges, version: int | None = None) -> None:
        """Make net changes in one commit, here and nowhere else, as the next or as a given version."""
        try:
            with self._transaction(lambda _: self._commit(version)) as edit:
                adopt(edit._check_open(), changes, complete=True)
        except EditError:
            raise
        except KineverseError as error:
            raise EditError(f"The changes cannot be adopted: {error}") from error

    def _restore(self, entries: Iterable[HistoryEntry], version: int) -> None:
        """Fill an empty model with entries of a document, checked, as of a version; that cannot be undone."""
        with no_collection(), self._transaction(lambda _: self._commit(version)) as edit:
            for entry in entries:
                edit.link(entry)
        self._history.commits.clear()

    def include(
        self,
        source: Any,
        prefix: str | None = None,
        *,
        root: Any = None,
        strict: bool = False,
        loops: LoopTreatment = "solve",
    ) -> list[str]:
        """Include a file or a shipped model in one edit, and return the tags; see :func:`kineverse.load`.

        Examples
        --------
        >>> home = kv.Model()
        >>> tags = home.include("kitchen")
        >>> tags = home.include("pr2", prefix="robot")
        >>> home
        <Model: 92 frames, 45 DoF, 90 constraints (version 2)>
        """
        with self.edit() as edit:
            return edit.include(source, prefix, root=root, strict=strict, loops=loops)

    def listen(
        self,
        callback: Callable[[Diff], None],
        *,
        paths: Iterable[str] | None = None,
        symbols: Iterable[Symbol] | None = None,
        tags: Iterable[str] | None = None,
        frames: Iterable[str] | None = None,
    ) -> Listener:
        """Register a callback for commits; it gets the part of each diff that passes the filter.

        Parameters
        ----------
        callback
            Function of a diff, called once per commit after the edit, in the order of versions. It may edit
            the model; its own commit is delivered after the present one. Exceptions are logged.
        paths
            Paths such as ``frames/kitchen``, for all values at or below them.
        symbols
            Symbols, for constraints with their coordinates in expression, bounds or gradient, and for rates
            of them, with them, or behind them. A dependent coordinate stands for those that determine it.
        tags
            Tags of operations that are added, removed, replaced, moved or run again.
        frames
            Frames, or patterns such as ``kitchen/*``, whose forward kinematics are followed: their own frames
            and rates, and those of all frames above them. The diff names those that moved in ``poses``.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> listener = model.listen(lambda diff: print(diff.poses), frames=["kitchen/fridge_door_handle"])
        >>> with model.edit() as edit:
        ...     tag = edit.write("owner", "Ada")  # of no interest to the listener
        >>> with model.edit() as edit:
        ...     edit.attach("kitchen/fridge_door_handle", parent="world", transform=kv.translation(1, 0, 1))
        'attach kitchen/fridge_door_handle to world'
        ('kitchen/fridge_door_handle',)
        >>> listener.close()
        """
        return self._listeners.add(callback, CommitFilter.of(paths, symbols, tags, frames))

    # -- copies --------------------------------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """Return an immutable snapshot of the model, which can be stored, compared and pickled.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> before = model.snapshot()
        >>> with model.edit() as edit:
        ...     edit.remove(model.history.tags[-1])
        >>> before.version, model.version, before == model.snapshot()
        (1, 2, False)
        """
        with self._lock, no_collection():
            self._settle()
            head = {kind: dict(self._history.ordered(kind)) for kind in self._history.head}
            return Snapshot(head, tuple(self._history.sequence), self._version, self._sources)

    def copy(self) -> Model:
        """Return an independent model with the same operations, without applying them again.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> other = model.copy()
        >>> with other.edit() as edit:
        ...     tag = edit.add_frame("lamp", parent="world")
        >>> "lamp" in other.frames, "lamp" in model.frames
        (True, False)
        """
        # No object made here is garbage, so the collector would only cost time.
        with self._lock, no_collection():
            self._settle()
            return Model(self._history.copy(), self._version, self._sources)

    __copy__ = copy

    def __deepcopy__(self, memo: Any) -> Model:
        return self.copy()

    def __reduce__(self) -> Any:
        return Snapshot.model, (self.snapshot(),)


class Snapshot(ModelView):
    """Immutable model at one version, with all queries. Snapshots are equal if all values are equal.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> snapshot = model.snapshot()
    >>> with model.edit() as edit:
    ...     edit.write("owner", "Ada")
    'data owner'
    >>> snapshot.version, "owner" in snapshot.data
    (1, False)
    >>> snapshot.model()
    <Model: 54 frames, 23 DoF, 46 constraints (version 1)>
    """

    def __init__(
        self,
        head: dict[str, dict[str, Any]],
        entries: tuple[HistoryEntry, ...],
        version: int,
        sources: tuple[SourceFile, ...] = (),
    ) -> None:
        self._entries = entries
        self._sources = sources
        super().__init__(head, version)

    @property
    def entries(self) -> tuple[HistoryEntry, ...]:
        """Operations in order, each with its tag, its reads and its writes."""
        return self._entries

    def model(self) -> Model:
        """Return a new model with the content of the snapshot."""
        return Model(self._entries, self._version, self._sources)

    @property
    def tags(self) -> list[str]:
        """Tags of the operations, in order."""
        return [e.tag for e in self._entries]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Snapshot):
            return NotImplemented
        return self.tags == other.tags and self._head == other._head

    def __hash__(self) -> int:
        return hash(tuple(self.tags))

    def __reduce__(self) -> Any:
        return Snapshot, (self._head, self._entries, self._version, self._sources)
