"""Storage of arrays of any dimension in CasADi's two-dimensional matrices.

An expression of shape ``(a, b, c)`` is stored as an ``SX`` of ``a*b`` rows and ``c`` columns, a vector as one
column, a scalar as 1×1. Rearrangements are computed by numpy on arrays of indices and applied once to the
elements.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
import numpy.typing as npt

SX: TypeAlias = Any
ArrayShape: TypeAlias = tuple[int, ...]
IndexArray: TypeAlias = npt.NDArray[np.intp]


def rows_and_columns(shape: ArrayShape) -> tuple[int, int]:
    """Return the size of the matrix that stores an array of this shape."""
    if not shape:
        return 1, 1
    if len(shape) == 1:
        return shape[0], 1
    return math.prod(shape[:-1]), shape[-1]


def indices(shape: ArrayShape) -> IndexArray:
    """Return an array of this shape that numbers the elements in C order."""
    return np.arange(math.prod(shape)).reshape(shape)


def gather(sx: SX, shape: ArrayShape, index: IndexArray) -> SX:
    """Return the matrix that stores ``array.ravel()[index]``, for ``sx`` storing an array of ``shape``."""
    rows, columns = rows_and_columns(shape)
    if rows > 1 and columns > 1:
        index = (index % columns) * rows + index // columns
    out_rows, out_columns = rows_and_columns(index.shape)
    flat = index.reshape(out_rows, out_columns).T.ravel().tolist()
    if len(flat) == 1:
        return sx[flat[0]]
    return ca.reshape(sx[flat], out_rows, out_columns)


def column(sx: SX, shape: ArrayShape) -> SX:
    """Return the elements in C order as one column."""
    if sx.shape[1] == 1:
        return sx
    return ca.reshape(sx.T, sx.numel(), 1)


def from_column(sx: SX, shape: ArrayShape) -> SX:
    """Return the matrix that stores an array of this shape, from its :func:`column`."""
    rows, columns = rows_and_columns(shape)
    if columns == 1:
        return ca.reshape(sx, rows, 1) if sx.shape[0] != rows else sx
    return ca.reshape(sx, columns, rows).T


def from_array(array: npt.NDArray[Any]) -> SX:
    """Return the matrix that stores an array of numbers."""
    return ca.SX(ca.DM(array.reshape(rows_and_columns(array.shape))))
