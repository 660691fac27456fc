"""Decomposition of transforms into a constant pose and motions about joint axes.

Whatever a transform is written as, a product of factors or one matrix, it is looked at as mathematics: the
variable whose spatial twist ∂T/∂x · T⁻¹ is constant moves the rest by exp(twist · x), which is a rotation
about a line, a translation, or both. That is split off, and the rest is looked at again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.expressions.expression import Expression
from kineverse.formats.description import IDENTITY_COEFFICIENTS, Coefficients
from kineverse.intervals.graph import Term, TermGraph
from kineverse.lie import rotation_along_z, round_exact, transform, translation
from kineverse.model.body import Pose, Vector3
from kineverse.spatial import OneAxisTransform

from .trig_polynomial import NOISE, TooManyTermsError, TrigPolynomial, TrigPolynomialConverter

Matrix: TypeAlias = npt.NDArray[np.float64]
ZERO_VECTOR: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class JointMotion:
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
    amount: Coefficients
    curve: Expression | None = None

    @property
    def curved(self) -> bool:
        """Whether it moves by a curve over coordinates, and not by a polynomial of one."""
        return self.variable.op != ca.OP_PARAMETER

    def in_frame(self, pose: Matrix) -> JointMotion:
        """Return the same motion in coordinates of a frame that is at ``pose`` where this one is in."""
        r, p = pose[:3, :3], pose[:3, 3]
        axis = round_exact(r.T @ np.array(self.axis))
        if not self.turns:
            return self._with(axis, np.zeros(3))
        point = r.T @ (np.array(self.point) - p)
        return self._with(axis, point - axis * (axis @ point))

    def _with(self, axis: Matrix, point: Matrix) -> JointMotion:
        return replace(self, axis=as_vector3(axis), point=as_vector3(round_position(point)))


@dataclass(frozen=True)
class QuaternionMotion:
    """A rotation by a quaternion of four coordinates (x, y, z, w) about a point [m]."""

    factor: Expression
    point: Vector3 = ZERO_VECTOR


AnyJointMotion: TypeAlias = JointMotion | QuaternionMotion


@dataclass(frozen=True)
class MotionChain:
    """parent_T_frame: a pose, then motions, all of them in the axes of the frame where all amounts are 0."""

    pose: Matrix
    moving: tuple[AnyJointMotion, ...]


class UnrecognisedMotionError(Exception):
    """A transform is no product of motions about fixed lines; the writer turns it into a refusal."""


def round_position(position: Matrix) -> Matrix:
    """Return a position without the noise that products leave [m]."""
    return np.where(np.abs(position) < NOISE, 0.0, position)


def as_vector3(numbers: Matrix) -> Vector3:
    """Return three numbers as such, without negative zeros."""
    x, y, z = (float(n) + 0.0 for n in numbers)
    return x, y, z


_SAME = 1e-12


def decompose_transform(
    factors: Sequence[Pose | Expression],
    terms: TermGraph,
    quaternions: Sequence[Expression] = (),
    *,
    offsets: bool = False,
) -> MotionChain:
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
    parts: list[Matrix | AnyJointMotion] = []
    for factor in factors:
        if isinstance(factor, Pose):
            parts.append(factor.matrix)
        elif factor in quaternions:
            parts.append(QuaternionMotion(factor))
        else:
            parts += _parts(factor, terms, offsets)
    # Constants are gathered in front: behind a motion, they change the line that it is about.
    behind, moving = np.eye(4), list[AnyJointMotion]()
    for part in reversed(parts):
        if isinstance(part, JointMotion):
            moving.append(part.in_frame(behind))
        elif isinstance(part, QuaternionMotion):
            if np.abs(behind[:3, :3] - np.eye(3)).max() > 0:
                raise UnrecognisedMotionError(
                    "is turned by a constant behind its quaternion; add a frame for that"
                )
            moving.append(QuaternionMotion(part.factor, as_vector3(round_position(-behind[:3, 3]))))
        else:
            behind = _clean_pose(part @ behind)
    return MotionChain(behind, tuple(reversed(moving)))


def _parts(factor: Expression, terms: TermGraph, offsets: bool) -> list[Matrix | AnyJointMotion]:
    """Return one factor as constants and motions."""
    harmonics = TrigPolynomialConverter()
    try:
        if isinstance(factor, OneAxisTransform):
            amount = harmonics.of(terms.term(factor.amount))
            found = _axis_motion(factor, amount, harmonics, terms, offsets)
            if found is not None:
                return found
        try:
            return _split_off_motions(_entries(factor, terms, harmonics), harmonics)
        except UnrecognisedMotionError:
            # A rotation by a curve, of which a document has the matrix only, is one by a variable.
            angles = TrigPolynomialConverter(angles=True)
            return list(
                _substitute_polynomials(_split_off_motions(_entries(factor, terms, angles), angles), angles)
            )
    except TooManyTermsError:
        raise UnrecognisedMotionError("is too long a product to be taken apart") from None


def _entries(
    factor: Expression, terms: TermGraph, harmonics: TrigPolynomialConverter
) -> list[list[TrigPolynomial]]:
    entries = [harmonics.of(term) for term in terms.elements(factor)]
    return [[entries[row + 4 * column] for column in range(4)] for row in range(4)]


def _substitute_polynomials(
    parts: Iterable[Matrix | AnyJointMotion], harmonics: TrigPolynomialConverter
) -> Iterator[Matrix | AnyJointMotion]:
    """Yield the same with motions by polynomials in place of those by the variables that these are."""
    for part in parts:
        sums = (
            _as_polynomials(harmonics.of(part.variable), harmonics) if isinstance(part, JointMotion) else None
        )
        if sums is None or not isinstance(part, JointMotion):
            yield part
            continue
        polynomials, offset = sums
        for index, coefficients in sorted(polynomials.items(), key=lambda item: -len(item[1])):
            whole = tuple(part.amount[1] * c for c in (offset, *coefficients))
            yield replace(part, variable=harmonics.variables[index], amount=whole)
            offset = 0.0


def _axis_motion(
    factor: OneAxisTransform,
    amount: TrigPolynomial,
    harmonics: TrigPolynomialConverter,
    terms: TermGraph,
    offsets: bool,
) -> list[Matrix | AnyJointMotion] | None:
    """Return one by its amount; None for a translation by waves, which is one along circles."""
    sums = _as_polynomials(amount, harmonics)
    if sums is None:
        if _of_coordinates(amount, harmonics) and not factor.is_rotation:
            return None
        curve = factor.amount
        return [
            JointMotion(
                factor.is_rotation,
                factor.direction,
                ZERO_VECTOR,
                terms.term(curve),
                IDENTITY_COEFFICIENTS,
                curve,
            )
        ]
    polynomials, offset = sums
    found: list[Matrix | AnyJointMotion] = []
    if offset and not (offsets and polynomials):
        found.append(OneAxisTransform(factor.direction, offset, factor.is_rotation)())
        offset = 0.0
    for index, coefficients in sorted(polynomials.items()):
        whole = (offset, *coefficients)
        found.append(
            JointMotion(factor.is_rotation, factor.direction, ZERO_VECTOR, harmonics.variables[index], whole)
        )
        offset = 0.0
    return found


def _of_coordinates(amount: TrigPolynomial, harmonics: TrigPolynomialConverter) -> bool:
    return all(harmonics.variables[v].op == ca.OP_PARAMETER for v in amount.variables)


def _as_polynomials(
    amount: TrigPolynomial, harmonics: TrigPolynomialConverter
) -> tuple[dict[int, Coefficients], float] | None:
    """Return an amount as polynomials of coordinates and a constant, if it is that."""
    return amount.polynomials if _of_coordinates(amount, harmonics) else None


def _split_off_motions(
    matrix: list[list[TrigPolynomial]], harmonics: TrigPolynomialConverter
) -> list[Matrix | AnyJointMotion]:
    """Split off one variable after the other, from the left."""
    found: list[Matrix | AnyJointMotion] = []
    while variables := sorted({v for row in matrix for entry in row for v in entry.variables}):
        for index in variables:
            twist = _twist(matrix, index)
            if twist is not None:
                found += _exponential(twist, harmonics.variables[index])
                matrix = [[entry.at_zero(index) for entry in row] for row in matrix]
                break
        else:
            found += _circles(matrix, harmonics)
            zero = TrigPolynomial.constant(0.0)
            matrix = [[*row[:3], zero] for row in matrix[:3]] + [matrix[3]]
            left = {v for row in matrix for entry in row for v in entry.variables}
            if left and all(_twist(matrix, index) is None for index in left):
                raise UnrecognisedMotionError(
                    "is no product of rotations about and translations along fixed lines"
                )
    constant = np.array([[entry.number for entry in row] for row in matrix], dtype=float)
    return [*found, constant]


def _twist(matrix: list[list[TrigPolynomial]], index: int) -> Matrix | None:
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
        raise UnrecognisedMotionError("is no rigid transform everywhere")
    return np.array([*velocity, spin[2, 1], spin[0, 2], spin[1, 0]])


def _sum(parts: Iterable[TrigPolynomial]) -> TrigPolynomial:
    total = TrigPolynomial.constant(0.0)
    for part in parts:
        total = total + part
    return total


def _exponential(twist: Matrix, variable: Term) -> list[Matrix | AnyJointMotion]:
    """Return exp(twist · x) as a translation along a line and a rotation about it."""
    v, w = twist[:3], twist[3:]
    speed = float(np.linalg.norm(w))
    if speed < NOISE:
        length = float(np.linalg.norm(v))
        return [JointMotion(False, as_vector3(round_exact(v / length)), ZERO_VECTOR, variable, (0.0, length))]
    axis = round_exact(w / speed)
    point, pitch = np.cross(axis, v) / speed, float(axis @ v)
    turn = JointMotion(True, as_vector3(axis), as_vector3(round_position(point)), variable, (0.0, speed))
    if abs(pitch) < NOISE:
        return [turn]
    return [JointMotion(False, as_vector3(axis), ZERO_VECTOR, variable, (0.0, pitch)), turn]


def _circles(
    matrix: list[list[TrigPolynomial]], harmonics: TrigPolynomialConverter
) -> list[Matrix | AnyJointMotion]:
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
                raise UnrecognisedMotionError("is moved by more than multiples and waves of its coordinates")
            elif powers:
                slides.setdefault(powers[0][0], np.zeros(3))[i] = c.real
            else:
                constant[i, 3] = c.real
    found: list[Matrix | AnyJointMotion] = [constant]
    for index, direction in slides.items():
        length = float(np.linalg.norm(direction))
        axis = as_vector3(round_exact(direction / length))
        found.append(JointMotion(False, axis, ZERO_VECTOR, harmonics.variables[index], (0.0, length)))
    for frequencies, amplitude in waves.items():
        found += _ellipse(frequencies, amplitude, harmonics)
    return found


def _ellipse(
    frequencies: tuple[tuple[int, float], ...],
    c: npt.NDArray[np.complex128],
    harmonics: TrigPolynomialConverter,
) -> list[Matrix | AnyJointMotion]:
    """Return the translation by Re(c exp(iθ)), θ = w·x, as turns about the normal of its plane."""
    normal = np.cross(c.real, -c.imag)
    if np.linalg.norm(normal) < NOISE * np.abs(c).max():
        along = c.real if np.abs(c.real).max() > np.abs(c.imag).max() else c.imag
        normal = rotation_along_z(along)[:, 0]
    normal = round_exact(normal / np.linalg.norm(normal))
    u, v, _ = rotation_along_z(normal).T
    found: list[Matrix | AnyJointMotion] = []
    for sign in (1, -1):
        arm = (c @ u + sign * 1j * (c @ v)) / 2
        if abs(arm) < NOISE:
            continue
        # Re(arm · (u - sign·i·v) · exp(iθ)): an arm that is turned by θ about sign · normal.
        reach = translation(arm.real * u + sign * arm.imag * v)
        axis = as_vector3(sign * normal)
        turns = [
            JointMotion(True, axis, ZERO_VECTOR, harmonics.variables[index], (0.0, w))
            for index, w in frequencies
        ]
        back = [JointMotion(True, axis, ZERO_VECTOR, m.variable, (0.0, -m.amount[1])) for m in turns]
        found += [*turns, reach, *back]
    return found


def _clean_pose(pose: Matrix) -> Matrix:
    """Return a pose without the noise that products leave."""
    return transform(round_exact(pose[:3, :3]), round_position(pose[:3, 3]))
