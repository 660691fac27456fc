"""Rotations about and translations along constant directions, by an amount: what most joints do.

An :class:`AxisMotion` is a 4×4 expression like any other. But it remembers direction and amount, which is all
that kinematics wants of it, and builds its matrix when somebody looks at it. A robot has dozens of them and
most questions are about a few.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from .errors import ShapeError
from .expressions.expression import Expression, ExpressionLike, as_expression
from .expressions.layout import SX

Direction = tuple[float, float, float]

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

# Which entries a rotation about an axis has, column by column, and what they are: cos, sin, -sin or 1. Built
# sparse, because element by element each would cost ten times as much.
_TURNS = {
    X: ([0, 1, 2, 1, 2], [0, 1, 1, 2, 2], (3, 0, 1, 2, 0)),
    Y: ([0, 2, 1, 0, 2], [0, 0, 1, 2, 2], (0, 2, 3, 1, 0)),
    Z: ([0, 1, 0, 1, 2], [0, 0, 1, 1, 2], (0, 1, 2, 0, 3)),
}
_ROTATIONS = {axis: ca.Sparsity.triplet(3, 3, rows, columns) for axis, (rows, columns, _) in _TURNS.items()}
_TRANSFORMS = {
    axis: ca.Sparsity.triplet(4, 4, [*rows, 3], [*columns, 3]) for axis, (rows, columns, _) in _TURNS.items()
}
_TRANSLATION = ca.Sparsity.triplet(4, 4, [0, 1, 2, 0, 1, 2, 3], [0, 1, 2, 3, 3, 3, 3])
_ONE = ca.SX(1)


class AxisMotion(Expression):
    """A 4×4 transform: a rotation about a coordinate axis or a translation along any direction.

    Attributes
    ----------
    direction
        A constant unit vector; of a rotation, one of the three coordinate axes.
    amount
        A scalar, [rad] or [m].
    turns
        Whether it is a rotation.
    """

    __slots__ = ("amount", "direction", "turns")

    direction: Direction
    amount: Expression
    turns: bool

    def __new__(cls, direction: Direction, amount: ExpressionLike, turns: bool) -> AxisMotion:
        """Return the motion; :func:`turn` and :func:`slide` are the ways to get one."""
        self = object.__new__(cls)
        self.direction, self.amount, self.turns = direction, as_expression(amount), turns
        if self.amount.shape:
            what = "An angle" if turns else "A distance"
            raise ShapeError(f"{what} is a scalar, not of shape {self.amount.shape}.")
        self._describe((4, 4), self.amount._nodes)
        return self

    def __getattr__(self, name: str) -> Any:
        # Called for what is not there: the graph, before it is looked at for the first time.
        if name != "_sx":
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        if self.turns:
            graph = ca.SX(_TRANSFORMS[self.direction], ca.vertcat(*self._entries(), _ONE))
        else:
            graph = ca.SX(_TRANSLATION, ca.vertcat(_ONE, _ONE, _ONE, self.offset, _ONE))
        self._sx = graph
        return graph

    @property
    def rotation(self) -> SX:
        """The 3×3 rotation of a motion that turns."""
        return ca.SX(_ROTATIONS[self.direction], ca.vertcat(*self._entries()))

    @property
    def offset(self) -> SX:
        """The translation of a motion that does not turn, 3×1."""
        sx = self.amount._sx
        return ca.vertcat(*(sx if d == 1 else ca.SX(d) if d == 0 else d * sx for d in self.direction))

    def _entries(self) -> list[SX]:
        angle = self.amount._sx
        sine = ca.SX.unary(ca.OP_SIN, angle)
        entries = (ca.SX.unary(ca.OP_COS, angle), sine, ca.SX.unary(ca.OP_NEG, sine), _ONE)
        return [entries[i] for i in _TURNS[self.direction][2]]

    @property
    def is_constant(self) -> bool:
        """Whether the amount is constant."""
        return self.amount.is_constant

    def __reduce__(self) -> Any:
        return AxisMotion, (self.direction, self.amount, self.turns)


def turn(axis: Direction, angle: ExpressionLike) -> AxisMotion:
    """Return the 4×4 rotation about the coordinate axis X, Y or Z by ``angle`` [rad]."""
    return AxisMotion(axis, angle, True)


def slide(direction: Direction, distance: ExpressionLike) -> AxisMotion:
    """Return the 4×4 translation along a constant unit vector by ``distance`` [m]."""
    return AxisMotion(direction, distance, False)
