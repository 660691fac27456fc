"""Compilation of expressions to functions of numbers."""

from __future__ import annotations

import ctypes
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeAlias, overload
from weakref import WeakSet

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse._names import answer_foreign_names
from kineverse._synonyms import FUNCTION_SYNONYMS
from kineverse.errors import CompileError, InvalidValueError
from kineverse.expressions import Expression, ExpressionLike, array
from kineverse.expressions.expression import NO_NODES, from_casadi
from kineverse.expressions.layout import SX, ArrayShape
from kineverse.lie import Array
from kineverse.symbols import Symbol

from .evaluator import Evaluator, bind, make_pooled_call
from .program import FUNCTION_NAME, SINGLE_KIND, CasadiFunction, Program
from .signature import make_signature

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    from .batch import Batch
    from .c_library import ProgramLibrary

    Results = TypeVar("Results", default=Any)  # without brackets the type of the results is Any
else:
    from typing import TypeVar

    Results = TypeVar("Results")

# Modules about C are imported where a function is compiled: CasADi's interpreter needs none of them.

Tier: TypeAlias = Literal["interpreter", "c"]
WantedTier: TypeAlias = Literal["auto", "interpreter", "c"]

# Inputs and outputs count as operations too. Any program with a further operation is worth compiling: the
# extension calls a compiled sum in a fifth of the time of CasADi's interpreter.
_WORTH_COMPILING = 4
_LENGTHY = 5000  # from so many operations on, which take some microseconds, a call releases the GIL


@overload
def compile(  # noqa: A001
    outputs: list[Any] | tuple[Any, ...],
    inputs: Iterable[Symbol] | None = None,
    *,
    tier: WantedTier = "auto",
    wait: bool = False,
) -> CompiledFunction[tuple[Array, ...]]: ...


@overload
def compile(  # noqa: A001
    outputs: Expression | float | npt.NDArray[Any],
    inputs: Iterable[Symbol] | None = None,
    *,
    tier: WantedTier = "auto",
    wait: bool = False,
) -> CompiledFunction[Array]: ...


def compile(  # noqa: A001
    outputs: ExpressionLike | Sequence[ExpressionLike],
    inputs: Iterable[Symbol] | None = None,
    *,
    tier: WantedTier = "auto",
    wait: bool = False,
) -> CompiledFunction[Any]:
    """Return a fast function of numbers that evaluates expressions.

    The function can be called at once, by CasADi's interpreter. C is generated and compiled in the
    background; it replaces the interpreter when it is ready, with the same results to the last bit, and is
    cached on disk.

    Parameters
    ----------
    outputs
        An expression (calls return one array), or a list or tuple of them (calls return a tuple of arrays).
    inputs
        The symbols that make up the input vector, in this order; by default all symbols of the outputs,
        sorted by name, which is not the order of a chain: that is ``model.symbols_of(frame)``.
    tier
        ``"auto"`` as described; without a C compiler, or if C does not pay, the interpreter stays.
        ``"interpreter"`` never compiles. ``"c"`` requires C.
    wait
        True to return only when C is ready or has failed.

    Raises
    ------
    ExpressionError
        If an input is not a symbol.
    DuplicateNameError
        If a symbol is among the inputs twice.
    UnknownNameError
        If outputs depend on symbols that are not among the inputs.
    CompileError
        If there is no output, or if tier ``"c"`` is impossible.

    Examples
    --------
    >>> model = kv.load("kitchen")
    >>> f = kv.compile(model.fk("kitchen/fridge_door_handle")[:3, 3])
    >>> f([0.5]).round(3)
    array([ 0.842, -1.403,  1.184])
    >>> f.batch([[0.0], [0.5], [1.0]]).round(3)
    array([[ 1.137, -1.312,  1.184],
           [ 0.842, -1.403,  1.184],
           [ 0.626, -1.626,  1.184]])
    """
    if tier not in ("auto", "interpreter", "c"):
        raise InvalidValueError(f"Unknown tier {tier!r}; tiers are 'auto', 'interpreter' and 'c'.")
    single = not isinstance(outputs, (list, tuple))
    expressions = tuple(array(o) for o in ((outputs,) if single else outputs))  # type: ignore[union-attr]
    if not expressions:
        raise CompileError("There is no output to compile.")
    return CompiledFunction(expressions, inputs, single=single, tier=tier, wait=wait)


