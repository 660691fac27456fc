"""Inverses, products, determinants and squared norms of small matrices and of stacks of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from kineverse.errors import InvalidValueError
from kineverse.lie import Array

_SINGULAR = (
    "Some directions are known so much better than others that floating point cannot hold both: a covariance "
    "is far too small, or an uncertainty far too large."
)


@contextmanager
def singularity_named() -> Iterator[None]:
    """Raise an InvalidValueError where numpy finds a matrix singular; also a decorator of functions."""
    try:
        yield
    except np.linalg.LinAlgError:
        raise InvalidValueError(_SINGULAR) from None


def invert_matrices(matrices: Array) -> Array:
    """Invert a stack of positive definite matrices."""
    if matrices.shape[-1] == 1:
        return 1.0 / matrices
    with singularity_named():
        return np.asarray(np.linalg.inv(matrices), dtype=np.float64)


def transposed(matrices: Array) -> Array:
    """Transpose each of a stack of matrices."""
    return np.swapaxes(matrices, -1, -2)


def multiply_vectors(matrices: Array, vectors: Array) -> Array:
    """Multiply matrices (..., m, n) by vectors (..., n)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def log_determinants(matrices: Array) -> Array:
    """Return the log determinants of positive definite matrices."""
    return np.asarray(np.linalg.slogdet(matrices)[1])


def sum_log_determinants(matrices: Array) -> float:
    """Sum the log determinants of positive definite matrices."""
    return float(np.sum(log_determinants(matrices)))


def symmetric(matrix: Array) -> Array:
    """Return the symmetric part ½ (A + Aᵀ) of a matrix or a stack of them, which removes rounding errors."""
    return (matrix + transposed(matrix)) / 2


def inverse_spd(matrix: Array) -> Array:
    """Return the symmetric inverse of a positive definite matrix."""
    if matrix.shape == (1, 1) and 0.0 < matrix[0, 0] < math.inf:
        return 1.0 / matrix
    try:
        np.linalg.cholesky(matrix)
        return symmetric(np.asarray(np.linalg.inv(matrix), dtype=np.float64))
    except np.linalg.LinAlgError:
        raise InvalidValueError(_SINGULAR) from None


def squared_errors(errors: Array, covariances: Array) -> Array:
    """Return the squared Mahalanobis norms eᵀ S⁻¹ e, (N,), of errors (N, m) with covariances S (N, m, m)."""
    with singularity_named():
        weighted = np.linalg.solve(covariances, errors[:, :, None])[:, :, 0]
        return np.asarray(np.sum(errors * weighted, axis=1))
