"""SE(3) and SO(3) on stacks of arrays, the numeric twin of spatial."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Stack = npt.NDArray[np.float64]


def transform(rotation: Stack, position: Stack) -> Stack:
    """Return transforms of rotations (..., 3, 3) and positions (..., 3)."""
    shape = rotation.shape[:-2]
    if shape != position.shape[:-1]:
        shape = np.broadcast_shapes(shape, position.shape[:-1])
    result = np.zeros((*shape, 4, 4))
    result[..., :3, :3] = rotation
    result[..., :3, 3] = position
    result[..., 3, 3] = 1.0
    return result


def inverse(a_T_b: Stack) -> Stack:
    """Return b_T_a."""
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return transform(b_R_a, -(b_R_a @ a_T_b[..., :3, 3:])[..., 0])


def orthonormalize(a_T_b: Stack) -> Stack:
    """Return transforms whose rotations are the nearest ones, for rotations that are nearly so.

    One step of Newton's method for the polar decomposition: R (3 - RᵀR) / 2 squares the error.
    """
    rotation = a_T_b[..., :3, :3]
    nearer = 0.5 * rotation @ (3.0 * np.eye(3) - np.swapaxes(rotation, -1, -2) @ rotation)
    return transform(nearer, a_T_b[..., :3, 3])


def rotation_along_z(z: Stack) -> Stack:
    """Return a rotation (3, 3) whose last column is a direction z (3,)."""
    z = z / np.linalg.norm(z)
    # By numbers, as numpy takes long over three of them.
    z0, z1, z2 = z.tolist()
    least = int(np.argmin(np.abs(z)))
    x0, x1, x2 = ((0.0, -z2, z1), (z2, 0.0, -z0), (-z1, z0, 0.0))[least]
    length = math.hypot(x0, x1, x2)
    x0, x1, x2 = x0 / length, x1 / length, x2 / length
    y0, y1, y2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
    return np.array([[x0, y0, z0], [x1, y1, z1], [x2, y2, z2]])


def mean_rotation(rotations: Stack) -> Stack:
    """Return the rotation nearest to the mean of matrices (N, 3, 3), as one matrix."""
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    if np.linalg.det(u @ vt) < 0.0:
        u[:, 2] *= -1.0
    result: Stack = u @ vt
    return result


def skew(v: Array) -> Array:
    """Return [v]×, so that ``skew(v) @ w`` is v × w."""
    result = np.zeros((*v.shape, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -z, y, -x
    result[..., 1, 0], result[..., 2, 0], result[..., 2, 1] = z, -y, x
    return result


def exp_so3(v: Array) -> Array:
    """Return rotations by the length of v [rad] about v, (..., 3, 3), by Rodrigues' formula."""
    angle = np.sqrt(np.einsum("...i,...i->...", v, v))[..., None, None]
    k = skew(v)
    # sin(t)/t, and (1 - cos t)/t² as a square, which loses nothing near 0.
    first, second = np.sinc(angle / math.pi), 0.5 * np.sinc(0.5 * angle / math.pi) ** 2
    result: Array = np.eye(3) + first * k + second * (k @ k)
    return result


def log_so3(rotation: Array) -> Array:
    """Return rotation vectors, of a length of at most π [rad]."""
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
        result[far] = _near_half_turn(rotation[far], v[far], angle[far])
    return result


def _near_half_turn(rotation: Array, v: Array, angle: Array) -> Array:
    outer = 0.5 * (rotation + np.swapaxes(rotation, -1, -2))
    cosine = np.cos(angle)[..., None]
    outer[..., (0, 1, 2), (0, 1, 2)] -= cosine
    largest = np.argmax(np.einsum("...ii->...i", outer), axis=-1)
    axis = np.take_along_axis(outer, largest[..., None, None], axis=-1)[..., 0]
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    sign = np.where(np.einsum("...i,...i->...", axis, v) < 0.0, -1.0, 1.0)
    result: Array = axis * (sign * angle)[..., None]
    return result


def right_jacobian(v: Array) -> Array:
    """Return J with Exp(v + δ) = Exp(v) Exp(J δ) to first order, (..., 3, 3)."""
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
    """Return Jr⁻¹ at rotation vectors, (..., 3, 3): log(E·exp(a)) ≈ log E + Jr⁻¹ a.

    Jr⁻¹ = I + ½[θ]× + (1/θ² - (1 + cos θ)/(2θ sin θ)) [θ]×² (Solà et al., A micro Lie theory, Eq. 144).
    """
    squared = np.einsum("...i,...i->...", v, v)
    angle = np.sqrt(squared)
    half = np.maximum(angle, 1e-3) / 2
    # The second factor in another form, finite at π: (1 - (θ/2) cot(θ/2)) / θ².
    exact = (1 - half / np.tan(half)) / (4 * half * half)
    factor = np.where(angle > 0.02, exact, 1 / 12 + squared / 720)
    k = skew(v)
    found: Array = np.eye(3) + k / 2 + factor[..., None, None] * (k @ k)
    return found


Array = npt.NDArray[np.float64]
