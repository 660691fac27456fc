"""Transactions on a model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from kineverse._checks import check_flag
from kineverse._runtime import no_collection
from kineverse._synonyms import EDIT_SYNONYMS
from kineverse.errors import DuplicateNameError, EditError, unknown_attribute_error
from kineverse.expressions.expression import ExpressionLike
from kineverse.symbols import Symbol

from . import registry
from .basic_operations import AddFrame, Attach, Constrain, Override, SetData, SetRate
from .body import Body, Pose
from .changes import Change, Diff, find_moved_tags
from .constraint import Constraint
from .frame import WORLD, Frame, TransformLike
from .history import History, HistoryEntry
from .operation import Operation
from .rates import as_row
from .registry import LoopTreatment

if TYPE_CHECKING:
    from .model_view import ModelView


class Edit:
    """Transaction on a model, opened by :meth:`.Model.edit` in a ``with`` block.

    The end of the block commits the edit. An exception in it restores the model. In the block, the model
    shows the edit so far; other threads wait.
    """

    def __init__(self, history: History, model: ModelView) -> None:
        self._history = history
        self._model = model
        self._open = True
        self._added: dict[str, None] = {}
        self._removed: dict[str, None] = {}
        self._replaced: dict[str, None] = {}
        self._again: dict[str, None] = {}
        self._order: list[HistoryEntry] = []

    if not TYPE_CHECKING:  # type checkers report unknown names themselves

        def __getattr__(self, name):
            raise unknown_attribute_error("An edit", name, dir(self), EDIT_SYNONYMS)

    # -- operations ----------------------------------------------------------------------------------------

    def apply(self, operation: Operation, tag: str | None = None, *, override: bool = False) -> str:
        """Append an operation, and return its tag.

        Parameters
        ----------
        operation, tag
            Operation and its tag; by default its ``default_tag()``.
        override
            True if it may overwrite frames, bodies, articulations and rates of earlier operations.

        Raises
        ------
        DuplicateNameError
            If the tag exists, or an earlier operation wrote the same name. Data may be overwritten. An
            operation that has read the old value, such as :class:`Attach`, may overwrite it as well.
        EditError
            If the operation raises an error that is not of this package. Errors of this package pass.
        """
        check_flag("override", override)
        if override and isinstance(operation, Operation):
            operation = Override(operation)
        chosen = self._tag(operation, tag)
        self._check_open().append(chosen, operation)
        return self._note_added(chosen)

    def link(self, entry: HistoryEntry) -> str:
        """Append an operation of a document and return its tag; it is not run where it finds what it read.

        Raises
        ------
        DuplicateNameError, UnknownNameError, ModelError
            As :meth:`apply`.
        """
        self._check_open().append_entry(entry)
        return self._note_added(entry.tag)

    def insert(
        self,
        operation: Operation,
        tag: str | None = None,
        *,
        before: str | None = None,
        after: str | None = None,
        to_affect: str | None = None,
    ) -> str:
        """Insert an operation before or after another one, and return its tag.

        Parameters
        ----------
        operation, tag
            Operation and its tag; by default its ``default_tag()``.
        before, after
            Tag of the neighbour.
        to_affect
            Tag of an operation, or name of a frame, which stands for its last writer. The new operation is
            inserted directly before it, so that it reads the new values (2022 paper, III-A3).
        """
        if sum(x is not None for x in (before, after, to_affect)) != 1:
            raise EditError("Say where to insert: exactly one of before=, after= and to_affect=.")
        history = self._check_open()
        if to_affect is not None:
            before = to_affect
            writers = history.cells.get(("frames", to_affect))
            if to_affect not in history.entries and writers:
                before = writers[-1].tag
        index = history.index(before) if before is not None else history.index(str(after)) + 1
        chosen = self._tag(operation, tag)
        history.insert(chosen, operation, index)
        return self._note_added(chosen)

    def replace(self, tag: str, operation: Operation) -> None:
        """Replace an operation under its tag; operations that depend on it are applied again."""
        self._check_open().replace(tag, operation)
        if tag not in self._added:
            self._replaced[tag] = None

    def remove(self, tag: str) -> None:
        """Remove an operation, with its constraints and all its other writes."""
        history = self._check_open()
        before = [] if self._order else list(history.sequence)
        history.remove(tag)
        self._order = self._order or before
        self._replaced.pop(tag, None)
        self._again.pop(tag, None)
        if tag in self._added:
            del self._added[tag]
        else:
            self._removed[tag] = None

    # -- shorthands ----------------------------------------------------------------------------------------

    def add_frame(
        self,
        name: str,
        parent: str,
        transform: TransformLike | Sequence[TransformLike] = Pose(),
        body: Body | None = None,
        tag: str | None = None,
        *,
        override: bool = False,
    ) -> str:
        """Add a frame at a 4×4 transform parent_T_frame, or at the product of several.

        The default is the identity. The name of an existing frame is refused unless ``override`` is given;
        :meth:`attach` moves an existing frame.
        """
        return self.apply(
            AddFrame(name, Frame.from_transform(parent, transform), body), tag, override=override
        )

    def constrain(
        self,
        name: str,
        lower: ExpressionLike,
        expression: ExpressionLike,
        upper: ExpressionLike,
        tag: str | None = None,
    ) -> str:
        """Add a constraint ``lower <= expression <= upper``; bounds may be expressions or ±inf."""
        return self.apply(Constrain(name, Constraint.from_expressions(lower, expression, upper)), tag)

    def close_loop(
        self,
        frame: str,
        to: str = WORLD,
        mask: tuple[str, ...] = ("x", "y", "z"),
        name: str | None = None,
        tag: str | None = None,
        **options: Any,
    ) -> str:
        """Close a loop between two frames; see :class:`kineverse.CloseLoop` for the options."""
        name = name or f"{frame} to {to}"
        loop = registry.make_shorthand("close_loop", name=name, frame=frame, to=to, mask=mask, **options)
        return self.apply(loop, tag)

    def set_rate(
        self,
        coordinate: Symbol,
        row: Mapping[Symbol, ExpressionLike],
        tag: str | None = None,
        *,
        override: bool = False,
    ) -> str:
        """Set the rate of a coordinate to ``Σ expression·speed`` over a row.

        A second rate of one coordinate is refused unless ``override`` is given.
        """
        return self.apply(SetRate(coordinate, as_row(coordinate, row)), tag, override=override)

    def attach(
        self,
        frame: str,
        parent: str,
        transform: TransformLike | Sequence[TransformLike],
        tag: str | None = None,
    ) -> str:
        """Attach a frame, with all frames below it, to another parent, as when a gripper grasps an object."""
        return self.apply(Attach(frame, Frame.from_transform(parent, transform)), tag)

    def write(self, name: str, value: Any, tag: str | None = None) -> str:
        """Store an immutable value under ``data``, in place of an earlier one of that name."""
        return self.apply(SetData(name, value), tag)

    def include(
        self,
        source: Any,
        prefix: str | None = None,
        *,
        root: Any = None,
        strict: bool = False,
        loops: LoopTreatment = "solve",
    ) -> list[str]:
        """Append the operations of a file or shipped model, see :func:`kineverse.load`; return their tags."""
        with no_collection():
            try:
                return registry.include_source(self, source, prefix, root=root, strict=strict, loops=loops)
            except DuplicateNameError as error:
                raise DuplicateNameError(
                    f"{error} include(source, prefix=...) puts a prefix in front of all names."
                ) from None

    @property
    def model(self) -> ModelView:
        """The edited model, which shows the edit so far."""
        return self._model

    # -- inside --------------------------------------------------------------------------------------------

    def _tag(self, operation: Operation, tag: str | None) -> str:
        if tag is not None:
            return tag
        if not isinstance(operation, Operation):
            raise EditError(
                f"{operation!r} is not an operation; subclass kv.Operation as a frozen dataclass."
            )
        return operation.default_tag()

    def _diff(self, version: int, changes: Iterable[Change], reruns: int) -> Diff:
        moved: tuple[str, ...] = ()
        if self._again:
            old = [entry.tag for entry in self._order if entry.tag not in self._added]
            moved = find_moved_tags(old, [entry.tag for entry in self._history.sequence], self._again)
        exchanged = self._added.keys() | self._replaced.keys()
        entries = self._history.entries
        rerun = [entries[tag] for tag in self._history.run_again - exchanged if tag in entries]
        return Diff(
            version,
            tuple(changes),
            tuple(self._added),
            tuple(self._removed),
            tuple(self._replaced),
            reruns,
            moved,
            tuple(entry.tag for entry in sorted(rerun, key=lambda entry: entry.place)),
        )

    def _check_open(self) -> History:
        if not self._open:
            raise EditError("This edit is over; start another one with model.edit().")
        return self._history

    def _note_added(self, tag: str) -> str:
        if tag in self._removed:
            del self._removed[tag]
            self._replaced[tag] = self._again[tag] = None
        else:
            self._added[tag] = None
        return tag
