"""Methods of numpy arrays that expressions have too."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy

from kineverse.errors import ExpressionError

if TYPE_CHECKING:
    from .expression import Expression, ExpressionLike

Axis: TypeAlias = int | tuple[int, ...] | None

np: Any = numpy  # to the type checker numpy's functions return arrays of numbers


class ArrayMethods:
    """Base of :class:`.Expression`: each method is numpy's function of the same name."""

    __slots__ = ()

    # -- rearranging ---------------------------------------------------------------------------------------

    def swapaxes(self, axis1: int, axis2: int) -> Expression:
        """Return the array with two axes exchanged."""
        return cast("Expression", np.swapaxes(self, axis1, axis2))

    def squeeze(self, axis: Axis = None) -> Expression:
        """Return the array without its axes of length 1, or without the given ones."""
        return cast("Expression", np.squeeze(self, axis))

    def diagonal(self, offset: int = 0, axis1: int = 0, axis2: int = 1) -> Expression:
        """Return a diagonal along the last axis."""
        return cast("Expression", np.diagonal(self, offset, axis1, axis2))

    def repeat(self, repeats: Any, axis: int | None = None) -> Expression:
        """Return the array with its elements repeated."""
        return cast("Expression", np.repeat(self, repeats, axis))

    def take(self, indices: Any, axis: int | None = None) -> Expression:
        """Return the elements at some places along an axis, or of all elements."""
        return cast("Expression", np.take(self, indices, axis))

    def copy(self) -> Expression:
        """Return the expression itself, which is immutable."""
        return cast("Expression", np.copy(self))

    def astype(self, dtype: Any) -> Expression:
        """Return the expression itself: its values are 64-bit floats."""
        if numpy.dtype(dtype) != numpy.float64:
            raise ExpressionError(
                f"The values of an expression are 64-bit floats, not {numpy.dtype(dtype)}. Call it with "
                "values, e({name: number}), and convert what comes out."
            )
        return self.copy()

    def item(self, *place: Any) -> Expression:
        """Return one element as a scalar: the only one, or the one at an index."""
        flat: Expression = np.ravel(self)
        if not place and flat.size != 1:
            raise ExpressionError(
                f"item() is the element of an array that has one, and this has shape {np.shape(self)}. "
                "Write e[i, j], or e.tolist() for all of them."
            )
        index = place[0] if len(place) == 1 else place or 0
        whole: Any = self
        return cast("Expression", whole[index] if isinstance(index, tuple) else flat[index])

    def tolist(self) -> Any:
        """Return nested lists of scalar expressions, and a scalar as itself."""
        rows: Any = self
        return [row.tolist() for row in rows] if np.ndim(self) else self

    # -- reductions ---------------------------------------------------------------------------------------

    def sum(self, axis: Axis = None, *, keepdims: bool = False) -> Expression:
        """Return the sum over all elements, or along one axis or several."""
        return cast("Expression", np.sum(self, axis=axis, keepdims=keepdims))

    def prod(self, axis: Axis = None, *, keepdims: bool = False) -> Expression:
        """Return the product of all elements, or along one axis or several."""
        return cast("Expression", np.prod(self, axis=axis, keepdims=keepdims))

    def mean(self, axis: Axis = None, *, keepdims: bool = False) -> Expression:
        """Return the mean of all elements, or along one axis or several."""
        return cast("Expression", np.mean(self, axis=axis, keepdims=keepdims))

    def min(self, axis: Axis = None, *, keepdims: bool = False) -> Expression:
        """Return the smallest of all elements, or along one axis or several."""
        return cast("Expression", np.min(self, axis=axis, keepdims=keepdims))

    def max(self, axis: Axis = None, *, keepdims: bool = False) -> Expression:
        """Return the largest of all elements, or along one axis or several."""
        return cast("Expression", np.max(self, axis=axis, keepdims=keepdims))

    def cumsum(self, axis: int | None = None) -> Expression:
        """Return the sums up to each element, along an axis or of all elements in C order."""
        return cast("Expression", np.cumsum(self, axis=axis))

    def cumprod(self, axis: int | None = None) -> Expression:
        """Return the products up to each element, along an axis or of all elements in C order."""
        return cast("Expression", np.cumprod(self, axis=axis))

    def trace(self, offset: int = 0, axis1: int = 0, axis2: int = 1) -> Expression:
        """Return the sum of a diagonal."""
        return cast("Expression", np.trace(self, offset, axis1, axis2))

    # -- elementwise, and products -------------------------------------------------------------------------

    def clip(self, min: Any = None, max: Any = None) -> Expression:  # noqa: A002 - numpy's names
        """Return the elements limited to [min, max]."""
        return cast("Expression", np.clip(self, min, max))

    def round(self, decimals: int = 0) -> Expression:
        """Return the elements rounded to a number of decimals; of two equally near, the even one."""
        return cast("Expression", np.round(self, decimals))

    def dot(self, other: ExpressionLike) -> Expression:
        """Return the sum of products over the last axis of this and the last but one of the other."""
        return cast("Expression", np.dot(self, other))
