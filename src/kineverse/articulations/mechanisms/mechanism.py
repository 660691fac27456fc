"""What the mechanisms have in common: parts with bodies, coordinates with limits, one record."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from kineverse.articulations.joint import PlacedOperation, check_joint_number
from kineverse.articulations.limits import Limits, check_limits
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.model.articulation import Articulation
from kineverse.model.body import Shape
from kineverse.model.constraint import ConstraintLike
from kineverse.model.frame import TransformLike
from kineverse.model.operation import Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.symbols import Symbol, position

from .simple_bodies import solid_body

BASE = "base"


class MechanismPart(NamedTuple):
    """One frame of a mechanism: which other part it is placed in, where, and what is seen of it."""

    below: str
    place: tuple[TransformLike, ...]
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Mechanism(PlacedOperation):
    """Base of the mechanisms: several frames ``name/…`` that move together by a few coordinates.

    ``name/base`` stands still at ``origin`` in the parent; x points away from who uses it, y to the left, z
    up. A mechanism with one coordinate has the degree of freedom ``name``, others ``name/…``. Limits of
    coordinates are constraints ``…/position`` and ``…/velocity``.

    Raises
    ------
    InvalidValueError
        For limits that contradict each other, and numbers that cannot be.
    DuplicateNameError
        For an articulation or a frame that exists.
    """

    main: ClassVar[str]
    """The part that it is all for."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for path, limits in self.limits.items():
            check_limits(limits, f"What limits '{path}' of the {self.noun} '{self.name}'")
            dict(limits.on(path, position(path)))

    @property
    def child(self) -> str:
        """The frame of its main part."""
        return self.path(self.main)

    @property
    @abstractmethod
    def limits(self) -> Mapping[str, Limits]:
        """The paths of its coordinates, with their limits."""

    @abstractmethod
    def parts(self) -> Mapping[str, MechanismPart]:
        """Return its frames by their names below ``name/``, the base first."""

    def locks(self) -> Mapping[str, ConstraintLike]:
        """Return its other constraints by their names below ``name/``."""
        return {}

    def known(self) -> tuple[tuple[str, Any], ...]:
        """Return what is known beside kinematics: springs and the like."""
        return ()

    def data(self) -> Mapping[str, Any]:
        """Return what else is written, by names below ``name/``."""
        return {}

    def path(self, part: str = "") -> str:
        """Return the name of something that belongs to it."""
        return f"{self.name}/{part}" if part else self.name

    def q(self, part: str = "") -> Symbol:
        """Return one of its coordinates."""
        return position(self.path(part))

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the frames with their bodies, the limits and locks, and the record."""
        parts = self.parts()
        self.check_names(model, map(self.path, parts))
        constraints: dict[str, ConstraintLike] = {}
        for path, limits in self.limits.items():
            constraints.update(limits.on(path, position(path)))
        constraints.update({self.path(name): lock for name, lock in self.locks().items()})
        coordinates = tuple(map(position, self.limits))
        return Writes(
            frames={self.path(n): (self._below(part), part.place) for n, part in parts.items()},
            bodies={self.path(n): solid_body(part.shapes) for n, part in parts.items() if part.shapes},
            constraints=constraints,
            articulations={
                self.name: Articulation(
                    self.kind,
                    self.parent,
                    self.child,
                    coordinates,
                    (0.0,) * len(coordinates),
                    tuple(q.derivative() for q in coordinates),
                    self.known(),
                )
            },
            data={self.path(n): value for n, value in self.data().items()},
        )

    def _below(self, part: MechanismPart) -> str:
        return self.path(part.below) if part.below else self.parent

    def base(self, *shapes: Shape) -> MechanismPart:
        """Return the part that stands still."""
        return MechanismPart("", (self.origin,), shapes)

    def number(self, field: str, *, positive: bool = False) -> float:
        """Return a field that is a finite number.

        Raises
        ------
        InvalidValueError
            If it is none, or not positive where it has to be.
        """
        return check_joint_number(getattr(self, field), self.its(field), positive=positive)

    def its(self, field: str) -> str:
        """Return what errors call a field."""
        return f"The {field.replace('_', ' ')} of the {self.noun} '{self.name}'"

    def range_of(self, field: str, least: float, most: float) -> tuple[float, float]:
        """Return the ends of limits that have to be numbers, because the geometry ends somewhere.

        Raises
        ------
        InvalidValueError
            If they are missing, no numbers, or beyond what the geometry allows.
        """
        limits = getattr(self, field)
        check_limits(limits, self.its(field))
        ends = []
        for name, end in (("lower", limits.lower), ("upper", limits.upper)):
            if end is None or (isinstance(end, Expression) and end.symbols):
                raise InvalidValueError(f"{self.its(field)} has a number as its {name} end, not {end!r}.")
            ends.append(check_joint_number(end, f"{self.its(field)}, its {name} end,"))
        lower, upper = ends
        if not least <= lower < upper <= most:
            raise InvalidValueError(
                f"{self.its(field)} is a range within [{least:.6g}, {most:.6g}], not from {lower:g} to "
                f"{upper:g}."
            )
        return lower, upper

    def check_within(self, field: str, limits: Limits) -> None:
        """Look whether a threshold lies between the ends of a coordinate, as far as these are numbers.

        Raises
        ------
        InvalidValueError
            If it does not, so the coordinate would never get to the other side of it.
        """
        value = self.number(field)
        lower, upper = constant_value(limits.lower), constant_value(limits.upper)
        if (lower is not None and value <= lower) or (upper is not None and value >= upper):
            raise InvalidValueError(
                f"{self.its(field)} lies between {limits.lower!r} and {limits.upper!r}, and is not {value:g}."
            )


def constant_value(bound: ExpressionLike | None) -> float | None:
    """Return a bound that is there and constant, else None."""
    if bound is None:
        return None
    expression = as_expression(bound)
    return None if expression.symbols else float(expression)
