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

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> with model.edit() as edit:
    ...     edit.add_frame("lamp", parent="kitchen/sink_area", transform=kv.translation(0, 0, 1))
    ...     edit.constrain("kitchen/ajar", 0, kv.position("kitchen/fridge_door"), 0.3)
    'frame lamp'
    'constraint kitchen/ajar'
    >>> model.limits("kitchen/fridge_door")
    (0.0, 0.3)
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

        Examples
        --------
        >>> model = kv.Model()
        >>> with model.edit() as edit:
        ...     edit.apply(kv.Prismatic(name="drawer", parent="world", child="drawer", lower=0, upper=0.4))
        ...     edit.apply(kv.model.SetData("owner", "Ada"), tag="whose it is")
        'joint drawer'
        'whose it is'
        >>> model.history.tags
        ['joint drawer', 'whose it is']
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

        See Also
        --------
        kineverse.formats.entries_from_bytes
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

        Examples
        --------
        >>> model = kv.Model()
        >>> with model.edit() as edit:
        ...     edit.write("height", 1.0)
        ...     edit.add_frame("lamp", parent="world")
        ...     edit.insert(kv.model.SetData("colour", "red"), before="frame lamp")
        'data height'
        'frame lamp'
        'data colour'
        >>> model.history.tags
        ['data height', 'data colour', 'frame lamp']
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
        """Replace an operation under its tag; operations that depend on it are applied again.

        Examples
        --------
        >>> model = kv.Model()
        >>> with model.edit() as edit:
        ...     edit.apply(kv.Prismatic(name="drawer", parent="world", child="drawer", lower=0, upper=0.4))
        ...     edit.add_frame("handle", parent="drawer", transform=kv.translation(0.1, 0, 0))
        'joint drawer'
        'frame handle'
        >>> hinge = kv.Revolute(name="door", parent="world", child="drawer", axis=(0, 0, 1))
        >>> with model.edit() as edit:
        ...     edit.replace("joint drawer", hinge)
        >>> model.symbols_of("handle")
        (door,)
        """
        self._check_open().replace(tag, operation)

    def remove(self, tag: str) -> None:
        """Remove an operation, with its constraints and all its other writes.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     tag = edit.constrain("ajar", 0, kv.position("kitchen/fridge_door"), 0.3)
        >>> with model.edit() as edit:
        ...     edit.remove(tag)
        >>> "ajar" in model.constraints
        False
        """
        self._check_open().remove(tag)

    # -- the edit as a value -------------------------------------------------------------------------------

    def net(self) -> NetChanges:
        """Return the net changes of the edit so far: what :meth:`.Model.adopt` makes in an equal model.

        Raises
        ------
        EditError, ModelError
            If the edit would be refused at its end.

        See Also
        --------
        kineverse.Model.adopt
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

        See Also
        --------
        kineverse.Model.adopt
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

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     edit.write("owner", "Ada")
        'data owner'
        >>> with model.edit() as edit:
        ...     edit.undo(model.version)
        >>> "owner" in model.data
        False
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

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     start = edit.savepoint()
        ...     edit.write("owner", "Ada")
        ...     start.roll_back()
        'data owner'
        >>> "owner" in model.data, model.version
        (False, 1)
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

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     edit.add_frame("magnet", "kitchen/fridge_door", kv.translation(0, -0.2, 0.3))
        'frame magnet'
        >>> model.symbols_of("magnet")
        (kitchen/fridge_door,)
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
        """Add a constraint ``lower <= expression <= upper``; bounds may be expressions or ±inf.

        Examples
        --------
        >>> left, right = kv.position("kitchen/fridge_door"), kv.position("kitchen/oven_door")
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     edit.constrain("one open at a time", -np.inf, left + right, 1.5)
        'constraint one open at a time'
        >>> model.violations({left: 1.0, right: 0.7})
        1 violated
          one open at a time: -inf <= 1.7 <= 1.5 is off by 0.2
        """
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
        """Close a loop between two frames; see :class:`kineverse.CloseLoop` for the options.

        Examples
        --------
        >>> model = kv.Model()
        >>> with model.edit() as edit:
        ...     for name, x, length in (("crank", 0.0, 0.4), ("rocker", 1.0, 0.9)):
        ...         at = kv.translation(x, 0, 0)
        ...         edit.apply(kv.Revolute(name=name, parent="world", child=name, axis=(0, 0, 1), origin=at))
        ...         edit.add_frame(f"{name}_end", name, kv.translation(length, 0, 0))
        ...     edit.apply(kv.Revolute(name="coupler", parent="crank_end", child="coupler", axis=(0, 0, 1)))
        ...     edit.add_frame("coupler_end", "coupler", kv.translation(1.1, 0, 0))
        ...     edit.close_loop("coupler_end", "rocker_end", home={"coupler": 1, "rocker": 1.5})
        'joint crank'
        'frame crank_end'
        'joint rocker'
        'frame rocker_end'
        'joint coupler'
        'frame coupler_end'
        'loop coupler_end to rocker_end'
        >>> model.degrees_of_freedom
        (crank,)
        >>> model.fk("coupler_end")({"crank": 0.5})[:2, 3].round(3)
        array([1.214, 0.874])
        """
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

        Examples
        --------
        >>> x, wheel = kv.position("cart/x"), kv.velocity("cart/wheel")
        >>> model = kv.Model()
        >>> with model.edit() as edit:
        ...     edit.add_frame("cart", parent="world", transform=kv.translation(x, 0, 0))
        ...     edit.set_rate(x, {wheel: 0.1})  # the radius of the wheel [m]
        'frame cart'
        'rate cart/x'
        >>> model.integrate({"cart/x": 0}, {wheel: 2.0}, dt=1.0)
        State({cart/x: 0.2})
        """
        return self.apply(SetRate(coordinate, as_row(coordinate, row)), tag, override=override)

    def attach(
        self,
        frame: str,
        parent: str,
        transform: TransformLike | Sequence[TransformLike],
        tag: str | None = None,
    ) -> str:
        """Attach a frame, with all frames below it, to another parent, as when a gripper grasps an object.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     edit.add_frame("cup", parent="world", transform=kv.translation(1, 0, 1))
        ...     edit.attach("cup", parent="kitchen/fridge_door", transform=kv.translation(0, 0, 0.2))
        'frame cup'
        'attach cup to kitchen/fridge_door'
        >>> model.frames["cup"].parent
        'kitchen/fridge_door'
        """
        return self.apply(Attach(frame, Frame.from_transform(parent, transform)), tag)

    def write(self, name: str, value: Any, tag: str | None = None) -> str:
        """Store an immutable value under ``data``, in place of an earlier one of that name.

        Examples
        --------
        >>> model = kv.load("kitchen")
        >>> with model.edit() as edit:
        ...     edit.write("kitchen/owner", "Ada")
        'data kitchen/owner'
        >>> model.data["kitchen/owner"]
        'Ada'
        """
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
        """Append the operations of a file or shipped model, see :func:`kineverse.load`; return their tags.

        Examples
        --------
        >>> model = kv.Model()
        >>> with model.edit() as edit:
        ...     tags = edit.include("kitchen")
        ...     edit.add_frame("lamp", parent="kitchen/sink_area")
        'frame lamp'
        >>> model
        <Model: 55 frames, 23 DoF, 46 constraints (version 1)>
        """
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
    """Point of an edit, from :meth:`Edit.savepoint`.

    See Also
    --------
    kineverse.model.Edit.savepoint
    """

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
