"""Rotations, rigid transforms and twists (SO(3), SE(3)) on stacks of arrays.

The numeric twin of :mod:`kineverse.spatial`, with its names and conventions: ``a_T_b`` maps coordinates in
frame b to coordinates in frame a, angles are in [rad], lengths in [m], quaternions are (x, y, z, w), twists
have the linear part first. Rotations have the shape (..., 3, 3) and transforms (..., 4, 4), with any leading
axes. Functions that build a rotation return (..., 3, 3).

Equations are those of Barfoot, State Estimation for Robotics (2nd ed., Chapter 8), and of Solà, Deray and
Atchuthan, A micro Lie theory for state estimation in robotics (2018).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

__all__ = [
    "Array",
    "adjoint",
    "axis_angle",
    "exp_se3",
    "exp_so3",
    "inverse",
    "inverse_right_jacobian",
    "log_se3",
    "log_so3",
    "mean_rotation",
    "normalize",
    "orthonormalize",
    "pose_difference",
    "position_of",
    "quaternion",
    "retract",
    "right_jacobian",
    "rotation_along_z",
    "rotation_angle",
    "rotation_of",
    "rotation_x",
    "rotation_y",
    "rotation_z",
    "round_exact",
    "rpy",
    "skew",
    "smallest_rotation_from_z",
    "snap",
    "to_quaternion",
    "to_rpy",
    "transform",
    "translation",
    "unit_vector",
]

Array: TypeAlias = npt.NDArray[np.float64]
"""An array of float64."""

EXACT_TOLERANCE = 1e-15  # distance to 0, 1 or -1 below which an entry of a rotation is exactly that

# -- rotations -----------------------------------------------------------------------------------------------


def skew(v: Array) -> Array:
    """Return [v]×, (..., 3, 3), so that ``skew(v) @ w`` is v × w.

    Examples
    --------
    >>> kv.lie.skew(np.array([0, 0, 1.0])) @ [1, 0, 0]
    array([0., 1., 0.])
    """
    result = np.zeros((*v.shape, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -z, y, -x
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = z, -y, x
    return result


def exp_so3(v: Array) -> Array:
    """Return the rotations by the length of v [rad] about v, (..., 3, 3).

    R = I + sin θ/θ [v]× + (1 - cos θ)/θ² [v]×² (Rodrigues; Barfoot, Eq. 8.23).

    Examples
    --------
    >>> kv.lie.exp_so3(np.array([[0, 0, np.pi], [0.1, 0, 0]])).shape
    (2, 3, 3)
    """
    angle = np.sqrt(np.einsum("...i,...i->...", v, v))[..., None, None]
    k = skew(v)
    # (1 - cos θ)/θ² as a square, which loses no digits near 0.
    first, second = np.sinc(angle / math.pi), 0.5 * np.sinc(0.5 * angle / math.pi) ** 2
    result: Array = np.eye(3) + first * k + second * (k @ k)
    return result


def log_so3(rotation: Array) -> Array:
    """Return rotation vectors (..., 3), of a length of at most π [rad]: the inverse of :func:`exp_so3`.

    Examples
    --------
    >>> kv.lie.log_so3(kv.lie.rotation_y(np.array(0.5)))
    array([0. , 0.5, 0. ])
    """
    v = 0.5 * np.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        axis=-1,
    )
    cosine = 0.5 * (rotation[..., 0, 0] + rotation[..., 1, 1] + rotation[..., 2, 2] - 1.0)
    sine = np.sqrt(np.einsum("...i,...i->...", v, v))
    angle = np.arctan2(sine, cosine)
    tiny = sine < 1e-9
    result: Array = v * np.where(tiny, 1.0, angle / np.where(tiny, 1.0, sine))[..., None]
    far = cosine < -0.99
    if np.any(far):
        # The sine carries no direction near half a turn; R + Rᵀ does: it is 2(1 - cos) nnᵀ + 2 cos I.
        result[far] = _log_near_half_turn(rotation[far], v[far], angle[far])
    return result


def _log_near_half_turn(rotation: Array, v: Array, angle: Array) -> Array:
    outer = 0.5 * (rotation + np.swapaxes(rotation, -1, -2))
    cosine = np.cos(angle)[..., None]
    outer[..., (0, 1, 2), (0, 1, 2)] -= cosine
    largest = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    axis = np.take_along_axis(outer, largest[..., None, None], axis=-1)[..., 0]
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    sign = np.where(np.einsum("...i,...i->...", axis, v) < 0.0, -1.0, 1.0)
    result: Array = axis * (sign * angle)[..., None]
    return result


def rotation_angle(rotation: Array) -> Array:
    """Return the angles of rotations, in [0, π] [rad].

    Examples
    --------
    >>> kv.lie.rotation_angle(kv.lie.rpy(np.array([0.3, 0, 0])))
    np.float64(0.3)
    """
    result: Array = np.linalg.norm(log_so3(rotation), axis=-1)
    return result


def right_jacobian(v: Array) -> Array:
    """Return Jr with exp(v + δ) = exp(v) exp(Jr δ) to first order, (..., 3, 3).

    Jr = I - (1 - cos θ)/θ² [v]× + (θ - sin θ)/θ³ [v]×² (Solà et al., Eq. 143). The left Jacobian at v is the
    right one at -v.

    Examples
    --------
    >>> v, d = np.array([0.3, 0.2, 0.1]), np.array([1e-6, 0, 0])
    >>> moved = kv.lie.exp_so3(v).T @ kv.lie.exp_so3(v + d)
    >>> np.allclose(kv.lie.log_so3(moved), kv.lie.right_jacobian(v) @ d, atol=1e-11)
    True
    """
    squared = np.einsum("...i,...i->...", v, v)
    angle = np.sqrt(squared)
    small = squared < 1e-6
    divisor = np.where(small, 1.0, squared)
    c = np.where(small, 0.5 - squared / 24.0, (1.0 - np.cos(angle)) / divisor)
    d = np.where(small, 1.0 / 6.0 - squared / 120.0, (angle - np.sin(angle)) / (divisor * np.sqrt(divisor)))
    k = skew(v)
    result: Array = d[..., None, None] * (k @ k) - c[..., None, None] * k
    result[..., (0, 1, 2), (0, 1, 2)] += 1.0
    return result


def inverse_right_jacobian(v: Array) -> Array:
    """Return Jr⁻¹, (..., 3, 3): log(R exp(δ)) = log R + Jr⁻¹ δ to first order.

    Jr⁻¹ = I + ½[v]× + (1/θ² - (1 + cos θ)/(2θ sin θ)) [v]×² (Solà et al., Eq. 144).

    Examples
    --------
    >>> v = np.array([0.3, 0.2, 0.1])
    >>> np.allclose(kv.lie.inverse_right_jacobian(v) @ kv.lie.right_jacobian(v), np.eye(3))
    True
    """
    squared = np.einsum("...i,...i->...", v, v)
    angle = np.sqrt(squared)
    half = np.maximum(angle, 1e-3) / 2
    # The factor in a form that is finite at π: (1 - (θ/2) cot(θ/2)) / θ².
    exact = (1 - half / np.tan(half)) / (4 * half * half)
    factor = np.where(angle > 0.02, exact, 1 / 12 + squared / 720)
    k = skew(v)
    result: Array = np.eye(3) + k / 2 + factor[..., None, None] * (k @ k)
    return result


def rotation_x(angle: Array) -> Array:
    """Return the rotations by angles (...) [rad] about x, (..., 3, 3).

    Examples
    --------
    >>> (kv.lie.rotation_x(np.array(np.pi / 2)) @ [0, 1, 0]).round(3)
    array([0., 0., 1.])
    """
    return _rotation_about(0, angle)


def rotation_y(angle: Array) -> Array:
    """Return the rotations by angles (...) [rad] about y, (..., 3, 3).

    Examples
    --------
    >>> (kv.lie.rotation_y(np.array(np.pi / 2)) @ [0, 0, 1]).round(3)
    array([1., 0., 0.])
    """
    return _rotation_about(1, angle)


def rotation_z(angle: Array) -> Array:
    """Return the rotations by angles (...) [rad] about z, (..., 3, 3).

    Examples
    --------
    >>> kv.lie.rotation_z(np.linspace(0, 1, 5)).shape
    (5, 3, 3)
    """
    return _rotation_about(2, angle)


def _rotation_about(axis: int, angle: Array) -> Array:
    after, last = (axis + 1) % 3, (axis + 2) % 3
    result = np.zeros((*np.shape(angle), 3, 3))
    result[..., axis, axis] = 1.0
    result[..., after, after] = result[..., last, last] = np.cos(angle)
    result[..., last, after] = np.sin(angle)
    result[..., after, last] = -result[..., last, after]
    return result


def axis_angle(axis: Array, angle: Array) -> Array:
    """Return the rotations by angles (...) [rad] about axes (..., 3) of any length but zero, (..., 3, 3).

    Examples
    --------
    >>> kv.lie.axis_angle(np.array([0, 0, 2.0]), np.array(np.pi / 2)).round(3)
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    return exp_so3(unit_vector(axis) * np.asarray(angle)[..., None])


