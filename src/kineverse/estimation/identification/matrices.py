"""Small matrices by the row: inverses and determinants of arrays (N, m, m)."""

from __future__ import annotations

import numpy as np

from .rigid import Array


def inverted(matrices: Array) -> Array:
    """Return the inverses of positive definite matrices."""
    size = matrices.shape[-1]
    if size == 1:
        return 1.0 / matrices
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def times(matrices: Array, vectors: Array) -> Array:
    """Return the products of matrices (..., m, n) and vectors (..., n)."""
    result: Array = (matrices @ vectors[..., None])[..., 0]
    return result


def log_determinants(matrices: Array) -> float:
    """Return the sum of the logarithms of the determinants of positive definite matrices."""
    return float(np.sum(np.linalg.slogdet(matrices)[1]))
