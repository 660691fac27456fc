"""Inverses, products and determinants of stacks of small matrices."""

from __future__ import annotations

import numpy as np

from kineverse.lie import Stack


def invert_matrices(matrices: Stack) -> Stack:
    """Return the inverses of positive definite matrices."""
    size = matrices.shape[-1]
    if size == 1:
        return 1.0 / matrices
    return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def multiply_vectors(matrices: Stack, vectors: Stack) -> Stack:
    """Return the products of matrices (..., m, n) and vectors (..., n)."""
    result: Stack = (matrices @ vectors[..., None])[..., 0]
    return result


def sum_log_determinants(matrices: Stack) -> float:
    """Return the sum of the logarithms of the determinants of positive definite matrices."""
    return float(np.sum(np.linalg.slogdet(matrices)[1]))
