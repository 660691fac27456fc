"""Positions, rotations and rigid motions as expressions.

``a_T_b`` is the 4×4 homogeneous transform that maps coordinates in frame b to coordinates in frame a, so
``a_T_c = a_T_b @ b_T_c``. Rotations are right-handed, angles in [rad], lengths in [m], quaternions in the
order (x, y, z, w). Axes and quaternions are normalised. Twists have the linear part first, then the angular
part.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

from .errors import ShapeError, ValueRejectedError
from .expressions.expression import Expression, ExpressionLike, array, as_expression, make, union, watcher_of
from .expressions.functions import arctan2, cos, norm, sin, sqrt, where
from .motions import X, Y, Z, turn

Vector: TypeAlias = ExpressionLike


def translation(
    x: ExpressionLike, y: ExpressionLike | None = None, z: ExpressionLike | None = None
) -> Expression:
    """Return the 4×4 transform that moves by (x, y, z) [m]; a single vector of three is taken apart.

    What is not given is 0.
    """
    first = as_expression(x)
    if first.shape and y is None and z is None:
        parts = _taken_apart("A translation", ("x", "y", "z"), (first,))
    else:
        others = (0.0 if y is None else y, 0.0 if z is None else z)
        parts = _taken_apart("A translation", ("x", "y", "z"), (first, *others))
    column = ca.vertcat(_ONE, _ONE, _ONE, *(p._sx for p in parts), _ONE)
    return make(ca.SX(_TRANSLATION, column), (4, 4), union(parts))


def _taken_apart(
    what: str, names: tuple[str, ...], given: tuple[ExpressionLike | None, ...]
) -> tuple[Expression, ...]:
    """Return the numbers that are given one by one, or as one vector alone.

    Raises
    ------
    ShapeError
        For more or fewer, and for arrays among them.
    """
    wanted = (
        f"{what} is given as {len(names)} numbers {', '.join(names)} or as one vector of "
        f"shape ({len(names)},) alone"
    )
    present = [as_expression(part) for part in given if part is not None]
    if len(present) == 1 and present[0].shape:
        (vector,) = present
        if vector.shape != (len(names),):
            raise ShapeError(f"{wanted}, not by something of shape {vector.shape}.")
        return tuple(vector)
    for part in present:
        if part.shape:
            raise ShapeError(f"{wanted}, not by something of shape {part.shape} among others.")
    if len(present) != len(names):
        raise ShapeError(f"{wanted}, not as {len(present)}.")
    return tuple(present)


_ONE = ca.SX(1)
_TRANSLATION = ca.Sparsity.triplet(4, 4, [0, 1, 2, 0, 1, 2, 3], [0, 1, 2, 3, 3, 3, 3])


def rotation_x(angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about x."""
    return turn(X, angle)


