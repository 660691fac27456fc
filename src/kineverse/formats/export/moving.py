"""Where a frame is in its parent, as a constant pose and motions about and along fixed lines."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.bounds.terms import Term
from kineverse.expressions.expression import Expression
from kineverse.model.body import Vector3
from kineverse.spatial import snapped

from .harmonics import NOISE
from .plan import Polynomial

Matrix: TypeAlias = npt.NDArray[np.float64]
NOTHING: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Motion:
    """A rotation about a line or a translation, by a polynomial of a variable [rad] or [m].

    Attributes
    ----------
    turns
        Whether it is a rotation.
    axis
        A unit vector.
    point
        On the line of a rotation [m].
    variable
        What moves it: a coordinate, or a curve over coordinates.
    amount
        The coefficients of the polynomial, constant first.
    curve
        The variable as an expression, if it is a curve that was given as one.
    """

    turns: bool
    axis: Vector3
    point: Vector3
    variable: Term
    amount: Polynomial
    curve: Expression | None = None

    @property
    def curved(self) -> bool:
        """Whether it moves by a curve over coordinates, and not by a polynomial of one."""
        return self.variable.op != ca.OP_PARAMETER

    def seen_from(self, pose: Matrix) -> Motion:
        """Return the same motion in coordinates of a frame that is at ``pose`` where this one is in."""
        r, p = pose[:3, :3], pose[:3, 3]
        axis = snapped(r.T @ np.array(self.axis))
        if not self.turns:
            return self._with(axis, np.zeros(3))
        point = r.T @ (np.array(self.point) - p)
        return self._with(axis, point - axis * (axis @ point))

    def _with(self, axis: Matrix, point: Matrix) -> Motion:
        return replace(self, axis=vector(axis), point=vector(rounded(point)))


@dataclass(frozen=True)
class Turning:
    """A rotation by a quaternion of four coordinates (x, y, z, w) about a point [m]."""

    factor: Expression
    point: Vector3 = NOTHING


Moving: TypeAlias = Motion | Turning


@dataclass(frozen=True)
class Placing:
    """parent_T_frame: a pose, then motions, all of them in the axes of the frame where all amounts are 0."""

    pose: Matrix
    moving: tuple[Moving, ...]


class UnrecognisedError(Exception):
    """A transform is no product of motions about fixed lines; the writer turns it into a refusal."""


def rounded(position: Matrix) -> Matrix:
    """Return a position without the noise that products leave [m]."""
    return np.where(np.abs(position) < NOISE, 0.0, position)


def vector(numbers: Matrix) -> Vector3:
    """Return three numbers as such, without negative zeros."""
    x, y, z = (float(n) + 0.0 for n in numbers)
    return x, y, z
