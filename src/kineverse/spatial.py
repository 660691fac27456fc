"""Rotations, rigid transforms and twists (SO(3), SE(3)) as expressions.

An :class:`OneAxisTransform` is a 4×4 expression that stores its axis and amount, which is all that kinematics
needs, and builds its matrix on first access: a model has dozens of them, and most queries need a few.

``a_T_b`` is the 4×4 homogeneous transform that maps coordinates in frame b to coordinates in frame a, so
``a_T_c = a_T_b @ b_T_c``. Rotations are right-handed, angles in [rad], lengths in [m], quaternions in the
order (x, y, z, w). Axes and quaternions are normalised. Twists have the linear part first, then the angular
part.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from kineverse.errors import InvalidValueError, ShapeError
from kineverse.expressions.expression import (
    Expression,
    ExpressionLike,
    access_listener,
    array,
    as_expression,
    binary,
    from_casadi,
    union_nodes,
)
from kineverse.expressions.functions import arctan2, cos, norm, sin, sqrt, where
from kineverse.expressions.layout import SX
from kineverse.lie import normalize

__all__ = [
    "Direction",
    "OneAxisTransform",
    "VectorLike",
    "adjoint",
    "as_one_axis_transform",
    "as_transform",
    "axis_angle",
    "exp_se3",
    "exp_so3",
    "inverse",
    "log_se3",
    "log_so3",
    "point",
    "position_of",
    "quaternion",
    "rotation_about",
    "rotation_angle",
    "rotation_of",
    "rotation_x",
    "rotation_y",
    "rotation_z",
    "rpy",
    "skew",
    "to_quaternion",
    "to_rpy",
    "transform",
    "translation",
    "translation_along",
    "unit_vector",
    "vector",
]

Direction = tuple[float, float, float]
"""A unit vector of numbers."""

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)

# Rows and columns of the entries of a rotation about an axis, column by column, and the entries: cos, sin,
# -sin or 1. A sparse matrix is ten times faster to build than one element by element.
_ROTATION_ENTRIES = {
    X: ([0, 1, 2, 1, 2], [0, 1, 1, 2, 2], (3, 0, 1, 2, 0)),
    Y: ([0, 2, 1, 0, 2], [0, 0, 1, 2, 2], (0, 2, 3, 1, 0)),
    Z: ([0, 1, 0, 1, 2], [0, 0, 1, 1, 2], (0, 1, 2, 0, 3)),
}
_ROTATION_SPARSITIES = {
    axis: ca.Sparsity.triplet(3, 3, rows, columns) for axis, (rows, columns, _) in _ROTATION_ENTRIES.items()
}
_TRANSFORM_SPARSITIES = {
    axis: ca.Sparsity.triplet(4, 4, [*rows, 3], [*columns, 3])
    for axis, (rows, columns, _) in _ROTATION_ENTRIES.items()
}
_TRANSLATION_SPARSITY = ca.Sparsity.triplet(4, 4, [0, 1, 2, 0, 1, 2, 3], [0, 1, 2, 3, 3, 3, 3])
_UNIT_ENTRY = ca.SX(1)
_UNIT_TOLERANCE = 1e-9  # largest difference of the length of a direction from 1


class OneAxisTransform(Expression):
    """A 4×4 transform: a rotation about a coordinate axis or a translation along any direction.

    Attributes
    ----------
    direction
        A constant unit vector; of a rotation, one of the three coordinate axes.
    amount
        A scalar, [rad] or [m].
    is_rotation
        True for a rotation, False for a translation.

    Examples
    --------
    >>> turn = kv.rotation_z(kv.position("q") / 2)
    >>> turn.direction, turn.amount, turn.is_rotation
    ((0.0, 0.0, 1.0), q/2, True)
    """

    __slots__ = ("amount", "direction", "is_rotation")

    direction: Direction
    amount: Expression
    is_rotation: bool

    def __new__(cls, direction: Direction, amount: ExpressionLike, is_rotation: bool) -> OneAxisTransform:
        """Return a rotation or translation; see :func:`rotation_about` and :func:`translation_along`."""
        self = object.__new__(cls)
        self.direction, self.amount, self.is_rotation = direction, as_expression(amount), is_rotation
        if self.amount.shape:
            what = "An angle" if is_rotation else "A distance"
            raise ShapeError(f"{what} is a scalar, not of shape {self.amount.shape}.")
        self._describe((4, 4), self.amount._nodes)
        return self

    def __getattr__(self, name: str) -> Any:
        # Called for missing attributes: the graph before its first access.
        if name != "_sx":
            return super().__getattr__(name)  # type: ignore[misc]
        if self.is_rotation:
            graph = ca.SX(_TRANSFORM_SPARSITIES[self.direction], ca.vertcat(*self._entries(), _UNIT_ENTRY))
        else:
            graph = ca.SX(
                _TRANSLATION_SPARSITY,
                ca.vertcat(_UNIT_ENTRY, _UNIT_ENTRY, _UNIT_ENTRY, self.offset, _UNIT_ENTRY),
            )
        self._sx = graph
        return graph

    @property
    def rotation(self) -> SX:
        """The 3×3 matrix of a rotation."""
        return ca.SX(_ROTATION_SPARSITIES[self.direction], ca.vertcat(*self._entries()))

    @property
    def offset(self) -> SX:
        """The offset of a translation, 3×1."""
        sx = self.amount._sx
        return ca.vertcat(*(sx if d == 1 else ca.SX(d) if d == 0 else d * sx for d in self.direction))

    def _entries(self) -> list[SX]:
        angle = self.amount._sx
        sine = ca.SX.unary(ca.OP_SIN, angle)
        entries = (ca.SX.unary(ca.OP_COS, angle), sine, ca.SX.unary(ca.OP_NEG, sine), _UNIT_ENTRY)
        return [entries[i] for i in _ROTATION_ENTRIES[self.direction][2]]

    @property
    def is_constant(self) -> bool:
        """True if the amount is constant."""
        return self.amount.is_constant

    def __reduce__(self) -> Any:
        return OneAxisTransform, (self.direction, self.amount, self.is_rotation)


def rotation_about(axis: Direction, angle: ExpressionLike) -> OneAxisTransform:
    """Return the 4×4 rotation about the coordinate axis X, Y or Z by ``angle`` [rad].

    Examples
    --------
    >>> kv.spatial.rotation_about((0.0, 0.0, 1.0), kv.position("q"))[:2, 0]
    Expression(2,)[cos(q), sin(q)]
    """
    return OneAxisTransform(axis, angle, True)


def translation_along(direction: Direction, distance: ExpressionLike) -> OneAxisTransform:
    """Return the 4×4 translation along a constant unit vector by ``distance`` [m].

    Examples
    --------
    >>> kv.spatial.translation_along((0.6, 0.0, 0.8), kv.position("q"))[:3, 3]
    Expression(3,)[0.6*q, 0, 0.8*q]
    """
    return OneAxisTransform(direction, distance, False)


def as_one_axis_transform(transform: Expression) -> Expression:
    """Return a transform as a :class:`OneAxisTransform` if its matrix is one, else as it is.

    So kinematics treats a rotation or translation alike however it was written, also after it was stored as a
    matrix.

    Examples
    --------
    >>> turn = kv.rotation_z(kv.position("q"))
    >>> kv.spatial.as_one_axis_transform(kv.array(turn)).direction
    (0.0, 0.0, 1.0)
    """
    if isinstance(transform, OneAxisTransform):
        # Along a skew line, the matrix does not separate factors of the amount from those of the direction.
        is_skew = not transform.is_rotation and sum(d != 0 for d in transform.direction) > 1
        return transform if not is_skew else _as_translation(transform)
    sparsity = transform._sx.sparsity()
    if sparsity == _TRANSLATION_SPARSITY:
        return _as_translation(transform)
    for axis, pattern in _TRANSFORM_SPARSITIES.items():
        if sparsity == pattern:
            return _as_rotation(transform, axis)
    return transform


def _as_rotation(transform: Expression, axis: Direction) -> Expression:
    *entries, one = transform._sx.nonzeros()
    sine = entries[_ROTATION_ENTRIES[axis][2].index(1)]
    if sine.op() != ca.OP_SIN or not one.is_one():
        return transform
    motion = rotation_about(axis, from_casadi(sine.dep(0), (), transform._nodes))
    same = zip(entries, motion._entries(), strict=True)
    return motion if all(ca.is_equal(a, b, 2) for a, b in same) else transform


def _as_translation(transform: Expression) -> Expression:
    nonzeros = transform._sx.nonzeros()
    parts = nonzeros[3:6]
    moving = [k for k, part in enumerate(parts) if not part.is_constant()]
    if not moving or not all(e.is_one() for e in (*nonzeros[:3], nonzeros[6])):
        return transform
    if any(not part.is_zero() for k, part in enumerate(parts) if k not in moving):
        return transform
    if len(moving) == 1:
        axis = (X, Y, Z)[moving[0]]
        return translation_along(axis, from_casadi(parts[moving[0]], (), transform._nodes))
    direction, amount = [0.0, 0.0, 0.0], None
    for k in moving:
        factor, rest = _split_factor(parts[k])
        if amount is not None and not ca.is_equal(amount, rest, 1):
            return _without_axis(transform)
        direction[k], amount = factor, rest
    motion = translation_along(
        (direction[0], direction[1], direction[2]), from_casadi(amount, (), transform._nodes)
    )
    is_same = all(ca.is_equal(a, b, 2) for a, b in zip(parts, motion.offset.nonzeros(), strict=True))
    return (
        motion if is_same and abs(math.hypot(*direction) - 1) <= _UNIT_TOLERANCE else _without_axis(transform)
    )


def _split_factor(part: SX) -> tuple[float, SX]:
    if part.op() == ca.OP_NEG:
        factor, rest = _split_factor(part.dep(0))
        return -factor, rest
    if part.op() == ca.OP_MUL:
        for k in (0, 1):
            if part.dep(k).is_constant():
                return float(part.dep(k)), part.dep(1 - k)
    return 1.0, part


def _without_axis(transform: Expression) -> Expression:
    if not isinstance(transform, OneAxisTransform):
        return transform
    return from_casadi(transform._sx, transform.shape, transform._nodes)


VectorLike: TypeAlias = ExpressionLike
"""A vector of three elements, numbers or expressions."""


def translation(
    x: ExpressionLike, y: ExpressionLike | None = None, z: ExpressionLike | None = None
) -> Expression:
    """Return the 4×4 translation by (x, y, z) [m], given one by one or as one vector of shape (3,).

    Missing coordinates are 0.

    Examples
    --------
    >>> kv.translation(kv.position("drawer"), 0, 0.5)[:3, 3]
    Expression(3,)[drawer, 0, 0.5]
    >>> kv.translation([1, 2, 3])()[:3, 3]
    array([1., 2., 3.])
    """
    first = as_expression(x)
    if first.shape and y is None and z is None:
        parts = _components("A translation", ("x", "y", "z"), (first,))
    else:
        others = (0.0 if y is None else y, 0.0 if z is None else z)
        parts = _components("A translation", ("x", "y", "z"), (first, *others))
    column = ca.vertcat(_UNIT_ENTRY, _UNIT_ENTRY, _UNIT_ENTRY, *(p._sx for p in parts), _UNIT_ENTRY)
    return from_casadi(ca.SX(_TRANSLATION_SPARSITY, column), (4, 4), union_nodes(parts))


def _components(
    what: str, names: tuple[str, ...], given: tuple[ExpressionLike | None, ...]
) -> tuple[Expression, ...]:
    """Return the numbers that are given one by one, or as a single vector."""
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


def rotation_x(angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about x.

    Examples
    --------
    >>> (kv.rotation_x(np.pi / 2) @ kv.spatial.point(0, 1, 0))().round(3)
    array([0., 0., 1., 1.])
    """
    return rotation_about(X, angle)