def rotation_y(angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about y."""
    return turn(Y, angle)


def rotation_z(angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about z."""
    return turn(Z, angle)


def axis_angle(axis: Vector, angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about ``axis`` (Rodrigues).

    Raises
    ------
    ValueRejectedError
        For a constant axis of length zero.
    """
    x, y, z = unit(axis, "The axis of a rotation")
    c, s = cos(angle), sin(angle)
    t = 1 - c
    return array(
        [
            [c + x * x * t, x * y * t - z * s, x * z * t + y * s, 0],
            [y * x * t + z * s, c + y * y * t, y * z * t - x * s, 0],
            [z * x * t - y * s, z * y * t + x * s, c + z * z * t, 0],
            [0, 0, 0, 1],
        ]
    )


def rpy(
    roll: ExpressionLike, pitch: ExpressionLike | None = None, yaw: ExpressionLike | None = None
) -> Expression:
    """Return the 4×4 rotation by roll about x, then pitch about y, then yaw about z, all fixed axes [rad].

    The three are given one by one, or as one vector of shape (3,) alone.
    """
    names = ("roll", "pitch", "yaw")
    about_x, about_y, about_z = _taken_apart("A rotation by roll, pitch and yaw", names, (roll, pitch, yaw))
    return rotation_z(about_z) @ rotation_y(about_y) @ rotation_x(about_x)


def rpy_of(a_R_b: ExpressionLike) -> Expression:
    """Return roll, pitch and yaw [rad], shape (3,), of a rotation or transform; pitch in [-π/2, π/2].

    At pitch ±π/2 roll and yaw are not defined apart: any yaw is given, and the roll that goes with it. The
    derivative does not exist there.
    """
    r = rotation_of(a_R_b)
    yaw = arctan2(r[1, 0], r[0, 0])
    c, s = cos(yaw), sin(yaw)
    return array(
        [
            # Not arctan2(r21, r22), which knows nothing of that yaw and is noise at pitch ±π/2.
            arctan2(s * r[0, 2] - c * r[1, 2], c * r[1, 1] - s * r[0, 1]),
            arctan2(-r[2, 0], norm(array([r[0, 0], r[1, 0]]))),
            yaw,
        ]
    )


def quaternion(
    x: ExpressionLike,
    y: ExpressionLike | None = None,
    z: ExpressionLike | None = None,
    w: ExpressionLike | None = None,
) -> Expression:
    """Return the 4×4 rotation of the quaternion (x, y, z, w) of any length but zero: the scalar is last.

    The four are given one by one, or as one vector of shape (4,) alone.

    Raises
    ------
    ShapeError
        For more or fewer than four.
    ValueRejectedError
        For a constant quaternion of length zero, or infinite.
    """
    q = array(list(_taken_apart("A quaternion", ("x", "y", "z", "w"), (x, y, z, w))))
    watcher = watcher_of(q)
    if watcher is not None:
        anew: Expression = watcher.ask("quaternion", q)
        return anew
    if not q.symbols:
        largest = float(np.abs(q()).max())
        if not 0 < largest < math.inf:
            raise ValueRejectedError(
                f"A quaternion of length {'zero' if not largest else 'infinity'} has no direction."
            )
        # By a power of two, which changes no digit, or the square of something tiny is nothing.
        q = q * math.ldexp(1.0, min(-math.frexp(largest)[1], 1000))
    scale = 2 / (q @ q)
    x, y, z, w = q
    return array(
        [
            [1 - scale * (y * y + z * z), scale * (x * y - z * w), scale * (x * z + y * w), 0],
            [scale * (x * y + z * w), 1 - scale * (x * x + z * z), scale * (y * z - x * w), 0],
            [scale * (x * z - y * w), scale * (y * z + x * w), 1 - scale * (x * x + y * y), 0],
            [0, 0, 0, 1],
        ]
    )


def quaternion_of(a_R_b: ExpressionLike) -> Expression:
    """Return the unit quaternion (x, y, z, w) with w >= 0, shape (4,), of a rotation or transform.

    Of the four formulas the one with the largest divisor is selected, so value and derivative are finite for
    every rotation; at angle π the sign is that of the largest component.
    """
    r = rotation_of(a_R_b)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    # 4q_i² for x, y, z, w; the columns are proportional to the quaternion.
    squares = [1 + 2 * r[i, i] - trace for i in range(3)] + [1 + trace]
    xy, xz, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    candidates = [
        array([squares[0], xy, xz, wx]),
        array([xy, squares[1], yz, wy]),
        array([xz, yz, squares[2], wz]),
        array([wx, wy, wz, squares[3]]),
    ]
    best, largest = candidates[3], squares[3]
    for candidate, square in zip(candidates[:3], squares[:3], strict=True):
        larger = _greater(square, largest)
        best, largest = where(larger, candidate, best), where(larger, square, largest)
    q = best / (2 * sqrt(largest))
    return where(_greater(0, q[3]), -q, q)


def rotation_vector(a_R_b: ExpressionLike) -> Expression:
    """Return the logarithm of a rotation or transform: axis times angle in [0, π] [rad], shape (3,).

    Value and derivative are finite for every rotation, at 0 and at π as well.
    """
    q = quaternion_of(a_R_b)
    v, w = q[:3], q[3]
    squared = v @ v
    # 2·atan2(√s, w)/√s, by its series in s/w² where s is small; the series is in no danger as w is near 1
    # there.
    small = _greater(1e-3, squared)
    ratio = squared / where(small, w * w, 1)
    series = 2 / where(small, w, 1) * _polynomial(ratio, [(-1) ** k / (2 * k + 1) for k in range(7)])
    sine = sqrt(where(small, 1, squared))
    return v * where(small, series, 2 * arctan2(sine, w) / sine)


def rotation_angle(a_R_b: ExpressionLike) -> Expression:
    """Return the angle of a rotation or transform, in [0, π] [rad]; its gradient at 0 is 0."""
    return norm(rotation_vector(a_R_b))


def exponential(rotation_vector: Vector) -> Expression:
    """Return the 4×4 rotation by the vector's length [rad] about its direction; smooth at zero."""
    v = _three(rotation_vector, "A rotation vector")
    s, c, _ = _sine_series(v @ v)
    k = skew(v)
    rotation = as_expression(np.eye(3)) + s * k + c * (k @ k)
    return transform(rotation, np.zeros(3))


def twist_exponential(twist: Vector) -> Expression:
    """Return the 4×4 transform exp(ξ) of a twist (v, ω), shape (6,) [m], [rad]; smooth at zero."""
    xi = as_expression(twist)
    if xi.shape != (6,):
        raise ShapeError(f"A twist has shape (6,), linear part first, not {xi.shape}.")
    v, omega = xi[:3], xi[3:]
    s, c, d = _sine_series(omega @ omega)
    k = skew(omega)
    kk = k @ k
    return transform(as_expression(np.eye(3)) + s * k + c * kk, v + c * (k @ v) + d * (kk @ v))


def twist_logarithm(a_T_b: ExpressionLike) -> Expression:
    """Return the twist (v, ω), shape (6,) [m], [rad], whose exponential is the transform; angles below π."""
    t = transform_like(a_T_b)
    omega = rotation_vector(t)
    s, c, _ = _sine_series(omega @ omega)
    k = skew(omega)
    angle2 = omega @ omega
    small = _greater(1e-2, angle2)
    series = _polynomial(angle2, [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000])
    factor = where(small, series, (1 - s / (2 * c)) / where(small, 1, angle2))
    p = t[:3, 3]
    v = p - (k @ p) / 2 + factor * (k @ (k @ p))
    return np.concatenate([v, omega])  # type: ignore[return-value]


def inverse(a_T_b: ExpressionLike) -> Expression:
    """Return b_T_a: (Rᵀ, -Rᵀ p), 4×4."""
    t = transform_like(a_T_b)
    r = t[:3, :3].T
    return transform(r, -(r @ t[:3, 3]))


def transform(a_R_b: ExpressionLike, a_p: Vector) -> Expression:
    """Return the 4×4 transform of a 3×3 (or 4×4) rotation and a position of shape (3,) [m]."""
    r = rotation_of(a_R_b)
    p = _three(a_p, "A position")
    upper = np.concatenate([r, p.reshape(3, 1)], axis=1)
    return np.concatenate([upper, [[0.0, 0.0, 0.0, 1.0]]])  # type: ignore[return-value]


def rotation_of(a_T_b: ExpressionLike) -> Expression:
    """Return the 3×3 rotation of a 4×4 transform; a 3×3 matrix is returned as it is."""
    t = as_expression(a_T_b)
    if t.shape == (3, 3):
        return t
    return transform_like(t)[:3, :3]


def position_of(a_T_b: ExpressionLike) -> Expression:
    """Return the position of frame b in a, shape (3,) [m]."""
    return transform_like(a_T_b)[:3, 3]


def point(x: ExpressionLike, y: ExpressionLike | None = None, z: ExpressionLike | None = None) -> Expression:
    """Return the homogeneous coordinates (x, y, z, 1) of a point: transforms move it.

    The three are given one by one, or as one vector of shape (3,) alone.
    """
    return array([*_taken_apart("A point", ("x", "y", "z"), (x, y, z)), 1])


def vector(x: ExpressionLike, y: ExpressionLike | None = None, z: ExpressionLike | None = None) -> Expression:
    """Return the homogeneous coordinates (x, y, z, 0) of a direction: transforms only turn it.

    The three are given one by one, or as one vector of shape (3,) alone.
    """
    return array([*_taken_apart("A direction", ("x", "y", "z"), (x, y, z)), 0])


def skew(v: Vector) -> Expression:
    """Return the 3×3 matrix [v]× with ``skew(v) @ w = v × w``."""
    x, y, z = _three(v, "A vector")
    return array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def adjoint(a_T_b: ExpressionLike) -> Expression:
    """Return the 6×6 matrix that maps twists (v, ω) in frame b to twists in frame a."""
    t = transform_like(a_T_b)
    r = t[:3, :3]
    upper = np.concatenate([r, skew(t[:3, 3]) @ r], axis=1)
    lower = np.concatenate([np.zeros((3, 3)), r], axis=1)
    return np.concatenate([upper, lower])  # type: ignore[return-value]


def transform_like(a_T_b: ExpressionLike) -> Expression:
    """Return the argument as an expression of shape (4, 4).

    Raises
    ------
    ShapeError
        If it has another shape.
    """
    t = as_expression(a_T_b)
    if t.shape != (4, 4):
        raise ShapeError(f"A transform is a 4×4 matrix, not of shape {t.shape}.")
    return t


def unit(v: Vector, what: str = "The vector") -> Expression:
    """Return the vector divided by its length, shape (3,).

    Raises
    ------
    ValueRejectedError
        For a constant vector of length zero.
    """
    expression = _three(v, what)
    watcher = watcher_of(expression)
    if watcher is not None:
        anew: Expression = watcher.ask("unit", expression)
        return anew
    if not expression.symbols:
        number = normalised(expression())
        if number is None:
            raise ValueRejectedError(f"{what} has length zero.")
        if expression.is_constant:
            return as_expression(number)
    return expression / norm(expression)


def normalised(v: Iterable[float]) -> tuple[float, ...] | None:
    """Return numbers divided by their length, entries within 1e-15 of 0 and ±1 exact; None if it is zero."""
    numbers = [float(c) for c in v]
    largest = max(map(abs, numbers))
    if not 0 < largest < math.inf:
        return None
    scaled = [c / largest for c in numbers]  # or the square of something tiny is nothing
    length = math.sqrt(sum(c * c for c in scaled))
    result = tuple(_snapped(c / length) for c in scaled)
    return None if any(math.isnan(c) for c in result) else result


def _snapped(number: float) -> float:
    nearest = float(round(number)) if math.isfinite(number) else number
    # Adding 0.0 turns -0.0 into 0.0.
    return (nearest if abs(number - nearest) < 1e-15 else number) + 0.0


def snapped(numbers: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return rotation entries with those within 1e-15 of 0 and ±1 made exact.

    cos(π/2) is 6e-17 in floating point; what was meant is 0, and zeros make expressions small.
    """
    return np.reshape([_snapped(n) for n in numbers.ravel().tolist()], numbers.shape)


def _three(v: Vector, what: str) -> Expression:
    expression = as_expression(v)
    if expression.shape != (3,):
        raise ShapeError(f"{what} has shape (3,), not {expression.shape}.")
    return expression


def _greater(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return 1 where a > b, else 0: a plain fact for selections, with no slope and no trend."""
    import casadi as ca

    from .expressions.expression import binary

    return binary(ca.OP_LT, b, a)


def _polynomial(x: Expression, coefficients: list[float]) -> Expression:
    result = as_expression(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = coefficient + x * result
    return result


def _sine_series(squared: Expression) -> tuple[Expression, Expression, Expression]:
    """Return sin θ/θ, (1 - cos θ)/θ² and (θ - sin θ)/θ³ of θ², by their series where θ² is small."""
    small = _greater(1e-2, squared)
    theta2 = where(small, 1, squared)
    theta = sqrt(theta2)
    exact = (sin(theta) / theta, (1 - cos(theta)) / theta2, (theta - sin(theta)) / (theta2 * theta))
    series = []
    for start in (1, 2, 3):
        coefficients, term = [], 1.0
        for k in range(2, start + 1):
            term /= k
        for k in range(7):
            coefficients.append(term)
            term *= -1 / ((start + 2 * k + 1) * (start + 2 * k + 2))
        series.append(_polynomial(squared, coefficients))
    a, b, c = (where(small, s, e) for s, e in zip(series, exact, strict=True))
    return a, b, c
