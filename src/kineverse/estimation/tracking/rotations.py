"""Errors of rotations, many at a time."""

from __future__ import annotations

import numpy as np

from kineverse.estimation.noise import Array


def logarithms(rotations: Array) -> Array:
    """Return axis times angle in [0, π] of rotations (m, 3, 3), shape (m, 3) [rad]; of any at π."""
    r = rotations
    double_sine = np.stack(
        [r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1
    )
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    # (v, w) of a quaternion of any length; of the four ways the one with the largest divisor.
    diagonal = np.stack([r[:, i, i] for i in range(3)], axis=1)
    squares = np.concatenate([1 + 2 * diagonal - trace[:, None], 1 + trace[:, None]], axis=1)
    best = np.argmax(squares, axis=1)
    sums = r + np.swapaxes(r, 1, 2)
    which = np.arange(len(r))
    column = np.minimum(best, 2)
    v = sums[which, :, column]
    v[which, column] = squares[which, column]
    w = double_sine[which, column]
    is_small = best == 3
    v[is_small], w[is_small] = double_sine[is_small], squares[is_small, 3]
    v, w = np.where(w < 0, -1.0, 1.0)[:, None] * v, np.abs(w)
    sine = np.sqrt(np.einsum("ij,ij->i", v, v))
    half = np.arctan2(sine, w)
    scale: Array = np.divide(2 * half, sine, out=2 / np.where(w > 0, w, 1.0), where=sine > 1e-9 * w)
    found: Array = v * scale[:, None]
    return found


def slopes_of_logarithms(vectors: Array) -> Array:
    """Return Jr⁻¹ at rotation vectors (m, 3), shape (m, 3, 3): log(E·exp(a)) ≈ log E + Jr⁻¹ a.

    Jr⁻¹ = I + ½[θ]× + (1/θ² - (1 + cos θ)/(2θ sin θ)) [θ]×² (Solà et al., A micro Lie theory, Eq. 144).
    """
    squared = np.einsum("ij,ij->i", vectors, vectors)
    angle = np.sqrt(squared)
    half = np.maximum(angle, 1e-3) / 2
    # The second factor in another form, finite at π: (1 - (θ/2) cot(θ/2)) / θ².
    exact = (1 - half / np.tan(half)) / (4 * half * half)
    factor = np.where(angle > 0.02, exact, 1 / 12 + squared / 720)
    k = np.zeros((len(vectors), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vectors[:, 2], vectors[:, 1], -vectors[:, 0]
    k -= np.swapaxes(k, 1, 2)
    found: Array = np.eye(3) + k / 2 + factor[:, None, None] * (k @ k)
    return found
