"""Functions of expressions for JAX.

On the CPU, XLA calls compiled C by its foreign function interface, for all points at once. It needs no Python
then: ``jax.pure_callback`` waits for itself when arrays are large and threads are few. On other devices, and
without C, the function consists of operations of JAX. Derivatives are further programs in both cases.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from importlib import metadata
from typing import Any, Literal

from kineverse._extras import install_command
from kineverse.compilation.c_library import ProgramLibrary, open_library
from kineverse.compilation.c_source import read_source
from kineverse.compilation.codegen import VECTOR, generate_batch_source, missing_operations
from kineverse.compilation.program import Program
from kineverse.compilation.toolchain import vector_optimisation_level
from kineverse.errors import CompileError, MissingDependencyError
from kineverse.expressions import ExpressionLike
from kineverse.expressions.layout import ArrayShape
from kineverse.symbols import Symbol

from .array_source import load_operations
from .derivatives import DerivativePrograms, array_error, check_tier, dtype_error

# Raise the number when other source is generated from the same program and texts.
_KIND = "xla 1 " + hashlib.sha256(
    (read_source("xla_ffi.c", {"program.h": ""}) + repr(VECTOR)).encode()
).hexdigest()  # fmt: skip

# Libraries by the names under which XLA knows them. Never unloaded: an executable may outlive all else.
_registered: dict[str, Any] = {}


def to_jax(
    expressions: ExpressionLike | Sequence[ExpressionLike],
    inputs: Iterable[Symbol],
    *,
    tier: Literal["auto", "c", "operations"] = "auto",
) -> Callable[[Any], Any]:
    """Return a function for JAX that evaluates expressions.

    ``jit``, ``vmap``, ``grad``, ``jvp``, ``vjp`` and others go through it, any number of times. Its
    derivatives are those of :meth:`.Expression.jacobian`, and of :meth:`.Expression.partial` by parameters.
    It runs where its argument is, and cannot be pickled.

    Parameters
    ----------
    expressions
        An expression (the function returns an array), or a list or tuple of them (it returns a tuple).
    inputs
        The symbols, parameters among them, that make up the argument, in this order.
    tier
        ``"auto"`` calls compiled C on a CPU if it can be compiled, and has operations of JAX elsewhere.
        ``"c"`` requires C, and runs on a CPU only. ``"operations"`` never compiles C.

    Returns
    -------
    callable
        A function of an array of shape (..., n), the n inputs along its last axis. It returns arrays of
        shape ``(..., *shape)`` for an expression of some shape, of the argument's type: float32 or float64.
        Whole numbers count as ``float``. On a CPU float32 is computed in float64. Where a loop does not
        close, results are NaN, and no error is raised.

    Raises
    ------
    MissingDependencyError
        If JAX is not installed.
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
    >>> import jax
    >>> x, y = kv.position("x"), kv.position("y")
    >>> f = kv.to_jax(x * np.sin(y), [x, y], tier="operations")
    >>> jax.grad(f)(jax.numpy.array([2.0, 0.0]))
    Array([0., 2.], dtype=float32)
    """
    jax = _import_jax()
    check_tier(tier)
    programs = DerivativePrograms(expressions, inputs, "to_jax")

    @cache
    def level(order: int) -> Callable[[Any], list[Any]]:
        return _differentiable(*programs.program(order), programs.count, tier, lambda: level(order + 1))

    if tier != "operations":
        library = _library(programs.program(0)[0])
        library.request()
        if tier == "c" and library.error:
            raise CompileError(f"The function cannot be compiled: {library.error}.")

    evaluate = jax.jit(lambda x: level(0)(x))

    def function(x: Any) -> Any:
        values = _as_array(x)
        programs.check_shape(values.shape)
        results = evaluate(values)
        return results[0] if programs.single else tuple(results)

    return function


def _import_jax() -> Any:
    try:
        import jax  # it is an extra
        import jax.extend
        import jax.ffi
        import jax.numpy
    except ImportError:
        raise MissingDependencyError(f"to_jax needs jax: {install_command('jax')}") from None
    return jax


def _as_array(x: Any) -> Any:
    jnp = _import_jax().numpy
    try:
        values = jnp.asarray(x)
    except (TypeError, ValueError):
        raise array_error(x) from None
    if jnp.issubdtype(values.dtype, jnp.integer):
        return values.astype(jnp.result_type(float))
    if values.dtype not in (jnp.float32, jnp.float64):
        raise dtype_error(values.dtype)
    return values


def _differentiable(
    program: Program,
    shapes: tuple[ArrayShape, ...],
    count: int,
    tier: str,
    following: Callable[[], Callable[[Any], list[Any]]],
) -> Callable[[Any], list[Any]]:
    """Return a function of arrays whose tangents are computed by the next order."""
    jax = _import_jax()
    jnp = jax.numpy
    load = load_operations(program, shapes, m=jnp, erf=jax.lax.erf, erfinv=jax.lax.erf_inv)

    def in_operations(x: Any) -> list[Any]:
        return load(x.dtype == jnp.float32)(x, x.dtype.type)

    def compute(x: Any) -> list[Any]:
        if tier == "operations":
            return in_operations(x)
        in_c = _in_c(program, shapes, required=tier == "c")
        if in_c is None:
            return in_operations(x)
        if tier == "c" or set(jax.extend.backend.backends()) == {"cpu"}:
            return in_c(x)
        results: list[Any] = jax.lax.platform_dependent(x, cpu=in_c, default=in_operations)
        return results

    values = jax.custom_jvp(compute)

    def differentiate(points: tuple[Any], tangents: tuple[Any]) -> tuple[list[Any], list[Any]]:
        (x,), (v,) = points, tangents
        results = following()(x)
        rates = []
        for shape, slope in zip(shapes, results[count:], strict=True):
            speeds = jnp.reshape(v, (*v.shape[:-1], *(1,) * len(shape), v.shape[-1]))
            rates.append(jnp.sum(slope * speeds, axis=-1))
        return results[: len(shapes)], rates

    values.defjvp(differentiate)
    evaluate: Callable[[Any], list[Any]] = values
    return evaluate


def _in_c(
    program: Program, shapes: tuple[ArrayShape, ...], *, required: bool
) -> Callable[[Any], list[Any]] | None:
    """Return the function that calls compiled C; None if there is none."""
    jax = _import_jax()
    library = _library(program)
    name = "" if library.error else f"kineverse_{library.key}"
    if name not in _registered:
        if not library.wait():
            if required:
                raise CompileError(f"The function cannot be compiled: {library.error}.")
            return None
        _registered[name] = library.code
        jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(library.code), platform="cpu")

    def like(x: Any) -> list[Any]:
        empty = (range(x.ndim - 1, x.ndim - 1 + len(shape)) for shape in shapes)
        return [
            jax.numpy.broadcast_to(jax.numpy.expand_dims(x[..., 0], tuple(axes)), (*x.shape[:-1], *shape))
            for axes, shape in zip(empty, shapes, strict=True)
        ]

    def call(x: Any) -> list[Any]:
        results = jax.eval_shape(like, x)  # in shard_map they vary from device to device, as x does
        return list(jax.ffi.ffi_call(name, results, vmap_method="broadcast_all")(x))

    return call


def _library(program: Program) -> ProgramLibrary[Any]:
    """Return the library of a program with the handler of calls of XLA."""
    level = None if missing_operations(program) else vector_optimisation_level(program.instructions)
    kind = f"{_KIND} {metadata.version('jaxlib')}"
    source = partial(generate_batch_source, program, "xla_ffi.c")
    return ProgramLibrary(program, kind, source, _load, level, (f"-I{_import_jax().ffi.include_dir()}",))


def _load(path: str) -> Any:
    return open_library(path).kineverse_xla_ffi