@answer_foreign_names("A compiled function", FUNCTION_SYNONYMS)
@answer_foreign_names("A compiled function", FUNCTION_SYNONYMS)
class CompiledFunction(Generic[Results]):
    """A function of a vector of numbers, created by :func:`compile`.

    To a type checker, calls of a ``CompiledFunction[R]`` return R: an array for a function of a single
    expression, a tuple of arrays otherwise. Any number of threads may call it at the same time.

    Parameters
    ----------
    inputs
        The symbols in the order of the vector, or None.
    single
        True if calls return one array instead of a tuple.
    tier, wait
        See :func:`compile`.

    Attributes
    ----------
    inputs
        The symbols of the input vector, in its order.
    names
        Their text names.
    shapes
        The shape of every output.
    tier
        The present kind of evaluation: ``"interpreter"`` or ``"c"``.

    Examples
    --------
    >>> x, y = kv.position("x"), kv.position("y")
    >>> f = kv.compile([x * y, kv.array([x, y])])
    >>> f.names, f.shapes
    (('x', 'y'), ((), (2,)))
    >>> product, vector = f([3, 4])
    >>> product, vector
    (array(12.), array([3., 4.]))
    >>> f({"x": 3, "y": 4})[0]
    array(12.)
    """

    __slots__ = (
        "__weakref__", "_batch", "_call", "_evaluators", "_function", "_library", "_lock", "_native",
        "_outputs", "_program", "_signature", "_single", "_wanted", "inputs", "names", "shapes", "tier",
    )  # fmt: skip

    inputs: tuple[Symbol, ...]
    names: tuple[str, ...]
    shapes: tuple[ArrayShape, ...]
    tier: Tier
    _call: Callable[[Any], Results]

    def __init__(
        self,
        outputs: tuple[Expression, ...],
        inputs: Iterable[Symbol] | None,
        *,
        single: bool,
        tier: WantedTier = "auto",
        wait: bool = False,
    ) -> None:
        self._signature = make_signature(outputs, inputs)
        self.inputs = self._signature.inputs
        self.names = self._signature.names
        self.shapes = tuple(e.shape for e in outputs)
        self._outputs = outputs
        self._single = single
        self._wanted = tier
        self._lock = threading.Lock()
        self._evaluators: WeakSet[Evaluator] = WeakSet()
        self._program = program = Program(outputs, self.inputs)
        self._batch: Batch | None = None
        self._library: ProgramLibrary[_Code] | None = None
        if tier == "c" or (tier == "auto" and program.instructions >= _WORTH_COMPILING):
            from .c_library import ProgramLibrary
            from .call_extension import call_extension
            from .toolchain import optimisation_level

            level = optimisation_level(program.instructions)
            self._library = ProgramLibrary(
                program, SINGLE_KIND, program.source, _load, level, ready=self._ready
            )
            if tier == "c" and self._library.error:
                raise CompileError(f"The function cannot be compiled: {self._library.error}.")
            # First, so that it is ready when the function's own library is, also for those who wait.
            call_extension.prepare(self._ready, urgent=wait)
        if self._library is not None and self._library.find():
            self._ready()
            return
        self._evaluate_by(program.function, None)
        if self._library is not None:
            self._library.request(urgent=wait)
            if wait:
                self.wait()

    def __call__(self, x: Any = (), /) -> Results:
        """Return the outputs at ``x``, in new arrays.

        A function without inputs is called without an argument.

        Parameters
        ----------
        x
            The values of :attr:`inputs`, a sequence of n numbers; or a mapping from symbols or their names to
            numbers, without which parameters have their own; or a State, which may have more symbols.

        Returns
        -------
        numpy.ndarray or tuple of numpy.ndarray
            An array per output, of its shape; for a function of a single expression that array alone.

        Raises
        ------
        UnknownNameError
            If a mapping lacks a symbol or has one that is not an input.
        InvalidValueError
            If a mapping contains NaN or values that are not numbers.
        """
        return self._call(x)

    def batch(self, x: npt.ArrayLike, out: Any = None) -> Results:
        """Return the outputs at many points.

        Rows are distributed over all cores. The results are those of single calls, except for the last digits
        (4 ulp) of elementary functions. The first batch that is large enough waits for the compiler.

        Parameters
        ----------
        x
            A point per row, shape (N, n).
        out
            Arrays for the results: contiguous, float64, of shape ``(N, *shape)``, one per output (alone if
            there is a single output). New ones if None.

        Returns
        -------
        numpy.ndarray or tuple of numpy.ndarray
            An array of shape ``(N, *shape)`` per output; for a function of one expression that array alone.

        Raises
        ------
        ShapeError
            If ``x`` is not an array of n columns of numbers, or ``out`` does not fit.

        Examples
        --------
        >>> handle = kv.load("kitchen").fk("kitchen/fridge_door_handle")
        >>> poses = kv.compile(handle).batch(np.linspace(0, 1.5, 1000).reshape(-1, 1))
        >>> poses.shape, poses[:, 0, 3].max().round(3)
        ((1000, 4, 4), np.float64(1.137))
        """
        if self._batch is None:
            from .batch import Batch

            self._batch = Batch(self._program, self.shapes, self._single, self._wanted)
        results: Results = self._batch(x, out, self._function)
        return results

    def bind(self) -> Evaluator:
        """Return an evaluator for one thread, which writes its results in place.

        Examples
        --------
        >>> x = kv.position("x")
        >>> evaluate = kv.compile(x**2).bind()
        >>> evaluate.input[0] = 3
        >>> evaluate()
        >>> evaluate.outputs[0]
        array(9.)
        """
        size, convert = self._signature.size, self._signature.vector
        with self._lock:
            if self._native is not None:
                outputs = tuple(np.zeros(shape) for shape in self.shapes)
                return self._native_evaluator(self._native, np.zeros(size), outputs)
            evaluator = Evaluator(self.shapes, size, convert)
            self._set_function(evaluator)
            if self.tier != "c":
                self._evaluators.add(evaluator)
        return evaluator

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until C is ready or has failed, and return True if it is ready.

        Parameters
        ----------
        timeout
            In seconds; forever if None.

        Raises
        ------
        CompileError
            If C is required (``tier="c"``) and has failed.

        Examples
        --------
        >>> f = kv.compile(kv.position("x") ** 2, tier="interpreter")
        >>> f.wait(), f.tier
        (False, 'interpreter')
        """
        if self._library is None:
            return False
        from .call_extension import call_extension

        begin = perf_counter()
        call_extension.wait(timeout)  # first, so that evaluators which are bound from now on are its own
        left = None if timeout is None else max(timeout - (perf_counter() - begin), 0.0)
        there = self._library.wait(left)
        if self._wanted == "c" and self._library.error:
            raise CompileError(f"The function cannot be compiled: {self._library.error}.")
        return there

    @property
    def address(self) -> int | None:
        """Address of the C function, valid as long as this object; None while there is none."""
        code = self._library.code if self._library is not None else None
        return None if code is None else code.address

    def _ready(self) -> None:
        """Switch to C, or to the extension that calls it; called in any thread."""
        if self._library is not None and self._library.code is not None:
            self._evaluate_by(self._library.code.function, self._library.code)

    def _evaluate_by(self, function: CasadiFunction, code: _Code | None) -> None:
        """Replace the function from the next call on."""
        shapes, check, convert = self.shapes, self._program.checked, self._signature.vector
        native: _Code | None = None
        if code is not None:
            from .call_extension import MOST_OUTPUTS, call_extension

            native = code if len(shapes) <= MOST_OUTPUTS and call_extension.module is not None else None
        if native is not None:
            call = call_extension.module.Call(
                native.address,
                self._signature.size,
                shapes,
                self._single,
                self._program.instructions > _LENGTHY,
                convert,
                check,
                native,
            )
        else:
            call = make_pooled_call(function, self._signature.size, shapes, self._single, convert, check)
        with self._lock:
            self._function = function
            self._native = native
            # One assignment: a call uses the old function with its bindings or the new one with its own.
            self._call = call
            self.tier = "interpreter" if code is None else "c"
            if self.tier == "c":
                for evaluator in self._evaluators:
                    self._set_function(evaluator)
                self._evaluators.clear()

    def _set_function(self, evaluator: Evaluator) -> None:
        if self._native is not None:
            run = self._native_evaluator(self._native, evaluator.input, evaluator.outputs)
            evaluator._evaluate_by(run, None)
        else:
            check = self._program.checked
            evaluator._evaluate_by(*bind(self._function, evaluator.input, evaluator.outputs, check))

    def _native_evaluator(self, code: _Code, vector: Array, outputs: tuple[Array, ...]) -> Evaluator:
        from .call_extension import call_extension

        lengthy = self._program.instructions > _LENGTHY
        evaluator: Evaluator = call_extension.module.Evaluator(
            code.address, vector, outputs, lengthy, self._signature.vector, self._program.checked, code
        )
        return evaluator

    def __copy__(self) -> CompiledFunction:
        return self

    def __deepcopy__(self, memo: Any) -> CompiledFunction:
        return self

    def __reduce__(self) -> Any:
        restore = partial(CompiledFunction, single=self._single, tier=self._wanted)
        return restore, (self._outputs, self.inputs)

    def __repr__(self) -> str:
        inputs = ", ".join(self.names[:4]) + (", ..." if len(self.names) > 4 else "")
        outputs = ", ".join(map(str, self.shapes[:6])) + (", ..." if len(self.shapes) > 6 else "")
        return f"CompiledFunction({len(self.names)} inputs: {inputs} -> {outputs}; {self.tier})"

    def _repr_html_(self) -> str:
        from kineverse._rich_display import html_table  # for start-up time

        rows = [("input", str(i), name) for i, name in enumerate(self.names)]
        rows += [("output", str(i), f"shape {shape}") for i, shape in enumerate(self.shapes)]
        return html_table(f"compiled function, evaluated by {self.tier}", ("", "number", ""), rows)


@dataclass(frozen=True, slots=True)
class _Code:
    """A compiled function: CasADi's, its address, and the library, which stays as long as this."""

    function: CasadiFunction
    address: int
    library: ctypes.CDLL