def rpy(angles: Array) -> Array:
    """Return the rotations Rz(yaw) Ry(pitch) Rx(roll) about fixed axes, of angles (..., 3) [rad].

    Examples
    --------
    >>> kv.lie.rpy(np.array([0, 0, np.pi / 2])).round(3)
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    result: Array = rotation_z(angles[..., 2]) @ rotation_y(angles[..., 1]) @ rotation_x(angles[..., 0])
    return result


def to_rpy(rotation: Array) -> Array:
    """Return roll, pitch and yaw (..., 3) [rad] of rotations; pitch in [-π/2, π/2].

    At pitch ±π/2 only a sum of roll and yaw is defined; yaw is 0 there.

    Examples
    --------
    >>> kv.lie.to_rpy(kv.lie.rpy(np.array([0.1, 0.2, 0.3]))).round(3)
    array([0.1, 0.2, 0.3])
    """
    r = rotation
    yaw = np.arctan2(r[..., 1, 0], r[..., 0, 0])
    yaw = np.where(np.abs(r[..., 1, 0]) + np.abs(r[..., 0, 0]) > 1e-12, yaw, 0.0)
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-r[..., 2, 0], c * r[..., 0, 0] + s * r[..., 1, 0])
    # Not arctan2(r21, r22), which does not depend on that yaw and is noise at pitch ±π/2.
    roll = np.arctan2(s * r[..., 0, 2] - c * r[..., 1, 2], c * r[..., 1, 1] - s * r[..., 0, 1])
    return np.stack([roll, pitch, yaw], axis=-1)


def quaternion(xyzw: Array) -> Array:
    """Return the rotations (..., 3, 3) of quaternions (..., 4) of any length but zero.

    Examples
    --------
    >>> kv.lie.quaternion(np.array([0, 0, 1, 1.0])).round(3)
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    q = unit_vector(xyzw)
    x, y, z, w = (q[..., k] for k in range(4))
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], axis=-1),
            np.stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], axis=-1),
            np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=-1),
        ],
        axis=-2,
    )


