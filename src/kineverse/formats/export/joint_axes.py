"""Decomposition of transforms into a constant pose and motions about joint axes.

A transform T is a product of factors or one matrix. If the spatial twist ∂T/∂x · T⁻¹ of a variable x is
constant, then T = exp(twist · x) · R, and R does not depend on x. The exponential is a rotation about a line,
a translation, or both (Chasles). It is split off, and R is decomposed in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.expressions.expression import Expression
from kineverse.formats.description import IDENTITY_COEFFICIENTS, Coefficients, Matrix
from kineverse.intervals.graph import Term, TermGraph
from kineverse.lie import rotation_along_z, round_exact, transform, translation
from kineverse.model.body import Pose, Vector3
from kineverse.spatial import OneAxisTransform

from .trig_polynomial import NOISE, TooManyTermsError, TrigPolynomial, TrigPolynomialConverter

ZERO_VECTOR: Vector3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class JointMotion:
    """Rotation about a line or translation along one, by a polynomial of a variable [rad] or [m]."""

    is_rotation: bool  # True for a rotation, False for a translation
    axis: Vector3  # direction of the line, a unit vector
    point: Vector3  # point on the line of a rotation [m]
    variable: Term  # variable of the polynomial: a coordinate, or a curve over coordinates
    coefficients: Coefficients  # coefficients of the polynomial, constant first
    curve: Expression | None = None

    @property
    def is_curved(self) -> bool:
        """True if the variable is a curve over coordinates rather than a coordinate."""
        return self.variable.op != ca.OP_PARAMETER

    def in_frame(self, pose: Matrix) -> JointMotion:
        """Return the motion in coordinates of a frame whose pose in this motion's frame is ``pose``."""
        r, p = pose[:3, :3], pose[:3, 3]
        axis = round_exact(r.T @ np.array(self.axis))
        if not self.is_rotation:
            return self._with(axis, np.zeros(3))
        point = r.T @ (np.array(self.point) - p)
        return self._with(axis, point - axis * (axis @ point))

    def _with(self, axis: Matrix, point: Matrix) -> JointMotion:
        return replace(self, axis=as_vector3(axis), point=as_vector3(round_position(point)))


@dataclass(frozen=True)
class QuaternionMotion:
    """Rotation by a quaternion of four coordinates (x, y, z, w) about a point [m]."""

    factor: Expression
    point: Vector3 = ZERO_VECTOR


AnyJointMotion: TypeAlias = JointMotion | QuaternionMotion


@dataclass(frozen=True)
class MotionChain:
    """parent_T_frame as a constant pose and motions after it.

    Axes and points of the motions are in coordinates of the frame while all positions are 0.
    """

    pose: Matrix
    motions: tuple[AnyJointMotion, ...]


class UnrecognisedMotionError(Exception):
    """A transform that is no product of motions about fixed lines; reported as an unsupported feature."""


def round_position(position: Matrix) -> Matrix:
    """Return a position [m] without the rounding errors of products."""
    return np.where(np.abs(position) < NOISE, 0.0, position)


def as_vector3(numbers: Matrix) -> Vector3:
    """Return an array of three numbers as a tuple, without negative zeros."""
    x, y, z = (float(n) + 0.0 for n in numbers)
    return x, y, z


_SKEW_TOLERANCE = 1e-12  # tolerance for the skew symmetry of an angular velocity matrix Ṙ Rᵀ


def decompose_transform(
    factors: Sequence[Pose | Expression],
    terms: TermGraph,
    quaternions: Sequence[Expression] = (),
    *,
    offsets: bool = False,
) -> MotionChain:
    """Decompose a product of transforms into a constant pose and motions."""
    parts: list[Matrix | AnyJointMotion] = []
    for factor in factors:
        if isinstance(factor, Pose):
            parts.append(factor.matrix)
        elif factor in quaternions:
            parts.append(QuaternionMotion(factor))
        else:
            parts += _decompose_factor(factor, terms, offsets)
    # Constants are moved to the front: a constant behind a motion changes the coordinates of its line.
    behind, motions = np.eye(4), list[AnyJointMotion]()
    for part in reversed(parts):
        if isinstance(part, JointMotion):
            motions.append(part.in_frame(behind))
        elif isinstance(part, QuaternionMotion):
            if np.abs(behind[:3, :3] - np.eye(3)).max() > 0:
                raise UnrecognisedMotionError(
                    "is turned by a constant behind its quaternion; add a frame for that"
                )
            motions.append(QuaternionMotion(part.factor, as_vector3(round_position(-behind[:3, 3]))))
        else:
            pose = part @ behind
            behind = transform(round_exact(pose[:3, :3]), round_position(pose[:3, 3]))
    return MotionChain(behind, tuple(reversed(motions)))


