"""Operations, their writes, and the rules of overwriting.

An operation is a frozen value. Its ``apply`` reads the model at the operation's place in the sequence and
returns :class:`Writes`. The reads are recorded, so the operation is applied again if and only if they change.
"""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from kineverse.errors import DuplicateNameError, ExpressionError, InvalidValueError, suggest
from kineverse.expressions.expression import Expression, ExpressionLike
from kineverse.symbols import Symbol

from .articulation import Articulation, check_home
from .body import Body, Pose
from .constraint import Constraint, ConstraintLike, as_constraint
from .frame import Frame, TransformLike
from .rates import as_entry, to_plain

if TYPE_CHECKING:
    from .history import HistoryEntry
    from .read_recorder import ReadRecorder, SeenValues

KINDS = ("frames", "bodies", "articulations", "constraints", "rates", "data")
FRAMES, BODIES, ARTICULATIONS, CONSTRAINTS, RATES, DATA = KINDS


class _Signature:
    """Signature of an operation: that of ``__init__``, as ``__new__`` takes anything."""

    def __get__(self, operation: object, owner: type) -> inspect.Signature:
        found = inspect.signature(owner.__init__)  # type: ignore[misc]
        _, *parameters = found.parameters.values()
        return found.replace(parameters=parameters, return_annotation=inspect.Signature.empty)


@dataclass(frozen=True)
class Writes:
    """Values that an operation writes, by name.

    Attributes
    ----------
    frames
        :class:`Frame` values, or pairs (parent, transform) for :meth:`Frame.from_transform`.
    constraints
        :class:`Constraint` values or triples (lower, expression, upper). They are removed with the operation.
    rates
        Rows ``{speed: expression}`` by coordinate; for a dependent coordinate, its expression. See
        :mod:`kineverse.model.rates`.
    bodies, articulations
        Bodies by frame, and records for people and exporters.
    data
        Other immutable values that can be compared.

    See Also
    --------
    kineverse.Operation
    """

    frames: Mapping[str, Frame | tuple[str, TransformLike | Sequence[TransformLike]]] = field(
        default_factory=dict
    )
    constraints: Mapping[str, ConstraintLike] = field(default_factory=dict)
    rates: Mapping[Symbol, Mapping[Symbol, ExpressionLike] | ExpressionLike] = field(default_factory=dict)
    bodies: Mapping[str, Body] = field(default_factory=dict)
    articulations: Mapping[str, Articulation] = field(default_factory=dict)
    data: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_cells(writes: Mapping[tuple[str, str], Any]) -> Writes:
        """Build writes from values by kind and name."""
        kinds: dict[str, dict[Any, Any]] = {kind: {} for kind in KINDS}
        for (kind, name), value in writes.items():
            if kind == RATES:
                coordinate, entry = value
                kinds[kind][coordinate] = entry if isinstance(entry, Expression) else dict(entry)
            elif kind == FRAMES:
                kinds[kind][name] = (value.parent, value.factors)
            else:
                kinds[kind][name] = value
        return Writes(**kinds)

    def writes(self) -> dict[tuple[str, str], Any]:
        """Return all values in canonical form and plain coordinates, in the order of KINDS, then of names."""
        result: dict[tuple[str, str], Any] = {}
        for name, frame in self.frames.items():
            value = _as_frame(name, frame)
            if any(isinstance(f, Expression) and f.nodes for f in value.factors):
                value = map_expressions(FRAMES, value, to_plain)
            result[FRAMES, name] = value
        records: dict[str, Mapping[str, Any]] = {BODIES: self.bodies, ARTICULATIONS: self.articulations}
        for kind, values in records.items():
            for name, record in values.items():
                _check_value(kind, name, record)
                if isinstance(record, Articulation) and record.follows is not None and record.follows.nodes:
                    record = replace(record, follows=to_plain(record.follows))
                result[kind, name] = record
        for name, triple in self.constraints.items():
            c = as_constraint(triple)
            if c.lower.nodes or c.expression.nodes or c.upper.nodes:
                c = map_expressions(CONSTRAINTS, c, to_plain)
            result[CONSTRAINTS, name] = c
        for coordinate, row in self.rates.items():
            result[RATES, str(coordinate)] = (coordinate, as_entry(coordinate, row))
        for name, datum in self.data.items():
            _check_value(DATA, name, datum)
            result[DATA, name] = datum
        return result


class FinishedWrites(Writes):
    """Writes of an earlier run, which are canonical already."""

    def __init__(self, writes: Mapping[tuple[str, str], Any]) -> None:
        object.__setattr__(self, "_finished", writes)

    def writes(self) -> dict[tuple[str, str], Any]:
        """Return all values by kind and name."""
        finished: dict[tuple[str, str], Any] = vars(self)["_finished"]
        return finished