def _load(path: str) -> _Code:
    from .c_library import open_library

    library = open_library(path)
    address = ctypes.cast(library[FUNCTION_NAME], ctypes.c_void_p).value
    return _Code(ca.external(FUNCTION_NAME, path), address or 0, library)


def compile_columns(
    columns: Sequence[SX], symbols: Sequence[Symbol], tier: WantedTier = "auto"
) -> CompiledFunction[tuple[Array, ...]]:
    """Compile columns of numbers as a function of a vector of symbols.

    Different symbols may have one name here, as parameters of one path with different values do. The columns
    contain no nodes: where a loop does not close the result is NaN, and no error.
    """
    names = Counter(map(str, set(symbols)))
    inputs = [s if names[str(s)] == 1 else Symbol(f"{s.path}/input {i}") for i, s in enumerate(symbols)]
    renamed = [(old.sx, new.sx) for old, new in zip(symbols, inputs, strict=True) if old is not new]
    if renamed:
        old, new = (ca.vertcat(*side) for side in zip(*renamed, strict=True))
        columns = ca.substitute(list(columns), [old], [new])
    outputs = [from_casadi(ca.densify(column), (column.numel(),), NO_NODES) for column in columns]
    return compile(outputs, inputs, tier=tier)


def insert_values(columns: list[SX], symbols: Sequence[Symbol]) -> list[SX]:
    """Replace symbols by their own values, 0 for those without one."""
    if not symbols:
        return columns
    values = ca.SX(ca.DM([s.value or 0.0 for s in symbols]))
    return ca.substitute(columns, [ca.vertcat(*(s.sx for s in symbols))], [values])