def _decompose_factor(factor: Expression, terms: TermGraph, offsets: bool) -> list[Matrix | AnyJointMotion]:
    converter = TrigPolynomialConverter()
    try:
        if isinstance(factor, OneAxisTransform):
            amount = converter.convert(terms.term(factor.amount))
            result = _axis_motion(factor, amount, converter, terms, offsets)
            if result is not None:
                return result
        try:
            return _split_off_motions(_matrix_entries(factor, terms, converter), converter)
        except UnrecognisedMotionError:
            # Documents have only the matrix of a rotation by a curve: its angle becomes a variable.
            converter = TrigPolynomialConverter(angles=True)
            parts = _split_off_motions(_matrix_entries(factor, terms, converter), converter)
            return list(_substitute_polynomials(parts, converter))
    except TooManyTermsError:
        raise UnrecognisedMotionError("is too long a product to be taken apart") from None


def _matrix_entries(
    factor: Expression, terms: TermGraph, converter: TrigPolynomialConverter
) -> list[list[TrigPolynomial]]:
    """Return the 4 x 4 entries of a transform as trigonometric polynomials."""
    entries = [converter.convert(term) for term in terms.elements(factor)]
    return [[entries[row + 4 * column] for column in range(4)] for row in range(4)]


def _substitute_polynomials(
    parts: Iterable[Matrix | AnyJointMotion], converter: TrigPolynomialConverter
) -> Iterator[Matrix | AnyJointMotion]:
    for part in parts:
        sums = None
        if isinstance(part, JointMotion):
            sums = _as_polynomials(converter.convert(part.variable), converter)
        if sums is None or not isinstance(part, JointMotion):
            yield part
            continue
        polynomials, offset = sums
        for index, coefficients in sorted(polynomials.items(), key=lambda item: -len(item[1])):
            whole = tuple(part.coefficients[1] * c for c in (offset, *coefficients))
            yield replace(part, variable=converter.variables[index], coefficients=whole)
            offset = 0.0


def _axis_motion(
    factor: OneAxisTransform,
    amount: TrigPolynomial,
    converter: TrigPolynomialConverter,
    terms: TermGraph,
    offsets: bool,
) -> list[Matrix | AnyJointMotion] | None:
    """Decompose a one-axis transform by its amount; None for a translation by sines and cosines.

    A translation by sines and cosines of coordinates is one along circles; see
    :func:`_split_off_translation`.
    """
    sums = _as_polynomials(amount, converter)
    if sums is None:
        if _has_only_coordinates(amount, converter) and not factor.is_rotation:
            return None
        line, curve = (factor.is_rotation, factor.direction, ZERO_VECTOR), factor.amount
        return [JointMotion(*line, terms.term(curve), IDENTITY_COEFFICIENTS, curve)]
    polynomials, offset = sums
    result: list[Matrix | AnyJointMotion] = []
    if offset and not (offsets and polynomials):
        result.append(OneAxisTransform(factor.direction, offset, factor.is_rotation)())
        offset = 0.0
    for index, coefficients in sorted(polynomials.items()):
        whole = (offset, *coefficients)
        result.append(
            JointMotion(factor.is_rotation, factor.direction, ZERO_VECTOR, converter.variables[index], whole)
        )
        offset = 0.0
    return result


def _has_only_coordinates(amount: TrigPolynomial, converter: TrigPolynomialConverter) -> bool:
    return all(converter.variables[v].op == ca.OP_PARAMETER for v in amount.variables)


def _as_polynomials(
    amount: TrigPolynomial, converter: TrigPolynomialConverter
) -> tuple[dict[int, Coefficients], float] | None:
    return amount.polynomials if _has_only_coordinates(amount, converter) else None


