"""Base classes of the joints: a child frame, its origin in a parent frame, limits."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Container, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

from kineverse._checks import real_number
from kineverse.errors import DuplicateNameError, InvalidValueError, KineverseError
from kineverse.expressions.expression import Expression, ExpressionLike
from kineverse.lie import normalize
from kineverse.model.articulation import Articulation
from kineverse.model.body import AxisLike, Pose, Vector3
from kineverse.model.frame import TransformLike
from kineverse.model.operation import Operation, Writes, split_words
from kineverse.model.read_recorder import ReadRecorder
from kineverse.symbols import Symbol, position

from .limits import limit_constraints

Size: TypeAlias = float | Expression  # a size of a joint, a number or an expression


@dataclass(frozen=True, kw_only=True)
class PlacedOperation(Operation):
    """Base of operations with a name and an origin in a parent frame."""

    name: str  # name of the articulation and, if it has one coordinate, of its degree of freedom
    parent: str  # parent frame
    origin: TransformLike = Pose()  # pose of the articulation in the parent frame

    def __post_init__(self) -> None:
        self.check_texts("name", "parent")
        given = self.origin
        if isinstance(given, Pose) or (isinstance(given, Expression) and given.shape == (4, 4)):
            return
        try:
            object.__setattr__(self, "origin", Pose.from_matrix(given))
        except (KineverseError, TypeError, ValueError) as error:
            raise InvalidValueError(
                f"The origin of the {self.noun} '{self.name}' is not a pose. {error} It is a 4×4 transform: "
                f"{_place(given)}, a kv.model.Pose, or a 4×4 array of numbers."
            ) from None

    @property
    def kind(self) -> str:
        """Kind of the articulation: that of documents, in lower case."""
        return self.document_kind.lower()

    @property
    def noun(self) -> str:
        """Name in errors: the kind in words."""
        return split_words(self.document_kind)

    def check_lengths(self, *fields: str) -> None:
        """Check that fields are positive lengths [m]."""
        for field in fields:
            what = f"The {field} of the {self.noun} '{self.name}'"
            check_joint_number(getattr(self, field), what, positive=True)

    def check_sizes(self, *fields: str) -> None:
        """Check that fields are positive lengths [m], numbers or expressions."""
        for field in fields:
            check_size(getattr(self, field), f"The {field} of the {self.noun} '{self.name}'", positive=True)

    def check_texts(self, *fields: str) -> None:
        """Check that fields are names."""
        for field in fields:
            given = getattr(self, field)
            if not isinstance(given, str) or not given:
                what = f"The {field} of the {self.noun} '{self.name}'"
                raise InvalidValueError(f"{what} is a path like 'kitchen/door', not {given!r}.")

    def check_names(self, model: ReadRecorder, frames: Iterable[str]) -> None:
        """Check that the names of the articulation and of its frames are free."""
        wanted: list[tuple[str, str, Container[str]]] = [("an articulation", self.name, model.articulations)]
        wanted += [("a frame", frame, model.frames) for frame in frames]
        for what, name, names in wanted:
            if name in names:
                raise DuplicateNameError(
                    f"There is {what} '{name}' already, so the {self.noun} '{self.name}' cannot create it. "
                    "Choose another name, or replace the operation that wrote it."
                )


def _place(given: object) -> str:
    """Return the code of a translation for an error; a general example unless three numbers are given."""
    try:
        x, y, z = map(real_number, given)  # type: ignore[call-overload]
    except (TypeError, ValueError, OverflowError):
        return "kv.translation(x, y, z) @ kv.rpy(roll, pitch, yaw) or the like"
    return f"kv.translation({x:g}, {y:g}, {z:g})"


@dataclass(frozen=True, kw_only=True)
class Joint(PlacedOperation):
    """Base of the joints that connect a child frame to a parent frame.

    Attributes
    ----------
    child
        Name of the child frame, which the joint writes.
    origin
        parent_T_joint, the pose of the child at coordinate 0.
    dynamics
        Dynamic parameters as (name, value) pairs: effort [N] or [N m], damping, friction, …

    See Also
    --------
    kineverse.Fixed
    kineverse.Revolute
    """

    child: str
    dynamics: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_texts("child")

    def default_tag(self) -> str:
        """Return ``joint`` and the name."""
        return f"joint {self.name}"

    def record(
        self,
        coordinates: tuple[Symbol, ...] = (),
        home: tuple[float, ...] | None = None,
        speeds: tuple[Symbol, ...] | None = None,
        follows: Expression | None = None,
    ) -> Articulation:
        """Return the record of the articulation.

        Parameters
        ----------
        coordinates, home
            Coordinates and their values at home, by default 0.
        speeds
            Speeds that move them, by default their derivatives.
        follows
            The position as an expression, for a joint without a coordinate of its own.
        """
        home = (0.0,) * len(coordinates) if home is None else home
        speeds = tuple(s.derivative() for s in coordinates) if speeds is None else speeds
        ends = self.parent, self.child
        return Articulation(self.kind, *ends, coordinates, home, speeds, self.dynamics, follows)

    def check_free(self, model: ReadRecorder) -> None:
        """Check that the names of the articulation and of its child are free."""
        self.check_names(model, [self.child])


@dataclass(frozen=True, kw_only=True)
class Fixed(Joint, document_kind="Fixed"):
    """Fixed joint: parent_T_child = origin.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> with model.edit() as edit:
    ...     edit.apply(
    ...         kv.Fixed(
    ...             name="lamp", parent="kitchen/sink_area", child="lamp", origin=kv.translation(0, 0, 0.3)
    ...         )
    ...     )
    'joint lamp'
    >>> model.fk("lamp", relative_to="kitchen/sink_area")()[:3, 3]
    array([0. , 0. , 0.3])
    """

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame."""
        frames = {self.child: (self.parent, self.origin)}
        return Writes(frames=frames, articulations={self.name: self.record()})


