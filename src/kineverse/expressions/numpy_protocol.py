"""numpy's functions on expressions: ``np.sin(e)``, ``np.stack([a, b])``, ``array + e`` and their kin.

Functions that only rearrange elements are applied to arrays of indices, so numpy itself decides what they
mean.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any

import casadi as ca
import numpy as np

from kineverse.errors import ExpressionError, KineverseError, ShapeError

from . import functions as f
from . import layout
from .expression import Expression, array, as_expression, binary, floor_divide, make, matmul, unary, union

_UNARY_OPS = {
    np.negative: ca.OP_NEG, np.sin: ca.OP_SIN, np.cos: ca.OP_COS, np.tan: ca.OP_TAN, np.arcsin: ca.OP_ASIN,
    np.arccos: ca.OP_ACOS, np.arctan: ca.OP_ATAN, np.sinh: ca.OP_SINH, np.cosh: ca.OP_COSH,
    np.tanh: ca.OP_TANH, np.arcsinh: ca.OP_ASINH, np.arccosh: ca.OP_ACOSH, np.arctanh: ca.OP_ATANH,
    np.exp: ca.OP_EXP, np.log: ca.OP_LOG, np.sqrt: ca.OP_SQRT, np.square: ca.OP_SQ, np.absolute: ca.OP_FABS,
    np.fabs: ca.OP_FABS, np.sign: ca.OP_SIGN, np.floor: ca.OP_FLOOR, np.ceil: ca.OP_CEIL,
    np.expm1: ca.OP_EXPM1, np.log1p: ca.OP_LOG1P,
}  # fmt: skip

_BINARY_OPS = {
    np.add: ca.OP_ADD, np.subtract: ca.OP_SUB, np.multiply: ca.OP_MUL, np.true_divide: ca.OP_DIV,
    np.power: ca.OP_POW, np.float_power: ca.OP_POW, np.arctan2: ca.OP_ATAN2,
}  # fmt: skip

_UFUNCS: dict[Any, Callable[..., Any]] = {
    np.positive: as_expression,
    np.copysign: f.copysign,
    np.floor_divide: floor_divide,
    np.remainder: lambda a, b: as_expression(a) % b,
    np.minimum: f.minimum,
    np.fmin: f.fmin,
    np.maximum: f.maximum,
    np.fmax: f.fmax,
    np.hypot: f.hypot,
    np.matmul: matmul,
    np.reciprocal: lambda a: 1 / as_expression(a),
    np.less: lambda a, b: as_expression(a) < b,
    np.less_equal: lambda a, b: as_expression(a) < b,
    np.greater: lambda a, b: as_expression(a) > b,
    np.greater_equal: lambda a, b: as_expression(a) > b,
    np.logical_and: lambda a, b: as_expression(a) & b,
    np.logical_or: lambda a, b: as_expression(a) | b,
    np.logical_not: lambda a: ~as_expression(a),
    np.bitwise_and: lambda a, b: as_expression(a) & b,
    np.bitwise_or: lambda a, b: as_expression(a) | b,
    np.invert: lambda a: ~as_expression(a),
    np.deg2rad: lambda a: as_expression(a) * (np.pi / 180),
    np.radians: lambda a: as_expression(a) * (np.pi / 180),
    np.rad2deg: lambda a: as_expression(a) * (180 / np.pi),
    np.degrees: lambda a: as_expression(a) * (180 / np.pi),
    np.equal: lambda a, b: as_expression(a) == as_expression(b),
    np.not_equal: lambda a, b: as_expression(a) != as_expression(b),
}


_REDUCTIONS = {
    np.add: f.sum_along, np.multiply: f.product_along, np.minimum: f.smallest, np.maximum: f.largest,
}  # fmt: skip


def apply_ufunc(ufunc: Any, method: str, inputs: tuple[Any, ...], options: Mapping[str, Any]) -> Any:
    """Carry out a numpy ufunc on expressions.

    Raises
    ------
    ExpressionError
        For ufuncs, methods or options that have no counterpart.
    """
    if method == "reduce" and ufunc in _REDUCTIONS and not set(options) - {"axis"}:
        return _REDUCTIONS[ufunc](inputs[0], options.get("axis", 0))
    if options.get("out") is not None:
        raise ExpressionError(
            f"np.{ufunc.__name__} cannot write expressions into an existing array of numbers."
        )
    if method != "__call__":
        reducing = ", ".join(f"np.{known.__name__}" for known in _REDUCTIONS)
        raise ExpressionError(
            f"np.{ufunc.__name__}.{method} with the options {sorted(options)} is not available for "
            f"expressions; there is reduce, with axis=, of {reducing}."
        )
    if options:
        raise ExpressionError(
            f"np.{ufunc.__name__} of expressions takes no {'=, '.join(sorted(options))}=; leave it out. "
            "To select, there is np.where."
        )
    if ufunc in _UNARY_OPS:
        return unary(_UNARY_OPS[ufunc], as_expression(inputs[0]))
    if ufunc in _BINARY_OPS:
        return binary(_BINARY_OPS[ufunc], *inputs)
    if ufunc in _UFUNCS:
        return _UFUNCS[ufunc](*inputs)
    raise _unavailable(f"np.{ufunc.__name__}")


_REARRANGING = {
    np.transpose, np.reshape, np.ravel, np.squeeze, np.expand_dims, np.moveaxis, np.swapaxes, np.flip,
    np.fliplr, np.flipud, np.roll, np.tile, np.repeat, np.broadcast_to, np.diagonal, np.take, np.rot90,
    np.atleast_1d, np.atleast_2d, np.atleast_3d,
}  # fmt: skip

_AT_LEAST = {np.atleast_1d, np.atleast_2d, np.atleast_3d}
_JOINING = {np.concatenate, np.stack, np.vstack, np.hstack, np.dstack, np.column_stack}
# How many arguments come before an array to write into.
_BEFORE_OUT = {np.take: 3, np.concatenate: 2, np.stack: 2}


def apply_function(function: Any, args: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Carry out a numpy function on expressions.

    Raises
    ------
    ExpressionError
        If it is not available.
    """
    name = f"{getattr(function, '__module__', 'numpy')}.{function.__name__}"
    if function in _AT_LEAST and len(args) != 1:
        return tuple(function(as_expression(a)) for a in args)
    if function in _FUNCTIONS:
        parameters = signature(_FUNCTIONS[function])
        try:
            bound = parameters.bind(*args, **options)
        except TypeError as error:
            raise ExpressionError(
                f"{name} of expressions: {error}. Its parameters are {', '.join(parameters.parameters)}."
            ) from None
        return _FUNCTIONS[function](*bound.args, **bound.kwargs)
    if function not in _REARRANGING and function not in _JOINING:
        raise _unavailable(name)
    if (
        not args
        or {"out", "dtype", "casting"} & options.keys()
        or len(args) > _BEFORE_OUT.get(function, len(args))
    ):
        raise ExpressionError(f"{name} takes expressions as its first argument, and neither out= nor dtype=.")
    if any(isinstance(a, Expression) for a in (*args[1:], *options.values())):
        raise ExpressionError(
            f"{name} rearranges the elements of its first argument by plain numbers, not by expressions."
        )
    try:
        return (_rearrange if function in _REARRANGING else _join)(function, args[0], args[1:], options)
    except KineverseError:
        raise
    except (ValueError, IndexError) as error:
        parts = [args[0]] if function in _REARRANGING else args[0]
        shapes = " and ".join(str(as_expression(part).shape) for part in parts)
        raise ShapeError(f"{name}: {error} (of shape {shapes}).") from None
    except TypeError as error:
        raise ExpressionError(f"{name} of expressions: {error}.") from None


