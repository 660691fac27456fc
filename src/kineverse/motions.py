"""Rotations about and translations along constant directions, by an amount: what most joints do.

An :class:`AxisMotion` is a 4×4 expression like any other. But it remembers direction and amount, which is all
that kinematics wants of it, and builds its matrix when somebody looks at it. A robot has dozens of them and
most questions are about a few.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca

from .errors import ShapeError
from .expressions.expression import Expression, ExpressionLike, as_expression, make
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
_UNIT = 1e-9
"""How far the length of a direction may be from 1."""


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
            return super().__getattr__(name)  # type: ignore[misc]
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


def as_motion(transform: Expression) -> Expression:
    """Return a 4×4 transform as the motion that its matrix is, if it is one; else as it is.

    So a motion is the same to kinematics however it was written down, and after it was sent as a matrix.
    """
    if isinstance(transform, AxisMotion):
        # Along a skew line, factors of the amount and those of the direction are one in the matrix.
        is_skew = not transform.turns and sum(d != 0 for d in transform.direction) > 1
        return transform if not is_skew else _as_slide(transform)
    sparsity = transform._sx.sparsity()
    if sparsity == _TRANSLATION:
        return _as_slide(transform)
    for axis, pattern in _TRANSFORMS.items():
        if sparsity == pattern:
            return _as_turn(transform, axis)
    return transform


def _as_turn(transform: Expression, axis: Direction) -> Expression:
    *entries, one = transform._sx.nonzeros()
    sine = entries[_TURNS[axis][2].index(1)]
    if sine.op() != ca.OP_SIN or not one.is_one():
        return transform
    motion = turn(axis, make(sine.dep(0), (), transform._nodes))
    same = zip(entries, motion._entries(), strict=True)
    return motion if all(ca.is_equal(a, b, 2) for a, b in same) else transform


def _as_slide(transform: Expression) -> Expression:
    nonzeros = transform._sx.nonzeros()
    parts = nonzeros[3:6]
    moving = [k for k, part in enumerate(parts) if not part.is_constant()]
    if not moving or not all(e.is_one() for e in (*nonzeros[:3], nonzeros[6])):
        return transform
    if any(not part.is_zero() for k, part in enumerate(parts) if k not in moving):
        return transform
    if len(moving) == 1:
        axis = (X, Y, Z)[moving[0]]
        return slide(axis, make(parts[moving[0]], (), transform._nodes))
    direction, amount = [0.0, 0.0, 0.0], None
    for k in moving:
        factor, rest = _multiple(parts[k])
        if amount is not None and not ca.is_equal(amount, rest, 1):
            return _opaque(transform)
        direction[k], amount = factor, rest
    motion = slide((direction[0], direction[1], direction[2]), make(amount, (), transform._nodes))
    is_same = all(ca.is_equal(a, b, 2) for a, b in zip(parts, motion.offset.nonzeros(), strict=True))
    return motion if is_same and abs(math.hypot(*direction) - 1) <= _UNIT else _opaque(transform)


def _multiple(part: SX) -> tuple[float, SX]:
    """Return a scalar as a number and what it is a multiple of."""
    if part.op() == ca.OP_NEG:
        factor, rest = _multiple(part.dep(0))
        return -factor, rest
    if part.op() == ca.OP_MUL:
        for k in (0, 1):
            if part.dep(k).is_constant():
                return float(part.dep(k)), part.dep(1 - k)
    return 1.0, part


def _opaque(transform: Expression) -> Expression:
    """Return a transform without what it knows beside its matrix."""
    if not isinstance(transform, AxisMotion):
        return transform
    return make(transform._sx, transform.shape, transform._nodes)
