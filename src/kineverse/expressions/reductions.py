"""Sums, products, extrema and norms along axes, and running sums, with numpy's arguments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from kineverse.errors import ExpressionError, ShapeError

from . import functions as f
from . import layout
from .array_methods import Axis
from .expression import Expression, ExpressionLike, array, as_expression


def sum_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the sum over all elements, or along axes, which stay with length 1 if they are kept."""
    return _keep_axes(f.sum_along(a, axis), a, axis, keepdims)


def prod_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the product of all elements, or along axes."""
    return _keep_axes(f.product_along(a, axis), a, axis, keepdims)


def min_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the smallest of all elements, or along axes."""
    return _keep_axes(f.min_along(a, axis), a, axis, keepdims)


def max_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the largest of all elements, or along axes."""
    return _keep_axes(f.max_along(a, axis), a, axis, keepdims)


def ptp_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the largest less the smallest of all elements, or along axes."""
    return max_axes(a, axis, keepdims=keepdims) - min_axes(a, axis, keepdims=keepdims)


def mean_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the mean of all elements, or along axes.

    Raises
    ------
    ShapeError
        For that of nothing.
    """
    operand, summed = as_expression(a), f.sum_along(a, axis)
    if summed.size and not operand.size:
        raise ShapeError(f"Nothing has no mean (of shape {operand.shape}).")
    result = summed * (summed.size / operand.size) if summed.size else summed
    return _keep_axes(result, a, axis, keepdims)


def _keep_axes(result: Expression, a: ExpressionLike, axis: Axis, keepdims: bool) -> Expression:
    if not keepdims:
        return result
    shape = as_expression(a).shape
    axes = range(len(shape)) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    gone = {k % len(shape) for k in axes}
    return result.reshape(tuple(1 if k in gone else n for k, n in enumerate(shape)))


def cumsum(a: ExpressionLike, axis: int | None = None) -> Expression:
    """Return the sums up to each element, along an axis or of all elements in C order."""
    return _accumulate(lambda x, y: x + y, a, axis)


def cumprod(a: ExpressionLike, axis: int | None = None) -> Expression:
    """Return the products up to each element, along an axis or of all elements in C order."""
    return _accumulate(lambda x, y: x * y, a, axis)


def _accumulate(
    join: Callable[[Expression, Expression], Expression], a: ExpressionLike, axis: Any
) -> Expression:
    rows = _axis_to_front(
        as_expression(a).ravel() if axis is None else as_expression(a), 0 if axis is None else axis
    )
    found: list[Expression] = []
    for row in rows:
        found.append(join(found[-1], row) if found else row)
    return _axis_from_front(array(found).reshape(rows.shape), 0 if axis is None else axis)


def diff(a: ExpressionLike, n: int = 1, axis: int = -1) -> Expression:
    """Return the differences of neighbours along an axis, n times."""
    if not isinstance(n, (int, np.integer)) or n < 0:
        raise ExpressionError(f"Differences are taken a whole number of times, not {n!r}.")
    rows = _axis_to_front(as_expression(a), axis)
    for _ in range(int(n)):
        rows = rows[1:] - rows[:-1]
    return _axis_from_front(rows, axis)


def norm_axes(
    x: ExpressionLike,
    ord: Any = None,  # noqa: A002 - numpy's name
    axis: Axis = None,
    keepdims: bool = False,
) -> Expression:
    """Return the norm of an array, or of its vectors or matrices along axes.

    Of vectors there are those of order 2, 1 and ±inf, of matrices the one of Frobenius.
    """
    operand = as_expression(x)
    axes = axis if isinstance(axis, tuple) else None if axis is None else (axis,)
    dimensions = operand.ndim if axes is None else len(axes)
    if ord is not None and dimensions == 1:
        return vector_norm(operand, axis=axis, keepdims=keepdims, ord=ord)
    if ord is not None and (ord != "fro" or dimensions != 2):
        raise _no_such_norm(ord, "a matrix" if dimensions == 2 else f"an array of shape {operand.shape}")
    if axes is not None and dimensions not in (1, 2):
        raise ShapeError(f"A norm is taken along one axis or two, not along {axis}.")
    return _euclidean(operand, axis, keepdims)


def vector_norm(
    x: ExpressionLike,
    *,
    axis: Axis = None,
    keepdims: bool = False,
    ord: Any = 2,  # noqa: A002 - numpy's name
) -> Expression:
    """Return the norms of order 2, 1 or ±inf of the vectors along axes, of all elements if there are none."""
    if ord == 2:
        return _euclidean(as_expression(x), axis, keepdims)
    if ord == 1:
        return sum_axes(f.absolute(x), axis, keepdims=keepdims)
    if ord in (math.inf, -math.inf):
        return (max_axes if ord > 0 else min_axes)(f.absolute(x), axis, keepdims=keepdims)
    raise _no_such_norm(ord, "a vector")


def matrix_norm(
    x: ExpressionLike,
    *,
    keepdims: bool = False,
    ord: Any = "fro",  # noqa: A002 - numpy's name
) -> Expression:
    """Return Frobenius' norm of the matrices of the last two axes."""
    if ord not in (None, "fro"):
        raise _no_such_norm(ord, "a matrix")
    return _euclidean(as_expression(x), (-2, -1), keepdims)


def _no_such_norm(ord: Any, what: str) -> ExpressionError:  # noqa: A002
    return ExpressionError(
        f"There is no norm of order {ord!r} of {what} for expressions. Of vectors there are the Euclidean "
        "one (2, the default), 1, inf and -inf; of matrices that of Frobenius ('fro', the default)."
    )


def _euclidean(x: Expression, axis: Axis, keepdims: bool) -> Expression:
    if axis is None:
        return _keep_axes(f.norm(x), x, axis, keepdims)
    rows, rest = f.axis_first(x, axis)
    found = array([f.norm(column) for column in rows.T]).reshape(rest)
    return _keep_axes(found, x, axis, keepdims)


def _axis_to_front(x: Expression, axis: int) -> Expression:
    """Return an array with one of its axes moved to the front."""
    try:
        return x._rearranged(np.moveaxis(layout.indices(x.shape), axis, 0))
    except (ValueError, TypeError):
        raise ShapeError(f"Axis {axis} does not fit an array of shape {x.shape}.") from None


def _axis_from_front(x: Expression, axis: int) -> Expression:
    return x._rearranged(np.moveaxis(layout.indices(x.shape), 0, axis))
