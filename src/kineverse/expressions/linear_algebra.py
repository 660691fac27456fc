"""Matrix and tensor products, Einstein sums, inverse, determinant, linear solve and matrix power.

Products align the axes of their operands by indices, multiply elementwise and sum, so D is that of sums and
products.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from string import ascii_letters
from typing import Any

import casadi as ca
import numpy as np

from kineverse.errors import ExpressionError, ShapeError

from . import layout
from .expression import Expression, ExpressionLike, array, as_expression, broadcast, from_casadi, matmul
from .reductions import move_axis, sum_axes


def einsum(subscripts: str, *operands: ExpressionLike) -> Expression:
    """Return the sum of products in Einstein's notation, as ``np.einsum("ij,j->i", A, x)``.

    Operands are multiplied from the left to the right. Without an arrow the result has the letters that occur
    once, in alphabetical order.
    """
    if not isinstance(subscripts, str):
        raise ExpressionError('np.einsum of expressions takes its subscripts as text: "ij,jk->ik".')
    given = [as_expression(operand) for operand in operands]
    inputs, output = _parse_subscripts(subscripts, given)
    lengths: dict[str, int] = {}
    for letters, operand in zip(inputs, given, strict=True):
        for letter, length in zip(letters, operand.shape, strict=True):
            known = lengths.setdefault(letter, length)
            if known != length and 1 not in (known, length):
                shapes = " and ".join(str(o.shape) for o in given)
                raise ShapeError(
                    f"np.einsum: {letter!r} of {subscripts!r} is an axis of length {known} and of length "
                    f"{length} (of shapes {shapes})."
                )
            lengths[letter] = max(known, length) if known and length else 0
    letters, result = inputs[0], given[0]
    for k, operand in enumerate(given[1:], start=1):
        later = set(output).union(*inputs[k + 1 :])
        joined = "".join(dict.fromkeys(letters + inputs[k]))
        kept = "".join(letter for letter in joined if letter in later)
        result = _contract([(letters, result), (inputs[k], operand)], kept, lengths)
        letters = kept
    return _contract([(letters, result)], output, lengths)


def _parse_subscripts(subscripts: str, operands: Sequence[Expression]) -> tuple[list[str], str]:
    """Return the letters of each operand and of the result, with letters in place of each ellipsis."""
    text = subscripts.replace(" ", "")
    left, arrow, right = text.partition("->")
    inputs = left.split(",")
    if len(inputs) != len(operands):
        counts = f"{len(inputs)} operands, not {len(operands)}"
        raise ExpressionError(f"np.einsum: {subscripts!r} is about {counts}.")
    free = [letter for letter in ascii_letters if letter not in text]
    hidden = ""
    for place, (part, operand) in enumerate(zip(inputs, operands, strict=True)):
        before, dots, after = part.partition("...")
        missing = operand.ndim - len(before) - len(after)
        if not set(before + after) <= set(ascii_letters):
            raise ExpressionError(f"np.einsum: {part!r} in {subscripts!r} is not made of letters.")
        if missing and not (dots and 0 < missing <= len(free)):
            shape = operand.shape
            raise ShapeError(
                f"np.einsum: {part!r} in {subscripts!r} does not fit an operand of shape {shape}."
            )
        # Axes of an ellipsis are aligned at the end, as in broadcasting.
        filled = "".join(reversed(free[:missing]))
        inputs[place] = before + filled + after
        hidden = max(hidden, filled, key=len)
    if arrow:
        before, dots, after = right.partition("...")
        output = before + (hidden if dots else "") + after
        if len(set(output)) < len(output) or set(output) - set("".join(inputs)) or (hidden and not dots):
            raise ExpressionError(
                f"np.einsum: behind the arrow of {subscripts!r} is every letter of the result once, and each "
                "of them occurs before it."
            )
    else:
        together = "".join(inputs)
        once = sorted(x for x in set(together) if together.count(x) == 1 and x not in hidden)
        output = hidden + "".join(once)
    return inputs, output


def _contract(parts: Sequence[tuple[str, Expression]], output: str, lengths: dict[str, int]) -> Expression:
    """Return the product of operands with letters for axes, summed over letters not in the output."""
    summed = "".join(dict.fromkeys(x for letters, _ in parts for x in letters if x not in output))
    kept, rest = math.prod(lengths[x] for x in output), math.prod(lengths[x] for x in summed)
    factors = [_align_axes(operand, letters, output + summed, lengths) for letters, operand in parts]
    product = factors[0].reshape(kept, rest)
    for factor in factors[1:]:
        product = product * factor.reshape(kept, rest)
    total = from_casadi(ca.sum2(product._sx), (kept,), product._nodes) if summed else product
    return total.reshape(tuple(lengths[x] for x in output))


def _align_axes(operand: Expression, letters: str, wanted: str, lengths: dict[str, int]) -> Expression:
    """Return an operand with one axis for each letter: diagonals taken, missing axes repeated."""
    index = layout.indices(operand.shape)
    unique = "".join(dict.fromkeys(letters))
    for letter in unique:
        # An axis of length 1 is repeated before the diagonal is taken.
        while letters.count(letter) > 1:
            first, second = letters.index(letter), letters.rindex(letter)
            length = max(index.shape[first], index.shape[second])
            shape = [length if k in (first, second) else n for k, n in enumerate(index.shape)]
            index = np.moveaxis(np.diagonal(np.broadcast_to(index, shape), 0, first, second), -1, first)
            letters = letters[:second] + letters[second + 1 :]
    index = np.transpose(index, [letters.index(x) for x in wanted if x in letters])
    index = index[tuple(slice(None) if x in letters else None for x in wanted)]
    return operand._rearranged(np.broadcast_to(index, tuple(lengths[x] for x in wanted)))


def stacked_product(a: Expression, b: Expression) -> Expression:
    """Return the matrix products of two stacks of matrices, broadcast against each other."""
    left, right = "j" if a.ndim == 1 else "...ij", "j" if b.ndim == 1 else "...jk"
    try:
        return einsum(f"{left},{right}->...{'i' * (a.ndim > 1)}{'k' * (b.ndim > 1)}", a, b)
    except ShapeError:
        raise ShapeError(f"Shapes {a.shape} and {b.shape} cannot be multiplied as matrices.") from None


def dot(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return numpy's dot: products, with sums over the last axis of a and the last but one of b."""
    x, y = as_expression(a), as_expression(b)
    if not x.ndim or not y.ndim:
        return x * y
    if x.ndim <= 2 and y.ndim <= 2:
        return matmul(x, y)
    return tensordot(x, y, (x.ndim - 1, max(y.ndim - 2, 0)))