def rotation_y(angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about y.

    Examples
    --------
    >>> (kv.rotation_y(np.pi / 2) @ kv.spatial.point(0, 0, 1))().round(3)
    array([1., 0., 0., 1.])
    """
    return rotation_about(Y, angle)


def rotation_z(angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about z.

    Examples
    --------
    >>> kv.rotation_z(kv.position("door"))[:2, :2]
    Expression(2, 2)[cos(door), -sin(door), sin(door), cos(door)]
    >>> kv.rotation_z(np.deg2rad(90))()[:2, :2].round(3)
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    return rotation_about(Z, angle)


def axis_angle(axis: VectorLike, angle: ExpressionLike) -> Expression:
    """Return the 4×4 rotation by ``angle`` [rad] about ``axis`` (Rodrigues).

    Raises
    ------
    InvalidValueError
        For a constant axis of length zero.

    Examples
    --------
    >>> kv.axis_angle((1, 1, 1), 2 * np.pi / 3)().round(3)[:3, :3] + 0.0
    array([[0., 0., 1.],
           [1., 0., 0.],
           [0., 1., 0.]])
    >>> kv.axis_angle((0, 0, 0), kv.position("q"))
    Traceback (most recent call last):
        ...
    kineverse.errors.InvalidValueError: The axis of a rotation has length zero.
    """
    x, y, z = unit_vector(axis, "The axis of a rotation")
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

    Examples
    --------
    >>> yaw = kv.rpy(0, 0, kv.position("yaw"))
    >>> yaw[:2, 0]
    Expression(2,)[cos(yaw), sin(yaw)]
    >>> kv.spatial.to_rpy(kv.rpy(0.1, 0.2, 0.3))().round(3)
    array([0.1, 0.2, 0.3])
    """
    names = ("roll", "pitch", "yaw")
    about_x, about_y, about_z = _components("A rotation by roll, pitch and yaw", names, (roll, pitch, yaw))
    return rotation_z(about_z) @ rotation_y(about_y) @ rotation_x(about_x)


def to_rpy(a_R_b: ExpressionLike) -> Expression:
    """Return roll, pitch and yaw [rad], shape (3,), of a rotation or transform; pitch in [-π/2, π/2].

    At pitch ±π/2 only a sum of roll and yaw is defined; the result is any yaw with the corresponding roll.
    The derivative does not exist there.

    Examples
    --------
    >>> kv.spatial.to_rpy(kv.rpy(0.1, 0.2, 0.3))().round(3)
    array([0.1, 0.2, 0.3])
    """
    r = rotation_of(a_R_b)
    yaw = arctan2(r[1, 0], r[0, 0])
    c, s = cos(yaw), sin(yaw)
    return array(
        [
            # Not arctan2(r21, r22), which does not depend on that yaw and is noise at pitch ±π/2.
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
    """Return the 4×4 rotation of a quaternion (x, y, z, w) of any length but zero, the scalar last.

    The four are given one by one, or as one vector of shape (4,) alone.

    Raises
    ------
    InvalidValueError
        For a constant quaternion of length zero, or infinite.

    Examples
    --------
    >>> kv.quaternion(0, 0, 1, 1)()[:3, :3].round(3)
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    q = array(list(_components("A quaternion", ("x", "y", "z", "w"), (x, y, z, w))))
    listener = access_listener(q)
    if listener is not None:
        result: Expression = listener.ask("quaternion", q)
        return result
    if not q.symbols:
        largest = float(np.abs(q()).max())
        if not 0 < largest < math.inf:
            raise InvalidValueError(
                f"A quaternion of length {'zero' if not largest else 'infinity'} has no direction."
            )
        # Scaled by a power of two, which is exact, because the square of a tiny number underflows.
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


def to_quaternion(a_R_b: ExpressionLike) -> Expression:
    """Return the unit quaternion (x, y, z, w) with w >= 0, shape (4,), of a rotation or transform.

    Of the four formulas the one with the largest divisor is selected, so value and derivative are finite for
    every rotation; at angle π the sign is that of the largest component.

    Examples
    --------
    >>> kv.spatial.to_quaternion(kv.rotation_z(np.pi / 2))().round(4)
    array([0.    , 0.    , 0.7071, 0.7071])
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


def log_so3(a_R_b: ExpressionLike) -> Expression:
    """Return the logarithm of a rotation or transform: axis times angle in [0, π] [rad], shape (3,).

    Value and derivative are finite for every rotation, at 0 and at π as well.

    Examples
    --------
    >>> kv.spatial.log_so3(kv.rotation_y(kv.position("q")))({"q": 0.5})
    array([0. , 0.5, 0. ])
    """
    q = to_quaternion(a_R_b)
    v, w = q[:3], q[3]
    squared = v @ v
    # 2·atan2(√s, w)/√s, by its series in s/w² where s is small and w is near 1.
    small = _greater(1e-3, squared)
    ratio = squared / where(small, w * w, 1)
    series = 2 / where(small, w, 1) * _polynomial(ratio, [(-1) ** k / (2 * k + 1) for k in range(7)])
    sine = sqrt(where(small, 1, squared))
    return v * where(small, series, 2 * arctan2(sine, w) / sine)


def rotation_angle(a_R_b: ExpressionLike) -> Expression:
    """Return the angle of a rotation or transform, in [0, π] [rad]; its gradient at 0 is 0.

    Examples
    --------
    >>> turned = kv.rotation_x(0.3) @ kv.rotation_y(kv.position("q"))
    >>> kv.spatial.rotation_angle(turned)({"q": 0.4}).round(4)
    np.float64(0.4988)
    """
    return norm(log_so3(a_R_b))


def exp_so3(rotation_vector: VectorLike) -> Expression:
    """Return the 4×4 rotation by the vector's length [rad] about its direction; smooth at zero.

    Examples
    --------
    >>> kv.spatial.exp_so3([0, 0, np.pi / 2])()[:2, :2].round(3)
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    v = _as_vector3(rotation_vector, "A rotation vector")
    s, c, _ = _sine_series(v @ v)
    k = skew(v)
    rotation = as_expression(np.eye(3)) + s * k + c * (k @ k)
    return transform(rotation, np.zeros(3))


def exp_se3(twist: VectorLike) -> Expression:
    """Return the 4×4 transform exp(ξ) of a twist (v, ω), shape (6,) [m], [rad]; smooth at zero.

    Examples
    --------
    >>> screw = kv.spatial.exp_se3([0, 0, 0.1, 0, 0, np.pi])  # half a turn about z, 0.1 m along it
    >>> screw()[:3].round(3)
    array([[-1. , -0. ,  0. ,  0. ],
           [ 0. , -1. ,  0. ,  0. ],
           [ 0. ,  0. ,  1. ,  0.1]])
    """
    xi = as_expression(twist)
    if xi.shape != (6,):
        raise ShapeError(f"A twist has shape (6,), linear part first, not {xi.shape}.")
    v, omega = xi[:3], xi[3:]
    s, c, d = _sine_series(omega @ omega)
    k = skew(omega)
    kk = k @ k
    return transform(as_expression(np.eye(3)) + s * k + c * kk, v + c * (k @ v) + d * (kk @ v))


def log_se3(a_T_b: ExpressionLike) -> Expression:
    """Return the twist (v, ω), shape (6,) [m], [rad], whose exponential is the transform; angles below π.

    Examples
    --------
    >>> kv.spatial.log_se3(kv.translation(1, 0, 0) @ kv.rotation_x(0.5))().round(3)
    array([1. , 0. , 0. , 0.5, 0. , 0. ])
    """
    t = as_transform(a_T_b)
    omega = log_so3(t)
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
    """Return b_T_a: (Rᵀ, -Rᵀ p), 4×4.

    Examples
    --------
    >>> world_T_door = kv.translation(1, 0, 0) @ kv.rotation_z(kv.position("door"))
    >>> door_T_world = kv.inverse(world_T_door)
    >>> (door_T_world @ world_T_door)({"door": 0.3}).round(9)
    array([[1., 0., 0., 0.],
           [0., 1., 0., 0.],
           [0., 0., 1., 0.],
           [0., 0., 0., 1.]])
    """
    t = as_transform(a_T_b)
    r = t[:3, :3].T
    return transform(r, -(r @ t[:3, 3]))


def transform(a_R_b: ExpressionLike, a_p: VectorLike) -> Expression:
    """Return the 4×4 transform of a 3×3 (or 4×4) rotation and a position of shape (3,) [m].

    Examples
    --------
    >>> a_T_b = kv.transform(kv.rotation_z(kv.position("q")), [1, 2, 3])
    >>> a_T_b({"q": np.pi / 2})[:3].round(3)
    array([[ 0., -1.,  0.,  1.],
           [ 1.,  0.,  0.,  2.],
           [ 0.,  0.,  1.,  3.]])
    """
    r = rotation_of(a_R_b)
    p = _as_vector3(a_p, "A position")
    upper = np.concatenate([r, p.reshape(3, 1)], axis=1)
    return np.concatenate([upper, [[0.0, 0.0, 0.0, 1.0]]])  # type: ignore[return-value]


def rotation_of(a_T_b: ExpressionLike) -> Expression:
    """Return the 3×3 rotation of a 4×4 transform; a 3×3 matrix is returned as it is.

    Examples
    --------
    >>> kv.spatial.rotation_of(kv.translation(1, 2, 3)).shape
    (3, 3)
    """
    t = as_expression(a_T_b)
    if t.shape == (3, 3):
        return t
    return as_transform(t)[:3, :3]


def position_of(a_T_b: ExpressionLike) -> Expression:
    """Return the position of frame b in a, shape (3,) [m].

    Examples
    --------
    >>> kv.spatial.position_of(kv.rotation_z(kv.position("q")) @ kv.translation(0.4, 0, 0))
    Expression(3,)[0.4*cos(q), 0.4*sin(q), 0]
    """
    return as_transform(a_T_b)[:3, 3]


def point(x: ExpressionLike, y: ExpressionLike | None = None, z: ExpressionLike | None = None) -> Expression:
    """Return the homogeneous coordinates (x, y, z, 1) of a point, which transforms rotate and translate.

    The three are given one by one, or as one vector of shape (3,) alone.

    Examples
    --------
    >>> (kv.translation(1, 0, 0) @ kv.spatial.point(0, 0.2, 0))()
    array([1. , 0.2, 0. , 1. ])
    """
    return array([*_components("A point", ("x", "y", "z"), (x, y, z)), 1])


def vector(x: ExpressionLike, y: ExpressionLike | None = None, z: ExpressionLike | None = None) -> Expression:
    """Return the homogeneous coordinates (x, y, z, 0) of a direction, which transforms only rotate.

    The three are given one by one, or as one vector of shape (3,) alone.

    Examples
    --------
    >>> (kv.translation(1, 0, 0) @ kv.spatial.vector(0, 0.2, 0))()
    array([0. , 0.2, 0. , 0. ])
    """
    return array([*_components("A direction", ("x", "y", "z"), (x, y, z)), 0])


def skew(v: VectorLike) -> Expression:
    """Return the 3×3 matrix [v]× with ``skew(v) @ w = v × w``.

    Examples
    --------
    >>> (kv.spatial.skew([0, 0, 1]) @ np.array([1, 0, 0]))()
    array([0., 1., 0.])
    """
    x, y, z = _as_vector3(v, "A vector")
    return array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def adjoint(a_T_b: ExpressionLike) -> Expression:
    """Return the 6×6 matrix that maps twists (v, ω) in frame b to twists in frame a.

    Examples
    --------
    >>> a_T_b = kv.translation(0, 1, 0)
    >>> (kv.spatial.adjoint(a_T_b) @ np.array([0, 0, 0, 0, 0, 1]))()
    array([1., 0., 0., 0., 0., 1.])
    """
    t = as_transform(a_T_b)
    r = t[:3, :3]
    upper = np.concatenate([r, skew(t[:3, 3]) @ r], axis=1)
    lower = np.concatenate([np.zeros((3, 3)), r], axis=1)
    return np.concatenate([upper, lower])  # type: ignore[return-value]


def as_transform(a_T_b: ExpressionLike) -> Expression:
    """Return the argument as an expression of shape (4, 4).

    Examples
    --------
    >>> kv.spatial.as_transform(np.eye(4)).shape
    (4, 4)
    >>> kv.spatial.as_transform([1, 2, 3])
    Traceback (most recent call last):
        ...
    kineverse.errors.ShapeError: A transform is a 4×4 matrix, not of shape (3,).
    """
    t = as_expression(a_T_b)
    if t.shape != (4, 4):
        raise ShapeError(f"A transform is a 4×4 matrix, not of shape {t.shape}.")
    return t


def unit_vector(v: VectorLike, what: str = "The vector") -> Expression:
    """Return the vector divided by its length, shape (3,).

    Raises
    ------
    InvalidValueError
        For a constant vector of length zero.

    Examples
    --------
    >>> kv.spatial.unit_vector([3, 0, 4])()
    array([0.6, 0. , 0.8])
    """
    expression = _as_vector3(v, what)
    listener = access_listener(expression)
    if listener is not None:
        result: Expression = listener.ask("unit", expression)
        return result
    if not expression.symbols:
        number = normalize(expression())
        if number is None:
            raise InvalidValueError(f"{what} has length zero.")
        if expression.is_constant:
            return as_expression(number)
    return expression / norm(expression)


def _as_vector3(v: VectorLike, what: str) -> Expression:
    expression = as_expression(v)
    if expression.shape != (3,):
        raise ShapeError(f"{what} has shape (3,), not {expression.shape}.")
    return expression


def _greater(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return 1 where a > b, else 0: a comparison for selections, without gradient and trend."""
    return binary(ca.OP_LT, b, a)


def _polynomial(x: Expression, coefficients: list[float]) -> Expression:
    result = as_expression(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = coefficient + x * result
    return result


def _sine_series(squared: Expression) -> tuple[Expression, Expression, Expression]:
    """Return sin θ/θ, (1 - cos θ)/θ² and (θ - sin θ)/θ³ of θ², by Taylor series where θ² is small."""
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