def to_quaternion(rotation: Array) -> Array:
    """Return the unit quaternions (x, y, z, w) with w >= 0 of rotations, (..., 4).

    Of the four formulas, each of which divides by a component, the one with the largest divisor is selected
    (Shepperd 1978).

    Examples
    --------
    >>> kv.lie.to_quaternion(kv.lie.rotation_z(np.array(np.pi / 2))).round(4)
    array([0.    , 0.    , 0.7071, 0.7071])
    """
    r = rotation
    # 4 q qᵀ; each row is a multiple of the quaternion.
    products = np.empty((*r.shape[:-2], 4, 4))
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    products[..., 0, 0], products[..., 1, 1] = 1 + xx - yy - zz, 1 - xx + yy - zz
    products[..., 2, 2], products[..., 3, 3] = 1 - xx - yy + zz, 1 + (xx + yy + zz)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        products[..., i, j] = products[..., j, i] = r[..., i, j] + r[..., j, i]
        products[..., 3, k] = products[..., k, 3] = r[..., j, i] - r[..., i, j]
    best = np.argmax(np.einsum("...ii->...i", products), axis=-1)
    row = unit_vector(np.take_along_axis(products, best[..., None, None], axis=-2)[..., 0, :])
    result: Array = row * np.where(row[..., 3:] < 0.0, -1.0, 1.0)
    return result


