"""Transactions on a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from .commits.net_changes import NetChanges, adopt, find_net_changes
from .commits.undo import take_back
from .constraint import Constraint
from .frame import WORLD, Frame, TransformLike
from .history import History, HistoryEntry, check_operation
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
        self._savepoints: list[Savepoint] = []

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
        self._check_open().insert(chosen, operation)
        return chosen

    def link(self, entry: HistoryEntry) -> str:
        """Append an operation of a document and return its tag; it is not run where it finds what it read.

        Raises
        ------
        DuplicateNameError, UnknownNameError, ModelError
            As :meth:`apply`.
        """
        self._check_open().link(entry)
        return entry.tag

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
        return chosen

    def replace(self, tag: str, operation: Operation) -> None:
        """Replace an operation under its tag; operations that depend on it are applied again."""
        self._check_open().replace(tag, operation)

    def remove(self, tag: str) -> None:
        """Remove an operation, with its constraints and all its other writes."""
        self._check_open().remove(tag)

    # -- the edit as a value -------------------------------------------------------------------------------

    def net(self) -> NetChanges:
        """Return the net changes of the edit so far: what :meth:`.Model.adopt` makes in an equal model.

        Raises
        ------
        EditError, ModelError
            If the edit would be refused at its end.
        """
        history = self._check_open()
        self._model.rates  # noqa: B018 - settles, and raises for cyclic rates
        return find_net_changes(history)

    def adopt(self, changes: NetChanges) -> None:
        """Link the entries of another edit's net changes as they are, without running their operations.

        Other operations that read what they change are run again, as after any edit. An entry that was at the
        end goes to the end.

        Raises
        ------
        EditError
            If a tag is taken or missing, or something is not of the right type. Names, parents and cycles are
            checked as in any edit.
        """
        adopt(self._check_open(), changes, complete=False)

    def undo(self, version: int) -> None:
        """Take back the commit that led to a version: what it has put, moved and removed.

        What came after it stands, and is run again where it reads what changes. An undo can be taken back as
        well. A model keeps its last ``kv.model.UNDO_LIMIT`` commits, and a copy of it keeps them too.

        Raises
        ------
        EditError
            If a later edit has changed an operation that this one would change, or the commit is not kept.
        InvalidValueError
            If the version is not an integer.
        """
        take_back(self._check_open(), version)

    def savepoint(self) -> Savepoint:
        """Return a point of the edit that it can be rolled back to, several times.

        An edit that was rolled back to its beginning has done nothing, and is no commit::

            with model.edit() as edit:
                start = edit.savepoint()
                edit.remove("joint door")
                changes = edit.net()
                start.roll_back()
        """
        return Savepoint(self)

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

    def record_source(self, source: registry.SourceFile) -> None:
        """Note that operations of the edit are from a file."""
        self._model._sources = (*self._model._sources, source)

    # -- inside --------------------------------------------------------------------------------------------

    def _tag(self, operation: Operation, tag: str | None) -> str:
        if tag is not None:
            return tag
        check_operation(operation)
        return operation.default_tag()

    def _check_open(self) -> History:
        if not self._open:
            raise EditError("This edit is over; start another one with model.edit().")
        return self._history


class Savepoint:
    """Point of an edit, from :meth:`Edit.savepoint`."""

    def __init__(self, edit: Edit) -> None:
        self._edit = edit
        self._mark = edit._check_open().mark()
        edit._savepoints.append(self)

    def roll_back(self) -> None:
        """Undo what the edit has done since this point; the edit goes on.

        Raises
        ------
        EditError
            If the edit is over, or was rolled back to an earlier point.
        """
        history, known = self._edit._check_open(), self._edit._savepoints
        if self not in known:
            raise EditError("This savepoint is gone, because the edit was rolled back to an earlier one.")
        del known[known.index(self) + 1 :]
        history.return_to(self._mark)
