"""Frames as a constant pose and motions about and along fixed lines, recognised from their transforms.

Whatever a transform is written as, a product of factors or one matrix, it is looked at as mathematics: the
variable whose spatial twist ∂T/∂x · T⁻¹ is constant moves the rest by exp(twist · x), which is a rotation
about a line, a translation, or both. That is split off, and the rest is looked at again.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.bounds.terms import Term, Terms
from kineverse.expressions.expression import Expression
from kineverse.model.body import Pose
from kineverse.motions import AxisMotion
from kineverse.spatial import snapped

from .harmonics import NOISE, Harmonic, Harmonics, TooLargeError
from .moving import NOTHING, Matrix, Motion, Moving, Placing, Turning, UnrecognisedError, rounded, vector
from .plan import ITSELF, Polynomial

_SAME = 1e-12


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
            moving.append(Turning(part.factor, vector(rounded(-behind[:3, 3]))))
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
        try:
            return _split(_entries(factor, terms, harmonics), harmonics)
        except UnrecognisedError:
            # A rotation by a curve, of which a document has the matrix only, is one by a variable.
            angles = Harmonics(angles=True)
            return list(_resolved(_split(_entries(factor, terms, angles), angles), angles))
    except TooLargeError:
        raise UnrecognisedError("is too long a product to be taken apart") from None


def _entries(factor: Expression, terms: Terms, harmonics: Harmonics) -> list[list[Harmonic]]:
    entries = [harmonics.of(term) for term in terms.elements(factor)]
    return [[entries[row + 4 * column] for column in range(4)] for row in range(4)]


def _resolved(parts: Iterable[Matrix | Moving], harmonics: Harmonics) -> Iterator[Matrix | Moving]:
    """Yield the same with motions by polynomials in place of those by the variables that these are."""
    for part in parts:
        sums = _sums(harmonics.of(part.variable), harmonics) if isinstance(part, Motion) else None
        if sums is None or not isinstance(part, Motion):
            yield part
            continue
        polynomials, offset = sums
        for index, coefficients in sorted(polynomials.items(), key=lambda item: -len(item[1])):
            whole = tuple(part.amount[1] * c for c in (offset, *coefficients))
            yield replace(part, variable=harmonics.variables[index], amount=whole)
            offset = 0.0


def _axis_motion(
    factor: AxisMotion, amount: Harmonic, harmonics: Harmonics, terms: Terms, offsets: bool
) -> list[Matrix | Moving] | None:
    """Return one by its amount; None for a translation by waves, which is one along circles."""
    sums = _sums(amount, harmonics)
    if sums is None:
        if _of_coordinates(amount, harmonics) and not factor.turns:
            return None
        curve = factor.amount
        return [Motion(factor.turns, factor.direction, NOTHING, terms.of(curve), ITSELF, curve)]
    polynomials, offset = sums
    found: list[Matrix | Moving] = []
    if offset and not (offsets and polynomials):
        found.append(AxisMotion(factor.direction, offset, factor.turns)())
        offset = 0.0
    for index, coefficients in sorted(polynomials.items()):
        whole = (offset, *coefficients)
        found.append(Motion(factor.turns, factor.direction, NOTHING, harmonics.variables[index], whole))
        offset = 0.0
    return found


def _of_coordinates(amount: Harmonic, harmonics: Harmonics) -> bool:
    return all(harmonics.variables[v].op == ca.OP_PARAMETER for v in amount.variables)


def _sums(amount: Harmonic, harmonics: Harmonics) -> tuple[dict[int, Polynomial], float] | None:
    """Return an amount as polynomials of coordinates and a constant, if it is that."""
    return amount.polynomials if _of_coordinates(amount, harmonics) else None


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
        return [Motion(False, vector(snapped(v / length)), NOTHING, variable, (0.0, length))]
    axis = snapped(w / speed)
    point, pitch = np.cross(axis, v) / speed, float(axis @ v)
    turn = Motion(True, vector(axis), vector(rounded(point)), variable, (0.0, speed))
    if abs(pitch) < NOISE:
        return [turn]
    return [Motion(False, vector(axis), NOTHING, variable, (0.0, pitch)), turn]


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
        axis = vector(snapped(direction / length))
        found.append(Motion(False, axis, NOTHING, harmonics.variables[index], (0.0, length)))
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
        axis = vector(sign * normal)
        turns = [
            Motion(True, axis, NOTHING, harmonics.variables[index], (0.0, w)) for index, w in frequencies
        ]
        back = [Motion(True, axis, NOTHING, m.variable, (0.0, -m.amount[1])) for m in turns]
        found += [*turns, reach, *back]
    return found


def _tidy(pose: Matrix) -> Matrix:
    """Return a pose without the noise that products leave."""
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = snapped(pose[:3, :3]), rounded(pose[:3, 3])
    return result