_INSTEAD = {
    "all": "logic, a & b", "any": "logic, a | b", "divmod": "a // b and a % b",
    "solve": "np.linalg.inv(A) @ b", "append": "np.concatenate", "block": "np.concatenate",
    "einsum": "@ and np.sum", "tensordot": "@ and np.sum", "log10": "np.log(x) / np.log(10)",
    "log2": "np.log(x) / np.log(2)", "exp2": "2**x",
}  # fmt: skip


def _unavailable(name: str) -> ExpressionError:
    instead = _INSTEAD.get(name.rpartition(".")[2])
    return ExpressionError(
        f"{name} is not available for expressions{f'; write {instead}' if instead else ''}. "
        "Of numbers it is: call the expression with values first, e({name: number})."
    )


def _rearrange(function: Any, operand: Any, args: Sequence[Any], options: Mapping[str, Any]) -> Expression:
    expression = as_expression(operand)
    index = function(layout.indices(expression.shape), *args, **options)
    return expression._rearranged(np.asarray(index))


def _join(function: Any, parts: Sequence[Any], args: Sequence[Any], options: Mapping[str, Any]) -> Expression:
    operands = [as_expression(p) for p in parts]
    offset, numbered = 0, []
    for operand in operands:
        numbered.append(layout.indices(operand.shape) + offset)
        offset += operand.size
    index = function(numbered, *args, **options)
    elements = ca.vertcat(*(layout.column(o._sx, o.shape) for o in operands))
    return make(layout.gather(elements, (offset,), index), index.shape, union(operands))