def mean_rotation(rotations: Array) -> Array:
    """Return the chordal mean (3, 3) of rotations (N, 3, 3): the rotation nearest to the mean matrix.

    Examples
    --------
    >>> kv.lie.mean_rotation(kv.lie.rotation_z(np.array([0.1, 0.3])))[0].round(4)
    array([ 0.9801, -0.1987,  0.    ])
    """
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    if np.linalg.det(u @ vt) < 0.0:
        u[:, 2] *= -1.0
    result: Array = u @ vt
    return result


def rotation_along_z(z: Array) -> Array:
    """Return a rotation (3, 3) whose last column is along z (3,).

    Its first column is perpendicular to the coordinate axis that is the farthest from z.

    Examples
    --------
    >>> kv.lie.rotation_along_z(np.array([0, 3.0, 4.0]))[:, 2]
    array([0. , 0.6, 0.8])
    """
    z = z / np.linalg.norm(z)
    # In floats: numpy's overhead on three numbers is larger than the computation.
    z0, z1, z2 = z.tolist()
    least = int(np.argmin(np.abs(z)))
    x0, x1, x2 = ((0.0, -z2, z1), (z2, 0.0, -z0), (-z1, z0, 0.0))[least]
    length = math.hypot(x0, x1, x2)
    x0, x1, x2 = x0 / length, x1 / length, x2 / length
    y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    return np.array([[x0, y0, z0], [x1, y1, z1], [x2, y2, z2]])


def smallest_rotation_from_z(z: Array) -> Array:
    """Return the rotation (3, 3) by the smallest angle that maps (0, 0, 1) to a unit vector (3,).

    It is about x if the angle is π. R = I + [v]× + [v]×²/(1 + c) with v = (0, 0, 1) × z and the cosine c.

    Examples
    --------
    >>> kv.lie.smallest_rotation_from_z(np.array([1.0, 0, 0])).round(3) + 0.0
    array([[ 0.,  0.,  1.],
           [ 0.,  1.,  0.],
           [-1.,  0.,  0.]])
    """
    v = np.array([-z[1], z[0], 0.0])
    if z[2] < 0 and not v.any():
        return np.diag([1.0, -1.0, -1.0])
    k = skew(v)
    # Near half a turn 1/(1 + c) as (1 - c)/s², because the sum cancels.
    factor = 1 / (1 + z[2]) if z[2] > 0 else (1 - z[2]) / (v @ v)
    result: Array = np.eye(3) + k + k @ k * factor
    return result


# -- transforms ----------------------------------------------------------------------------------------------


