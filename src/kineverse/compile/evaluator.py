"""CasADi functions bound to memory: evaluators for one thread and pools for many.

A plain call of a CasADi function takes some 17 µs whatever it computes; one that is bound to its arguments
and results takes a tenth of one. But it has one place for its results and no lock, so a function that may be
called from anywhere keeps a pool of bindings, takes one out for each call and hands out copies.
"""

from __future__ import annotations

from abc import ABCMeta
from collections.abc import Callable, Sequence
from operator import call
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .program import CasadiFunction, Check, DoubleVector

Array: TypeAlias = npt.NDArray[np.float64]
BoundCall: TypeAlias = Callable[[], object]
VectorCall: TypeAlias = Callable[[Any], Any]
OutputShape: TypeAlias = tuple[int, ...]


def bind(
    function: CasadiFunction, vector: DoubleVector, outputs: Sequence[Array], check: Check | None
) -> tuple[BoundCall, object]:
    """Bind a function of one vector to arrays.

    Parameters
    ----------
    function
        CasADi's function.
    vector
        Where it reads; contiguous.
    outputs
        Where it writes, an array per output; contiguous.
    check
        What is done with vector and outputs after each evaluation; None for nothing.

    Returns
    -------
    tuple
        What evaluates, and an object that must be kept for as long as that may be called.
    """
    buffer, run = function.buffer()
    buffer.set_arg(0, vector.data)
    for i, output in enumerate(outputs):
        buffer.set_res(i, output.reshape(-1).data)
    if check is None:
        return run, buffer

    def run_checked() -> None:
        run()
        check(vector, outputs)

    return run_checked, buffer


def make_pooled_call(
    function: CasadiFunction,
    size: int,
    shapes: Sequence[OutputShape],
    single: bool,
    convert: VectorCall,
    check: Check | None,
) -> VectorCall:
    """Return a call that gives fresh arrays and can be used by any number of threads.

    Parameters
    ----------
    function
        CasADi's function of one vector.
    size
        The length of the vector.
    shapes
        The shape of each output.
    single
        Whether the one array is returned, rather than a tuple of them.
    convert
        Turns what is not a vector of doubles into one, or raises.
    check
        As for :func:`bind`.
    """
    # Appending to and popping from a list are atomic.
    pool: list[tuple[memoryview, BoundCall, Any, object]] = []
    take, give_back = pool.pop, pool.append
    pair = len(shapes) == 2

    def new() -> tuple[memoryview, BoundCall, Any, object]:
        vector = np.zeros(size)
        outputs = tuple(np.zeros(shape) for shape in shapes)
        run, keep = bind(function, vector, outputs, check)
        return vector.data, run, tuple(output.copy for output in outputs), keep

    def evaluate(x: Any) -> Any:
        try:
            binding = take()
        except IndexError:
            binding = new()
        vector, run, copies, _ = binding
        try:
            # This assignment refuses everything but doubles of the right number; it would not see a mask.
            vector[:] = x if type(x) is np.ndarray else convert(x)  # type: ignore[assignment]
        except (ValueError, TypeError):
            vector[:] = convert(x)
        run()
        if pair:
            # The usual case; going through a list of copies would take a quarter of the whole call.
            first, second = copies
            results = first(), second()
        elif single:
            results = copies[0]()
        else:
            results = tuple(map(call, copies))
        give_back(binding)
        return results

    return evaluate


class Evaluator(metaclass=ABCMeta):
    """A function with a place for its input and for its outputs, for one thread.

    Fill :attr:`input`, call, read :attr:`outputs`. Every call rewrites the arrays in :attr:`outputs` in
    place: copy what has to outlive the next one. Made by :meth:`CompiledFunction.bind`; it becomes faster by
    itself when the function's C is ready.

    Attributes
    ----------
    input
        The vector that is evaluated at, shape (n,); zeros at first.
    outputs
        The arrays that calls write to, one per output.
    """

    __slots__ = ("__weakref__", "_convert", "_kept", "_run", "_view", "input", "outputs")

    input: DoubleVector
    outputs: tuple[Array, ...]

    def __init__(
        self, shapes: tuple[OutputShape, ...], size: int, convert: Callable[[Any], DoubleVector]
    ) -> None:
        put = super().__setattr__
        put("input", np.zeros(size))
        put("outputs", tuple(np.zeros(shape) for shape in shapes))
        put("_view", self.input.data)
        put("_convert", convert)
        put("_kept", [])

    def __call__(self, x: Any = None, /) -> None:
        """Evaluate, and rewrite :attr:`outputs`.

        Parameters
        ----------
        x
            The input; what :attr:`input` holds if None. It is copied there.

        Raises
        ------
        ShapeError
            If ``x`` is no vector of n numbers.
        """
        if x is not None:
            try:
                self._view[:] = x if type(x) is np.ndarray else self._convert(x)  # type: ignore[call-overload]
            except (ValueError, TypeError):
                self.input[:] = self._convert(x)
        self._run()

    def _evaluate_by(self, run: BoundCall, keep: object) -> None:
        """Evaluate by something else from the next call on, in the same memory.

        Parameters
        ----------
        run
            What reads :attr:`input` and writes :attr:`outputs`.
        keep
            What has to live as long as ``run`` may be called.
        """
        # A call may be running in another thread: what it uses must stay.
        self._kept.append(keep)
        object.__setattr__(self, "_run", run)

    _kept: list[object]
    _run: BoundCall
    _view: memoryview
    _convert: Callable[[Any], DoubleVector]

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(
            f"Evaluators write in place; for the input, say evaluator.input[:] = x (not {name} = ...)."
        )

    def __repr__(self) -> str:
        outputs = ", ".join(str(o.shape) for o in self.outputs[:6]) + (
            ", ..." if len(self.outputs) > 6 else ""
        )
        return f"Evaluator({self.input.size} inputs -> {outputs})"