@dataclass(frozen=True, kw_only=True)
class OneAxisMotion(Joint):
    """Base of motions along or about one axis by a scalar q, a coordinate or a function of others.

    Attributes
    ----------
    axis
        Direction in the joint's frame, of any length but zero.
    lower, upper
        Limits of q [m] or [rad], numbers or expressions; None leaves that side open.
    velocity
        Limit of ``|q̇|`` [m/s] or [rad/s]; None for no limit.

    See Also
    --------
    kineverse.Revolute
    kineverse.articulations.Gearbox
    """

    axis: AxisLike = (1.0, 0.0, 0.0)
    lower: ExpressionLike | None = None
    upper: ExpressionLike | None = None
    velocity: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", check_axis(self.axis, self.name))

    @abstractmethod
    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return the factors of joint_T_child."""

    def joint_writes(self, q: Expression) -> Writes:
        """Return the child frame, the limits and the record for a position q.

        The coordinate ``name`` is on record as the joint's own; any other q as an expression that it follows.
        """
        own = (q,) if isinstance(q, Symbol) and q == position(self.name) else ()
        return Writes(
            frames={self.child: (self.parent, (self.origin, *self.motion(q)))},
            constraints=dict(limit_constraints(self.name, q, self.lower, self.upper, self.velocity)),
            articulations={self.name: self.record(own, follows=None if own else q)},
        )


@dataclass(frozen=True, kw_only=True)
class OneDofJoint(OneAxisMotion):
    """Base of the joints with one coordinate q along or about an axis.

    Attributes
    ----------
    position
        Expression for q in place of a degree of freedom: a mimic joint, linear or not. The limits are
        constraints on that expression.

    See Also
    --------
    kineverse.Revolute
    kineverse.Prismatic
    """

    position: Expression | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.position is not None:
            check_position_expression(self.position, f"The position of the {self.noun} '{self.name}'")

    @property
    def q(self) -> Expression:
        """The coordinate, or the expression in its place."""
        return position(self.name) if self.position is None else self.position

    def apply(self, model: ReadRecorder) -> Writes:
        """Write the child frame and the limits."""
        return self.joint_writes(self.q)


def check_axis(axis: AxisLike, name: str) -> Vector3:
    """Return the axis of a joint as a tuple of numbers."""
    try:
        x, y, z = map(real_number, axis)
    except (TypeError, ValueError, OverflowError):
        raise InvalidValueError(f"The axis of joint '{name}' is three numbers, not {axis!r}.") from None
    if normalize((x, y, z)) is None:
        problem = "has length zero" if (x, y, z) == (0, 0, 0) else f"is {(x, y, z)}, which is no direction"
        raise InvalidValueError(f"The axis of joint '{name}' {problem}.")
    return x, y, z


def check_position_expression(expression: object, what: str) -> Expression:
    """Return a scalar expression of positions after checking that it is one."""
    scalar = check_scalar(expression, what)
    moving = [str(s) for s in scalar.symbols if s.order]
    if moving:
        raise InvalidValueError(f"{what} is about positions, and not about {', '.join(moving)}.")
    return scalar


def check_scalar(expression: object, what: str) -> Expression:
    """Return a scalar expression after checking that it is one."""
    if not isinstance(expression, Expression):
        raise InvalidValueError(f"{what} is an expression, not {expression!r}.")
    if expression.shape:
        raise InvalidValueError(f"{what} is a scalar, not of shape {expression.shape}.")
    return expression


def check_size(size: object, what: str, *, positive: bool = False) -> float | None:
    """Check a size, a number or an expression; return its number, None if it depends on positions.

    Parameters of an expression have their own values.
    """
    if not isinstance(size, Expression):
        return check_joint_number(size, what, positive=positive)
    expression = check_position_expression(size, what)
    if any(symbol.has_derivative for symbol in expression.symbols):
        return None
    value = float(expression({s: s.value for s in expression.symbols}))
    return check_joint_number(value, what, positive=positive)


def check_joint_number(number: object, what: str, *, positive: bool = False) -> float:
    """Return a finite number after checking that it is one."""
    try:
        value = real_number(number)
    except (TypeError, ValueError, OverflowError):
        raise InvalidValueError(f"{what} is a number, not {number!r}.") from None
    if not math.isfinite(value) or (positive and value <= 0):
        kind = "a positive, finite number" if positive else "a finite number"
        raise InvalidValueError(f"{what} is {kind}, not {number!r}.")
    return value
