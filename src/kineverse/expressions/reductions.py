"""Sums, products, extrema and norms along axes, and running sums, with numpy's arguments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from kineverse.errors import ExpressionError, ShapeError

from . import layout
from .array_methods import Axis
from .expression import Expression, ExpressionLike, array, as_expression, from_casadi
from .functions import absolute, norm
from .nonsmooth import Extremum


def sum_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the sum over all elements, or along one axis or several, which keep the length 1 if kept."""
    rows, rest = axis_first(a, axis)
    total = from_casadi(ca.sum1(rows._sx).T, (rows.shape[1],), rows._nodes).reshape(rest)
    return _keep_axes(total, a, axis, keepdims)


def prod_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the product of all elements, or along one axis or several; 1 of none."""
    rows, rest = axis_first(a, axis)
    product = as_expression(np.ones(rows.shape[1]))
    for row in rows:
        product = product * row
    return _keep_axes(product.reshape(rest), a, axis, keepdims)


def min_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the smallest of all elements, or along one axis or several.

    The gradient is the mean of those of all the elements that are the smallest; see :func:`.minimum`.
    """
    return _keep_axes(_extremum(a, axis, "min"), a, axis, keepdims)


def max_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the largest of all elements, or along one axis or several.

    The gradient is the mean of those of all the elements that are the largest; see :func:`.maximum`.
    """
    return _keep_axes(_extremum(a, axis, "max"), a, axis, keepdims)


def _extremum(a: ExpressionLike, axis: Axis, which: str) -> Expression:
    rows, rest = axis_first(a, axis)
    if not rows.shape[0]:
        raise ShapeError("Nothing has no smallest or largest element.")
    columns = (tuple(column) for column in rows.T)
    found = [c[0] if len(c) == 1 else Extremum.from_arguments(c, (), (which,)) for c in columns]
    return array(found).reshape(rest)


def ptp_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the largest minus the smallest of all elements, or along one axis or several."""
    return max_axes(a, axis, keepdims=keepdims) - min_axes(a, axis, keepdims=keepdims)


def mean_axes(a: ExpressionLike, axis: Axis = None, *, keepdims: bool = False) -> Expression:
    """Return the mean of all elements, or along one axis or several."""
    operand, summed = as_expression(a), sum_axes(a, axis)
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
    along = 0 if axis is None else axis
    rows = move_axis(as_expression(a).ravel() if axis is None else as_expression(a), along, 0)
    found: list[Expression] = []
    for row in rows:
        found.append(join(found[-1], row) if found else row)
    return move_axis(array(found).reshape(rows.shape), 0, along)


def diff(a: ExpressionLike, n: int = 1, axis: int = -1) -> Expression:
    """Return the differences of neighbours along an axis, n times."""
    if not isinstance(n, (int, np.integer)) or n < 0:
        raise ExpressionError(f"Differences are taken a whole number of times, not {n!r}.")
    rows = move_axis(as_expression(a), axis, 0)
    for _ in range(int(n)):
        rows = rows[1:] - rows[:-1]
    return move_axis(rows, 0, axis)


def norm_axes(
    x: ExpressionLike,
    ord: Any = None,  # noqa: A002 - numpy's name
    axis: Axis = None,
    keepdims: bool = False,
) -> Expression:
    """Return the norm of an array, or of its vectors or matrices along axes.

    Vectors have norms of order 2, 1 and ±inf, matrices the Frobenius norm.
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
    """Return the norms of order 2, 1 or ±inf of the vectors along axes; of all elements without axes."""
    if ord == 2:
        return _euclidean(as_expression(x), axis, keepdims)
    if ord == 1:
        return sum_axes(absolute(x), axis, keepdims=keepdims)
    if ord in (math.inf, -math.inf):
        return (max_axes if ord > 0 else min_axes)(absolute(x), axis, keepdims=keepdims)
    raise _no_such_norm(ord, "a vector")


def matrix_norm(
    x: ExpressionLike,
    *,
    keepdims: bool = False,
    ord: Any = "fro",  # noqa: A002 - numpy's name
) -> Expression:
    """Return the Frobenius norm of the matrices of the last two axes."""
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
        return _keep_axes(norm(x), x, axis, keepdims)
    rows, rest = axis_first(x, axis)
    found = array([norm(column) for column in rows.T]).reshape(rest)
    return _keep_axes(found, x, axis, keepdims)


def axis_first(x: ExpressionLike, axis: Axis) -> tuple[Expression, tuple[int, ...]]:
    """Return a matrix with the given axes as rows and the others as columns, and the shape of the others."""
    operand = as_expression(x)
    axes = tuple(range(operand.ndim)) if axis is None else axis if isinstance(axis, tuple) else (axis,)
    try:
        index = np.moveaxis(layout.indices(operand.shape), axes, range(len(axes)))
    except (ValueError, TypeError):
        raise ShapeError(f"Axis {axis} does not fit an array of shape {operand.shape}.") from None
    along, rest = index.shape[: len(axes)], index.shape[len(axes) :]
    return operand._rearranged(index.reshape(math.prod(along), math.prod(rest))), rest


def move_axis(x: Expression, source: int, destination: int) -> Expression:
    """Return an array with one of its axes moved to another place."""
    if source == destination:
        return x
    try:
        index = np.moveaxis(layout.indices(x.shape), source, destination)
    except (ValueError, TypeError):
        axis = destination if source == -1 else source
        raise ShapeError(f"Axis {axis} does not fit an array of shape {x.shape}.") from None
    return x._rearranged(index)
