"""Functions of expressions for PyTorch.

On the CPU, tensors are rows of a batch of compiled C, without copies. On other devices the function consists
of operations of PyTorch. Derivatives are further programs in both cases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, Literal

import numpy as np

from kineverse._extras import install_command
from kineverse.compilation.batch import Batch
from kineverse.compilation.program import Program
from kineverse.errors import InvalidValueError, MissingDependencyError, ShapeError
from kineverse.expressions import ExpressionLike
from kineverse.expressions.layout import ArrayShape
from kineverse.symbols import Symbol

from .array_source import array_source
from .derivatives import DerivativePrograms, check_tier, dtype_error


def to_torch(
    expressions: ExpressionLike | Sequence[ExpressionLike],
    inputs: Iterable[Symbol],
    *,
    tier: Literal["auto", "c", "operations"] = "auto",
) -> Callable[[Any], Any]:
    """Return a function for PyTorch that evaluates expressions.

    Automatic differentiation and the transforms of ``torch.func`` go through it, any number of times. Its
    derivatives are those of :meth:`.Expression.jacobian`, and of :meth:`.Expression.partial` by parameters.
    It runs on the device of its argument, and cannot be pickled.

    Parameters
    ----------
    expressions
        An expression (the function returns a tensor), or a list or tuple of them (it returns a tuple).
    inputs
        The symbols, parameters among them, that make up the argument, in this order.
    tier
        ``"auto"`` calls compiled C for tensors on the CPU, CasADi's interpreter until there is C, and has
        operations of PyTorch elsewhere. ``"c"`` requires C, and takes tensors on the CPU only.
        ``"operations"`` never compiles C.

    Returns
    -------
    callable
        A function of a tensor of shape (..., n), the n inputs along its last dimension. It returns tensors of
        shape (..., *shape) for an expression of some shape, of the argument's type: float32 or float64.
        Whole numbers count as the default type. On the CPU float32 is computed in float64. Where a loop does
        not close, results are NaN, and no error is raised.

    Raises
    ------
    MissingDependencyError
        If PyTorch is not installed.
    ExpressionError
        If an input is not a symbol, or there is none.
    DuplicateNameError
        If a symbol is among the inputs twice.
    UnknownNameError
        If expressions or their gradients depend on symbols that are not among the inputs.
    CompileError
        If there is no expression, or if C is required and impossible.
    """
    torch = _import_torch()
    check_tier(tier)
    programs = DerivativePrograms(expressions, inputs, "to_torch")
    single, check_shape = programs.single, programs.check_shape

    @cache
    def level(order: int) -> Any:
        return _differentiable(*programs.program(order), programs.count, tier, lambda: level(order + 1))

    first = level(0)

    def function(x: Any) -> Any:
        values = _as_tensor(x)
        check_shape(values.shape)
        results = first.apply(values)
        return results[0] if single else results

    # Dynamo cannot look into compiled C, nor trace an operation that has a forward mode.
    return torch.compiler.disable(function)  # type: ignore[no-any-return]


def _import_torch() -> Any:
    try:
        import torch  # it is an extra
    except ImportError:
        raise MissingDependencyError(f"to_torch needs torch: {install_command('torch')}") from None
    return torch


def _as_tensor(x: Any) -> Any:
    import torch

    try:
        values = torch.as_tensor(x)
    except (TypeError, ValueError, RuntimeError):
        raise ShapeError(
            f"Expected a tensor, not a {type(x).__name__}: the function takes one vector, in the order "
            "of its inputs."
        ) from None
    if values.dtype in (torch.int8, torch.int16, torch.int32, torch.int64, torch.uint8):
        return values.to(torch.get_default_dtype())
    if values.dtype not in (torch.float32, torch.float64):
        raise dtype_error(values.dtype)
    return values


def _differentiable(
    program: Program, shapes: tuple[ArrayShape, ...], count: int, tier: str, following: Callable[[], Any]
) -> Any:
    """Return an operation of autograd, whose derivatives are computed by the next order."""
    import torch

    on_host = None if tier == "operations" else _on_host(program, shapes, tier)
    in_operations = _in_operations(program, shapes)

    class Evaluate(torch.autograd.Function):  # type: ignore[misc]
        @staticmethod
        def forward(x: Any) -> Any:
            if on_host is not None and x.device.type == "cpu":
                return on_host(x)
            if tier == "c":
                raise InvalidValueError(
                    f"The tensor is on {x.device}, and tier 'c' is for the CPU: make the function "
                    "without it, or move the tensor."
                )
            return tuple(in_operations(x))

        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any], output: Any) -> None:
            ctx.set_materialize_grads(False)
            ctx.save_for_backward(*inputs)
            ctx.save_for_forward(*inputs)

        @staticmethod
        def backward(ctx: Any, *weights: Any) -> Any:
            (x,) = ctx.saved_tensors
            slopes = following().apply(x)[count:]
            terms = [
                (weight.reshape((*x.shape[:-1], 1, math.prod(shape))) @ _matrix(slope, x)).squeeze(-2)
                for shape, slope, weight in zip(shapes, slopes, weights, strict=True)
                if weight is not None
            ]
            return sum(terms[1:], terms[0]) if terms else None

        @staticmethod
        def jvp(ctx: Any, v: Any) -> Any:
            (x,) = ctx.saved_tensors
            slopes = following().apply(x)[count:]
            return tuple(
                (_matrix(slope, x) @ v.unsqueeze(-1)).reshape((*x.shape[:-1], *shape))
                for shape, slope in zip(shapes, slopes, strict=True)
            )

        @staticmethod
        def vmap(info: Any, in_dims: tuple[int], x: Any) -> Any:
            results = Evaluate.apply(x.movedim(in_dims[0], 0))
            return results, (0,) * len(results)

    return Evaluate


def _matrix(slope: Any, x: Any) -> Any:
    """Return derivatives with one row for each element of the output."""
    count = math.prod(slope.shape[x.ndim - 1 : -1])
    return slope.reshape((*x.shape[:-1], count, x.shape[-1]))


def _in_operations(program: Program, shapes: tuple[ArrayShape, ...]) -> Callable[[Any], list[Any]]:
    """Return the function that consists of operations of PyTorch."""
    import torch

    @cache
    def make(single_precision: bool) -> Callable[[Any, Callable[[float], Any]], list[Any]]:
        source = array_source(program, shapes, single_precision=single_precision)
        names = {"m": torch, "erf": torch.erf, "erfinv": torch.erfinv}
        exec(compile(source, "<kineverse operations>", "exec"), names)
        evaluate: Callable[[Any, Callable[[float], Any]], list[Any]] = names["evaluate"]
        return evaluate

    def evaluate(x: Any) -> list[Any]:
        return make(x.dtype == torch.float32)(
            x, lambda number: torch.full((), number, dtype=x.dtype, device=x.device)
        )

    return evaluate


def _on_host(program: Program, shapes: tuple[ArrayShape, ...], tier: str) -> Callable[[Any], tuple[Any, ...]]:
    """Return the function of tensors on the CPU, whose memory is that of arrays."""
    import torch

    batch, interpreted = Batch(program, shapes, False, tier), program.function
    batch.request()

    def evaluate(x: Any) -> tuple[Any, ...]:
        leading, size = x.shape[:-1], x.shape[-1]
        rows = x.detach().reshape(-1, size) if size else x.detach()
        results = batch(rows.numpy(), None, interpreted)
        return tuple(
            torch.from_numpy(np.asarray(result)).reshape((*leading, *shape)).to(x.dtype)
            for result, shape in zip(results, shapes, strict=True)
        )

    return evaluate
