"""Inverses, products, determinants and squared norms of stacks of small matrices."""

from __future__ import annotations

import numpy as np

from kineverse.lie import Array


def invert_matrices(matrices: Array) -> Array:
    """Return the inverses of positive definite matrices."""
    size = matrices.shape[-1]
    if size == 1:
        return 1.0 / matrices
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def multiply_vectors(matrices: Array, vectors: Array) -> Array:
    """Return the products of matrices (..., m, n) and vectors (..., n)."""
    result: Array = (matrices @ vectors[..., None])[..., 0]
    return result


def sum_log_determinants(matrices: Array) -> float:
    """Return the sum of the logarithms of the determinants of positive definite matrices."""
    return float(np.sum(np.linalg.slogdet(matrices)[1]))


def squared_errors(errors: Array, covariances: Array) -> Array:
    """Return the squared Mahalanobis norms eᵀ S⁻¹ e, (N,), of errors (N, m) with covariances S (N, m, m)."""
    weighted = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
    squares: Array = np.sum(errors * weighted, axis=1)
    return squares
