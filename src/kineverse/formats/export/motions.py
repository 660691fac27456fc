"""Frames as a constant pose and motions about and along fixed lines, recognised from their transforms.

Whatever a transform is written as, a product of factors or one matrix, it is looked at as mathematics: the
variable whose spatial twist ∂T/∂x · T⁻¹ is constant moves the rest by exp(twist · x), which is a rotation
about a line, a translation, or both. That is split off, and the rest is looked at again.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.bounds.terms import Term, Terms
from kineverse.expressions.expression import Expression
from kineverse.model.body import Pose, Vector3
from kineverse.motions import AxisMotion
from kineverse.spatial import snapped

from .harmonics import NOISE, Harmonic, Harmonics, TooLargeError
from .plan import ITSELF, Polynomial

Matrix: TypeAlias = npt.NDArray[np.float64]
_NOTHING: Vector3 = (0.0, 0.0, 0.0)
_SAME = 1e-12


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
        return replace(self, axis=_vector(axis), point=_vector(_rounded(point)))


@dataclass(frozen=True)
class Turning:
    """A rotation by a quaternion of four coordinates (x, y, z, w) about a point [m]."""

    factor: Expression
    point: Vector3 = _NOTHING


Moving: TypeAlias = Motion | Turning


@dataclass(frozen=True)
class Placing:
    """parent_T_frame: a pose, then motions, all of them in the axes of the frame where all amounts are 0."""

    pose: Matrix
    moving: tuple[Moving, ...]


class UnrecognisedError(Exception):
    """A transform is no product of motions about fixed lines; the writer turns it into a refusal."""


def placing(
    factors: Sequence[Pose | Expression],
    terms: Terms,
    quaternions: Sequence[Expression] = (),
    *,
    offsets: bool = False,
) -> Placing:
    """Return a product of transforms as a pose and motions.

    Parameters
    ----------
    factors
        The transforms, in terms of coordinates that depend on nothing.
    terms
        Where the steps of expressions are known.
    quaternions
        The rotations by quaternions that there are; they are recognised by being one of these.
    offsets
        Whether what is constant in the amount of a motion stays there, rather than in the pose.

    Raises
    ------
    UnrecognisedError
        If it is no such product.
    """
    parts: list[Matrix | Moving] = []
    for factor in factors:
        if isinstance(factor, Pose):
            parts.append(factor.matrix)
        elif factor in quaternions:
            parts.append(Turning(factor))
        else:
            parts += _parts(factor, terms, offsets)
    # Constants are gathered in front: behind a motion, they change the line that it is about.
    behind, moving = np.eye(4), list[Moving]()
    for part in reversed(parts):
        if isinstance(part, Motion):
            moving.append(part.seen_from(behind))
        elif isinstance(part, Turning):
            if np.abs(behind[:3, :3] - np.eye(3)).max() > 0:
                raise UnrecognisedError("is turned by a constant behind its quaternion; add a frame for that")
            moving.append(Turning(part.factor, _vector(_rounded(-behind[:3, 3]))))
        else:
            behind = _tidy(part @ behind)
    return Placing(behind, tuple(reversed(moving)))


def _parts(factor: Expression, terms: Terms, offsets: bool) -> list[Matrix | Moving]:
    """Return one factor as constants and motions."""
    harmonics = Harmonics()
    try:
        if isinstance(factor, AxisMotion):
            amount = harmonics.of(terms.of(factor.amount))
            found = _axis_motion(factor, amount, harmonics, terms, offsets)
            if found is not None:
                return found
        entries = [harmonics.of(term) for term in terms.elements(factor)]
        matrix = [[entries[row + 4 * column] for column in range(4)] for row in range(4)]
        return _split(matrix, harmonics)
    except TooLargeError:
        raise UnrecognisedError("is too long a product to be taken apart") from None


def _axis_motion(
    factor: AxisMotion, amount: Harmonic, harmonics: Harmonics, terms: Terms, offsets: bool
) -> list[Matrix | Moving] | None:
    """Return one by its amount; None for a translation by waves, which is one along circles."""
    known = all(harmonics.variables[v].op == ca.OP_PARAMETER for v in amount.variables)
    sums = amount.polynomials if known else None
    if sums is None:
        if known and not factor.turns:
            return None
        curve = factor.amount
        return [Motion(factor.turns, factor.direction, _NOTHING, terms.of(curve), ITSELF, curve)]
    polynomials, offset = sums
    found: list[Matrix | Moving] = []
    if offset and not (offsets and polynomials):
        found.append(AxisMotion(factor.direction, offset, factor.turns)())
        offset = 0.0
    for index, coefficients in sorted(polynomials.items()):
        whole = (offset, *coefficients)
        found.append(Motion(factor.turns, factor.direction, _NOTHING, harmonics.variables[index], whole))
        offset = 0.0
    return found


def _split(matrix: list[list[Harmonic]], harmonics: Harmonics) -> list[Matrix | Moving]:
    """Split off one variable after the other, from the left."""
    found: list[Matrix | Moving] = []
    while variables := sorted({v for row in matrix for entry in row for v in entry.variables}):
        for index in variables:
            twist = _twist(matrix, index)
            if twist is not None:
                found += _exponential(twist, harmonics.variables[index])
                matrix = [[entry.at_zero(index) for entry in row] for row in matrix]
                break
        else:
            found += _circles(matrix, harmonics)
            zero = Harmonic.constant(0.0)
            matrix = [[*row[:3], zero] for row in matrix[:3]] + [matrix[3]]
            left = {v for row in matrix for entry in row for v in entry.variables}
            if left and all(_twist(matrix, index) is None for index in left):
                raise UnrecognisedError("is no product of rotations about and translations along fixed lines")
    constant = np.array([[entry.number for entry in row] for row in matrix], dtype=float)
    return [*found, constant]


def _twist(matrix: list[list[Harmonic]], index: int) -> Matrix | None:
    """Return the twist (v, ω) by which a variable moves a transform, if it is constant."""
    if not any(index in entry.variables for row in matrix for entry in row):
        return None
    slope = [[entry.derivative(index) for entry in row] for row in matrix[:3]]
    spin = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            entry = _sum(slope[i][k] * matrix[j][k] for k in range(3)).number
            if entry is None:
                return None
            spin[i, j] = entry
    velocity = np.zeros(3)
    for i in range(3):
        # v = ṗ - ω × p
        carried = _sum(matrix[k][3].scaled(spin[i, k]) for k in range(3))
        rest = (slope[i][3] - carried).number
        if rest is None:
            return None
        velocity[i] = rest
    if np.abs(spin + spin.T).max() > _SAME:
        raise UnrecognisedError("is no rigid transform everywhere")
    return np.array([*velocity, spin[2, 1], spin[0, 2], spin[1, 0]])


def _sum(parts: Iterable[Harmonic]) -> Harmonic:
    total = Harmonic.constant(0.0)
    for part in parts:
        total = total + part
    return total


def _exponential(twist: Matrix, variable: Term) -> list[Matrix | Moving]:
    """Return exp(twist · x) as a translation along a line and a rotation about it."""
    v, w = twist[:3], twist[3:]
    speed = float(np.linalg.norm(w))
    if speed < NOISE:
        length = float(np.linalg.norm(v))
        return [Motion(False, _vector(snapped(v / length)), _NOTHING, variable, (0.0, length))]
    axis = snapped(w / speed)
    point, pitch = np.cross(axis, v) / speed, float(axis @ v)
    turn = Motion(True, _vector(axis), _vector(_rounded(point)), variable, (0.0, speed))
    if abs(pitch) < NOISE:
        return [turn]
    return [Motion(False, _vector(axis), _NOTHING, variable, (0.0, pitch)), turn]


def _circles(matrix: list[list[Harmonic]], harmonics: Harmonics) -> list[Matrix | Moving]:
    """Return the translation of a transform as slides and, where it is a sum of waves, as circles.

    Each wave of a point is an ellipse, and an ellipse is two circles that are run through in opposite
    directions. A circle is a turn by w·x, an arm, and the turn back.
    """
    slides: dict[int, Matrix] = {}
    waves: dict[tuple[tuple[int, float], ...], npt.NDArray[np.complex128]] = {}
    constant = np.eye(4)
    for i in range(3):
        for (powers, frequencies), c in matrix[i][3].terms.items():
            if frequencies and not powers:
                if frequencies[0][1] > 0:  # the other half is its conjugate
                    waves.setdefault(frequencies, np.zeros(3, complex))[i] = 2 * c
            elif frequencies or sum(n for _, n in powers) > 1:
                raise UnrecognisedError("is moved by more than multiples and waves of its coordinates")
            elif powers:
                slides.setdefault(powers[0][0], np.zeros(3))[i] = c.real
            else:
                constant[i, 3] = c.real
    found: list[Matrix | Moving] = [constant]
    for index, direction in slides.items():
        length = float(np.linalg.norm(direction))
        axis = _vector(snapped(direction / length))
        found.append(Motion(False, axis, _NOTHING, harmonics.variables[index], (0.0, length)))
    for frequencies, amplitude in waves.items():
        found += _ellipse(frequencies, amplitude, harmonics)
    return found


def _ellipse(
    frequencies: tuple[tuple[int, float], ...], c: npt.NDArray[np.complex128], harmonics: Harmonics
) -> list[Matrix | Moving]:
    """Return the translation by Re(c exp(iθ)), θ = w·x, as turns about the normal of its plane."""
    normal = np.cross(c.real, -c.imag)
    if np.linalg.norm(normal) < NOISE * np.abs(c).max():
        along = c.real if np.abs(c.real).max() > np.abs(c.imag).max() else c.imag
        normal = np.cross(np.eye(3)[int(np.argmin(np.abs(along)))], along)
    normal = snapped(normal / np.linalg.norm(normal))
    u = np.cross(np.eye(3)[int(np.argmin(np.abs(normal)))], normal)
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    found: list[Matrix | Moving] = []
    for sign in (1, -1):
        arm = (c @ u + sign * 1j * (c @ v)) / 2
        if abs(arm) < NOISE:
            continue
        # Re(arm · (u - sign·i·v) · exp(iθ)): an arm that is turned by θ about sign · normal.
        reach = np.eye(4)
        reach[:3, 3] = arm.real * u + sign * arm.imag * v
        axis = _vector(sign * normal)
        turns = [
            Motion(True, axis, _NOTHING, harmonics.variables[index], (0.0, w)) for index, w in frequencies
        ]
        back = [Motion(True, axis, _NOTHING, m.variable, (0.0, -m.amount[1])) for m in turns]
        found += [*turns, reach, *back]
    return found


def _tidy(pose: Matrix) -> Matrix:
    """Return a pose without the noise that products leave."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = snapped(pose[:3, :3]), _rounded(pose[:3, 3])
    return result


def _rounded(position: Matrix) -> Matrix:
    return np.where(np.abs(position) < NOISE, 0.0, position)


def _vector(numbers: Matrix) -> Vector3:
    x, y, z = (float(n) + 0.0 for n in numbers)
    return x, y, z
