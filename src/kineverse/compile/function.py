"""Expressions as functions of numbers."""

from __future__ import annotations

import ctypes
import logging
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeAlias, overload
from weakref import WeakSet

import casadi as ca
import numpy as np
import numpy.typing as npt

from kineverse.errors import CompileError, InvalidValueError
from kineverse.expressions import Expression, ExpressionLike, array
from kineverse.symbols import Symbol

from .batch import Batch
from .c_library import ProgramLibrary
from .call_extension import MOST_OUTPUTS, call_extension
from .evaluator import Array, Evaluator, OutputShape, bind, make_pooled_call
from .program import FUNCTION_NAME, SINGLE_KIND, CasadiFunction, DoubleVector, Program
from .signature import make_signature

if TYPE_CHECKING:
    from typing_extensions import TypeVar

    # Without brackets it is a function of anything.
    Results = TypeVar("Results", default=Any)
else:
    from typing import TypeVar

    Results = TypeVar("Results")

logger = logging.getLogger("kineverse.compile")

Tier: TypeAlias = Literal["interpreter", "c"]
WantedTier: TypeAlias = Literal["auto", "interpreter", "c"]

# Inputs and outputs count as operations too: below this there is nothing to compute. Everything else is worth
# it, as the extension calls a compiled sum in a fifth of the time that CasADi's interpreter needs.
_WORTH_COMPILING = 4
# So many operations take some microseconds: others may have the GIL meanwhile.
_LENGTHY = 5000


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

    The function can be called at once, by CasADi's interpreter. Meanwhile C is generated and compiled in the
    background; it takes over when it is ready, gives the same numbers to the last bit, and is kept for later.

    Parameters
    ----------
    outputs
        An expression (calls return one array), or a list or tuple of them (calls return a tuple of arrays).
    inputs
        The symbols that make up the input vector, in this order; by default all symbols of the outputs,
        sorted by name, which is not the order of a chain: that is ``model.find_term_symbols(frame)``.
    tier
        ``"auto"`` as described; without a C compiler, or where C is of no use, the interpreter stays.
        ``"interpreter"`` never compiles. ``"c"`` insists on C.
    wait
        Whether to return only when C is ready (or is known not to come).

    Raises
    ------
    ExpressionError
        If something else than symbols is among the inputs.
    DuplicateNameError
        If a symbol is among the inputs twice.
    UnknownNameError
        If outputs depend on symbols that are not among the inputs.
    CompileError
        If there is nothing to compile, or if tier ``"c"`` is known to be impossible.
    """
    if tier not in ("auto", "interpreter", "c"):
        raise InvalidValueError(f"Unknown tier {tier!r}; tiers are 'auto', 'interpreter' and 'c'.")
    single = not isinstance(outputs, (list, tuple))
    expressions = tuple(array(o) for o in ((outputs,) if single else outputs))  # type: ignore[union-attr]
    if not expressions:
        raise CompileError("There is no output to compile.")
    return CompiledFunction(expressions, inputs, single=single, tier=tier, wait=wait)


class CompiledFunction(Generic[Results]):
    """A function of a vector of numbers, made by :func:`compile`.

    To a type checker ``CompiledFunction[R]`` is one whose calls return R: an array for a function of a single
    expression, a tuple of arrays otherwise.

    It may be called from any number of threads.

    Parameters
    ----------
    outputs
        What is computed.
    inputs
        The symbols in the order of the vector, or None.
    single
        Whether calls return one array instead of a tuple.
    tier, wait
        See :func:`compile`.

    Attributes
    ----------
    inputs
        The symbols whose values make up the input vector, in its order.
    names
        Their text names.
    shapes
        The shape of every output.
    tier
        What evaluates at the moment: ``"interpreter"`` or ``"c"``.
    """

    __slots__ = (
        "__weakref__", "_batch", "_call", "_evaluators", "_function", "_library", "_lock", "_native",
        "_outputs", "_program", "_signature", "_single", "_wanted", "inputs", "names", "shapes", "tier",
    )  # fmt: skip

    inputs: tuple[Symbol, ...]
    names: tuple[str, ...]
    shapes: tuple[OutputShape, ...]
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
            self._library = ProgramLibrary(program, SINGLE_KIND, program.source, _load, self._ready)
            if tier == "c" and self._library.error:
                raise CompileError(f"The function cannot be compiled: {self._library.error}.")
        if self._library is not None:
            # First, so that it is there when the function's own library is.
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
        """Return the outputs at ``x``, in arrays that belong to the caller.

        A function without inputs, of constants, is called without anything.

        Parameters
        ----------
        x
            The values of :attr:`inputs`, a sequence of n numbers; or a mapping from symbols or their names to
            numbers, where parameters may be left out; or a State, which may know more.

        Returns
        -------
        numpy.ndarray or tuple of numpy.ndarray
            An array per output, of its shape; for a function of a single expression that array alone.

        Raises
        ------
        ShapeError
            If ``x`` is no vector of n numbers.
        UnknownNameError
            If a mapping misses a symbol or knows one that is not among the inputs.
        InvalidValueError
            If a mapping contains NaN or what is not a number.
        """
        return self._call(x)

    def batch(self, x: npt.ArrayLike, out: Any = None) -> Results:
        """Return the outputs at many points.

        Rows are spread over all cores. The numbers are those of single calls but for the last digits (4 ulp)
        of elementary functions. The first batch that is large enough to pay for it waits for a compiler.

        Parameters
        ----------
        x
            A point per row, shape (N, n).
        out
            Where to write: contiguous float64 arrays of shape (N, *shape), one per output (alone if there is
            a single output). New ones are made if None.

        Returns
        -------
        numpy.ndarray or tuple of numpy.ndarray
            An array of shape (N, *shape) per output; for a function of a single expression that array alone.

        Raises
        ------
        ShapeError
            If ``x`` is no array of n columns of numbers, or ``out`` does not fit.
        """
        if self._batch is None:
            self._batch = Batch(self._program, self._signature, self.shapes, self._single, self._wanted)
        results: Results = self._batch(x, out, self._function)
        return results

    def bind(self) -> Evaluator:
        """Return an evaluator of one's own, which writes its results in place, for one thread."""
        size, convert = self._signature.size, self._signature.vector
        with self._lock:
            if self._native:
                outputs = tuple(np.zeros(shape) for shape in self.shapes)
                return self._native_evaluator(np.zeros(size), outputs)
            evaluator = Evaluator(self.shapes, size, convert)
            self._let_evaluate(evaluator)
            if self.tier != "c":
                self._evaluators.add(evaluator)
        return evaluator

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until C evaluates, or is known not to come; return whether it does.

        Parameters
        ----------
        timeout
            In seconds; forever if None.

        Raises
        ------
        CompileError
            If C was insisted on (``tier="c"``) and cannot be had.
        """
        if self._library is None:
            return False
        there = self._library.wait(timeout)
        if self._wanted == "c" and self._library.error:
            raise CompileError(f"The function cannot be compiled: {self._library.error}.")
        return there

    @property
    def address(self) -> int | None:
        """Where the C is, for other C to call; None while there is none. It lives as long as the function."""
        code = self._library.code if self._library is not None else None
        return None if code is None else code.address

    def _ready(self) -> None:
        """Let C take over, or the extension that calls it, in whichever thread it was loaded."""
        if self._library is not None and self._library.code is not None:
            self._evaluate_by(self._library.code.function, self._library.code.address)

    def _evaluate_by(self, function: CasadiFunction, address: int | None) -> None:
        """Evaluate by another function from the next call on.

        Parameters
        ----------
        function
            CasADi's function.
        address
            Where its C is, if it is compiled.
        """
        shapes, check, convert = self.shapes, self._program.checked, self._signature.vector
        direct = address is not None and len(shapes) <= MOST_OUTPUTS and call_extension.module is not None
        if direct:
            lengthy = self._program.instructions > _LENGTHY
            size = self._signature.size
            call = call_extension.module.Call(address, size, shapes, self._single, lengthy, convert, check)
        else:
            call = make_pooled_call(function, self._signature.size, shapes, self._single, convert, check)
        with self._lock:
            self._function = function
            self._native = address if direct else None
            # One assignment: a call sees the old function with its bindings or the new one with its own.
            self._call = call
            self.tier = "interpreter" if address is None else "c"
            if self.tier == "c":
                for evaluator in self._evaluators:
                    self._let_evaluate(evaluator)
                self._evaluators.clear()

    def _let_evaluate(self, evaluator: Evaluator) -> None:
        """Have an evaluator use the present function."""
        if self._native:
            run = self._native_evaluator(evaluator.input, evaluator.outputs)
            evaluator._evaluate_by(run, None)
        else:
            check = self._program.checked
            evaluator._evaluate_by(*bind(self._function, evaluator.input, evaluator.outputs, check))

    def _native_evaluator(self, vector: DoubleVector, outputs: tuple[Array, ...]) -> Evaluator:
        lengthy = self._program.instructions > _LENGTHY
        evaluator: Evaluator = call_extension.module.Evaluator(
            self._native, vector, outputs, lengthy, self._signature.vector, self._program.checked
        )
        return evaluator

    def __copy__(self) -> CompiledFunction:
        return self

    def __deepcopy__(self, memo: Any) -> CompiledFunction:
        return self

    def __reduce__(self) -> Any:
        return _restore, (self._outputs, self.inputs, self._single, self._wanted)

    def __repr__(self) -> str:
        inputs = ", ".join(self.names[:4]) + (", ..." if len(self.names) > 4 else "")
        outputs = ", ".join(map(str, self.shapes[:6])) + (", ..." if len(self.shapes) > 6 else "")
        return f"CompiledFunction({len(self.names)} inputs: {inputs} -> {outputs}; {self.tier})"


@dataclass(frozen=True, slots=True)
class _Code:
    """A compiled function: as CasADi's, and where it is."""

    function: CasadiFunction
    address: int


def _load(path: str) -> _Code:
    address = ctypes.cast(ctypes.CDLL(path)[FUNCTION_NAME], ctypes.c_void_p).value
    return _Code(ca.external(FUNCTION_NAME, path), address or 0)


def _restore(
    outputs: tuple[Expression, ...], inputs: tuple[Symbol, ...], single: bool, tier: WantedTier
) -> CompiledFunction:
    return CompiledFunction(outputs, inputs, single=single, tier=tier)
