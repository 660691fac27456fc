"""Functions of expressions for PyTorch.

On the CPU, tensors are rows of a batch of compiled C, without copies. On other devices the function consists
of operations of PyTorch. Derivatives are further programs in both cases.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from typing import Any, Literal

import numpy as np

from kineverse._extras import install_command
from kineverse.compilation.batch import Batch
from kineverse.compilation.program import Program
from kineverse.errors import InvalidValueError, MissingDependencyError, ShapeError
from kineverse.expressions import ExpressionLike
from kineverse.expressions.layout import ArrayShape
from kineverse.symbols import Symbol

from .array_source import load_operations
from .derivatives import DerivativePrograms, array_error, check_tier, dtype_error


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
        shape ``(..., *shape)`` for an expression of some shape, of the argument's type: float32 or float64.
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

    Examples
    --------
    >>> import torch
    >>> x, y = kv.position("x"), kv.position("y")
    >>> f = kv.to_torch(x * np.sin(y), [x, y], tier="operations")
    >>> point = torch.tensor([2.0, 0.0], requires_grad=True)
    >>> f(point).backward()
    >>> point.grad
    tensor([0., 2.])
    """
    torch = _import_torch()
    check_tier(tier)
    programs = DerivativePrograms(expressions, inputs, "to_torch")

    @cache
    def level(order: int) -> Any:
        return _differentiable(*programs.program(order), programs.count, tier, lambda: level(order + 1))

    first = level(0)

    def function(x: Any) -> Any:
        values = _as_tensor(x)
        programs.check_shape(values.shape)
        results = first.apply(values)
        return results[0] if programs.single else results

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

    def has_tensors(x: Any) -> bool:
        return isinstance(x, torch.Tensor) or (isinstance(x, (list, tuple)) and any(map(has_tensors, x)))

    if not isinstance(x, torch.Tensor) and has_tensors(x):  # PyTorch takes their numbers, and no gradient
        raise ShapeError(
            f"Expected one tensor, not a {type(x).__name__} of tensors. Write torch.stack(values, dim=-1)."
        )
    try:
        if isinstance(x, np.ma.MaskedArray):  # PyTorch takes what is masked for numbers
            raise TypeError
        values = torch.as_tensor(x)
    except (TypeError, ValueError, RuntimeError):
        raise array_error(x) from None
    whole = not (values.is_floating_point() or values.is_complex() or values.dtype == torch.bool)
    if whole:
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
    load = load_operations(program, shapes, m=torch, erf=torch.erf, erfinv=torch.erfinv)

    def in_operations(x: Any) -> list[Any]:
        constant = partial(torch.full, (), dtype=x.dtype, device=x.device)
        return load(x.dtype == torch.float32)(x, constant)

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
            # Not as matrices: their products have few digits with autocast, and on a GPU with TF32.
            terms = [
                (slope * weight.unsqueeze(-1)).reshape((*x.shape[:-1], math.prod(shape), x.shape[-1])).sum(-2)
                for shape, slope, weight in zip(shapes, slopes, weights, strict=True)
                if weight is not None
            ]
            return sum(terms[1:], terms[0]) if terms else None

        @staticmethod
        def jvp(ctx: Any, v: Any) -> Any:
            (x,) = ctx.saved_tensors
            slopes = following().apply(x)[count:]
            return tuple(
                (slope * v.reshape((*v.shape[:-1], *(1,) * len(shape), v.shape[-1]))).sum(-1)
                for shape, slope in zip(shapes, slopes, strict=True)
            )

        @staticmethod
        def vmap(info: Any, in_dims: tuple[int], x: Any) -> Any:
            results = Evaluate.apply(x.movedim(in_dims[0], 0))
            return results, (0,) * len(results)

    return Evaluate


def _on_host(program: Program, shapes: tuple[ArrayShape, ...], tier: str) -> Callable[[Any], tuple[Any, ...]]:
    """Return the function of tensors on the CPU, whose memory is that of arrays."""
    import torch

    batch, interpreted = Batch(program, shapes, False, tier), program.function
    batch.request()

    def evaluate(x: Any) -> tuple[Any, ...]:
        leading, size = x.shape[:-1], x.shape[-1]
        rows = x.reshape(-1, size).numpy(force=True)  # force: x may be a view of negated memory
        results = batch(rows, None, interpreted)
        return tuple(
            torch.from_numpy(np.asarray(result)).reshape((*leading, *shape)).to(x.dtype)
            for result, shape in zip(results, shapes, strict=True)
        )

    return evaluate