def _as_frame(name: str, frame: Frame | tuple[str, TransformLike | Sequence[TransformLike]]) -> Frame:
    if not isinstance(frame, Frame):
        if not isinstance(frame, (tuple, list)) or len(frame) != 2:
            raise InvalidValueError(
                f"Frame {name!r} is written as a pair (parent, transform), not as {frame!r}."
            )
        frame = Frame.from_transform(*frame)
    if not isinstance(frame.parent, str):
        raise InvalidValueError(
            f"The parent of frame {name!r} is given by its name, not by {frame.parent!r}."
        )
    for f in frame.factors:
        if not isinstance(f, Pose) and not (isinstance(f, Expression) and f.shape == (4, 4)):
            return Frame.from_transform(frame.parent, frame.factors)
    return frame


_TYPES = {BODIES: Body, ARTICULATIONS: Articulation}


def _check_value(kind: str, name: str, value: object) -> None:
    if kind in _TYPES and not isinstance(value, _TYPES[kind]):
        raise InvalidValueError(f"{kind}/{name} is a kv.model.{_TYPES[kind].__name__}, not {value!r}.")
    if isinstance(value, Articulation):
        check_home(name, value)
    try:
        hash(value)
    except TypeError:
        raise InvalidValueError(
            f"{kind}/{name} can be changed from outside, as it is or contains a list, a dict or an array; "
            "write tuples, frozen dataclasses or expressions instead."
        ) from None


class Operation(ABC):
    """Step in building a model; subclass it as a frozen dataclass.

    A new type of articulation takes ten lines::

        @dataclass(frozen=True)
        class Slide(kv.Operation):
            name: str
            parent: str

            def apply(self, model):
                q = kv.position(self.name)
                return kv.model.Writes(
                    frames={self.name: (self.parent, kv.translation(q, 0, 0))},
                    constraints={f"{self.name}/range": (0, q, 1)},
                )

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Slide(kv.Operation):
    ...     name: str
    ...     parent: str
    ...
    ...     def apply(self, model):
    ...         q = kv.position(self.name)
    ...         return kv.model.Writes(
    ...             frames={self.name: (self.parent, kv.translation(q, 0, 0))},
    ...             constraints={f"{self.name}/range": (0, q, 1)},
    ...         )
    >>> model = kv.Model()
    >>> with model.edit() as edit:
    ...     edit.apply(Slide("drawer", "world"))
    'slide drawer'
    >>> model.fk("drawer")({"drawer": 0.3})[:3, 3]
    array([0.3, 0. , 0. ])
    """

    traceable: ClassVar[bool] = True
    """True if the writes may be expressions of the reads; False skips the attempt to trace them."""

    overrides: ClassVar[bool] = False
    """True if the operation may overwrite frames, bodies, articulations and rates that it has not read."""

    recorded: ClassVar[Mapping[tuple[str, str], Any]] = MappingProxyType({})
    """Writes of the operation in the document that it comes from; empty if it has its code."""

    document_kind: ClassVar[str]
    """Frozen name of the class in documents, in kinds of articulations and in tags."""

    _tag: ClassVar[str]

    __signature__ = _Signature()

    def __init_subclass__(cls, *, document_kind: str = "", tag: str = "", **keywords: Any) -> None:
        """Name a class in documents, frozen for those that ship, else its own name; and in default tags."""
        super().__init_subclass__(**keywords)
        cls.document_kind = document_kind or cls.__name__
        cls._tag = tag or split_words(cls.document_kind)

    if not TYPE_CHECKING:  # a type checker knows the keywords

        def __new__(cls, *args, **keywords):
            """Create an operation; an error for wrong arguments lists the right ones."""
            check_keywords(cls, args, keywords)
            return object.__new__(cls)

    @abstractmethod
    def apply(self, model: ReadRecorder) -> Writes:
        """Return the writes of the operation, given the model before it.

        The result must be a pure function of the fields and of the values read from ``model``.
        """

    def see(self, model: ReadRecorder) -> SeenValues | None:
        """Return what an operation of a document finds in a model; None if it has its code."""
        return None

    def rebuild(self) -> Operation | None:
        """Return the operation as a value of its class; None for one of a document without its class."""
        return self

    def below(self, prefix: str) -> Operation | None:
        """Return the operation with its names below a prefix that ends with a slash.

        Only the class knows which texts are names. None, the default, says that it does not.
        """
        return None

    def default_tag(self) -> str:
        """Return the default tag: the kind, and the name of the operation if it has one."""
        name = getattr(self, "name", "")
        return f"{self._tag} {name}" if name else self._tag


def split_words(kind: str) -> str:
    """Return a name like ``DoorWithHandle`` in words, ``door with handle``."""
    return "".join(f" {c.lower()}" if c.isupper() else c for c in kind).strip()