def transform(rotation: Array, position: Array) -> Array:
    """Return the transforms (..., 4, 4) of rotations (..., 3, 3) and positions (..., 3), broadcast.

    Examples
    --------
    >>> kv.lie.transform(np.eye(3), np.array([[1.0, 0, 0], [2, 0, 0]])).shape
    (2, 4, 4)
    """
    shape = rotation.shape[:-2]
    if shape != position.shape[:-1]:
        shape = np.broadcast_shapes(shape, position.shape[:-1])
    result = np.zeros((*shape, 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = position
    result[..., 3, 3] = 1.0
    return result


def translation(position: Array) -> Array:
    """Return the transforms (..., 4, 4) that move by positions (..., 3).

    Examples
    --------
    >>> kv.lie.translation(np.array([1.0, 2, 3]))
    array([[1., 0., 0., 1.],
           [0., 1., 0., 2.],
           [0., 0., 1., 3.],
           [0., 0., 0., 1.]])
    """
    return transform(np.eye(3), position)


def rotation_of(a_T_b: Array) -> Array:
    """Return the rotations (..., 3, 3) of transforms, as a view.

    Examples
    --------
    >>> kv.lie.rotation_of(np.stack([np.eye(4)] * 5)).shape
    (5, 3, 3)
    """
    return a_T_b[..., :3, :3]


def position_of(a_T_b: Array) -> Array:
    """Return the positions (..., 3) of frames b in frames a, as a view.

    Examples
    --------
    >>> kv.lie.position_of(kv.lie.translation(np.array([1.0, 2, 3])))
    array([1., 2., 3.])
    """
    return a_T_b[..., :3, 3]


def inverse(a_T_b: Array) -> Array:
    """Return b_T_a: (Rᵀ, -Rᵀ p).

    Examples
    --------
    >>> kv.lie.position_of(kv.lie.inverse(kv.lie.translation(np.array([1.0, 2, 3]))))
    array([-1., -2., -3.])
    """
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return transform(b_R_a, -(b_R_a @ a_T_b[..., :3, 3:])[..., 0])


def orthonormalize(a_T_b: Array) -> Array:
    """Return transforms with the nearest rotations, for matrices that are nearly rotations.

    One step of Newton's method for the polar decomposition: R (3 - RᵀR) / 2 squares the error.

    Examples
    --------
    >>> worn = kv.lie.translation(np.zeros(3)) + np.diag([1e-5, 0, 0, 0])
    >>> kv.lie.orthonormalize(worn)[0, 0]
    np.float64(0.9999999998499995)
    """
    rotation = a_T_b[..., :3, :3]
    nearer = 0.5 * rotation @ (3.0 * np.eye(3) - np.swapaxes(rotation, -1, -2) @ rotation)
    return transform(nearer, a_T_b[..., :3, 3])


def exp_se3(twist: Array) -> Array:
    """Return the transforms exp(ξ), (..., 4, 4), of twists (v, ω), (..., 6) [m], [rad].

    The position is J v, with the left Jacobian J at ω (Barfoot, Eq. 8.33).

    Examples
    --------
    >>> kv.lie.exp_se3(np.array([0, 0, 0.1, 0, 0, np.pi]))[:3].round(3)
    array([[-1. , -0. ,  0. ,  0. ],
           [ 0. , -1. ,  0. ,  0. ],
           [ 0. ,  0. ,  1. ,  0.1]])
    """
    v, omega = twist[..., :3], twist[..., 3:]
    return transform(exp_so3(omega), (right_jacobian(-omega) @ v[..., None])[..., 0])


def log_se3(a_T_b: Array) -> Array:
    """Return the twists (v, ω), (..., 6) [m], [rad], whose exponentials are transforms; angles below π.

    Examples
    --------
    >>> kv.lie.log_se3(kv.lie.exp_se3(np.array([0.1, 0, 0, 0, 0, 0.5]))).round(3)
    array([ 0.1, -0. ,  0. ,  0. ,  0. ,  0.5])
    """
    omega = log_so3(a_T_b[..., :3, :3])
    v = (inverse_right_jacobian(-omega) @ a_T_b[..., :3, 3:])[..., 0]
    return np.concatenate([v, omega], axis=-1)


def adjoint(a_T_b: Array) -> Array:
    """Return the matrices (..., 6, 6) that map twists (v, ω) in frames b to twists in frames a.

    [[R, [p]× R], [0, R]] (Barfoot, Eq. 8.36).

    Examples
    --------
    >>> kv.lie.adjoint(kv.lie.translation(np.array([0, 1.0, 0]))) @ [0, 0, 0, 0, 0, 1]
    array([1., 0., 0., 0., 0., 1.])
    """
    r = a_T_b[..., :3, :3]
    result = np.zeros((*r.shape[:-2], 6, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = r
    result[..., :3, 3:] = skew(a_T_b[..., :3, 3]) @ r
    return result


def retract(a_T_b: Array, error: Array) -> Array:
    """Return the poses (p + δp, exp(δθ) R), (..., 4, 4), of errors (δp, δθ), (..., 6), in axes of frame a.

    The convention of :mod:`kineverse.estimation.noise`: a retraction of R³ × SO(3), not of SE(3).

    Examples
    --------
    >>> kv.lie.position_of(kv.lie.retract(np.eye(4), np.array([0.1, 0, 0, 0, 0, 0.5])))
    array([0.1, 0. , 0. ])
    """
    return transform(exp_so3(error[..., 3:]) @ a_T_b[..., :3, :3], a_T_b[..., :3, 3] + error[..., :3])


def pose_difference(a_T_c: Array, a_T_b: Array) -> Array:
    """Return the errors (δp, δθ), (..., 6) [m], [rad], by which poses c differ from poses b.

    The inverse of :func:`retract`: δp = p_c - p_b and δθ = log(R_c R_bᵀ).

    Examples
    --------
    >>> error = np.array([0.1, 0, 0, 0, 0, 0.5])
    >>> kv.lie.pose_difference(kv.lie.retract(np.eye(4), error), np.eye(4)).round(3)
    array([0.1, 0. , 0. , 0. , 0. , 0.5])
    """
    turned = a_T_c[..., :3, :3] @ np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return np.concatenate([a_T_c[..., :3, 3] - a_T_b[..., :3, 3], log_so3(turned)], axis=-1)


# -- vectors and exact numbers -------------------------------------------------------------------------------


def unit_vector(v: Array) -> Array:
    """Return vectors (..., n) divided by their lengths, which are not zero.

    Examples
    --------
    >>> kv.lie.unit_vector(np.array([3.0, 0, 4.0]))
    array([0.6, 0. , 0.8])
    """
    result: Array = v / np.linalg.norm(v, axis=-1, keepdims=True)
    return result


def normalize(v: Iterable[float]) -> tuple[float, ...] | None:
    """Return numbers divided by their length, entries within 1e-15 of 0 and ±1 exact; None if it is zero.

    Examples
    --------
    >>> kv.lie.normalize([0, 0, 2])
    (0.0, 0.0, 1.0)
    """
    numbers = [float(c) for c in v]
    largest = max(map(abs, numbers))
    if not 0 < largest < math.inf:
        return None
    scaled = [c / largest for c in numbers]  # or the square of something tiny is 0
    length = math.sqrt(sum(c * c for c in scaled))
    result = tuple(snap(c / length) for c in scaled)
    return None if any(math.isnan(c) for c in result) else result


def snap(value: float) -> float:
    """Return 0, 1 or -1 if the value is within :data:`EXACT_TOLERANCE` of it, else the value.

    Quarter turns are written to 16 digits, whose cosine is 6e-17; taken literally, it would stay in every
    expression of a chain as a term of noise, and zeros make expressions small.

    Examples
    --------
    >>> kv.lie.snap(np.cos(np.pi / 2)), kv.lie.snap(0.5)
    (0.0, 0.5)
    """
    if abs(value) <= EXACT_TOLERANCE:
        return 0.0
    if abs(abs(value) - 1.0) <= EXACT_TOLERANCE:
        return math.copysign(1.0, value)
    return value


def round_exact(numbers: Array) -> Array:
    """Return entries of rotations, each with :func:`snap`.

    Examples
    --------
    >>> kv.lie.round_exact(kv.lie.rotation_z(np.array(np.pi / 2)))
    array([[ 0., -1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0.,  1.]])
    """
    return np.reshape([snap(n) for n in numbers.ravel().tolist()], numbers.shape)
