"""Base of mechanisms, operations that write several frames, and simple bodies for their parts."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np

from kineverse.articulations.joint import PlacedOperation, check_joint_number
from kineverse.articulations.limits import Limits, check_limits
from kineverse.articulations.multi_axis import rotation_from_z
from kineverse.errors import InvalidValueError
from kineverse.expressions.expression import Expression, ExpressionLike, as_expression
from kineverse.model.articulation import Articulation
from kineverse.model.body import Body, Box, Cylinder, Pose, Rgba, Shape, Vector3
from kineverse.model.constraint import ConstraintLike
from kineverse.model.frame import TransformLike
from kineverse.model.operation import Writes
from kineverse.model.read_recorder import ReadRecorder
from kineverse.symbols import Symbol, position

WOOD: Rgba = (0.72, 0.53, 0.34, 1.0)
PALE: Rgba = (0.90, 0.88, 0.84, 1.0)
STEEL: Rgba = (0.62, 0.65, 0.69, 1.0)
DARK: Rgba = (0.22, 0.24, 0.27, 1.0)
RED: Rgba = (0.80, 0.22, 0.18, 1.0)
BLUE: Rgba = (0.20, 0.42, 0.70, 1.0)
YELLOW: Rgba = (0.95, 0.77, 0.20, 1.0)


def box_shape(size: Vector3, at: Vector3, color: Rgba) -> Shape:
    """Return a box with its centre at a point [m]."""
    return Shape(Box(size), shift(*at), color=color)


def rod_shape(start: Vector3, end: Vector3, radius: float, color: Rgba) -> Shape:
    """Return a cylinder from one point to another [m]."""
    along = np.subtract(end, start)
    pose = rotation_from_z((float(along[0]), float(along[1]), float(along[2])))
    pose[:3, 3] = np.add(start, end) / 2
    return Shape(Cylinder(radius, math.dist(start, end)), Pose.from_matrix(pose), color=color)


def panel(width: float, height: float, thickness: float, color: Rgba) -> Shape:
    """Return a panel on the plane z = 0 that reaches from a hinge along z to y = width [m]."""
    return box_shape((thickness, width, height), (0.0, width / 2, height / 2), color)


def case(size: Vector3, wall: float, color: Rgba, at: Vector3 = (0.0, 0.0, 0.0)) -> tuple[Shape, ...]:
    """Return the five walls of a box that is centred at a point and open towards -x [m]."""
    depth, width, height = size
    x, y, z = at
    return (
        box_shape((wall, width, height), (x + depth / 2 - wall / 2, y, z), color),
        *(box_shape((depth, wall, height), (x, y + side * (width - wall) / 2, z), color) for side in (-1, 1)),
        *(box_shape((depth, width, wall), (x, y, z + side * (height - wall) / 2), color) for side in (-1, 1)),
    )


def shift(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    """Return a translation [m]."""
    return Pose((1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z))


def solid_body(shapes: tuple[Shape, ...]) -> Body:
    """Return a body whose visual shapes are its collision shapes."""
    return Body(shapes, tuple(Shape(shape.geometry, shape.origin) for shape in shapes))


BASE = "base"


class MechanismPart(NamedTuple):
    """Frame of a mechanism: its parent part, the factors of its pose in there, and its shapes.

    See Also
    --------
    kineverse.articulations.GarageDoor
    """

    below: str
    place: tuple[TransformLike, ...]
    shapes: tuple[Shape, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Mechanism(PlacedOperation):
    """Base of the mechanisms: several frames ``name/…`` that move together by a few coordinates.

    ``name/base`` is fixed at ``origin`` in the parent; x points away from the user, y to the left, z up. A
    mechanism with one coordinate has the degree of freedom ``name``, others have ``name/…``. Limits of
    coordinates are constraints ``…/position`` and ``…/velocity``.

    Raises
    ------
    InvalidValueError
        For limits that contradict each other, and dimensions that are impossible.

    See Also
    --------
    kineverse.articulations.GarageDoor
    kineverse.articulations.FoldingDoor
    """

    main: ClassVar[str]
    """Name of the main part, the child frame of the record."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for path, limits in self.limits.items():
            check_limits(limits, f"What limits '{path}' of the {self.noun} '{self.name}'")
            dict(limits.constraints(path, position(path)))

    @property
    def child(self) -> str:
        """Frame of the main part."""
        return self.path(self.main)

    @property
    @abstractmethod
    def limits(self) -> Mapping[str, Limits]:
        """Limits of the coordinates, by path."""

    @abstractmethod
    def parts(self) -> Mapping[str, MechanismPart]:
        """Return the parts by their names below ``name/``, the base first."""

    def locks(self) -> Mapping[str, ConstraintLike]:
        """Return the constraints other than limits, by their names below ``name/``."""
        return {}

    def dynamics(self) -> tuple[tuple[str, Any], ...]:
        """Return dynamic parameters as (name, value) pairs: springs and the like."""
        return ()

    def data(self) -> Mapping[str, Any]:
        """Return further data, by their names below ``name/``."""
        return {}

    def path(self, part: str = "") -> str:
        """Return the full name of a part or coordinate."""
        return f"{self.name}/{part}" if part else self.name

    def q(self, part: str = "") -> Symbol:
        """Return a coordinate of the mechanism."""
        return position(self.path(part))

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the frames with their bodies, the limits and locks, and the record."""
        parts = self.parts()
        self.check_names(model, map(self.path, parts))
        constraints: dict[str, ConstraintLike] = {}
        for path, limits in self.limits.items():
            constraints.update(limits.constraints(path, position(path)))
        constraints.update({self.path(name): lock for name, lock in self.locks().items()})
        coordinates = tuple(map(position, self.limits))
        home, speeds = (0.0,) * len(coordinates), tuple(q.derivative() for q in coordinates)
        facts = self.kind, self.parent, self.child, coordinates, home, speeds, self.dynamics()
        above = {n: self.path(part.below) if part.below else self.parent for n, part in parts.items()}
        return Writes(
            frames={self.path(n): (above[n], part.place) for n, part in parts.items()},
            bodies={self.path(n): solid_body(part.shapes) for n, part in parts.items() if part.shapes},
            constraints=constraints,
            articulations={self.name: Articulation(*facts)},
            data={self.path(n): value for n, value in self.data().items()},
        )

    def base(self, *shapes: Shape) -> MechanismPart:
        """Return the base, which is fixed in the parent."""
        return MechanismPart("", (self.origin,), shapes)

    def number(self, field: str, *, positive: bool = False) -> float:
        """Return a field after checking that it is a finite number.

        Raises
        ------
        InvalidValueError
            If it is no finite number, or not positive although required.
        """
        return check_joint_number(getattr(self, field), self.describe(field), positive=positive)

    def describe(self, field: str) -> str:
        """Return the name of a field in errors."""
        return f"The {field.replace('_', ' ')} of the {self.noun} '{self.name}'"

    def numeric_range(self, field: str, least: float, most: float) -> tuple[float, float]:
        """Return lower and upper limit in a field, which have to be numbers within a range.

        Raises
        ------
        InvalidValueError
            If one is missing, no number, or outside of [least, most], the range that the geometry allows.
        """
        limits = getattr(self, field)
        check_limits(limits, self.describe(field))
        ends = []
        for name, end in (("lower", limits.lower), ("upper", limits.upper)):
            if end is None or (isinstance(end, Expression) and end.symbols):
                what = self.describe(field)
                raise InvalidValueError(f"{what} has a number as its {name} end, not {end!r}.")
            ends.append(check_joint_number(end, f"{self.describe(field)}, its {name} end,"))
        lower, upper = ends
        if not least <= lower < upper <= most:
            raise InvalidValueError(
                f"{self.describe(field)} is a range within [{least:.6g}, {most:.6g}], not from {lower:g} to "
                f"{upper:g}."
            )
        return lower, upper

    def check_threshold(self, field: str, limits: Limits) -> None:
        """Check that a threshold lies between the limits of a coordinate, if these are numbers.

        Raises
        ------
        InvalidValueError
            If it does not: the coordinate would never reach the threshold, or never leave it.
        """
        value = self.number(field)
        lower, upper = constant_value(limits.lower), constant_value(limits.upper)
        if (lower is not None and value <= lower) or (upper is not None and value >= upper):
            raise InvalidValueError(
                f"{self.describe(field)} lies between {limits.lower!r} and {limits.upper!r}, "
                f"and is not {value:g}."
            )


def constant_value(bound: ExpressionLike | None) -> float | None:
    """Return the value of a constant bound; None for no bound or one with symbols."""
    if bound is None:
        return None
    expression = as_expression(bound)
    return None if expression.symbols else float(expression)