class Keywords(NamedTuple):
    """Keywords of a class: the required ones, and all."""

    required: frozenset[str]
    known: tuple[str, ...]


def check_keywords(made: type, arguments: tuple[Any, ...], given: dict[str, Any]) -> None:
    """Check the arguments of an operation that takes keywords only."""
    keywords = find_keywords(made)
    if keywords is None or not (arguments or given):
        return  # pickle passes no arguments; in other cases Python reports the missing ones
    if not arguments and keywords.required <= given.keys() and given.keys() <= set(keywords.known):
        return
    name = made.__name__
    required = [f"{key}=" for key in keywords.known if key in keywords.required]
    optional = [f"{key}=" for key in keywords.known if key not in keywords.required]
    takes = f"It takes {', '.join(required) or 'nothing that has to be given'}"
    takes += f" and, if wanted, {', '.join(optional)}." if optional else "."
    if arguments:
        raise ExpressionError(f"{name} is made with keywords, and {arguments[0]!r} has none. {takes}")
    for key in given:
        if key not in keywords.known:
            raise ExpressionError(
                f"{name} has no keyword {key!r}. {suggest(key, keywords.known, 'keyword')} {takes}"
            )
    missing = [key for key in required if key[:-1] not in given]
    raise ExpressionError(f"{name} is made without {', '.join(missing)}. {takes}")


@cache
def find_keywords(made: type) -> Keywords | None:
    """Return the keywords of a keyword-only dataclass; None for any other class."""
    maker = next(base for base in made.__mro__ if "__init__" in vars(base))
    parameters = vars(maker).get("__dataclass_params__")
    if parameters is None or not parameters.init:
        return None
    own = [field for field in fields(maker) if field.init]
    if not own or not all(field.kw_only for field in own):
        return None
    required = {f.name for f in own if f.default is MISSING and f.default_factory is MISSING}
    return Keywords(frozenset(required), tuple(field.name for field in own))


ExpressionMap = Callable[[Expression], Any]


def map_expressions(kind: str, value: Any, f: ExpressionMap) -> Any:
    """Apply a function to each expression of a written value; symbols of records stay."""
    if kind == FRAMES:
        return Frame(value.parent, tuple(f(x) if isinstance(x, Expression) else x for x in value.factors))
    if kind == CONSTRAINTS:
        return Constraint(f(value.lower), f(value.expression), f(value.upper))
    if kind == RATES:
        coordinate, entry = value
        if isinstance(entry, Expression):
            return coordinate, f(entry)
        return coordinate, tuple((speed, f(factor)) for speed, factor in entry)
    if kind == ARTICULATIONS:
        return replace(value, dynamics=_map_nested(value.dynamics, f), follows=_map_nested(value.follows, f))
    return _map_nested(value, f) if kind == DATA else value


def find_expressions(kind: str, value: Any) -> list[Expression]:
    """Return the expressions of a written value, without symbols of records."""
    result: list[Expression] = []

    def note(expression: Expression) -> Expression:
        result.append(expression)
        return expression

    map_expressions(kind, value, note)
    return result


def _map_nested(datum: Any, f: ExpressionMap) -> Any:
    if isinstance(datum, Expression):
        return f(datum)
    return tuple(_map_nested(item, f) for item in datum) if isinstance(datum, tuple) else datum


_NOUNS = {
    FRAMES: "a frame",
    BODIES: "a body of",
    ARTICULATIONS: "an articulation",
    CONSTRAINTS: "a constraint",
    RATES: "a rate of",
    DATA: "a datum",
}


def may_override(entry: HistoryEntry, cell: Cell) -> bool:
    """Return whether an operation may overwrite a cell: data, or a cell that it has read."""
    kind = cell[0]
    if kind == CONSTRAINTS:
        return False
    if kind == DATA or cell in entry.reads.cells or entry.operation.overrides:
        return True
    return entry.reads.seen is not None and entry.reads.seen.overrides


def overwrite_error(cell: Cell, entry: HistoryEntry, maker: str) -> DuplicateNameError:
    """Return the error for a name that an earlier operation has written."""
    kind, name = cell
    what = f"{_NOUNS[kind]} '{name}'"
    if kind == CONSTRAINTS:
        return DuplicateNameError(
            f"There is {what} already, made by {maker!r}; choose another name or replace that operation."
        )
    attach = "To put it into another parent, attach it; to" if kind == FRAMES else "To"
    return DuplicateNameError(
        f"There is {what} already, written by {maker!r}, and {entry.tag!r} would write over it. Choose "
        f"another name, or replace that operation. {attach} write over it on purpose, pass override=True to "
        "the method of the edit."
    )


Cell = tuple[str, str]
