"""numpy's functions on expressions: ``np.sin(e)``, ``np.stack([a, b])``, ``array + e``.

Functions that only rearrange elements are applied to arrays of indices, so numpy itself defines their result.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from inspect import signature
from typing import Any

import casadi as ca
import numpy as np

from kineverse.errors import ExpressionError, KineverseError, ShapeError

from . import functions as f
from . import layout
from . import linear_algebra as c
from . import reductions as r
from .expression import Expression, as_expression, binary, from_casadi, matmul, unary, union_nodes

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
    np.arctan2: ca.OP_ATAN2, np.fmod: ca.OP_FMOD,
}  # fmt: skip

_UFUNCS: dict[Any, Callable[..., Any]] = {
    np.positive: as_expression,
    np.copysign: f.copysign,
    np.power: f.power,
    np.float_power: f.power,
    np.floor_divide: f.floor_divide,
    np.remainder: f.remainder,
    np.divmod: lambda a, b: (f.floor_divide(a, b), f.remainder(a, b)),
    np.rint: f.rint,
    np.trunc: f.trunc,
    np.log10: f.log10,
    np.log2: f.log2,
    np.exp2: lambda a: f.power(2.0, a),
    np.cbrt: f.cbrt,
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

# Functions that version 2 of numpy added.
_LATER_UFUNCS: dict[str, Callable[..., Any]] = {
    "vecdot": c.vecdot,
    "matvec": lambda a, x: c.einsum("...ij,...j->...i", a, x),
    "vecmat": lambda x, a: c.einsum("...i,...ij->...j", x, a),
}
_UFUNCS |= {getattr(np, name): function for name, function in _LATER_UFUNCS.items() if hasattr(np, name)}

_REDUCTIONS = {np.add: r.sum_axes, np.multiply: r.prod_axes, np.minimum: r.min_axes, np.maximum: r.max_axes}
_AXIS_OF_ITS_OWN = {getattr(np, "vecdot", None)}


def apply_ufunc(ufunc: Any, method: str, inputs: tuple[Any, ...], options: Mapping[str, Any]) -> Any:
    """Carry out a numpy ufunc on expressions."""
    if method == "reduce" and ufunc in _REDUCTIONS and not set(options) - {"axis", "keepdims"}:
        return _REDUCTIONS[ufunc](inputs[0], options.get("axis", 0), keepdims=options.get("keepdims", False))
    if options.get("out") is not None:
        name = f"np.{ufunc.__name__}"
        raise ExpressionError(f"{name} cannot write expressions into an existing array of numbers.")
    if method != "__call__":
        reducing = ", ".join(f"np.{known.__name__}" for known in _REDUCTIONS)
        raise ExpressionError(
            f"np.{ufunc.__name__}.{method} with the options {sorted(options)} is not available for "
            f"expressions; there is reduce, with axis= and keepdims=, of {reducing}."
        )
    if options and not (ufunc in _AXIS_OF_ITS_OWN and set(options) == {"axis"}):
        raise ExpressionError(
            f"np.{ufunc.__name__} of expressions takes no {'=, '.join(sorted(options))}=; leave it out. "
            "To select, there is np.where."
        )
    if ufunc in _UNARY_OPS:
        return unary(_UNARY_OPS[ufunc], as_expression(inputs[0]))
    if ufunc in _BINARY_OPS:
        return binary(_BINARY_OPS[ufunc], *inputs)
    if ufunc in _UFUNCS:
        return _UFUNCS[ufunc](*inputs, **options)
    raise _unavailable(f"np.{ufunc.__name__}")


_REARRANGING = {
    np.transpose, np.reshape, np.ravel, np.squeeze, np.expand_dims, np.moveaxis, np.swapaxes, np.flip,
    np.fliplr, np.flipud, np.roll, np.tile, np.repeat, np.broadcast_to, np.diagonal, np.take, np.rot90,
    np.delete, np.atleast_1d, np.atleast_2d, np.atleast_3d, np.split, np.array_split, np.hsplit, np.vsplit,
    np.dsplit,
}  # fmt: skip
# Functions that put zeros between the elements.
_SPREADING = {np.diag, np.diagflat, np.tril, np.triu}
_LATER = [(np, "matrix_transpose"), (np, "unstack"), (np.linalg, "matrix_transpose"), (np.linalg, "diagonal")]
_REARRANGING |= {getattr(home, name) for home, name in _LATER if hasattr(home, name)}

_AT_LEAST = {np.atleast_1d, np.atleast_2d, np.atleast_3d}
_JOINING = {np.concatenate, np.stack, np.vstack, np.hstack, np.dstack, np.column_stack, np.block, np.append}
# Numbers of arguments before the array to write into.
_BEFORE_OUT = {np.take: 3, np.concatenate: 2, np.stack: 2}


def apply_function(function: Any, args: Sequence[Any], options: Mapping[str, Any]) -> Any:
    """Carry out a numpy function on expressions."""
    name = f"{getattr(function, '__module__', 'numpy')}.{function.__name__}"
    if function in _AT_LEAST and len(args) != 1:
        return tuple(function(as_expression(a)) for a in args)
    if function in _FUNCTIONS:
        parameters = signature(_FUNCTIONS[function])
        try:
            bound = parameters.bind(*args, **options)
        except TypeError as error:
            listed = ", ".join(parameters.parameters)
            told = f"{name} of expressions: {error}. Its parameters are {listed}."
            raise ExpressionError(told) from None
        return _FUNCTIONS[function](*bound.args, **bound.kwargs)
    if function is np.append and len(args) > 1:
        # np.append takes two arguments instead of a sequence, and flattens both without an axis.
        axis = args[2] if len(args) > 2 else options.get("axis")
        return apply_function(np.concatenate, (args[:2],), {"axis": axis})
    if function not in _REARRANGING and function not in _SPREADING and function not in _JOINING:
        raise _unavailable(name)
    refused = {"out", "dtype", "casting"} & options.keys()
    if not args or refused or len(args) > _BEFORE_OUT.get(function, len(args)):
        raise ExpressionError(f"{name} takes expressions as its first argument, and neither out= nor dtype=.")
    if any(isinstance(a, Expression) for a in (*args[1:], *options.values())):
        raise ExpressionError(
            f"{name} rearranges the elements of its first argument by plain numbers, not by expressions."
        )
    try:
        return (_join if function in _JOINING else _rearrange)(function, args[0], args[1:], options)
    except KineverseError:
        raise
    except (ValueError, IndexError) as error:
        parts = _leaves(args[0]) if function in _JOINING else [args[0]]
        shapes = " and ".join(str(as_expression(part).shape) for part in parts)
        raise ShapeError(f"{name}: {error} (of shape {shapes}).") from None
    except TypeError as error:
        raise ExpressionError(f"{name} of expressions: {error}.") from None


_INSTEAD = {
    "all": "logic, a & b", "any": "logic, a | b", "sort": "np.min and np.max, or call it with values",
    "argmin": "np.min, or kv.where", "argmax": "np.max, or kv.where", "interp": "kv.spline(x, knots, values)",
    "std": "np.sqrt(np.mean((x - np.mean(x))**2))", "var": "np.mean((x - np.mean(x))**2)",
    "average": "np.sum(w * x) / np.sum(w)", "logical_xor": "(a | b) & ~(a & b)",
    "heaviside": "kv.where(x < 0, 0, 1)", "pinv": "np.linalg.inv(A.T @ A) @ A.T", "insert": "np.concatenate",
    "pad": "np.concatenate", "full_like": "value * np.ones(shape)", "polyval": "c[0]*x**2 + c[1]*x + c[2]",
    "linspace": "a + (b - a) * np.linspace(0, 1, n)", "isclose": "abs(a - b) < tolerance",
    "allclose": "np.max(abs(a - b)) < tolerance",
}  # fmt: skip


def _unavailable(name: str) -> ExpressionError:
    instead = _INSTEAD.get(name.rpartition(".")[2])
    return ExpressionError(
        f"{name} is not available for expressions{f'; write {instead}' if instead else ''}. "
        "Of numbers it is: call the expression with values first, e({name: number})."
    )


def _rearrange(function: Any, operand: Any, args: Sequence[Any], options: Mapping[str, Any]) -> Any:
    expression = as_expression(operand)
    spreading = function in _SPREADING
    index = function(layout.indices(expression.shape) + spreading, *args, **options)
    if spreading:
        # Elements are counted from 1, so 0 marks a filled place; it refers to an additional last element.
        index = np.where(index == 0, expression.size, index - 1)
        expression = _join(np.concatenate, [expression.ravel(), np.zeros(1)], (), {})
    if isinstance(index, (list, tuple)):
        return type(index)(expression._rearranged(np.asarray(part)) for part in index)
    return expression._rearranged(np.asarray(index))


def _join(function: Any, parts: Sequence[Any], args: Sequence[Any], options: Mapping[str, Any]) -> Expression:
    operands: list[Expression] = []
    offset = 0

    def numbered(part: Any) -> Any:
        nonlocal offset
        if function is np.block and isinstance(part, (list, tuple)):
            return [numbered(inner) for inner in part]
        operand = as_expression(part)
        operands.append(operand)
        offset += operand.size
        return layout.indices(operand.shape) + (offset - operand.size)

    blocks = numbered(parts) if function is np.block else [numbered(part) for part in parts]
    index = np.asarray(function(blocks, *args, **options))
    elements = ca.vertcat(*(layout.column(o._sx, o.shape) for o in operands))
    sx = layout.gather(elements, (offset,), index.astype(int))
    return from_casadi(sx, index.shape, union_nodes(operands))


def _leaves(parts: Any) -> list[Any]:
    if isinstance(parts, (list, tuple)):
        return [leaf for part in parts for leaf in _leaves(part)]
    return [parts]


def _trace(a: Any, offset: int = 0, axis1: int = 0, axis2: int = 1) -> Expression:
    diagonal: Any = np.diagonal(as_expression(a), offset, axis1, axis2)
    return r.sum_axes(diagonal, -1)


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


_FUNCTIONS: dict[Any, Callable[..., Any]] = {
    np.where: f.where,
    np.clip: _clip,
    np.sum: r.sum_axes,
    np.mean: r.mean_axes,
    np.min: r.min_axes,
    np.max: r.max_axes,
    np.amin: r.min_axes,
    np.amax: r.max_axes,
    np.ptp: r.ptp_axes,
    np.prod: r.prod_axes,
    np.cumsum: r.cumsum,
    np.cumprod: r.cumprod,
    np.diff: r.diff,
    np.round: f.around,
    np.around: f.around,
    np.fix: f.trunc,
    np.copy: as_expression,
    np.trace: _trace,
    np.dot: c.dot,
    np.inner: c.inner,
    np.vdot: lambda a, b: c.dot(as_expression(a).ravel(), as_expression(b).ravel()),
    np.outer: c.outer,
    np.cross: c.cross,
    np.kron: c.kron,
    np.einsum: c.einsum,
    np.tensordot: c.tensordot,
    np.linalg.norm: r.norm_axes,
    np.linalg.inv: c.matrix_inverse,
    np.linalg.det: c.determinant,
    np.linalg.solve: c.solve_linear,
    np.linalg.matrix_power: c.matrix_power,
    np.linalg.multi_dot: lambda arrays: reduce(c.dot, arrays),
    np.shape: lambda a: as_expression(a).shape,
    np.ndim: lambda a: as_expression(a).ndim,
    np.size: lambda a, axis=None: as_expression(a).size if axis is None else as_expression(a).shape[axis],
    np.zeros_like: lambda a: as_expression(np.zeros(as_expression(a).shape)),
    np.ones_like: lambda a: as_expression(np.ones(as_expression(a).shape)),
    np.array_equal: lambda a, b: as_expression(a) == as_expression(b),
}
_LATER_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "cross": lambda x1, x2, axis=-1: c.cross(x1, x2, axis=axis),
    "outer": c.outer,
    "trace": lambda x, offset=0: _trace(x, offset, -2, -1),
    "matmul": matmul,
    "vecdot": c.vecdot,
    "tensordot": lambda x1, x2, axes=2: c.tensordot(x1, x2, axes),
    "vector_norm": r.vector_norm,
    "matrix_norm": r.matrix_norm,
}
_FUNCTIONS |= {
    getattr(np.linalg, name): function
    for name, function in _LATER_FUNCTIONS.items()
    if hasattr(np.linalg, name)
}
if hasattr(np, "astype"):
    _FUNCTIONS[np.astype] = lambda x, dtype: as_expression(x).astype(dtype)