def _trace(a: Any) -> Expression:
    return f.sum_along(np.diagonal(as_expression(a)), -1)


def _cross(a: Any, b: Any) -> Expression:
    x, y = as_expression(a), as_expression(b)
    if x.shape != (3,) or y.shape != (3,):
        raise ShapeError(f"The cross product is one of two 3-vectors, not of shapes {x.shape} and {y.shape}.")
    return array([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])


def _dot(a: Any, b: Any) -> Expression:
    x, y = as_expression(a), as_expression(b)
    return x * y if not x.ndim or not y.ndim else matmul(x, y)


def _inner(a: Any, b: Any) -> Expression:
    return _dot(a, as_expression(b).T if np.ndim(a) else b)


def _clip(
    a: Any,
    a_min: Any = None,
    a_max: Any = None,
    *,
    min: Any = None,  # noqa: A002 - numpy's name
    max: Any = None,  # noqa: A002 - numpy's name
) -> Expression:
    if (a_min is not None and min is not None) or (a_max is not None and max is not None):
        raise ExpressionError("np.clip takes one lower and one upper bound: a_min or min, a_max or max.")
    lower, upper = min if a_min is None else a_min, max if a_max is None else a_max
    result = as_expression(a) if lower is None else f.maximum(a, lower)
    return result if upper is None else f.minimum(result, upper)


def _mean(a: Any, axis: int | tuple[int, ...] | None = None) -> Expression:
    total = f.sum_along(a, axis)
    if total.size and not as_expression(a).size:
        raise ShapeError(f"Nothing has no mean (of shape {as_expression(a).shape}).")
    if not total.size:
        return total
    return total * (total.size / as_expression(a).size)


def _norm(x: Any, ord: Any = None, axis: int | None = None) -> Expression:  # noqa: A002 - numpy's name
    dimensions = as_expression(x).ndim
    known = ord is None or (ord == 2 and dimensions == 1) or (ord == "fro" and dimensions == 2)
    if axis is not None or not known:
        raise ExpressionError("Of norms, the Euclidean one over all elements is available.")
    return f.norm(x)


_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.where: f.where,
    np.clip: _clip,
    np.sum: lambda a, axis=None: f.sum_along(a, axis),
    np.mean: _mean,
    np.min: lambda a, axis=None: f.smallest(a, axis),
    np.max: lambda a, axis=None: f.largest(a, axis),
    np.amin: lambda a, axis=None: f.smallest(a, axis),
    np.amax: lambda a, axis=None: f.largest(a, axis),
    np.prod: lambda a, axis=None: f.product_along(a, axis),
    np.trace: _trace,
    np.dot: _dot,
    np.inner: _inner,
    np.vdot: lambda a, b: _dot(as_expression(a).ravel(), as_expression(b).ravel()),
    np.outer: lambda a, b: as_expression(a).reshape(-1, 1) * as_expression(b).reshape(1, -1),
    np.cross: _cross,
    np.linalg.norm: _norm,
    np.linalg.inv: f.inverse,
    np.linalg.det: f.determinant,
    np.shape: lambda a: as_expression(a).shape,
    np.ndim: lambda a: as_expression(a).ndim,
    np.size: lambda a: as_expression(a).size,
    np.zeros_like: lambda a: as_expression(np.zeros(as_expression(a).shape)),
    np.ones_like: lambda a: as_expression(np.ones(as_expression(a).shape)),
    np.array_equal: lambda a, b: as_expression(a) == as_expression(b),
}
