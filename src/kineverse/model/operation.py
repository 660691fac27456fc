"""Operations: the steps a model is made of (2022 paper, III-A3 and Eq. 10).

An operation is a frozen value. Its ``apply`` reads from the model as it is at the operation's place in the
sequence and returns its :class:`Effects`; what it read is recorded, so it is run again when, and only when,
that changes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

from kineverse.errors import ValueRejectedError
from kineverse.expressions.expression import Expression, ExpressionLike
from kineverse.symbols import Symbol

from .articulation import Articulation, check_home
from .body import Body, Pose
from .constraint import Constraint, ConstraintLike, as_constraint
from .frame import Frame, TransformLike
from .keywords import check_keywords
from .rates import as_entry, plain

if TYPE_CHECKING:
    from .reader import Reader

FRAMES, BODIES, ARTICULATIONS, CONSTRAINTS, RATES, DATA = KINDS = (
    "frames",
    "bodies",
    "articulations",
    "constraints",
    "rates",
    "data",
)


@dataclass(frozen=True)
class Effects:
    """What an operation writes, by name.

    Attributes
    ----------
    frames
        :class:`Frame` values, or pairs (parent, transform) with anything :meth:`Frame.of` takes.
    constraints
        :class:`Constraint` values or triples (lower, expression, upper). They live and die with the
        operation.
    rates
        From coordinates to rows ``{speed: expression}``, or to the expression that a coordinate is which
        depends on others, see :mod:`kineverse.model.rates`.
    bodies, articulations
        What the frames carry, and records for people and exporters.
    data
        Anything else: immutable values that can be compared.
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
    def of(writes: Mapping[tuple[str, str], Any]) -> Effects:
        """Return the effects that have these writes, by kind and name."""
        kinds: dict[str, dict[Any, Any]] = {kind: {} for kind in KINDS}
        for (kind, name), value in writes.items():
            if kind == RATES:
                coordinate, entry = value
                kinds[kind][coordinate] = entry if isinstance(entry, Expression) else dict(entry)
            elif kind == FRAMES:
                kinds[kind][name] = (value.parent, value.factors)
            else:
                kinds[kind][name] = value
        return Effects(**kinds)

    def writes(self) -> dict[tuple[str, str], Any]:
        """Return all of it in canonical form, by kind and name, in plain coordinates."""
        result: dict[tuple[str, str], Any] = {}
        for name, frame in self.frames.items():
            value = _as_frame(name, frame)
            if any(isinstance(f, Expression) and f._nodes for f in value.factors):
                value = Frame(
                    value.parent, tuple(plain(f) if isinstance(f, Expression) else f for f in value.factors)
                )
            result[FRAMES, name] = value
        for name, triple in self.constraints.items():
            c = as_constraint(triple)
            if c.lower._nodes or c.expression._nodes or c.upper._nodes:
                c = Constraint(plain(c.lower), plain(c.expression), plain(c.upper))
            result[CONSTRAINTS, name] = c
        for coordinate, row in self.rates.items():
            result[RATES, str(coordinate)] = (coordinate, as_entry(coordinate, row))
        others: tuple[tuple[str, Mapping[str, Any]], ...] = (
            (BODIES, self.bodies),
            (ARTICULATIONS, self.articulations),
            (DATA, self.data),
        )
        for kind, values in others:
            for name, datum in values.items():
                _check_value(kind, name, datum)
                if isinstance(datum, Articulation) and datum.follows is not None and datum.follows._nodes:
                    datum = replace(datum, follows=plain(datum.follows))
                result[kind, name] = datum
        return result


def _as_frame(name: str, frame: Frame | tuple[str, TransformLike | Sequence[TransformLike]]) -> Frame:
    if not isinstance(frame, Frame):
        if not isinstance(frame, (tuple, list)) or len(frame) != 2:
            raise ValueRejectedError(
                f"Frame {name!r} is written as a pair (parent, transform), not as {frame!r}."
            )
        frame = Frame.of(*frame)
    if not isinstance(frame.parent, str):
        raise ValueRejectedError(
            f"The parent of frame {name!r} is given by its name, not by {frame.parent!r}."
        )
    if not all(
        isinstance(f, Pose) or (isinstance(f, Expression) and f.shape == (4, 4)) for f in frame.factors
    ):
        return Frame.of(frame.parent, frame.factors)
    return frame


_TYPES = {BODIES: Body, ARTICULATIONS: Articulation}


def _check_value(kind: str, name: str, value: object) -> None:
    if kind in _TYPES and not isinstance(value, _TYPES[kind]):
        raise ValueRejectedError(f"{kind}/{name} is a kv.{_TYPES[kind].__name__}, not {value!r}.")
    if isinstance(value, Articulation):
        check_home(name, value)
    try:
        hash(value)
    except TypeError:
        raise ValueRejectedError(
            f"{kind}/{name} can be changed from outside, as it is or contains a list, a dict or an array; "
            "write tuples, frozen dataclasses or expressions instead."
        ) from None


class Operation(ABC):
    """A step in building a model; subclass it as a frozen dataclass.

    Ten lines make a new kind of articulation::

        @dataclass(frozen=True)
        class Slide(kv.Operation):
            name: str
            parent: str

            def apply(self, model):
                q = kv.position(self.name)
                return kv.Effects(
                    frames={self.name: (self.parent, kv.translation(q, 0, 0))},
                    constraints={f"{self.name}/range": (0, q, 1)},
                )
    """

    traceable: ClassVar[bool] = True
    """Whether what it computes can be written down as expressions of what it reads; False saves the try."""

    overrides: ClassVar[bool] = False
    """Whether it may write over frames, bodies, articulations and rates that it has not looked at."""

    if not TYPE_CHECKING:  # a type checker knows the keywords

        def __new__(cls, *args, **keywords):
            """Make an operation; wrong arguments are answered with the right ones."""
            check_keywords(cls, args, keywords)
            return object.__new__(cls)

    @abstractmethod
    def apply(self, model: Reader) -> Effects:
        """Return what the operation writes, given the model before it.

        Must be a pure function of its fields and of what it reads from ``model``.
        """

    def default_tag(self) -> str:
        """Return the tag used when none is given: the class and the operation's name, if it has one."""
        kind = type(self).__name__
        words = "".join(f" {c.lower()}" if c.isupper() else c for c in kind).strip()
        name = getattr(self, "name", "")
        return f"{words} {name}" if name else words