def inner(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the sums of products over the last axes of both."""
    x, y = as_expression(a), as_expression(b)
    return x * y if not x.ndim or not y.ndim else tensordot(x, y, (-1, -1))


def tensordot(a: ExpressionLike, b: ExpressionLike, axes: Any = 2) -> Expression:
    """Return the sums of products over pairs of axes: a number of them, or two lists."""
    x, y = as_expression(a), as_expression(b)
    try:
        of_x: list[int] = []
        of_y: list[int] = []
        if isinstance(axes, (int, np.integer)):
            of_x, of_y = [*range(x.ndim - int(axes), x.ndim)], [*range(int(axes))]
        else:
            of_x, of_y = ([int(k)] if isinstance(k, (int, np.integer)) else [*map(int, k)] for k in axes)
        pairs = [(range(x.ndim)[i], range(y.ndim)[j]) for i, j in zip(of_x, of_y, strict=True)]
        if any(x.shape[i] != y.shape[j] for i, j in pairs):
            raise IndexError
    except (TypeError, ValueError, IndexError):
        raise ShapeError(
            f"np.tensordot: the axes {axes!r} do not pair those of shapes {x.shape} and {y.shape}."
        ) from None
    letters_of_x = list(ascii_letters[: x.ndim])
    letters_of_y = list(ascii_letters[x.ndim : x.ndim + y.ndim])
    for i, j in pairs:
        letters_of_y[j] = letters_of_x[i]
    summed = {letters_of_x[i] for i, _ in pairs}
    output = [letter for letter in letters_of_x + letters_of_y if letter not in summed]
    return einsum(f"{''.join(letters_of_x)},{''.join(letters_of_y)}->{''.join(output)}", x, y)


def vecdot(a: ExpressionLike, b: ExpressionLike, axis: int = -1) -> Expression:
    """Return the sums of products along an axis of two arrays, broadcast against each other."""
    x, y = (move_axis(as_expression(o), axis, -1) for o in (a, b))
    if x.shape[-1] != y.shape[-1]:
        raise ShapeError(f"np.vecdot: shapes {x.shape} and {y.shape} have last axes of different lengths.")
    return einsum("...i,...i->...", x, y)


def outer(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the products of each element of one with each of the other, as a matrix."""
    return as_expression(a).reshape(-1, 1) * as_expression(b).reshape(1, -1)


def kron(a: ExpressionLike, b: ExpressionLike) -> Expression:
    """Return the Kronecker product."""
    x, y = as_expression(a), as_expression(b)
    n = max(x.ndim, y.ndim)
    p, q = ((1,) * (n - o.ndim) + o.shape for o in (x, y))
    pairs = list(zip(p, q, strict=True))
    left, right = [k for i, _ in pairs for k in (i, 1)], [k for _, j in pairs for k in (1, j)]
    return (x.reshape(left) * y.reshape(right)).reshape(tuple(i * j for i, j in pairs))


def cross(
    a: ExpressionLike,
    b: ExpressionLike,
    axisa: int = -1,
    axisb: int = -1,
    axisc: int = -1,
    axis: int | None = None,
) -> Expression:
    """Return the cross products of 3-vectors along an axis of two arrays, broadcast against each other."""
    if axis is not None:
        axisa = axisb = axisc = axis
    x, y = move_axis(as_expression(a), axisa, -1), move_axis(as_expression(b), axisb, -1)
    if x.shape[-1:] != (3,) or y.shape[-1:] != (3,):
        raise ShapeError(
            f"The cross product is one of two 3-vectors, or of stacks of them along an axis, not of shapes "
            f"{as_expression(a).shape} and {as_expression(b).shape}."
        )
    if x.shape == (3,) and y.shape == (3,):
        return array([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])
    x, y = broadcast(x, y)
    following, last = [1, 2, 0], [2, 0, 1]
    product = x[..., following] * y[..., last] - x[..., last] * y[..., following]
    return move_axis(product, -1, axisc)


def matrix_inverse(matrix: ExpressionLike) -> Expression:
    """Return the inverse of a square matrix, ``D(A⁻¹) = -A⁻¹ D(A) A⁻¹``.

    For homogeneous transforms use :func:`kineverse.spatial.inverse`, which is far smaller.
    """
    a = _as_square_matrix(matrix, "an inverse")
    return from_casadi(ca.inv(a._sx), a.shape, a._nodes)


def _as_square_matrix(matrix: ExpressionLike, what: str) -> Expression:
    a = as_expression(matrix)
    if a.ndim != 2 or a.shape[0] != a.shape[1]:
        raise ShapeError(f"Only a square matrix has {what}, not one of shape {a.shape}.")
    return a


def determinant(matrix: ExpressionLike) -> Expression:
    """Return the determinant of a square matrix, a scalar."""
    a = _as_square_matrix(matrix, "a determinant")
    n = a.shape[0]
    if not n:
        return as_expression(1.0)
    if n < 5:
        return from_casadi(ca.det(a._sx), (), a._nodes)
    # Minors grow with n!; larger matrices by the characteristic polynomial (Faddeev-LeVerrier).
    identity = as_expression(np.eye(n))
    power, coefficient = identity, as_expression(1.0)
    for k in range(1, n + 1):
        product = matmul(a, power)
        coefficient = sum_axes(product[np.arange(n), np.arange(n)]) / -k
        power = product + coefficient * identity
    return coefficient if n % 2 == 0 else -coefficient


def solve_linear(matrix: ExpressionLike, right: ExpressionLike) -> Expression:
    """Return x with ``matrix @ x = right``, for a vector or a matrix on the right."""
    a, b = as_expression(matrix), as_expression(right)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or b.ndim not in (1, 2) or b.shape[0] != a.shape[0]:
        raise ShapeError(
            "A system of equations has a square matrix and a right side of as many rows, not shapes "
            f"{a.shape} and {b.shape}."
        )
    if not b.size:
        return b
    return from_casadi(ca.solve(ca.densify(a._sx), ca.densify(b._sx)), b.shape, a._nodes | b._nodes)


def matrix_power(matrix: ExpressionLike, exponent: int) -> Expression:
    """Return a square matrix to an integer power; a negative one of its inverse."""
    a = _as_square_matrix(matrix, "powers")
    if not isinstance(exponent, (int, np.integer)):
        raise ExpressionError(f"A matrix has whole powers, not {exponent!r}.")
    square, left = matrix_inverse(a) if exponent < 0 else a, abs(int(exponent))
    result = None if left else as_expression(np.eye(a.shape[0]))
    while left:
        if left % 2:
            result = square if result is None else matmul(result, square)
        left //= 2
        square = matmul(square, square) if left else square
    return as_expression(0.0) if result is None else result
