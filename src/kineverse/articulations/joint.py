"""What the ordinary joints have in common: a child frame, a place in its parent, limits."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from kineverse.errors import ValueRejectedError
from kineverse.expressions.expression import Expression, ExpressionLike
from kineverse.expressions.gradient import total_derivative
from kineverse.model.articulation import Articulation
from kineverse.model.body import Pose, Vector3
from kineverse.model.constraint import Constraint
from kineverse.model.operation import Effects, Operation
from kineverse.model.reader import Reader
from kineverse.spatial import normalised
from kineverse.symbols import Symbol, position


@dataclass(frozen=True, kw_only=True)
class Joint(Operation):
    """Base of the joints that connect a child frame to a parent frame.

    Attributes
    ----------
    name
        Name of the articulation and, where it has one coordinate, of its degree of freedom.
    parent, child
        Frames; the child is created.
    origin
        parent_T_joint, the place of the child at coordinate 0.
    dynamics
        What is known beside kinematics, as (name, value) pairs: effort [N] or [N m], damping, friction ...
    """

    name: str
    parent: str
    child: str
    origin: Pose = Pose()
    dynamics: tuple[tuple[str, Any], ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.origin, (Pose, Expression)):
            object.__setattr__(self, "origin", Pose.of(self.origin))

    def default_tag(self) -> str:
        """Return ``joint`` and the name."""
        return f"joint {self.name}"

    @property
    def kind(self) -> str:
        """The name of the class in lower case."""
        return type(self).__name__.lower()

    def record(
        self,
        coordinates: tuple[Symbol, ...] = (),
        home: tuple[float, ...] = (),
        speeds: tuple[Symbol, ...] = (),
    ) -> Articulation:
        """Return the record of this joint."""
        return Articulation(self.kind, self.parent, self.child, coordinates, home, speeds, self.dynamics)


@dataclass(frozen=True, kw_only=True)
class Fixed(Joint):
    """A rigid connection: parent_T_child = origin."""

    def apply(self, model: Reader) -> Effects:
        """Write the child frame."""
        return Effects(
            frames={self.child: (self.parent, self.origin)}, articulations={self.name: self.record()}
        )


@dataclass(frozen=True, kw_only=True)
class AxisJoint(Joint):
    """Base of the joints with one coordinate q along or about an axis.

    Attributes
    ----------
    axis
        Direction in the joint's frame, of any length but zero.
    lower, upper
        Limits of q [m] or [rad], numbers or expressions; None leaves that side open.
    velocity
        Limit of the speed, either way [m/s] or [rad/s]; None for no limit.
    position
        The expression to use for q instead of a degree of freedom of its own: a mimic joint, linear or not.
    """

    axis: Vector3 = (1.0, 0.0, 0.0)
    lower: ExpressionLike | None = None
    upper: ExpressionLike | None = None
    velocity: float | None = None
    position: Expression | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "axis", checked_axis(self.axis, self.name))

    @property
    def q(self) -> Expression:
        """The coordinate, or the expression that stands for it."""
        return position(self.name) if self.position is None else self.position

    @abstractmethod
    def motion(self, q: Expression) -> tuple[Pose | Expression, ...]:
        """Return joint_T_child as factors."""

    def apply(self, model: Reader) -> Effects:
        """Write the child frame and the limits."""
        own = isinstance(self.q, Symbol) and self.position is None
        coordinates = (self.q,) if own and isinstance(self.q, Symbol) else ()
        return Effects(
            frames={self.child: (self.parent, (self.origin, *self.motion(self.q)))},
            constraints=dict(limits(self.name, self.q, self.lower, self.upper, self.velocity)),
            articulations={
                self.name: self.record(
                    coordinates, (0.0,) * len(coordinates), tuple(c.derivative() for c in coordinates)
                )
            },
        )


def checked_axis(axis: Vector3, name: str) -> Vector3:
    """Return the axis of a joint as a tuple of numbers.

    Raises
    ------
    ValueRejectedError
        If it is not three numbers with a direction.
    """
    try:
        x, y, z = map(float, axis)
    except (TypeError, ValueError):
        raise ValueRejectedError(f"The axis of joint '{name}' is three numbers, not {axis!r}.") from None
    if normalised((x, y, z)) is None:
        problem = "has length zero" if (x, y, z) == (0, 0, 0) else f"is {(x, y, z)}, which is no direction"
        raise ValueRejectedError(f"The axis of joint '{name}' {problem}.")
    return x, y, z


def limits(
    name: str,
    q: Expression,
    lower: ExpressionLike | None,
    upper: ExpressionLike | None,
    velocity: float | None,
) -> Iterator[tuple[str, Constraint]]:
    """Yield the constraints ``name/position`` and ``name/velocity``, as far as there are any."""
    inf = float("inf")
    if (lower is not None or upper is not None) and q.symbols:
        yield (
            f"{name}/position",
            Constraint.of(-inf if lower is None else lower, q, inf if upper is None else upper),
        )
    if velocity is not None and velocity != inf:
        rate = total_derivative(q)
        if rate.symbols:
            if not velocity >= 0:
                raise ValueRejectedError(
                    f"The velocity limit of '{name}' is {velocity!r}; it cannot be negative."
                )
            yield f"{name}/velocity", Constraint.of(-velocity, rate, velocity)