def _split_off_motions(
    matrix: list[list[TrigPolynomial]], converter: TrigPolynomialConverter
) -> list[Matrix | AnyJointMotion]:
    """Decompose a matrix by splitting off the motion of one variable after the other, from the left."""
    found: list[Matrix | AnyJointMotion] = []
    while variables := sorted({v for row in matrix for entry in row for v in entry.variables}):
        for index in variables:
            twist = _twist(matrix, index)
            if twist is not None:
                found += _twist_motions(twist, converter.variables[index])
                matrix = [[entry.substitute_zero(index) for entry in row] for row in matrix]
                break
        else:
            found += _split_off_translation(matrix, converter)
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
    """Return the spatial twist (v, ω) of a transform by one variable; None if it is not constant."""
    if not any(index in entry.variables for row in matrix for entry in row):
        return None
    slope = [[entry.derivative(index) for entry in row] for row in matrix[:3]]
    spin = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            entry = _add_up(slope[i][k] * matrix[j][k] for k in range(3)).number
            if entry is None:
                return None
            spin[i, j] = entry
    velocity = np.zeros(3)
    for i in range(3):
        # v = ṗ - ω × p
        rotational = _add_up(matrix[k][3].scale(spin[i, k]) for k in range(3))
        entry = (slope[i][3] - rotational).number
        if entry is None:
            return None
        velocity[i] = entry
    if np.abs(spin + spin.T).max() > _SKEW_TOLERANCE:
        raise UnrecognisedMotionError("is no rigid transform everywhere")
    return np.array([*velocity, spin[2, 1], spin[0, 2], spin[1, 0]])


def _add_up(parts: Iterable[TrigPolynomial]) -> TrigPolynomial:
    total = TrigPolynomial.constant(0.0)
    for part in parts:
        total = total + part
    return total


def _twist_motions(twist: Matrix, variable: Term) -> list[Matrix | AnyJointMotion]:
    """Decompose exp(twist · x) into a translation along a line and a rotation about it."""
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


def _split_off_translation(
    matrix: list[list[TrigPolynomial]], converter: TrigPolynomialConverter
) -> list[Matrix | AnyJointMotion]:
    """Decompose the translation of a transform into straight lines and ellipses.

    The terms of one frequency w move a point along an ellipse. An ellipse is the sum of two circles that are
    traversed in opposite directions. A circle is a rotation by w·x, an arm, and the rotation back.
    """
    slides: dict[int, Matrix] = {}
    waves: dict[tuple[tuple[int, float], ...], npt.NDArray[np.complex128]] = {}
    constant = np.eye(4)
    for i in range(3):
        for (powers, frequencies), c in matrix[i][3].terms.items():
            if frequencies and not powers:
                if frequencies[0][1] > 0:  # the term of the opposite frequency is its conjugate
                    waves.setdefault(frequencies, np.zeros(3, complex))[i] = 2 * c
            elif frequencies or sum(n for _, n in powers) > 1:
                raise UnrecognisedMotionError("is moved by more than multiples and waves of its coordinates")
            elif powers:
                slides.setdefault(powers[0][0], np.zeros(3))[i] = c.real
            else:
                constant[i, 3] = c.real
    result: list[Matrix | AnyJointMotion] = [constant]
    for index, direction in slides.items():
        length = float(np.linalg.norm(direction))
        axis = as_vector3(round_exact(direction / length))
        result.append(JointMotion(False, axis, ZERO_VECTOR, converter.variables[index], (0.0, length)))
    for frequencies, amplitude in waves.items():
        result += _ellipse_motions(frequencies, amplitude, converter)
    return result


def _ellipse_motions(
    frequencies: tuple[tuple[int, float], ...],
    c: npt.NDArray[np.complex128],
    converter: TrigPolynomialConverter,
) -> list[Matrix | AnyJointMotion]:
    """Decompose the translation Re(c exp(iθ)), θ = w·x, into rotations about the normal of its plane."""
    normal = np.cross(c.real, -c.imag)
    if np.linalg.norm(normal) < NOISE * np.abs(c).max():
        along = c.real if np.abs(c.real).max() > np.abs(c.imag).max() else c.imag
        normal = rotation_along_z(along)[:, 0]
    normal = round_exact(normal / np.linalg.norm(normal))
    u, v, _ = rotation_along_z(normal).T
    result: list[Matrix | AnyJointMotion] = []
    for sign in (1, -1):
        arm = (c @ u + sign * 1j * (c @ v)) / 2
        if abs(arm) < NOISE:
            continue
        # Re(arm · (u - sign·i·v) · exp(iθ)): an arm that is rotated by θ about sign · normal.
        reach = translation(arm.real * u + sign * arm.imag * v)
        axis = as_vector3(sign * normal)
        turns = [
            JointMotion(True, axis, ZERO_VECTOR, converter.variables[index], (0.0, w))
            for index, w in frequencies
        ]
        back = [JointMotion(True, axis, ZERO_VECTOR, m.variable, (0.0, -m.coefficients[1])) for m in turns]
        result += [*turns, reach, *back]
    return result
